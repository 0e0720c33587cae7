"""Several processes learn what one with all their data learns."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from dataset_factory import make_dataset
from safetensors.torch import load_file, save_file

SHARE = """
import sys
import torch
from safetensors.torch import load_file, save_file
from lerobot_playbyear.policy.batch_norm import SharedBatchNorm2d, mean_over_processes
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


@pytest.mark.slow
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


AUGMENTATIONS = ("crop", "brightness", "hue", "degrees", "translate", "scale")
WITHOUT_CHANCE = tuple(f"--policy.augmentation_{name}=0" for name in AUGMENTATIONS)
"""Augmentation is drawn per process; without it two processes see what one does."""

TINY = (
    "--policy.type=playbyear",
    "--policy.device=cpu",
    "--policy.push_to_hub=false",
    "--policy.image_size=32",
    "--policy.vision_width=8",
    "--policy.audio_window_s=0.9",
    "--policy.n_memory_steps=3",
    "--policy.n_supervised_steps=4",
    "--policy.hidden_size=64",
    *WITHOUT_CHANCE,
    "--num_workers=0",
    "--log_freq=1",
    "--seed=3",
)


def launch(n_processes: int, program: str, *options: object) -> str:
    """Runs a program in several processes through the real launcher, one thread each; what it printed."""
    folder = Path(sys.executable).parent
    command = [str(folder / program), *map(str, options)]
    if n_processes > 1:
        processes = ("--multi_gpu", f"--num_processes={n_processes}", "--num_machines=1", "--main_process_port=0")
        command = [
            str(folder / "accelerate"),
            "launch",
            *processes,
            "--mixed_precision=no",
            "--dynamo_backend=no",
            *command,
        ]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    result = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    output = result.stdout + result.stderr
    assert result.returncode == 0, output[-4000:]
    return output


def figures(folder: Path, kind: str) -> list[dict[str, Any]]:
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [line for line in lines if line["kind"] == kind]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    root = tmp_path_factory.mktemp("data") / "noise"
    make_dataset(root, (30, 30), image_size=48)
    return root


@pytest.mark.slow
def test_lerobots_training_in_two_processes_learns_what_one_with_twice_the_batch_learns(tmp_path, dataset):
    slowly = (
        "--policy.optimizer_lr=1e-5"  # Adam makes whole steps of rounding errors, and statistics follow the weights
    )
    data = ("--dataset.repo_id=tests/noise", f"--dataset.root={dataset}", "--steps=6", "--save_freq=6", slowly)
    losses, weights = [], []
    for n_processes in (2, 1):
        folder = tmp_path / str(n_processes)
        options = (*TINY, *data, f"--output_dir={folder}", f"--batch_size={8 // n_processes}")
        output = launch(n_processes, "lerobot-train", *options)
        losses.append([float(found) for found in re.findall(r"loss:([\d.]+)", output)])
        weights.append(load_file(folder / "checkpoints" / "last" / "pretrained_model" / "model.safetensors"))
    assert len(losses[0]) == len(losses[1]) == 6
    assert losses[0] == pytest.approx(losses[1], abs=2e-3)  # three decimals are printed
    for key in (key for key in weights[0] if key.endswith(("mean", "variance", "running_var"))):
        torch.testing.assert_close(weights[0][key], weights[1][key], rtol=1e-2, atol=1e-3)


@pytest.mark.slow
def test_training_in_two_processes_learns_what_one_with_twice_the_batch_learns(tmp_path, dataset):
    """Over 20 updates, from stores on the disk that one of the two makes, with one checkpoint and one line per update."""
    options = ("--dataset.repo_id=tests/noise", "--dataset.eval_split=0.5", "--eval_steps=10")
    data = (f"--dataset.root={dataset}", *options)
    losses = {}
    for n_processes in (2, 1):
        folder, cache = tmp_path / str(n_processes), tmp_path / f"cache{n_processes}"
        store = ("--store=disk", f"--store.cache={cache}")
        options = (*TINY, *data, *store, "--steps=20", "--save_freq=10", f"--batch_size={8 // n_processes}")
        launch(n_processes, "playbyear-train", *options, f"--output_dir={folder}")
        losses[n_processes] = [line["loss"] for line in figures(folder, "train")]
        assert [line["step"] for line in figures(folder, "train")] == list(range(1, 21))
        assert [line["step"] for line in figures(folder, "validation")] == [10, 20]
        assert sorted(path.name for path in (folder / "checkpoints").iterdir()) == ["000010", "000020", "last"]
        assert len([path for path in cache.iterdir() if path.is_dir()]) == 2
    assert losses[2] == pytest.approx(losses[1], rel=2e-3)
    last = tmp_path / "2" / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
    launch(2, "playbyear-train", "--resume=true", f"--config_path={last}", "--steps=22")
    assert figures(tmp_path / "2", "train")[-1]["step"] == 22
