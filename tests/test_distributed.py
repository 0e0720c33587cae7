"""Several processes learn what one with all their data learns."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from dataset_factory import make_dataset
from safetensors.torch import load_file, save_file

SHARE = """
import sys
import torch
from safetensors.torch import load_file, save_file
from lerobot_playbyear.policy.shared_statistics import SharedBatchNorm2d, mean_over_processes
from lerobot_playbyear.policy.spectrogram import LogSpectrogram

folder, rank, n_processes = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
torch.set_num_threads(1)
if n_processes > 1:
    torch.distributed.init_process_group("gloo", init_method=f"file://{folder}/meet", rank=rank, world_size=n_processes)
data = {key: value.chunk(n_processes)[rank] for key, value in load_file(f"{folder}/data.safetensors").items()}
norm, spectrogram = SharedBatchNorm2d(5), LogSpectrogram(16000, 0.04, 0.035, 160)
images = data["images"].clone().requires_grad_()
loss = 0
for _ in range(2):
    seen = norm(images)
    heard = spectrogram(data["wave"], data["begun"])
    error = (seen.mean(dim=(2, 3)) - data["target"]).square().mean(dim=1) + heard.square().mean(dim=(1, 2))
    loss = loss + (error * data["weight"]).sum() / mean_over_processes(data["weight"].sum())
loss.backward()
results = {**norm.state_dict(), "loss": loss.detach(), "weight.grad": norm.weight.grad, "bias.grad": norm.bias.grad}
results |= {f"spectrogram.{key}": value for key, value in spectrogram.state_dict().items()}
results = {key: value.clone().contiguous() for key, value in results.items()} | {"images.grad": images.grad}
save_file(results, f"{folder}/{n_processes}.{rank}.safetensors")
if n_processes > 1:  # gloo's threads end with their group, not with the interpreter
    torch.distributed.barrier()
    torch.distributed.destroy_process_group()
"""


def run_together(folder: Path, n_processes: int) -> list[dict[str, torch.Tensor]]:
    """The script in several processes; what each of them ends with."""
    commands = [[sys.executable, "-c", SHARE, str(folder), str(rank), str(n_processes)] for rank in range(n_processes)]
    processes = [subprocess.Popen(command, stderr=subprocess.PIPE, text=True) for command in commands]
    errors = [process.communicate(timeout=300)[1] for process in processes]
    assert [process.returncode for process in processes] == [0] * n_processes, errors
    return [load_file(folder / f"{n_processes}.{rank}.safetensors") for rank in range(n_processes)]


def test_two_processes_normalise_and_weigh_like_one_with_all_items(tmp_path):
    generator = torch.Generator().manual_seed(0)
    begun = torch.ones(8, 32000, dtype=torch.bool)
    begun[1, :20000] = False  # the processes' items differ in how much of them counts
    data = {
        "images": torch.rand(8, 5, 6, 7, generator=generator) * torch.arange(1, 9)[:, None, None, None],
        "wave": 0.02 * torch.randn(8, 32000, generator=generator),
        "begun": begun,
        "target": torch.randn(8, 5, generator=generator),
        "weight": torch.tensor([1.0, 0, 0, 1, 1, 1, 2, 1]),
    }
    save_file(data, tmp_path / "data.safetensors")
    (one,), pair = run_together(tmp_path, 1), run_together(tmp_path, 2)
    for key in one.keys() - {"loss", "images.grad", "weight.grad", "bias.grad"}:
        for process in pair:
            torch.testing.assert_close(process[key], one[key], rtol=1e-5, atol=1e-6)
    for key in ("loss", "weight.grad", "bias.grad"):  # DistributedDataParallel takes the mean of gradients
        torch.testing.assert_close((pair[0][key] + pair[1][key]) / 2, one[key], rtol=1e-4, atol=1e-5)
    of_images = torch.cat([process["images.grad"] for process in pair]) / 2
    torch.testing.assert_close(of_images, one["images.grad"], rtol=1e-4, atol=1e-6)


def losses_of(command: list[str], folder: Path, batch_size: int, dataset: Path) -> tuple[list[float], Path]:
    """The loss of every step of a training, and its last checkpoint."""
    program = str(Path(sys.executable).with_name("lerobot-train"))
    options = [
        "--policy.type=playbyear",
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        "--policy.image_size=32",
        "--policy.vision_width=8",
        "--policy.audio_window_s=0.9",
        "--policy.n_memory_steps=3",
        "--policy.n_supervised_steps=4",
        "--policy.hidden_size=64",
        *(f"--policy.augmentation_{name}=0" for name in ("crop", "brightness", "hue", "degrees", "translate", "scale")),
        "--dataset.repo_id=tests/noise",
        f"--dataset.root={dataset}",
        f"--output_dir={folder}",
        f"--batch_size={batch_size}",
        "--num_workers=0",
        "--steps=6",
        "--save_freq=6",
        "--log_freq=1",
        "--seed=3",
        "--wandb.enable=false",
    ]
    result = subprocess.run(
        [*command, program, *options],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    output = result.stdout + result.stderr
    assert result.returncode == 0, output[-4000:]
    losses = [float(found) for found in re.findall(r"loss:([\d.]+)", output)]
    return losses, folder / "checkpoints" / "last" / "pretrained_model" / "model.safetensors"


@pytest.mark.slow
def test_accelerate_in_two_processes_learns_what_one_with_twice_the_batch_learns(tmp_path):
    dataset = tmp_path / "dataset"
    make_dataset(dataset, (30, 30), image_size=16)
    accelerate = str(Path(sys.executable).with_name("accelerate"))
    launch = [accelerate, "launch", "--multi_gpu", "--num_processes=2", "--num_machines=1", "--mixed_precision=no"]
    together, their_weights = losses_of([*launch, "--dynamo_backend=no"], tmp_path / "two", 4, dataset)
    alone, weights = losses_of([sys.executable], tmp_path / "one", 8, dataset)
    assert len(alone) == len(together) == 6
    assert together == pytest.approx(alone, abs=2e-3)  # three decimals are printed
    ours, theirs = load_file(weights), load_file(their_weights)
    for key in (key for key in ours if key.endswith(("mean", "variance", "running_var"))):
        torch.testing.assert_close(theirs[key], ours[key], rtol=1e-2, atol=1e-3)
