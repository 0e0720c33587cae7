"""What `playbyear-dagger` refuses, each with one clear error and before any work; and datasets that others wrote."""

import json
import shutil
import sys

import numpy as np
import pytest
from dagger_factory import QUICK, arguments, base_folder, command, dagger, metrics
from dataset_factory import dataset_features, make_dataset, random_frame
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets import LeRobotDataset

from lerobot_env_playbyear import PlaybyearEnvConfig
from lerobot_playbyear.dagger import DaggerConfig, attempt
from lerobot_playbyear.dagger.checks import check_places
from lerobot_playbyear.dagger.config import DaggerEvalConfig, DatasetSource, with_saved_options
from lerobot_playbyear.dagger.folder import RunFolder
from lerobot_playbyear.datasets.errors import PlaybyearError
from lerobot_playbyear.episodes import frames, saving
from lerobot_playbyear.recording.record import RecordConfig, RecordDatasetConfig, record
from lerobot_playbyear.scripts.commands import dagger as dagger_script

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize(
    ("features", "message"),
    [
        ({"fps": 10}, "has 10 frames per second, and the policy is configured for 20"),
        ({"sample_rate": 48000}, r"recorded at 48000 Hz in the dataset 'tests/demos'.*trained with 16000 Hz"),
        ({"state_size": 6}, r"'observation.state' has shape \(6,\).*trained with \(7,\)"),
        ({"action_size": 5}, r"'action' has shape \(5,\).*trained with \(4,\)"),
        ({"microphones": ()}, r"lacks \['observation.audio.gripper'\]"),
        ({"image_size": 24}, r"'observation.images.front' has shape \(24, 24, 3\)"),
    ],
    ids=["fps", "sample rate", "state", "action", "no microphone", "camera"],
)
def test_demonstrations_that_the_policy_was_not_made_for(features, message, tmp_path):
    features = {"image_size": 16, **features}
    fps = features.get("fps", 20)
    make_dataset(tmp_path / "demos", (5,), fps, features=dataset_features(**features))
    with pytest.raises(PlaybyearError, match=message):
        dagger(tmp_path, *QUICK, f"--demos.root={tmp_path / 'demos'}")
    assert not (tmp_path / "out").exists()
    assert not (tmp_path / "corrections").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            ("--env.sample_rate=8000",),
            r"differ: 'observation.audio.gripper' is int16 \(800,\) at 16000 Hz there and int16",
        ),
        (
            ("--env.image_size=20",),
            r"differ: 'observation.images.front' is picture \(16, 16, 3\) there and picture \(20",
        ),
        (("--env.sound=none",), "'observation.audio.gripper' is int16 .* there and absent here"),
        (("--env.microphones=[ceiling]",), "does not start.*ceiling"),
        (("--policy.push_to_hub=true",), "--policy.push_to_hub=true needs a name: give --policy.repo_id"),
        (("--policy.push_to_hub=true", "--policy.repo_id=me/no name"), "policy.repo_id='me/no name' cannot be pushed"),
    ],
)
def test_options_that_do_not_go_together(options, message, tmp_path):
    with pytest.raises(PlaybyearError, match=message):
        dagger(tmp_path, *QUICK, *options)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"batch_size": 5}, "--batch_size=5 must be even"),
        ({"warmup_episodes": 0}, "--warmup_episodes=0: give at least 1"),
        ({"learning_rate": 0.0}, "--learning_rate=0.0 must be above 0"),
        ({"updates": 5}, "--updates is for --episodes=0"),
        ({"episodes": 0}, "give --updates"),
        ({"eval": DaggerEvalConfig(n_episodes=0)}, "--eval.n_episodes=0: give at least 1, or --eval_every=0"),
    ],
)
def test_numbers_out_of_their_range(options, message):
    with pytest.raises(PlaybyearError, match=message):
        DaggerConfig(DatasetSource("a/b"), DatasetSource("c/d"), env=PlaybyearEnvConfig(), **options).check()


def test_a_run_without_evaluations_needs_no_episodes_of_one():
    source = DatasetSource("a/b")
    cfg = DaggerConfig(source, source, env=PlaybyearEnvConfig(), eval_every=0, eval=DaggerEvalConfig(n_episodes=0))
    cfg.check()
    assert len(cfg.eval_seeds) == 0


@pytest.mark.parametrize("said", ["true", "True", "yes", "on"])
def test_however_a_resume_is_said_the_saved_options_stay(finished, said):
    args = [f"--resume={said}", f"--output_dir={finished / 'out'}"]
    assert with_saved_options(args)[0] == f"--config_path={finished / 'out/dagger_config.json'}"


def test_recorded_noise_that_is_gone_is_told_before_any_attempt(tmp_path):
    with pytest.raises(PlaybyearError, match="nowhere"):
        dagger(tmp_path, *QUICK, f"--policy.audio_noise_files={tmp_path / 'nowhere'}", "--policy.audio_noise_db=20")
    assert not (tmp_path / "out").exists()


def test_without_an_environment_or_a_policy(tmp_path):
    with pytest.raises(
        PlaybyearError, match=r"No environment: give --env.type and --env.task, or --episodes=0 --updates=N"
    ):
        command(*arguments(tmp_path, "--episodes=1", env=()))
    without = [option for option in arguments(tmp_path, *QUICK) if not option.startswith("--policy")]
    with pytest.raises(PlaybyearError, match=r"HG-DAgger improves a trained policy: give .* --policy.path"):
        command(*without)


def test_an_environment_without_a_gate(tmp_path, monkeypatch):
    from gym_playbyear.environment import TaskEnv

    wanted = r"needs an environment with `intervention_gate\(\)`.*own_expert.py"
    monkeypatch.setattr(TaskEnv, "intervention_gate", None)
    with pytest.raises(
        PlaybyearError, match=r"OccludedGrasp.*--method.type=no_handback needs one. Give --method.type=redo"
    ):
        dagger(tmp_path, "--method.type=no_handback")
    with pytest.raises(PlaybyearError, match=f"--expert.person=true {wanted}"):
        dagger(tmp_path, "--method.type=redo", "--expert.person=true")
    monkeypatch.setattr(TaskEnv, "scripted_expert", None)
    with pytest.raises(PlaybyearError, match=wanted):
        dagger(tmp_path, "--method.type=redo")


def test_options_that_would_do_nothing_are_refused(tmp_path):
    late = DaggerConfig(DatasetSource("a/b"), DatasetSource("a/c"), episodes=0, updates=1, takeover_delay_s=0.5)
    with pytest.raises(PlaybyearError, match=r"--takeover_delay_s=0\.5: with --episodes=0 nobody takes over"):
        check_places(late)
    with pytest.raises(PlaybyearError, match=r"--expert\.reaction_s=0\.5 is of a person: give --expert\.person=true"):
        dagger(tmp_path, "--expert.reaction_s=0.5")
    dataset = RecordDatasetConfig("a/b", str(tmp_path / "data"), rgb_encoder=RGBEncoderConfig("h264"))
    with pytest.raises(PlaybyearError, match=r"--dataset\.rgb_encoder.* encodes video: give --dataset\.video=true"):
        record(RecordConfig(PlaybyearEnvConfig(), dataset))
    assert not (tmp_path / "out").exists()
    assert not (tmp_path / "data").exists()


def test_attempts_are_not_written_among_the_demonstrations(tmp_path):
    demos = base_folder() / "demos"
    (tmp_path / "link").symlink_to(demos)
    before = {path: path.stat().st_mtime_ns for path in demos.rglob("*")}
    for root in (demos, tmp_path / "link"):
        with pytest.raises(PlaybyearError, match="--demos and --interventions are the same dataset"):
            dagger(tmp_path, *QUICK, f"--interventions.root={root}")
    assert {path: path.stat().st_mtime_ns for path in demos.rglob("*")} == before
    with pytest.raises(PlaybyearError, match=r"--output_dir=.*out lies in the folder of --interventions"):
        dagger(tmp_path, *QUICK, f"--interventions.root={tmp_path / 'out'}")
    assert not (tmp_path / "out").exists()


# Output folders


def test_only_one_run_works_in_a_folder(tmp_path):
    folder = RunFolder(tmp_path / "out")
    lock = folder.lock()
    with pytest.raises(PlaybyearError, match="another playbyear-dagger is at work there"):
        dagger(tmp_path, *QUICK, "--episodes=1")
    assert folder.claim(resume=False) is None
    lock.release()
    assert not (tmp_path / "out").exists()
    (tmp_path / "out").mkdir()
    folder.lock().release()
    assert not list((tmp_path / "out").iterdir())  # it was there before


def test_a_disk_without_locks_is_warned_of(tmp_path, monkeypatch, caplog):
    def refuses(*_, **__):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr("lerobot_playbyear.dagger.run_lock.FileLock.acquire", refuses)
    RunFolder(tmp_path / "out").lock().release()
    assert "let no other playbyear-dagger work there" in caplog.text


def test_a_folder_that_cannot_be_made_is_told_before_anything_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr("lerobot_playbyear.dagger.run.check_dataset_files", lambda *_: pytest.fail("it was read"))
    (tmp_path / "file").write_text("mine")
    for place in ("file", "file/below"):
        with pytest.raises(PlaybyearError, match=f"--output_dir=.*{place} cannot be written"):
            dagger(tmp_path, *QUICK, f"--output_dir={tmp_path / place}")
    assert (tmp_path / "file").read_text() == "mine"


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("finished")
    dagger(folder, *QUICK, "--episodes=1")
    return folder


def test_the_folder_of_a_run_is_not_touched_without_resume(finished):
    with pytest.raises(PlaybyearError, match=r"holds a run already: go on with it with --resume=true"):
        dagger(finished, *QUICK)


@pytest.mark.parametrize(
    ("options", "difference"),
    [
        (("--env.task=OccludedPickPlace-v1",), r"--env was .*OccludedGrasp-v1.* and is .*OccludedPickPlace-v1"),
        (("--demos.repo_id=other/demos",), r"--demos was .*tests/demos.* and is .*other/demos"),
        (("--expert.n_steps=9",), "--expert was .*'n_steps': 8.* and is .*'n_steps': 9"),
        (("--episode_seed=5",), "--episode_seed was 10000 and is 5"),
        (("--policy.path=elsewhere",), "--policy.path was .*pretrained_model and is elsewhere"),
        (("--episodes=0", "--updates=5"), "--episodes was 1 and is 0"),
    ],
)
def test_resuming_another_run_names_the_difference(finished, options, difference):
    with pytest.raises(PlaybyearError, match=f"holds another run: {difference}"):
        dagger(finished, "--resume=true", *QUICK, *options)


def test_the_output_of_another_command_is_refused(tmp_path):
    with pytest.raises(PlaybyearError, match=r"holds files, but no run of playbyear-dagger"):
        dagger(tmp_path, *QUICK, "--resume=true", f"--output_dir={base_folder() / 'train'}")


def test_a_dataset_that_something_else_changed_is_refused(finished, tmp_path):
    shutil.copytree(finished / "out", tmp_path / "out")
    state = json.loads((tmp_path / "out/dagger_state.json").read_text())
    state["kept"] = state["round"] = 5
    (tmp_path / "out/dagger_state.json").write_text(json.dumps(state))
    with pytest.raises(PlaybyearError, match="holds 1 attempts, and this run knows of 5"):
        command("--resume=true", f"--output_dir={tmp_path / 'out'}", "--episodes=8")


def test_nothing_to_do_is_said(finished, tmp_path):
    with pytest.raises(PlaybyearError, match="holds 1 attempts already, and --episodes=1 asks for no more"):
        dagger(finished, *QUICK, "--episodes=1", f"--output_dir={tmp_path / 'out'}")


def test_the_command_says_in_one_line_what_is_wrong(finished, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["playbyear-dagger", *arguments(finished, *QUICK)])
    with pytest.raises(SystemExit, match=r"^error: --output_dir=.* holds a run already"):
        dagger_script()


def test_a_fault_of_the_program_shows_where_it_happened(monkeypatch, tmp_path):
    def play(*args, **kwargs):
        raise ValueError("a fault")

    monkeypatch.setattr(attempt, "play", play)
    monkeypatch.setattr(sys, "argv", ["playbyear-dagger", *arguments(tmp_path, *QUICK)])
    with pytest.raises(ValueError, match=r"^a fault$") as error:
        dagger_script()
    assert not isinstance(error.value, PlaybyearError)


def test_an_environment_that_breaks_its_word_in_the_middle_is_told_in_one_line(monkeypatch, tmp_path):
    def episode_frames(*args):
        return [
            {**frame, "observation.state": frame["observation.state"][:-1]} for frame in frames.episode_frames(*args)
        ]

    monkeypatch.setattr(saving, "episode_frames", episode_frames)
    monkeypatch.setattr(sys, "argv", ["playbyear-dagger", *arguments(tmp_path, *QUICK)])
    with pytest.raises(SystemExit, match=r"^error: .*observation\.state"):
        dagger_script()


# Recorded corrections


def learn(tmp_path, root, *options):
    offline = ("--episodes=0", "--updates=2", f"--interventions.root={root}")
    return command(*arguments(tmp_path, *offline, *options, env=()))


def rollout_dataset(root, lengths, mark, use_videos=False):
    """A dataset as `lerobot-rollout --strategy.type=dagger` writes it: observations, action and `intervention`, no more."""
    features = dataset_features(image_size=16, use_videos=use_videos)
    del features["next.reward"]
    names = [f"joint_{i}.pos" for i in range(4)]
    features["action"] = {"dtype": "float32", "shape": (4,), "names": names}
    options = {"robot_type": "so100", "use_videos": use_videos, "video_backend": "pyav"}
    if use_videos:  # LeRobot's default encoder does not take pictures as small as these
        options["rgb_encoder"] = RGBEncoderConfig(vcodec="h264")
    dataset = LeRobotDataset.create("tests/rollout_corrections", 20, features, root=root, **options)
    rng = np.random.default_rng(0)
    for length in lengths:
        for step in range(length):
            frame = {**random_frame(features, rng), "intervention": np.array([mark(step)], dtype=bool)}
            dataset.add_frame({**frame, "task": "grasp"})
        dataset.save_episode()
    dataset.finalize()


@pytest.mark.parametrize(
    ("mark", "use_videos"),
    [(lambda step: 5 <= step < 12, False), (lambda step: True, True)],
    ids=["whole", "corrections"],
)
def test_it_learns_from_what_lerobots_rollout_recorded(tmp_path, mark, use_videos):
    """Both of its modes: whole attempts with tags, and episodes of corrections alone; as pictures and as video."""
    rollout_dataset(tmp_path / "rollout", (20, 14), mark, use_videos=use_videos)
    out = learn(tmp_path, tmp_path / "rollout")
    assert (out / "checkpoints/000002/pretrained_model/model.safetensors").is_file()
    assert metrics(tmp_path, "round")[-1]["loss_interventions"] > 0


def test_demonstrations_alone_are_the_control(tmp_path):
    """Every frame of a demonstration was chosen by an expert: the same updates without corrections."""
    learn(tmp_path, base_folder() / "demos")
    assert metrics(tmp_path, "round")[-1]["step"] == 2


def test_corrections_without_a_correction(tmp_path):
    rollout_dataset(tmp_path / "rollout", (20,), lambda step: False)
    with pytest.raises(
        PlaybyearError, match="None of the 20 frames of the intervention dataset has 'intervention' set"
    ):
        learn(tmp_path, tmp_path / "rollout")


def test_corrections_that_do_not_say_who_acted(tmp_path):
    features = dataset_features(image_size=16)
    del features["intervention"]
    make_dataset(tmp_path / "data", (20,), features=features)
    with pytest.raises(PlaybyearError, match=r"wanted 'intervention', bool \(1,\), and there is no such feature"):
        learn(tmp_path, tmp_path / "data")


def test_corrections_that_are_empty(tmp_path):
    LeRobotDataset.create("tests/corrections", 20, dataset_features(image_size=16), root=tmp_path / "data").finalize()
    with pytest.raises(PlaybyearError, match="is empty"):
        learn(tmp_path, tmp_path / "data")


def test_corrections_that_differ_from_the_demonstrations(tmp_path):
    make_dataset(tmp_path / "data", (20,), features=dataset_features(image_size=16, state_size=5))
    with pytest.raises(
        PlaybyearError, match=r"the corrections differ: 'observation.state' is float32 \(7,\) there and"
    ):
        learn(tmp_path, tmp_path / "data")
