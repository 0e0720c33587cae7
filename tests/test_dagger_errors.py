"""What `playbyear-dagger` refuses, each with one clear error and before any work; and datasets that others wrote."""

import json
import shutil
import sys

import numpy as np
import pytest
import torch
from dagger_factory import QUICK, arguments, base_folder, command, dagger, metrics
from dataset_factory import dataset_features, random_frame
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets import LeRobotDataset
from lerobot.policies.act.configuration_act import ACTConfig
from safetensors.torch import load_file

from lerobot_env_playbyear import PlaybyearEnvConfig
from lerobot_playbyear.dagger import DaggerConfig, loop
from lerobot_playbyear.dagger.config import DaggerEvalConfig, with_saved_options
from lerobot_playbyear.dagger.run_folder import RunFolder
from lerobot_playbyear.datasets.errors import PlaybyearError
from lerobot_playbyear.datasets.reader import DatasetPlace
from lerobot_playbyear.episodes import frames, saving
from lerobot_playbyear.scripts.commands import dagger as dagger_script

pytestmark = pytest.mark.usefixtures("one_thread")


def test_a_run_without_evaluations_needs_no_episodes_of_one():
    source = DatasetPlace("a/b")
    cfg = DaggerConfig(source, source, env=PlaybyearEnvConfig(), eval_every=0, eval=DaggerEvalConfig(n_episodes=0))
    cfg.check()
    assert len(cfg.eval_seeds) == 0


@pytest.mark.parametrize("said", ["true", "True", "yes", "on"])
def test_however_a_resume_is_said_the_saved_options_stay(finished, said):
    args = [f"--resume={said}", f"--output_dir={finished / 'out'}"]
    assert with_saved_options(args)[0] == f"--config_path={finished / 'out/dagger_config.json'}"


def test_what_only_one_process_and_our_policy_can_do(tmp_path, monkeypatch):
    policy = ACTConfig(device="cpu", push_to_hub=False)
    (tmp_path / "act").mkdir()
    policy.save_pretrained(tmp_path / "act")
    with pytest.raises(PlaybyearError, match=r"the type 'act'.*--policy\.type=playbyear.*lerobot-rollout"):
        dagger(tmp_path, *QUICK, f"--policy.path={tmp_path / 'act'}")
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(PlaybyearError, match="2 processes were started, and playbyear-dagger works in one"):
        dagger(tmp_path, *QUICK)
    assert not (tmp_path / "out").exists()


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


# Output folders


def test_only_one_run_works_in_a_folder(tmp_path):
    folder = RunFolder(tmp_path / "out")
    with folder.locked():
        with pytest.raises(PlaybyearError, match="another playbyear-dagger is at work there"):
            dagger(tmp_path, *QUICK, "--episodes=1")
        assert folder.claim(resume=False) is None
    assert not (tmp_path / "out").exists()
    (tmp_path / "out").mkdir()
    with folder.locked():
        pass
    assert not list((tmp_path / "out").iterdir())  # it was there before


def test_a_disk_without_locks_is_warned_of(tmp_path, monkeypatch, caplog):
    def refuses(*_, **__):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr("lerobot_playbyear.datasets.files.FileLock.acquire", refuses)
    with RunFolder(tmp_path / "out").locked():
        pass
    assert "let no other playbyear-dagger work there" in caplog.text


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

    monkeypatch.setattr(loop, "play", play)
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


def rollout_dataset(root, lengths, mark, use_videos=False, by_policy=0.0):
    """A dataset as `lerobot-rollout --strategy.type=dagger` writes it: observations, action and `intervention`, no more."""
    features = dataset_features(image_size=16, use_videos=use_videos)
    del features["next.reward"]
    features["action"] = {"dtype": "float32", "shape": (4,), "names": None}
    options = {"robot_type": "so100", "use_videos": use_videos, "video_backend": "pyav"}
    if use_videos:  # LeRobot's default encoder does not take pictures as small as these
        options["rgb_encoder"] = RGBEncoderConfig(vcodec="h264")
    dataset = LeRobotDataset.create("tests/rollout_corrections", 20, features, root=root, **options)
    rng = np.random.default_rng(0)
    for length in lengths:
        for step in range(length):
            frame = {**random_frame(features, rng), "intervention": np.array([mark(step)], dtype=bool)}
            frame["action"] = frame["action"] + np.float32(by_policy * (not mark(step)))
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


def test_what_the_policy_did_by_itself_changes_nothing(tmp_path):
    weights = []
    for name, by_policy in (("mild", 0.0), ("wild", 5.0)):
        folder = tmp_path / name
        rollout_dataset(folder / "rollout", (20, 14), lambda step: 5 <= step < 12, by_policy=by_policy)
        weights.append(
            load_file(learn(folder, folder / "rollout") / "checkpoints/last/pretrained_model/model.safetensors")
        )
    before = load_file(base_folder() / "policy/model.safetensors")
    assert any(not torch.equal(weights[0][key], before[key]) for key in before)
    assert all(torch.equal(weights[0][key], weights[1][key]) for key in before)


def test_demonstrations_alone_are_the_control(tmp_path):
    """Every frame of a demonstration was chosen by an expert: the same updates without corrections."""
    learn(tmp_path, base_folder() / "demos")
    assert metrics(tmp_path, "round")[-1]["step"] == 2
