"""The check of a task: what deaf players see, twin environments, the table; and a control: the scripts are strong."""

import gc
import json
import types
from dataclasses import replace

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from support.shared import run_in_process

from gym_playbyear import ALL_TASKS, TASKS
from gym_playbyear.check.__main__ import main
from gym_playbyear.check.deaf import DeafTask
from gym_playbyear.check.occluded import JammingScript
from gym_playbyear.check.report import as_text, check, deaf_scripts, play, players
from gym_playbyear.check.twins import twin_test
from gym_playbyear.panda import SensorNoise
from gym_playbyear.registry import make_definition
from gym_playbyear.terminations import Pressed, Shoved, Success

GRASP, PICK_PLACE, POUCH, EASY, HARD = TASKS
EXACT = SensorNoise(0, 0, 0, 0, 0, 0, differentiated=False)


def without_terminations(name: str):
    """A cube task that nothing ends but success, at once, and time."""
    task = make_definition(name, {})
    return replace(task, terminations=(), success=Success(task.success.condition))


# The positive control: where the task's rules or its noise are missing, the same scripts and classifiers find it out


def test_without_its_terminations_tapping_and_jamming_solve_the_task():
    """Tapping in 30 of 30 episodes from seed 80000 on, with closed fingers as well."""
    report = check(without_terminations(GRASP), 6, first_seed=80000, names=["middle", "tap_fast", "jam"], twin=False)
    for name in ("tap_fast", "jam"):
        (solved,) = (row.successes for row in report.rows if row.name == name)
        assert solved > 0.6 * 6
        assert [fault for fault in report.broken if fault.startswith(f"{name} (deaf) solves")]


@pytest.mark.parametrize("left_out", [Shoved, Pressed])
def test_a_cube_that_one_finger_jams_against_a_rail_is_not_held(left_out):
    """Where it counted as held, 19 of 20 episodes from seed 80000 on were solved by jamming it, and pushing it on."""
    task = make_definition(GRASP, {})
    rules = tuple(rule for rule in task.terminations if not isinstance(rule, left_out))
    ends = {play(DeafTask(replace(task, terminations=rules)), JammingScript, seed) for seed in range(80000, 80003)}
    assert ends == {"pressed" if left_out is Shoved else "shoved"}


def test_without_sensor_noise_twin_worlds_are_told_apart():
    """An area of 0.98 with 12 episodes from seed 80000 on, 0.94 with 24."""
    result = twin_test(replace(make_definition(GRASP, {}), sensors=EXACT), range(80000, 80012), n_pictured=0)
    assert result.equal_until_touch
    assert result.auc.value > 0.9


# What deaf players may see


def reachable(root: object) -> list[object]:
    """Every object that can be reached from this one, but for code and what code has at hand anyway."""
    code = (type, types.ModuleType, types.FunctionType, types.BuiltinFunctionType, types.CodeType)
    seen: dict[int, object] = {}
    waiting = [root]
    while waiting:
        current = waiting.pop()
        if id(current) in seen or isinstance(current, code):
            continue
        seen[id(current)] = current
        waiting += gc.get_referents(current)
    return list(seen.values())


@pytest.mark.parametrize(("name", "script"), [(GRASP, "tap_fast"), (GRASP, "nudge"), (HARD, "feel")])
def test_no_script_can_reach_what_is_behind_the_scenes(name, script):
    task = DeafTask(name)
    scripts = deaf_scripts(task)
    view = task.begin(0)
    script = scripts[script](task.facts, np.random.default_rng(0))
    for _ in range(8):
        view, _, _ = task.advance(script.act(view))
    behind = (gym.Env, DeafTask, mujoco.MjData, mujoco.MjModel)
    assert not [found for found in reachable([script, view, task.facts]) if isinstance(found, behind)]
    assert any(isinstance(found, mujoco.MjData) for found in reachable(task)), "the search itself finds what there is"


def test_a_deaf_view_is_what_the_policy_observes():
    exact = replace(make_definition(PICK_PLACE, {}), sensors=EXACT)  # both draw the noise of their own
    task = DeafTask(exact, image_size=8)
    view = task.begin(3)
    env = DeafTask(exact, image_size=8).env
    observation, _ = env.reset(seed=3)
    rng = np.random.default_rng(0)
    for _ in range(8):
        np.testing.assert_array_equal(view.agent_pos, observation["agent_pos"])
        action = rng.uniform(-0.3, 0.3, 4)
        observation, (view, _, _) = env.step(action)[0], task.advance(action)
    np.testing.assert_array_equal(view.shown["bin_position"], env.position("bin"))
    env.close()


def test_a_script_that_knows_how_deep_the_keys_lie_takes_them_out():
    task = DeafTask(EASY)
    maker = deaf_scripts(task)["feel"]

    def told(facts, rng):
        script = maker(facts, rng)
        script.bottom = (0.058, 0.062)
        return script

    assert [play(task, told, seed, bottom=0.06) for seed in range(4)].count("success") >= 2


# Twin environments


@pytest.mark.parametrize(
    ("task", "n_episodes"),
    [(GRASP, 7), pytest.param(PICK_PLACE, 7, marks=pytest.mark.slow), pytest.param(HARD, 9, marks=pytest.mark.slow)],
)
def test_twins_are_the_same_until_the_touch_and_hard_to_tell_apart_after_it(task, n_episodes):
    result = twin_test(task, range(60000, 60000 + n_episodes), n_pictured=1)
    assert result.can_be_touched
    assert result.n_episodes >= 6
    assert result.equal_until_touch, result.first_difference
    assert result.auc.value <= 0.6


@pytest.mark.slow
def test_twin_pouches_are_the_same_to_the_end():
    result = twin_test(POUCH, range(60000, 60004), n_pictured=1)
    assert not result.can_be_touched
    assert result.equal_until_touch, result.first_difference
    assert result.pictures_after_touch == 0
    assert result.auc.value == 0.5


def with_screws_in_every_pouch(env):
    """By their sound."""
    env.materials |= dict.fromkeys(env.materials, "screws")


def with_a_red_seam(env):
    """If screws are in the pouch."""
    env.model.geom_rgba[env.model.body("pouch").geomadr + 6] = (1, env.secrets["contents"] == "peanuts", 0, 1)


def with_a_label(env):
    return {"label": float(env.secrets["contents"] == "screws")}


LIFTED = {"horizon": 20}


@pytest.mark.parametrize(
    ("change", "options", "fault"),
    [
        pytest.param(None, LIFTED, None, marks=pytest.mark.slow),
        (with_screws_in_every_pouch, LIFTED, "sound alike: by sound a classifier's area is 0.50, at least 0.80"),
        pytest.param(
            None, LIFTED | {"sound": "none"}, "alike: by sound a classifier's area is 0.50", marks=pytest.mark.slow
        ),
        pytest.param(  # drowned
            None, LIFTED | {"noise_level": 1e4}, "alike: by sound a classifier's area is 0.", marks=pytest.mark.slow
        ),
        pytest.param(  # nobody has lifted the pouch
            None, {"horizon": 12}, "alike: by sound a classifier's area is 0.50", marks=pytest.mark.slow
        ),
        (with_a_red_seam, {"horizon": 12}, "differ before the touch: seed 80000, step 0: pixels.front"),
        pytest.param(
            *(with_a_label, {"horizon": 12}, "differ before the touch: seed 80000, step 0: agent_pos, or numbers of"),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_task_that_no_ear_or_every_eye_can_solve_is_refused(monkeypatch, change, options, fault):
    """Its expert, which knows what is hidden, solves it all the same."""

    def of_an_author(*, contents=None):
        task = make_definition(POUCH, {"contents": contents})

        def initialize(env, given):
            shown = task.initialize_episode(env, given)
            return shown | ((change and change(env)) or {})

        return replace(task, initialize_episode=initialize)

    monkeypatch.setitem(ALL_TASKS._own, "Own-v1", of_an_author)
    report = check("Own-v1", 4, names=["leave"], options=options)
    faults = [found for found in report.broken if found.startswith("twin environments")]
    assert (fault is None and not faults) or any(fault in found for found in faults), faults
    assert f"a classifier that hears: area {report.twin.heard.value:.3f}" in as_text(report)


def test_twins_that_differ_are_found_out(monkeypatch):
    """Peanuts that move otherwise than screws: the arm's measurements tell."""
    begin = DeafTask.begin

    def lighter(self, seed, **options):
        view = begin(self, seed, **options)
        if self.env.secrets["contents"] == "peanuts":
            self.env.data.qvel[-6:] += 0.3
        return view

    monkeypatch.setattr(DeafTask, "begin", lighter)
    assert not twin_test(POUCH, range(60000, 60004), n_pictured=0, horizon=15).equal_until_touch


# The check


def test_the_check_holds_a_good_task_to_be_good_and_judges_a_learner():
    learned = [{"name": "rl", "hears": False, "successes": 1, "n_episodes": 10}]
    report = check(GRASP, 4, first_seed=1000, names=["expert"], learned=learned, twin=True)
    assert report.broken == []
    assert ("rl", "learned, deaf") in [(row.name, row.kind) for row in report.rows]
    assert "all limits hold" in as_text(report)
    assert "every observation but sound is the same" in as_text(report)


def test_the_check_says_who_breaks_a_limit_and_its_exit_status_is_1(tmp_path, capsys):
    """Without the time to grasp the expert fails."""
    options = [GRASP, "--episodes=2", "--seed=1000", "--no-twin", "--players", "expert", "tap_fast", "--horizon=20"]
    assert run_in_process(main, *options, f"--output={tmp_path / 'deep' / 'check.json'}") == 1
    assert "broken: expert (expert) solves 0 %, at least 95 % was promised" in capsys.readouterr().out
    rows = json.loads((tmp_path / "deep" / "check.json").read_text())["rows"]
    assert [(row["name"], row["kind"]) for row in rows] == [("expert", "expert"), ("tap_fast", "deaf")]


@pytest.mark.slow
@pytest.mark.parametrize("task", [GRASP, PICK_PLACE])
def test_the_expert_succeeds_and_the_blind_fail_over_100_seeds(task):
    names = [name for name, kind in players(DeafTask(task)).items() if kind != "deaf"]
    assert check(task, 100, first_seed=1000, names=names, twin=False, jobs=2).broken == []


def test_twins_that_are_the_same_world_prove_nothing():
    task = make_definition(GRASP, {})
    forgotten = replace(task, props=tuple(replace(prop, hidden=False) for prop in task.props))
    report = check(forgotten, 1, first_seed=1000, names=["middle"])
    assert report.twin is None
    assert [fault for fault in report.broken if "hides nothing" in fault]


def test_too_few_touches_are_told_after_who_played():
    report = check(GRASP, 2, first_seed=60000, names=["middle"], options={"horizon": 5})
    assert [row.name for row in report.rows] == ["middle"]
    assert [fault for fault in report.broken if "in 0 of 2 episodes" in fault]


def test_a_check_that_was_stopped_goes_on_with_the_next_player_and_says_so(tmp_path, capsys):
    file = tmp_path / "check.partial"
    settings = {"first_seed": 1000, "twin": False, "progress": file}
    check(GRASP, 1, names=["middle"], **settings)
    assert "check.partial" not in capsys.readouterr().err
    kept = json.loads(file.read_text())
    kept["played"]["middle"][0] = "as it was kept"
    file.write_text(json.dumps(kept))
    both = check(GRASP, 1, names=["middle", "push"], **settings)
    assert [row.ends for row in both.rows] == [{"as it was kept": 1}, {"shoved": 1}]
    assert "check.partial has middle of a check that was stopped" in capsys.readouterr().err
    other = check(GRASP, 2, names=["middle"], **settings)
    assert "as it was kept" not in other.rows[0].ends


@pytest.mark.slow
def test_processes_side_by_side_find_what_one_finds():
    options = {"first_seed": 1000, "names": ["middle", "nudge"], "twin": True}
    assert check(GRASP, 6, jobs=2, **options) == check(GRASP, 6, **options)
