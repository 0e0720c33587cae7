"""What `playbyear-dagger` refuses, each with one clear error and before any work; and datasets that others wrote."""

import json
import re
import shutil
import sys

import numpy as np
import pytest
import torch
from dagger_factory import QUICK, arguments, command, dagger, finished, metrics
from dataset_factory import dataset_features, random_frame
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets import LeRobotDataset
from lerobot.policies.act.configuration_act import ACTConfig
from safetensors.torch import load_file
from support.shared import trained

from lerobot_playbyear.dagger import loop
from lerobot_playbyear.dagger.run_folder import RunFolder
from lerobot_playbyear.datasets.errors import PlaybyearError
from lerobot_playbyear.scripts.commands import dagger as dagger_script

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module", name="finished")
def _finished():
    return finished()


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
    (tmp_path / "out/dagger_config.json.partial").write_text("{")  # of a run that could not write even its options
    assert folder.claim(resume=False) is None


def test_a_disk_without_locks_is_warned_of(tmp_path, monkeypatch, caplog):
    def refuses(*_, **__):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr("lerobot_playbyear.datasets.files.FileLock.acquire", refuses)
    with RunFolder(tmp_path / "out").locked():
        pass
    assert "let no other playbyear-dagger work there" in caplog.text


def test_the_folder_of_a_run_is_not_touched_without_resume(finished):
    with pytest.raises(PlaybyearError, match=r"holds a run already: go on with it with --resume=true"):
        dagger(finished, *QUICK)


def test_resuming_another_run_names_the_differences(finished):
    changed = (
        "--env.task=OccludedPickPlace-v1",
        "--demos.repo_id=other/demos",
        "--expert.n_steps=9",
        "--episode_seed=5",
    )
    with pytest.raises(PlaybyearError, match="holds another run: ") as refused:
        dagger(finished, "--resume=true", *QUICK, *changed, "--policy.path=elsewhere", "--episodes=0", "--updates=5")
    for difference in (
        r"--env was .*OccludedGrasp-v1.* and is .*OccludedPickPlace-v1",
        r"--demos was .*tests/demos.* and is .*other/demos",
        r"--expert was .*'n_steps': 8.* and is .*'n_steps': 9",
        "--episode_seed was 10000 and is 5",
        "--policy.path was .*pretrained_model and is elsewhere",
        "--episodes was 3 and is 0",
    ):
        assert re.search(difference, str(refused.value))


def test_a_dataset_that_something_else_changed_is_refused(finished, tmp_path):
    shutil.copytree(finished / "out", tmp_path / "out")
    state = json.loads((tmp_path / "out/dagger_state.json").read_text())
    state["kept"] = state["round"] = 5
    (tmp_path / "out/dagger_state.json").write_text(json.dumps(state))
    with pytest.raises(PlaybyearError, match="holds 3 attempts, and this run knows of 5"):
        command("--resume=true", f"--output_dir={tmp_path / 'out'}", "--episodes=8")


def test_nothing_to_do_is_said(finished, tmp_path):
    with pytest.raises(PlaybyearError, match="holds 3 attempts already, and --episodes=1 asks for no more"):
        dagger(finished, *QUICK, "--episodes=1", f"--output_dir={tmp_path / 'out'}")


def test_a_fault_of_the_program_shows_where_it_happened(monkeypatch, tmp_path):
    def play(*args, **kwargs):
        raise ValueError("a fault")

    monkeypatch.setattr(loop, "play", play)
    monkeypatch.setattr(sys, "argv", ["playbyear-dagger", *arguments(tmp_path, *QUICK)])
    with pytest.raises(ValueError, match=r"^a fault$") as error:
        dagger_script()
    assert not isinstance(error.value, PlaybyearError)


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


def test_it_learns_the_corrections_of_lerobots_rollout_and_nothing_of_what_the_policy_did(tmp_path):
    """Of whole attempts with tags."""
    weights = []
    for by_policy in (0.0, 5.0):
        folder = tmp_path / str(by_policy)
        rollout_dataset(folder / "rollout", (20, 14), lambda step: 5 <= step < 12, by_policy=by_policy)
        out = learn(folder, folder / "rollout")
        assert metrics(folder, "round")[-1]["loss_interventions"] > 0
        weights.append(load_file(out / "checkpoints/000002/pretrained_model/model.safetensors"))
    before = load_file(trained() / "model.safetensors")
    assert any(not torch.equal(weights[0][key], before[key]) for key in before)
    assert all(torch.equal(weights[0][key], weights[1][key]) for key in before)


def test_it_learns_from_episodes_of_corrections_alone_as_video(tmp_path):
    """The other mode of LeRobot's rollout; demonstrations are of this kind, too."""
    rollout_dataset(tmp_path / "rollout", (20, 14), lambda step: True, use_videos=True)
    learn(tmp_path, tmp_path / "rollout")
    assert metrics(tmp_path, "round")[-1]["loss_interventions"] > 0
