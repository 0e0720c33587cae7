"""What hearing costs in training: an update of the preset `cpu`, by the step between a spectrogram's columns.

    python benchmarks/hearing.py

Neighbouring windows share the columns in which they coincide: with 25 ms all of them, with the paper's 35 ms those of every
seventh frame. The limit is the same update deaf. Noise as data.
"""

import argparse
import json

import torch
from common import Row, in_turns, medians, parser_for, run
from policies import make_policy, random_runs
from training import update_of

from lerobot_playbyear.policy.optimization import computes_bfloat16
from lerobot_playbyear.training.heap import keep_freed_memory
from lerobot_playbyear.training.presets import RECIPES

SETUPS = {
    "one microphone of 16 kHz, 20 Hz": {"n_microphones": 1, "sample_rate": 16000, "fps": 20},
    "two microphones of 48 kHz, 5 Hz": {"n_microphones": 2, "sample_rate": 48000, "fps": 5},
}
EARS = {"25 ms": {"hop_s": 0.025}, "35 ms": {"hop_s": 0.035}, "deaf": {"use_audio": False}}


def measure(args: argparse.Namespace) -> list[Row]:
    """One row for each setup."""
    recipe = json.loads((RECIPES / "cpu.json").read_text())
    preset = {name: value for name, value in recipe["policy"].items() if name not in ("type", "device", "push_to_hub")}
    amp = computes_bfloat16()
    updates = {}
    for setup, sizes in SETUPS.items():
        for ear, options in EARS.items():
            policy = make_policy(**sizes, **{**preset, **options}).train()
            batch = random_runs(policy.config, recipe["batch_size"])

            def loss(policy=policy, batch=batch) -> torch.Tensor:
                with torch.autocast("cpu", dtype=torch.bfloat16, enabled=amp):
                    return policy(batch)[0]

            updates[setup, ear] = update_of(policy, loss)
    ms = {key: 1000 * value for key, value in medians(in_turns(updates, args.turns)).items()}
    return [
        Row(
            f"an update of the preset `cpu`, {setup}",
            ms[setup, "25 ms"],
            "ms",
            "columns every 35 ms",
            ms[setup, "35 ms"],
            "deaf",
            ms[setup, "deaf"],
        )
        for setup in SETUPS
    ]


if __name__ == "__main__":
    keep_freed_memory()
    torch.set_num_threads(1)
    run("hearing", parser_for(__doc__, turns=9), measure)
