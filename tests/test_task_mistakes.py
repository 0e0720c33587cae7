"""What is wrong with a task of one's own is told when the task is made, with the name that was meant."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import pytest

from gym_playbyear.check.report import check
from gym_playbyear.environment import TaskEnv
from gym_playbyear.registry import OptionError, make_definition
from gym_playbyear.sound.materials import WOOD, plate
from gym_playbyear.task import Task
from gym_playbyear.tasks.occluded import occluded_grasp
from gym_playbyear.tasks.tell_apart import PIECES, tell_apart
from gym_playbyear.terminations import Groped, Pressed, Shoved, Success, Termination


class Wrong(Termination):
    name = "wrong"

    def applies(self, env):
        return False


def made(make: Callable[..., Task] = tell_apart, **changes: Any) -> Callable[..., Task]:
    """A function of an author, who has changed something: what `gym_playbyear.tasks` names."""

    def factory(*, contents: str | None = None) -> Task:
        return replace(make() if make is occluded_grasp else make(contents=contents), **changes)

    return factory


def with_piece(**traits: Any) -> Callable[..., Task]:
    """The pouch with one piece changed."""
    *others, piece = tell_apart().props
    return made(props=(*others, replace(piece, **traits)))


@pytest.mark.parametrize(
    ("factory", "said"),
    [
        # Twins that name no option of the function or of the environment
        (made(twins=({"content": "screws"}, {"content": "peanuts"})), r"twins, option='content' .* mean 'contents'"),
        (made(twins=({}, {"hidden_objects": False})), r"twins, option='hidden_objects' .* mean 'hidden_object'"),
        (made(twins=({}, {"task": "x"})), r"twins, option='task' is not known"),
        # Things that are not there
        (with_piece(inside="pouhc"), rf"Prop '{PIECES[-1]}', inside='pouhc' .* mean 'pouch'\? There is .*piece0"),
        (with_piece(inside="drawer_lef"), r"inside='drawer_lef' is not known: There is piece0"),
        (made(force_proxy_of="puch"), r"force_proxy_of='puch' .* mean 'pouch'"),
        # Materials that are not there
        (with_piece(material="screw"), r"material='screw' .* mean 'screws'"),
        (with_piece(material="steel"), r"material='steel' is not known: .*There is bag, .*cardboard"),
        (with_piece(material=WOOD), r"material=Substance\(.* is not known: .*There is bag"),
        # Rules that are none
        (
            made(success=lambda env: True),
            r"success has <function .*not an instance of .*Success: write Success\(\.\.\.\)",
        ),
        (made(success=Success), r"success has <class .*write Success\(\.\.\.\)"),
        (
            made(occluded_grasp, terminations=(Groped(), Wrong)),
            r"terminations has <class .*Wrong.*write Wrong\(\.\.\.\)",
        ),
        (made(terminations=Wrong()), r"terminations=<.*Wrong object.* is not a tuple"),
        (made(terminations=(lambda env: False,)), r"terminations has <function .*write Termination\(\.\.\.\)"),
        (made(early_action=Pressed), r"early_action has <class .*Pressed"),
        (made(terminations=(Shoved("puch", 0.02),)), r"Shoved, prop='puch' .* mean 'pouch'"),
        (made(success=Success(bool, ("pouch", "wall"))), r"Success, prop=\('pouch', 'wall'\) is not known"),
        # Collections that are none
        (made(reset_options="contents"), r"reset_options='contents' is not a tuple"),
        (made(blind=(Wrong,)), r"blind=.* names no scripts: write \{\"name\": script\}"),
        (made(twins=("contents", "screws", "peanuts")), r"twins=.* are not two worlds"),
        (made(twins=({"contents": "screws"},)), r"twins=.* are not two worlds"),
    ],
)
def test_a_mistake_in_a_task_is_told_when_it_is_made(factory, said):
    with pytest.raises(ValueError, match=rf"^(TellApart|OccludedGrasp)-v1: .*{said}"):
        TaskEnv(factory, sound="none")


def test_a_task_of_a_partial_function_or_without_options_is_made():
    assert make_definition(partial(tell_apart, contents="screws"), {}).name == "TellApart-v1"
    own = replace(make_definition(occluded_grasp, {}), terminations=[Wrong()])
    assert make_definition(lambda: own, {}) is own


@pytest.mark.parametrize("twins", [({"contents": "screws"}, {}), ({}, {"sound": "sonar"}), ({}, {"horizon": 0})])
def test_twins_that_cannot_be_made_are_told_before_anyone_plays(twins, capsys):
    """What is no function any more has no options of its own, and a value may be wrong."""
    with pytest.raises(OptionError, match=r"contents='screws'|sound='sonar'|horizon=0"):
        check(made(twins=twins)(), 1, names=["leave"])
    assert "leave" not in capsys.readouterr().err


def test_a_limit_that_there_is_not_is_told_before_anyone_plays():
    with pytest.raises(ValueError, match=r"limits, limit='blnd' .* mean 'blind'"):
        check(made(limits={"blnd": 0.5})(), 1, names=["leave"])


def test_what_a_script_or_a_reset_names_wrongly_is_told():
    env = TaskEnv(made(), sound="none")
    env.reset_physics(seed=0)
    with pytest.raises(KeyError, match=r"'gripper-puch' is not a pair .* there is .*gripper-pouch"):
        env.contact_forces["gripper-puch"]
    with pytest.raises(ValueError, match=r"set_pose, prop='puch' .* mean 'pouch'"):
        env.set_pose("puch", (0.0, 0.0, 1.0))
    silent = TaskEnv(made(initialize_episode=lambda env, options: None), sound="none")
    with pytest.raises(ValueError, match=r"initialize_episode returned None: return what the camera shows"):
        silent.reset_physics(seed=0)


@pytest.mark.parametrize("modes", ["11,12", "11, 12", "1 1", "112", "10", "", ("11", "12"), 11.5])
def test_modes_of_a_plate_are_separated_by_spaces(modes):
    with pytest.raises(ValueError, match=r"modes=.* is not a mode\. Write two digits for each.*spaces.*'11 12 2b'"):
        plate(WOOD, (0.1, 0.1), 0.01, modes)
    assert len(plate(WOOD, (0.1, 0.1), 0.01, "11 12 2b")) == 3
