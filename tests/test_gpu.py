"""On a machine with a GPU: both trainers and HG-DAgger really train on it, save, load, resume and act.

Everything here is skipped without one; `test_flat_weights.py`, `test_fake_cuda.py` and `test_mps.py` show without a GPU
what can be shown.
"""

import sys
from pathlib import Path

import pytest
import torch
from accelerate.state import AcceleratorState
from dagger_factory import QUICK, base_folder, command, dagger
from dataset_factory import make_dataset
from lerobot.configs import parser
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies import make_pre_post_processors
from lerobot.scripts import lerobot_train
from lerobot.utils.import_utils import register_third_party_plugins
from safetensors.torch import load_file

from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy
from lerobot_playbyear.training import loop

train = parser.wrap()(loop.train)

AVAILABLE = {"cuda": torch.cuda.is_available, "mps": torch.backends.mps.is_available}
DEVICES = [
    pytest.param(name, marks=pytest.mark.skipif(not is_available(), reason=f"this machine has no {name}"))
    for name, is_available in AVAILABLE.items()
]
TINY = (
    "--policy.type=playbyear",
    "--policy.push_to_hub=false",
    "--policy.image_size=32",
    "--policy.vision_width=8",
    "--policy.audio_window_s=0.9",
    "--policy.n_memory_steps=3",
    "--policy.n_supervised_steps=4",
    "--policy.hidden_size=64",
    "--policy.audio_noise_db=0",
    "--policy.low_dimensional_noise=0.03",
    "--num_workers=0",
    "--batch_size=4",
    "--log_freq=1",
    "--seed=3",
)

pytestmark = pytest.mark.parametrize("device", DEVICES)


@pytest.fixture(autouse=True)
def precision_of_its_own():
    AcceleratorState._reset_state(True)
    yield
    AcceleratorState._reset_state(True)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    register_third_party_plugins()
    root = tmp_path_factory.mktemp("data") / "noise"
    make_dataset(root, (12, 17, 9, 14), image_size=48)
    return root


def run(script, *arguments):
    """A training script in this process, as the command line would."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["train", *map(str, arguments)])
        script()


def weights(checkpoint: Path) -> dict[str, torch.Tensor]:
    return load_file(checkpoint / "pretrained_model/model.safetensors")


def actions_of(checkpoint: Path, device: str, n_frames: int = 4) -> torch.Tensor:
    """What the policy of a checkpoint does on a device in an episode of noise, (n_frames, n_actions)."""
    folder = checkpoint / "pretrained_model"
    config = PreTrainedConfig.from_pretrained(folder, cli_overrides=[f"--device={device}"])
    policy = PlaybyearPolicy.from_pretrained(folder, config=config)
    before, after = make_pre_post_processors(
        config, str(folder), preprocessor_overrides={"device_processor": {"device": device}}
    )
    generator = torch.Generator().manual_seed(0)
    policy.reset()
    actions = []
    for _ in range(n_frames):
        frame = {key: torch.rand(1, *f.shape, generator=generator) for key, f in config.input_features.items()}
        actions.append(after(policy.select_action(before(frame))))
    return torch.cat(actions)


@pytest.mark.parametrize("dtype", ["float32", "auto", "float16"])
@pytest.mark.parametrize("script", [train, lerobot_train.train], ids=["playbyear-train", "lerobot-train"])
def test_a_training_saves_resumes_and_acts(device, script, dtype, root, tmp_path):
    data = ("--dataset.repo_id=tests/noise", f"--dataset.root={root}", f"--policy.dtype={dtype}")
    run(script, *TINY, *data, f"--policy.device={device}", "--steps=4", "--save_freq=2", f"--output_dir={tmp_path}/out")
    checkpoints = tmp_path / "out/checkpoints"
    half = checkpoints / "000002"
    run(
        script,
        "--resume=true",
        f"--config_path={half / 'pretrained_model/train_config.json'}",
        f"--output_dir={tmp_path}/on",
    )

    last, resumed = weights(checkpoints / "last"), weights(tmp_path / "on/checkpoints/000004")
    assert all(value.isfinite().all() for value in (*last.values(), *resumed.values()))
    assert any(not torch.equal(value, weights(half)[key]) for key, value in last.items())  # it goes on learning
    if script is train and dtype == "float32":  # which draws the same batches again; kernels on a GPU add in any order
        for key, value in last.items():
            torch.testing.assert_close(resumed[key], value, rtol=1e-2, atol=1e-3)
    torch.testing.assert_close(actions_of(half, device), actions_of(half, "cpu"), rtol=0, atol=1e-2)


def test_dagger_saves_and_goes_on(device, tmp_path):
    base_folder()
    AcceleratorState._reset_state(True)
    dagger(tmp_path, *QUICK, "--episodes=1", f"--policy.device={device}")
    command("--resume=true", f"--output_dir={tmp_path / 'out'}", "--episodes=2")

    last = weights(tmp_path / "out/checkpoints/last")
    assert all(value.isfinite().all() for value in last.values())
    config = PreTrainedConfig.from_pretrained(tmp_path / "out/checkpoints/last/pretrained_model")
    assert torch.device(config.device).type == device
