"""Somebody else's environment, whose microphone gives int16, through LeRobot's own evaluation."""

from pathlib import Path

import pytest
import torch
from lerobot.processor import PolicyProcessorPipeline
from support.shared import TINY, n_evaluated, run_in_process

from lerobot_playbyear.policy.processor_playbyear import Pcm16ToFloatProcessorStep
from lerobot_playbyear.scripts.commands import record, train

EXAMPLES = Path(__file__).parent.parent / "examples"
ENV = ["--env.discover_packages_path=gym_knock", "--env.type=knock"]


def test_lerobot_eval_takes_an_environment_of_ones_own_with_int16_sound(monkeypatch, tmp_path):
    """The example, recorded, learned from and evaluated."""
    monkeypatch.syspath_prepend(EXAMPLES)
    data = ["--dataset.repo_id=me/knock", f"--dataset.root={tmp_path / 'dataset'}"]
    assert run_in_process(record, *ENV, *data, "--dataset.num_episodes=2", "--num_workers=0") is None
    assert run_in_process(train, *TINY, *data, "--steps=2", f"--output_dir={tmp_path / 'train'}") is None
    checkpoint = tmp_path / "train/checkpoints/last/pretrained_model"
    assert n_evaluated(checkpoint, tmp_path / "eval", *ENV) == 1


def scale(sound) -> torch.Tensor:
    pipeline = PolicyProcessorPipeline(steps=[Pcm16ToFloatProcessorStep()])
    return pipeline({"observation.audio.finger": torch.as_tensor(sound)})["observation.audio.finger"]


@pytest.mark.parametrize("dtype", [torch.float32, torch.int16])
def test_int16_sound_is_divided_by_full_scale_however_quiet_it_is(dtype):
    """Nothing is guessed from the level: a room with one bit of noise stays quiet."""
    assert scale(torch.tensor([[-32768, 0, 16384]], dtype=dtype)).tolist() == [[-1.0, 0.0, 0.5]]
    assert scale(torch.tensor([[-1, 0, 1]], dtype=dtype)).tolist() == [[-1 / 32768, 0.0, 1 / 32768]]


@pytest.mark.parametrize("sample", [0.25, 40000.0, float("nan")])
def test_what_is_no_int16_sound_is_refused(sample):
    with pytest.raises(ValueError, match=r"observation\.audio\.finger holds .*not an int16 sample.*get_env_processors"):
        scale(torch.tensor([[0.0, sample]]))
