"""The methods behind `--method.type`: who acts, what is recorded, what is kept, and that each resumes exactly."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from dagger_factory import QUICK, Quick, column, corrections, dagger, metrics
from test_dagger import Scripted, scene
from test_dagger_resume import assert_a_power_cut_changes_nothing

from lerobot_env_playbyear import PlaybyearEnvConfig
from lerobot_playbyear.dagger.attempt import Scene
from lerobot_playbyear.dagger.config import CONFIG_NAME, DaggerConfig, DatasetSource, with_saved_options
from lerobot_playbyear.dagger.methods import gate_model, redo
from lerobot_playbyear.dagger.methods.beside import Early, Labelling, Late, Redoing, Staying, shifted
from lerobot_playbyear.dagger.methods.human_gated import NoHandbackConfig
from lerobot_playbyear.dagger.methods.weighted import WeightedConfig
from lerobot_playbyear.dagger.same_run import differences
from lerobot_playbyear.datasets.errors import PlaybyearError
from lerobot_playbyear.episodes.environment import env_spec
from lerobot_playbyear.episodes.episode import Verdict
from lerobot_playbyear.episodes.play import Seconds, play
from lerobot_playbyear.episodes.scripted_expert import ScriptedExpertConfig
from lerobot_playbyear.training.parts import TrainingParts

pytestmark = pytest.mark.usefixtures("one_thread")

RUN = (*QUICK, "--episodes=2", "--warmup_episodes=1")


class Telling(Scripted):
    """Remembers what others decided for it."""

    def reset(self, env):
        super().reset(env)
        self.told = []

    def take_over(self, until_told=True):
        self.told.append((self.n, until_told))

    def hand_back(self):
        self.told.append((self.n, None))


def flags(expert):
    env, actor, _ = scene()
    episode = play(env, actor, seed=5, expert=expert)
    env.close()
    return np.flatnonzero(episode.interventions).tolist(), episode


def test_an_expert_that_stays_acts_from_its_first_takeover_to_the_end():
    expert = Telling(steps=(4, 5, 9))
    steps, episode = flags(Staying(expert))
    assert steps == list(range(4, len(episode)))
    assert expert.told == [(4, True)]


@pytest.mark.parametrize("decides", [False, True])
def test_a_person_who_stays_is_not_asked_to_act_in_the_step_that_they_ended(decides):
    expert = Telling(steps=(4, 5), verdicts={7: Verdict.FAILURE})  # as where a leader no longer answers
    expert.decides = decides
    steps, episode = flags(Staying(expert))
    assert (len(episode), episode.verdict) == (8, Verdict.FAILURE)
    assert steps == ([4, 5, 6] if decides else [4, 5, 6, 7])  # a script has an action for it


def test_a_late_expert_begins_later_from_where_the_hand_is_then():
    expert = Telling(steps=(3, 10, 11, 12, 13, 14))
    steps, _ = flags(Late(expert, 2))
    assert steps == [12, 13, 14]  # by the third step it did not want to any more
    assert expert.told == [(12, False)]


def test_an_early_expert_begins_before_its_first_takeover_and_not_before_its_second():
    env, actor, _ = scene()
    expert = Telling(steps=(10, 11, 30))
    early = Early(expert, 4, env)
    episode = Scene(env, actor, early, early).attempt(5, 0, Seconds())
    env.close()
    assert np.flatnonzero(episode.interventions).tolist() == [6, 7, 8, 9, 10, 11, 30]
    assert expert.told == [(6, False)]
    assert len(episode) > 31


def test_a_rehearsal_changes_nothing_where_nobody_would_take_over():
    env, actor, expert = scene()
    early = Early(expert, 4, env)
    rehearsed = Scene(env, actor, early, early).attempt(5, 0, Seconds())
    plain = play(env, actor, 5, expert=expert)
    env.close()
    np.testing.assert_array_equal(rehearsed.actions, plain.actions)
    assert not rehearsed.interventions.any()


def test_labels_are_the_experts_and_the_policy_acts():
    expert = Scripted(steps=range(100))
    labelling = Labelling(expert)
    steps, episode = flags(labelling)
    assert steps == []
    assert len(labelling.labels) == len(episode)
    for step, action in expert.actions.items():
        np.testing.assert_array_equal(labelling.labels[step], np.clip(action, -1, 1))
    assert not np.allclose(np.stack(labelling.labels), episode.actions)


def test_an_expert_that_redoes_ends_a_try_and_acts_from_the_first_step_in_a_demonstration():
    expert = Telling(steps=(4, 5))
    redoing = Redoing(expert)
    _, tried = flags(redoing)
    assert (len(tried), tried.verdict, redoing.was_needed, expert.told) == (5, Verdict.DISCARD, True, [])
    redoing.demonstrates = True
    steps, shown = flags(redoing)
    assert steps == list(range(len(shown)))
    assert len(shown) > 5
    assert (shown.verdict, redoing.was_needed, expert.told) == (None, True, [(-1, True)])
    redoing.demonstrates, expert.steps = False, ()
    steps, tried = flags(redoing)
    assert (steps, tried.verdict, redoing.was_needed) == ([], None, False)
    expert.steps, expert.verdicts = (4,), {4: Verdict.DISCARD}  # a person throws the attempt away while taking over
    assert flags(redoing)[1].verdict is Verdict.DISCARD
    assert not redoing.was_needed


@pytest.mark.parametrize("is_person", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_tasks_script_acts_from_the_first_step_if_it_is_told_to(is_person):
    env, actor, _ = scene(n_steps=None)
    redoing = Redoing(ScriptedExpertConfig(person=is_person).make(env))
    redoing.demonstrates = True
    episode = play(env, actor, seed=5, expert=redoing)
    env.close()
    assert episode.interventions.all()
    assert episode.success or is_person  # its hand trembles


def test_where_no_gate_is_the_script_shows_what_the_policy_failed_in():
    env = env_spec(PlaybyearEnvConfig(task="TellApart-v1")).make()
    expert = ScriptedExpertConfig().make(env)
    redoing = Redoing(expert)
    still = SimpleNamespace(reset=lambda env: None, act=lambda observation: np.zeros(4, np.float32))
    tried = play(env, still, seed=5, expert=redoing)
    assert (tried.success, tried.interventions.any(), redoing.was_needed) == (False, False, False)
    redoing.demonstrates = True
    shown = play(env, still, seed=5, expert=redoing)
    env.close()
    assert (shown.success, shown.interventions.all(), expert.judges) == (True, True, False)
    with pytest.raises(AttributeError, match=r"TellApart-v1 has no intervention gate"):
        env.unwrapped.intervention_gate()


@pytest.mark.slow
def test_redo_learns_of_attempts_of_another_method_only_what_the_expert_chose(tmp_path, monkeypatch):
    dagger(tmp_path, *RUN)
    given = []
    monkeypatch.setattr(
        redo.Redo, "learned", lambda *args, real=redo.Redo.learned: given.append(real(*args)) or given[-1]
    )
    options = ("--method.type=redo", "--episodes=0", "--updates=1", f"--interventions.root={tmp_path / 'corrections'}")
    dagger(tmp_path / "other", *options, env=())
    assert given[-1].weights.tolist() == column(corrections(tmp_path), "intervention").ravel().tolist()
    assert given[-1].weights.sum() == 6


# Runs


def test_dagger_records_labels_as_actions_and_what_was_done_beside_them(tmp_path):
    dagger(tmp_path, *RUN, "--method.type=dagger", "--episode_seed=9999")
    data, attempts = corrections(tmp_path), metrics(tmp_path, "attempt")
    assert column(data, "intervention").all()
    np.testing.assert_allclose(column(data, "action"), np.tile([0.2, 0.1, -0.2, -1.0], (data.num_frames, 1)))
    assert not np.allclose(column(data, "executed_action"), column(data, "action"))
    assert [line["outcome"] for line in attempts] == ["kept", "kept"]
    assert [line["success"] for line in attempts] == [False, True]  # Quick ends seeds that 3 divides as failures
    assert [(line["autonomy"], line["n_takeovers"]) for line in attempts] == [(1.0, 0)] * 2
    assert [line["n_expert_steps"] for line in attempts] == [line["n_frames"] for line in attempts] == [8, 8]
    assert metrics(tmp_path, "round")[-1]["expert_steps"] == data.num_frames


def test_without_a_hand_back_an_attempt_ends_with_its_correction(tmp_path):
    dagger(tmp_path, *RUN, "--method.type=no_handback")
    marks = column(corrections(tmp_path), "intervention").reshape(2, 8)
    assert marks.tolist() == [[False, False, *[True] * 6]] * 2
    assert [line["takeover_steps"] for line in metrics(tmp_path, "attempt") if line["outcome"] == "kept"] == [[6], [6]]


def test_the_expert_shows_the_scenes_that_the_policy_fails_in(tmp_path, capfd):
    run = (*RUN, "--method.type=redo")
    dagger(tmp_path / "calm", *run)
    assert "context switches, autonomy 27%" in capfd.readouterr().out  # 3 steps of a try, 8 of a demonstration
    data, attempts = corrections(tmp_path / "calm"), metrics(tmp_path / "calm", "attempt")
    assert column(data, "intervention").all()
    np.testing.assert_allclose(column(data, "action"), np.tile([0.2, 0.1, -0.2, -1.0], (data.num_frames, 1)))
    assert [line["outcome"] for line in attempts] == ["kept", "kept"]
    cost = {"n_expert_steps": 8, "n_tried_steps": 3, "n_takeovers": 1, "n_switches": 1, "person_seconds": 0.55}
    assert all({key: line[key] for key in cost} == cost for line in attempts)
    assert_a_power_cut_changes_nothing(tmp_path / "killed", tmp_path / "calm", run, after=3)


def test_what_a_policy_solves_alone_is_not_shown_and_what_it_fails_at_unseen_is(tmp_path, monkeypatch):
    monkeypatch.setattr(Quick, "wants_control", lambda self, *_: setattr(self, "n", self.n + 1) is not None)
    dagger(tmp_path, *QUICK, "--method.type=redo", "--episodes=1", "--max_attempts=1", "--episode_seed=10000")
    (attempt,) = metrics(tmp_path, "attempt")  # seeds that 3 does not divide end as successes
    assert (attempt["outcome"], attempt["n_expert_steps"], attempt["autonomy"]) == ("unneeded", 0, 1.0)
    assert "n_tried_steps" not in attempt
    options = ("--episodes=1", "--max_attempts=1", "--episode_seed=9999", f"--output_dir={tmp_path / 'b/out'}")
    with pytest.raises(PlaybyearError, match="1 of 1 attempts in a row failed"):
        dagger(tmp_path, *QUICK, "--method.type=redo", *options)
    (attempt,) = metrics(tmp_path / "b", "attempt")
    assert (attempt["outcome"], attempt["n_expert_steps"], attempt["n_tried_steps"]) == ("failed", 8, 8)


@pytest.mark.parametrize(
    "options",
    [
        ("--method.type=weighted", "--method.before_s=0.1"),
        pytest.param(("--method.type=weighted", "--method.paper=iwr"), marks=pytest.mark.slow),
        pytest.param(("--learn_from=all", "--takeover_delay_s=-0.1"), marks=pytest.mark.slow),
    ],
    ids=["sirius", "iwr", "all, early"],
)
def test_other_frames_are_learned_from(tmp_path, options, capfd):
    dagger(tmp_path, *RUN, *options)
    assert "left out (--skip_s)" not in capfd.readouterr().out
    rounds = metrics(tmp_path, "round")
    assert [line["step"] for line in rounds] == [2, 4]
    assert all(line["loss_interventions"] > 0 < line["loss_demonstrations"] for line in rounds)


def test_a_run_skips_the_beginning_of_corrections(tmp_path, capfd):
    losses = {}
    for options in ((), ("--skip_s=0.1",), ("--skip_s=0",)):  # corrections of 3 frames, a memory of 2
        folder = tmp_path / str(len(losses))
        dagger(folder, *RUN, *options)
        losses[options] = [line["loss_interventions"] for line in metrics(folder, "round")]
        said = capfd.readouterr()
        assert "No correction is longer" not in said.err
        n = 6 if options == ("--skip_s=0",) else 2  # of two attempts
        assert f"Corrections: {n} of 6 frames that the expert chose are learned from" in said.out
        assert ("the first 0.1 s of every correction are left out" in said.out) is (n == 2)
    by_default, memory, nothing = losses.values()
    assert by_default == memory != nothing
    dagger(tmp_path / "long", *RUN, "--skip_s=60")
    assert "No correction is longer than the 1200 frames" in capfd.readouterr().err


def test_figures_of_the_field_stand_in_every_line(tmp_path, capfd):
    dagger(tmp_path, *RUN, "--eval_every=1", "--eval.n_episodes=1", "--eval.batch_size=1")
    kept = next(line for line in metrics(tmp_path, "attempt") if line["outcome"] == "kept")
    cost = {"n_expert_steps": 3, "n_takeovers": 1, "takeover_steps": [3], "n_switches": 2, "person_seconds": 0.4}
    assert {key: kept[key] for key in cost} == cost
    n_attempts = len(metrics(tmp_path, "attempt"))
    last = metrics(tmp_path, "round")[-1]
    assert (last["expert_steps"], last["takeovers"], last["switches"]) == (3 * n_attempts, n_attempts, 2 * n_attempts)
    assert last["autonomy"] == pytest.approx(5 / 8)
    evaluations = metrics(tmp_path, "eval")
    assert evaluations[0]["expert_steps"] == 0
    assert evaluations[-1]["expert_steps"] == last["expert_steps"]
    assert f"Expert:      {last['expert_steps']} steps in {n_attempts} takeovers" in capfd.readouterr().out


GATED = (
    "--method.type=robot_gated",
    "--method.rollouts=2",
    "--method.gate_updates=5",
    "--method.intervention_share=0.4",
    "--method.hands_back=true",
)


@pytest.mark.slow
def test_a_robot_that_asks_resumes_exactly(tmp_path):
    """Killed before it learned from its second round's attempts, after an attempt that is no correction was saved."""
    run = (*QUICK, *GATED, "--episodes=3", "--warmup_episodes=1")
    dagger(tmp_path / "calm", *run)
    attempts = metrics(tmp_path / "calm", "attempt")
    assert all(line["n_calls"] == 0 for line in attempts[:2])
    assert any(line["n_calls"] > 0 for line in attempts[2:])
    assert all(line["n_asked_steps"] == line["n_expert_steps"] for line in attempts)
    others = [line["seed"] for line in attempts if line["outcome"] in ("failed", "unneeded")]
    assert others
    n_commits = len(attempts) + 2
    for after in (2, 4, n_commits):
        assert_a_power_cut_changes_nothing(tmp_path / f"killed{after}", tmp_path / "calm", run, after)


def succeeds_from_the_first_step_on(expert, until_told=True):
    expert.is_success |= expert.n == 0


@pytest.mark.parametrize("kills", [(), pytest.param((1, 2, 3, 4, 5), marks=pytest.mark.slow)])
def test_what_fails_although_the_robot_may_ask_is_shown_from_its_first_step(tmp_path, monkeypatch, kills):
    """Of two attempts that the policy makes alone one fails, and is made good; a run that is killed on the way ends alike."""
    monkeypatch.setattr(Quick, "take_over", succeeds_from_the_first_step_on)
    run = (*QUICK, *GATED, "--method.redo_failed=true", "--episodes=2", "--warmup_episodes=1", "--episode_seed=9998")
    dagger(tmp_path / "calm", *run)
    attempts = metrics(tmp_path / "calm", "attempt")
    assert [line["outcome"] for line in attempts[:3]] == ["unneeded", "failed", "kept"]
    assert [line["seed"] for line in attempts[:3]] == [9998, 9999, 9999]
    cost = {
        "n_expert_steps": 8,
        "n_takeovers": 1,
        "n_switches": 1,
        "autonomy": 0.0,
        "person_seconds": 0.4,
        "n_calls": 0,
    }
    assert {key: attempts[2][key] for key in cost} == cost
    assert attempts[3]["seed"] == 10000
    marks = column(corrections(tmp_path / "calm"), "intervention")
    assert marks[:8].all()
    assert not attempts[0]["n_asked_steps"]
    for after in kills:
        assert_a_power_cut_changes_nothing(tmp_path / f"killed{after}", tmp_path / "calm", run, after)


def test_what_the_expert_fails_at_too_is_left(tmp_path):
    options = ("--method.redo_failed=true", "--method.rollouts=3", "--episodes=1", "--episode_seed=9999")
    dagger(tmp_path, *QUICK, *GATED, *options, "--max_attempts=30")
    attempts = metrics(tmp_path, "attempt")
    shown = [line["seed"] for line in attempts if line["autonomy"] == 0 and line["n_calls"] == 0]
    assert shown[0] == 9999
    assert [line["seed"] for line in attempts[:4]] == [9999, 9999, 10000, 10001]
    assert not any(line["n_asked_steps"] for line in attempts[:4])  # three of them count as first attempts


def test_a_run_does_not_end_before_the_scene_that_it_failed_in_is_shown(tmp_path, monkeypatch):
    monkeypatch.setattr(Quick, "take_over", succeeds_from_the_first_step_on)
    options = ("--method.rollouts=1", "--episodes=1", "--episode_seed=9999")  # by default
    dagger(tmp_path, *QUICK, *GATED[:1], *options, "--max_attempts=1")
    assert [line["outcome"] for line in metrics(tmp_path, "attempt")] == ["failed", "kept"]


@pytest.mark.slow
def test_a_robot_that_asks_at_once_and_fails_is_no_demonstration(tmp_path, monkeypatch):
    seen, learn = [], gate_model.GateModel.__init__

    def look(self, played, *args):
        seen.append({each.seed: (each.is_visited, each.success) for each in played})
        learn(self, played, *args)

    monkeypatch.setattr(gate_model.GateModel, "__init__", look)
    monkeypatch.setattr(gate_model.Asking, "asks", lambda *_: True)
    options = ("--method.rollouts=1", "--episodes=3", "--episode_seed=9998", "--warmup_episodes=1")
    dagger(tmp_path, *QUICK, *GATED, *options)
    failed = [line["seed"] for line in metrics(tmp_path, "attempt") if line["outcome"] == "failed"]
    learned = [seen[-1][seed] for seed in failed if seed in seen[-1]]  # one of the last round is learned from later
    assert learned
    assert set(learned) == {(True, False)}


@pytest.mark.slow
def test_a_robot_asks_once_its_first_attempts_are_made(tmp_path):
    dagger(tmp_path, *QUICK, *GATED, "--episodes=1", "--max_attempts=30")
    attempts = metrics(tmp_path, "attempt")
    assert [line["n_asked_steps"] for line in attempts[:2]] == [0, 0]
    assert attempts[-1]["outcome"] == "kept"
    assert attempts[-1]["n_expert_steps"] == attempts[-1]["n_asked_steps"] > 0
    assert attempts[-1]["person_seconds"] == pytest.approx(attempts[-1]["n_expert_steps"] / 20)
    assert (tmp_path / "out/attempts/meta/info.json").is_file()


@pytest.mark.slow
def test_attempts_in_which_nobody_could_be_asked_do_not_end_a_run(tmp_path):
    dagger(tmp_path, *QUICK, *GATED, "--method.rollouts=4", "--episodes=1", "--max_attempts=4", "--episode_seed=12000")
    attempts = metrics(tmp_path, "attempt")
    assert len(attempts) > 4
    assert attempts[-1]["outcome"] == "kept"


@pytest.mark.slow
def test_a_robot_that_does_not_go_on_by_itself_leaves_the_rest_to_the_expert(tmp_path):
    by_default = [option for option in GATED if "hands_back" not in option]
    dagger(tmp_path, *QUICK, *by_default, "--episodes=2", "--max_attempts=30")
    asked = [line for line in metrics(tmp_path, "attempt") if line["n_calls"]]
    assert asked
    assert all(line["n_calls"] == 1 >= line["n_switches"] for line in asked)  # none where it asks at once
    marks = column(corrections(tmp_path), "intervention").reshape(2, -1)
    assert all((np.diff(marks.astype(int), axis=1) >= 0).ravel())
    assert marks[:, -1].all()


@pytest.mark.slow
def test_new_weights_forget_the_policy_and_keep_its_normalisation(tmp_path, monkeypatch):
    dagger(tmp_path, *RUN)
    seen, update = [], TrainingParts.update

    def look(parts, *args):
        seen.append({key: value.clone() for key, value in parts.policy.state_dict().items()})
        return update(parts, *args)

    monkeypatch.setattr(TrainingParts, "update", look)
    offline = ("--episodes=0", "--updates=1", f"--interventions.root={tmp_path / 'corrections'}")
    for name, options in (("old", ()), ("new", ("--new_weights=true",)), ("again", ("--new_weights=true",))):
        dagger(tmp_path, *offline, *options, f"--output_dir={tmp_path / name}", env=())
    old, new, again = seen
    differ = {key for key in old if not np.array_equal(old[key], new[key])}
    assert any("lstm" in key for key in differ)
    assert not any("spectrogram" in key for key in differ)
    assert all(np.array_equal(new[key], again[key]) for key in new)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--learn_from=everything",), "--learn_from='everything': give expert or all"),
        (("--method.type=weighted", "--learn_from=all"), "--method.type=weighted says by itself what is learned from"),
        (("--method.type=dagger", "--takeover_delay_s=1"), "--method.type=dagger the expert does not decide when"),
        (("--method.type=redo", "--skip_s=1"), "--method.type=redo the expert chooses every frame"),
        (("--method.type=redo", "--takeover_delay_s=1"), "--method.type=redo a takeover only ends the policy's try"),
        (("--method.type=redo", "--learn_from=all"), "--method.type=redo says by itself what is learned from"),
        (("--method.type=robot_gated", "--method.intervention_share=1.5"), "intervention_share=1.5: give a share"),
        (("--skip_s=-1",), "--skip_s=-1.0: give 0 or more seconds"),
        (("--takeover_delay_s=0.02",), "--takeover_delay_s=0.02: that is less than half a step at 20 steps per second"),
        (
            ("--takeover_delay_s=-0.5", "--expert.type=scripted", "--expert.person=true"),
            "--takeover_delay_s below 0 plays every attempt twice",
        ),
        (("--skip_s=1", "--learn_from=all"), "--skip_s=1.0 and --learn_from=all"),
        (
            ("--skip_s=1", "--method.type=dagger"),
            "--skip_s=1.0: with --method.type=dagger the expert chooses every frame",
        ),
        (("--new_weights=true",), "--new_weights=true: a policy that knows nothing cannot be corrected"),
        (
            ("--expert.type=scripted", "--expert.person=true", "--expert.tremor=-1"),
            "--expert.tremor=-1.*give 0 or more",
        ),
    ],
)
def test_options_that_do_not_go_together(tmp_path, options, message):
    with pytest.raises(PlaybyearError, match=message):
        dagger(tmp_path, *RUN, *options)
    assert not (tmp_path / "out").exists()


def test_a_person_is_not_held_back():
    env, person = SimpleNamespace(unwrapped=None), SimpleNamespace(decides=True, can_label=False, clock_fps=20)
    with pytest.raises(
        PlaybyearError, match=r"--takeover_delay_s=0.5: a person who takes over has the control at once"
    ):
        shifted(person, 0.5, 20, env)
    assert isinstance(shifted(SimpleNamespace(decides=True, can_label=True, clock_fps=20), 0.5, 20, env), Late)


def test_a_run_goes_on_with_its_own_method_alone(tmp_path):
    def config(**options):
        return DaggerConfig(DatasetSource("a/demos"), DatasetSource("a/corrections"), **options)

    saved = config(method=NoHandbackConfig(), learn_from="all").options()
    (tmp_path / CONFIG_NAME).write_text(json.dumps(saved))
    assert differences(tmp_path, config(method=NoHandbackConfig(), learn_from="all")) == []
    assert differences(tmp_path, config(takeover_delay_s=0.5)) == [
        "--method was {'type': 'no_handback'} and is {'type': 'hg_dagger'}",
        "--takeover_delay_s was 0.0 and is 0.5",
        "--learn_from was all and is expert",
    ]


def test_a_run_of_a_version_without_methods_was_hg_dagger(tmp_path):
    source = DatasetSource("a/b")
    saved = DaggerConfig(source, source).options()
    for name in ("method", "takeover_delay_s", "learn_from", "new_weights", "skip_s"):
        del saved[name]
    saved["expert"] = {"type": "scripted"}
    (tmp_path / CONFIG_NAME).write_text(json.dumps(saved))
    assert with_saved_options(["--resume=true", f"--output_dir={tmp_path}"])[1] == "--skip_s=0"
    assert differences(tmp_path, DaggerConfig(source, source, skip_s=0.0)) == []
    assert differences(tmp_path, DaggerConfig(source, source)) == ["--skip_s was 0.0 and is None"]
    (changed,) = differences(tmp_path, DaggerConfig(source, source, skip_s=0.0, method=WeightedConfig()))
    assert changed.startswith("--method was {'type': 'hg_dagger'} and is {'type': 'weighted', 'paper': 'sirius'")


@pytest.mark.slow
def test_a_dataset_of_labels_is_no_place_for_corrections(tmp_path):
    dagger(tmp_path, *RUN, "--method.type=dagger", "--episodes=1")
    with pytest.raises(PlaybyearError, match="executed_action"):
        dagger(tmp_path, *RUN, f"--output_dir={tmp_path / 'other'}")
