"""How cost grows with the work: episodes in memory, environments per batch, cameras and microphones.

    python benchmarks/scaling.py

Not part of `make bench`: stores of up to 1,000 episodes are made of noise in memory (2.4 GB), so nothing is recorded.
Medians of a few turns.
"""

import argparse
from collections.abc import Callable, Sequence

import numpy as np
import torch
from common import Row, in_turns, medians, parser_for, run
from policies import PIXELS, SAMPLES, make_policy, random_observations, random_runs

from lerobot_playbyear.datasets import EpisodeStore

EPISODES = (10, 100, 1000)
ENVIRONMENTS = (1, 4, 16, 64)
SENSORS = (1, 2, 4)
_FRAMES = 100  # of an episode
_BATCH = 32  # windows


def noise_store(n_episodes: int) -> EpisodeStore:
    """Episodes of noise in memory."""
    n, generator = n_episodes * _FRAMES, np.random.default_rng(0)
    columns = {
        "observation.images.front": generator.integers(0, 256, (n, 3, PIXELS, PIXELS), np.uint8),
        "observation.audio.gripper": generator.integers(-1000, 1000, (n, SAMPLES), np.int16),
        "observation.state": generator.random((n, 7), np.float32),
        "action": generator.random((n, 4), np.float32),
    }
    starts = range(0, n, _FRAMES)
    tensors = {key: torch.from_numpy(values) for key, values in columns.items()}
    return EpisodeStore(tensors, list(starts), [start + _FRAMES for start in starts], 20)


def windows_work(n_episodes: int) -> Callable[[], object]:
    """Batches of windows as training uses them."""
    store, rng = noise_store(n_episodes), np.random.default_rng(1)
    deltas: dict[str, Sequence[int]] = dict.fromkeys(store.keys, range(-11, 1))
    deltas["observation.audio.gripper"] = range(-48, 1)
    return lambda: [store.windows(rng.integers(len(store), size=_BATCH), deltas) for _ in range(20)]


def step_work(n_environments: int, **options) -> Callable[[], object]:
    """A control step of several episodes at once."""
    policy = make_policy(**options).eval()
    policy.reset()
    observations = iter(random_observations(policy.config, 4, n_environments) * 1000)

    def act() -> None:
        with torch.inference_mode():
            policy.select_action(next(observations))

    return act


def update_work(n_sensors: int) -> Callable[[], object]:
    """Forward and backward pass of a small policy with several cameras and microphones."""
    policy = make_policy(n_sensors, n_sensors, image_size=84, vision_width=16, n_supervised_steps=8).train()
    batch = random_runs(policy.config, 4)

    def update() -> None:
        policy(batch)[0].backward()
        policy.zero_grad()

    return update


def measure(args: argparse.Namespace) -> list[Row]:
    rows = []
    small = {"image_size": 48, "vision_width": 16}
    for n in EPISODES:
        seconds = medians(in_turns({"windows": windows_work(n)}, args.turns))["windows"]
        rows.append(Row(f"windows from a store of {n} episodes", 20 * _BATCH / seconds, "windows/s"))
    steps = medians(in_turns({n: step_work(n, **small) for n in ENVIRONMENTS}, 5 * args.turns, warm_up=3))
    rows += [
        Row(f"control step of {n} environments in one batch, preset `cpu`'s network", 1e3 * steps[n], "ms")
        for n in ENVIRONMENTS
    ]
    sensors = {n: step_work(1, n_cameras=n, n_microphones=n, **small) for n in SENSORS}
    latency = medians(in_turns(sensors, 5 * args.turns, warm_up=3))
    updates = medians(in_turns({n: update_work(n) for n in SENSORS}, args.turns))
    for n in SENSORS:
        rows.append(Row(f"control step, {n} cameras and {n} microphones, the same", 1e3 * latency[n], "ms"))
        rate = 4 * 8 / updates[n]
        rows.append(Row(f"training, 84 px, width 16, {n} cameras and {n} microphones", rate, "windows/s"))
    return rows


if __name__ == "__main__":
    run("scaling", parser_for(__doc__, turns=5), measure)
