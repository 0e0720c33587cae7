"""What a command says to type next works as it stands."""

import shlex
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import register
from support.shared import run_in_process

from lerobot_env_playbyear.config import PlaybyearEnvConfig
from lerobot_playbyear.datasets.next_command import training_command
from lerobot_playbyear.scripts.commands import record, train
from lerobot_playbyear.training.report import evaluation_command

EXAMPLES = Path(__file__).parents[1] / "examples"
SHORT = ("--steps=2", "--batch_size=2", "--num_workers=0", "--log_freq=1")


def knocking(fps: int, kinds: tuple[str, ...]):
    """The example's box at another rate, and without some of its senses."""
    from gym_knock import Knocking
    from gym_knock.environment import SAMPLE_RATE

    sound = gym.spaces.Box(-32768, 32767, (SAMPLE_RATE // fps,), np.int16)
    spaces = {**Knocking.observation_space, "audio.finger": sound}

    class Other(Knocking):
        metadata = {**Knocking.metadata, "render_fps": fps}  # noqa: RUF012
        observation_space = gym.spaces.Dict({kind: spaces[kind] for kind in kinds})

        def _observation(self, knock):
            observation = super()._observation(knock)
            heard = np.resize(observation["audio.finger"], SAMPLE_RATE // fps)
            return {kind: {**observation, "audio.finger": heard}[kind] for kind in kinds}

    return Other


def said(capsys, what: str) -> list[str]:
    """The command that a line of the output names."""
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith(what)]
    return shlex.split(line.removeprefix(what))


@pytest.mark.parametrize(
    ("fps", "kinds"),
    [
        pytest.param(20, ("pixels", "agent_pos", "audio.finger"), marks=pytest.mark.slow),
        (10, ("agent_pos", "audio.finger")),
        pytest.param(40, ("pixels", "agent_pos"), marks=pytest.mark.slow),
    ],
    ids=["gym_knock", "blind at 10 Hz", "deaf at 40 Hz"],
)
@pytest.mark.timeout(300)  # LeRobot is imported, records and trains
def test_what_a_recording_says_to_type_next_trains_on_any_environment(fps, kinds, monkeypatch, tmp_path, capsys):
    """Nothing is added to it but that it ends soon; the folder's name has a blank."""
    monkeypatch.syspath_prepend(EXAMPLES)
    monkeypatch.chdir(tmp_path)
    env = ["--env.discover_packages_path=gym_knock", "--env.type=knock", f"--env.fps={fps}"]
    if len(kinds) < 3 or fps != 20:
        import gym_knock

        monkeypatch.setattr(gym_knock, "Other", knocking(fps, kinds), raising=False)
        monkeypatch.delitem(gym.registry, "gym_knock/Knock-v0")
        register("gym_knock/Knock-v0", lambda **options: gym_knock.Other(**options), max_episode_steps=60)
    data = ["--dataset.repo_id=me/knock", "--dataset.root=my knocks", "--dataset.num_episodes=2", "--num_workers=0"]
    assert run_in_process(record, *env, *data) is None
    command, *options = said(capsys, "Train on it: ")
    assert (command, options[0]) == ("playbyear-train", "--preset=cpu")
    assert run_in_process(train, *options, *SHORT) is None
    command, *options = said(capsys, "Go on: ")
    assert (command, options[0]) == ("playbyear-train", "--resume=true")
    assert run_in_process(train, *options) is None
    assert (tmp_path / "outputs/train/knock/checkpoints/000004/pretrained_model/model.safetensors").is_file()


@pytest.mark.parametrize(("has_gpu", "preset"), [(True, "gpu"), (False, "cpu")])
def test_the_preset_is_the_one_for_the_machine(has_gpu, preset, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: has_gpu)
    assert training_command("me/demos", ["observation.images.front", "observation.audio.mic"], "here") == (
        f"playbyear-train --preset={preset} --dataset.repo_id=me/demos --dataset.root=here --output_dir=outputs/train/demos"
    )


def test_a_policy_is_evaluated_with_all_the_microphones_that_it_hears():
    env = PlaybyearEnvConfig(task="OccludedGrasp-v1", microphones=["gripper", "room"])
    assert shlex.split(evaluation_command(Path("my policy"), env))[1:] == [
        "--policy.path=my policy",
        "--env.type=playbyear",
        "--env.task=OccludedGrasp-v1",
        '--env.microphones=["gripper","room"]',
    ]
    assert "microphones" not in evaluation_command(Path("policy"), PlaybyearEnvConfig(task="OccludedGrasp-v1"))
    assert evaluation_command(Path("policy"), None) == "lerobot-eval --policy.path=policy --env.type=..."
