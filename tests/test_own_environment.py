"""Somebody else's environment, whose microphone gives int16, through LeRobot's own evaluation."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.processor import PolicyProcessorPipeline
from lerobot.scripts import lerobot_eval

from lerobot_playbyear.policy.processor_playbyear import Pcm16ToFloatProcessorStep
from lerobot_playbyear.scripts.commands import record, train

EXAMPLES = Path(__file__).parent.parent / "examples"
ENV = ["--env.discover_packages_path=gym_knock", "--env.type=knock"]


def call(command, *arguments: str | Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [command.__name__, *map(str, arguments)])
        command()


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """Records the example's environment and trains a small policy; the folder of both."""
    folder = tmp_path_factory.mktemp("knock")
    data = ["--dataset.repo_id=me/knock", f"--dataset.root={folder / 'dataset'}"]
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(EXAMPLES)
        call(record, *ENV, *data, "--dataset.num_episodes=2", "--num_workers=0")
        call(
            train,
            "--policy.type=playbyear",
            "--policy.push_to_hub=false",
            "--policy.device=cpu",
            "--policy.image_size=32",
            "--policy.vision_width=4",
            *data,
            "--steps=2",
            "--batch_size=2",
            f"--output_dir={folder / 'train'}",
        )
        yield folder


def test_lerobot_eval_takes_an_environment_of_ones_own_with_int16_sound(trained):
    call(
        lerobot_eval.main,
        f"--policy.path={trained / 'train/checkpoints/last/pretrained_model'}",
        *ENV,
        "--eval.n_episodes=1",
        "--eval.batch_size=1",
        f"--output_dir={trained / 'eval'}",
    )
    assert json.loads((trained / "eval/eval_info.json").read_text())["overall"]["n_episodes"] == 1


def scale(sound) -> torch.Tensor:
    pipeline = PolicyProcessorPipeline(steps=[Pcm16ToFloatProcessorStep()])
    return pipeline({"observation.audio.finger": torch.as_tensor(sound)})["observation.audio.finger"]


@pytest.mark.parametrize("dtype", [torch.float32, torch.int16])
def test_int16_sound_is_divided_by_full_scale_however_quiet_it_is(dtype):
    """Nothing is guessed from the level: a room with one bit of noise stays quiet."""
    assert scale(torch.tensor([[-32768, 0, 16384]], dtype=dtype)).tolist() == [[-1.0, 0.0, 0.5]]
    assert scale(torch.tensor([[-1, 0, 1]], dtype=dtype)).tolist() == [[-1 / 32768, 0.0, 1 / 32768]]


def test_only_sound_is_scaled():
    step = Pcm16ToFloatProcessorStep()
    state = torch.tensor([[3.0]])
    assert step.observation({"observation.state": state, "observation.audio_level": state}) == {
        "observation.state": state,
        "observation.audio_level": state,
    }


@pytest.mark.parametrize("sample", [0.25, 40000.0, float("nan")])
def test_what_is_no_int16_sound_is_refused(sample):
    with pytest.raises(ValueError, match=r"observation\.audio\.finger holds .*no int16 sample.*get_env_processors"):
        scale(torch.tensor([[0.0, sample]]))


def test_the_step_is_saved_and_loaded_by_name(tmp_path):
    PolicyProcessorPipeline(steps=[Pcm16ToFloatProcessorStep()], name="sound").save_pretrained(tmp_path)
    loaded = PolicyProcessorPipeline.from_pretrained(tmp_path, config_filename="sound.json")
    assert isinstance(loaded.steps[0], Pcm16ToFloatProcessorStep)


def test_both_distributions_scale_alike():
    from lerobot_env_playbyear import PcmToFloatProcessorStep

    sound = torch.from_numpy(np.random.default_rng(0).integers(-32768, 32768, (2, 800)).astype(np.float32))
    theirs = PcmToFloatProcessorStep().observation({"observation.audio.finger": sound})["observation.audio.finger"]
    assert torch.equal(scale(sound), theirs)
