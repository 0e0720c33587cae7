"""What does the arm's state tell of a touch? A classifier looks for contact in what a deaf policy observes.

    python -m experiments.leaks

A hand sweeps as the expert does, but feels nothing and goes on until the cube was shoved too far; a twin with the same
random numbers sweeps where no cube is. From the last ten observations of the arm's state, a small network has to tell the
frames in contact from the twin's same frames; its area under the curve on held-out episodes is 0.5 where nothing leaks.
Rows are sensors, columns what the network is shown.
"""

import json
from dataclasses import replace

import gymnasium as gym
import numpy as np
import torch
from torch import nn

from experiments.protocol import RESULTS, command_line, save
from gym_playbyear.experts import ExpertConfig, GraspExpert
from gym_playbyear.proprioception import NO_SENSOR_NOISE, SensorNoise
from lerobot_playbyear.episodes.play import Observation, play

TASK = "OccludedGrasp-v0"
_ASIDE = -0.15  # x of a cube that is not in the way [m]
_HISTORY = 10  # frames, as long as the policy's memory
_PARTS = {"all": range(7), "hand": range(3), "fingers": (3, 4), "finger velocities": (5, 6)}
_SENSORS = {
    "the simulator's own state": NO_SENSOR_NOISE,
    "noise of 0.2 mm, velocities of their own": SensorNoise(finger=0.0002, quantum_finger=0.0001, differentiated=False),
    "noise of 0.2 mm, velocities from widths": SensorNoise(finger=0.0002, quantum_finger=0.0001),
    "widths in steps of 0.5 mm, velocities from them": SensorNoise(),
}


class Numb:
    """Sweeps as the expert does, and feels no touch. Remembers in which steps it was sweeping."""

    def reset(self, env: gym.Env) -> None:
        self._script = GraspExpert(env.unwrapped, ExpertConfig(contact_force=np.inf))
        self.sweeping: list[bool] = []

    def act(self, observation: Observation) -> np.ndarray:
        self.sweeping.append(self._script.phase == "sweep")
        return self._script.act()


def twin_sweeps(sensors: SensorNoise, seeds: range) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frames in which a hand that feels nothing touches the cube, and the same frames of twins without a cube in the way.

    Returns:
        States (N, 10, 7), the hand's relative to the newest; whether the cube was touched (N,); the seeds (N,).
    """
    env = gym.make(f"gym_playbyear:gym_playbyear/{TASK}", image_size=8, sound="none", disable_env_checker=True)
    task = env.unwrapped
    task.definition = replace(task.definition, sensors=sensors)
    windows, labels = [], []
    for seed in seeds:
        states, contacts = _sweep(env, seed, None)
        without, _ = _sweep(env, seed, (_ASIDE, float(task.cube_position[1])))
        for end in (t + 1 for t in contacts if _HISTORY <= t + 1 <= len(without)):
            windows += [states[end - _HISTORY : end], without[end - _HISTORY : end]]
            labels += [(True, seed), (False, seed)]
    env.close()
    touched, of_seed = map(np.array, zip(*labels, strict=True))
    stacked = np.array(windows)
    stacked[..., :3] -= stacked[:, -1:, :3]
    return stacked, touched, of_seed


def _sweep(env: gym.Env, seed: int, cube: tuple[float, float] | None) -> tuple[list[np.ndarray], list[int]]:
    """The observed states of a numb sweep, and in which of them the cube is touched."""
    numb = Numb()
    options = {} if cube is None else {"cube_position": cube}
    episode = play(env, numb, seed, options=options, watch=lambda: env.unwrapped.contact_forces["gripper-cube"] > 0)
    steps = enumerate(zip(numb.sweeping, episode.watched[1:], strict=True), start=1)
    contacts = [step for step, (sweeping, touched) in steps if sweeping and touched]
    return [observation["agent_pos"] for observation in episode.observations], contacts


def area_under_curve(scores: np.ndarray, positive: np.ndarray) -> float:
    """The probability that a positive scores above a negative."""
    return float(np.mean(scores[positive][:, None] > scores[~positive]))


def contact_auc(windows: np.ndarray, touched: np.ndarray, held_out: np.ndarray, dims: list[int]) -> float:
    """How well a network with two hidden layers tells contact from free sweep on held-out episodes."""
    torch.manual_seed(0)
    inputs = torch.tensor(windows[:, :, dims].reshape(len(windows), -1), dtype=torch.float32)
    train = torch.tensor(~held_out)
    inputs = (inputs - inputs[train].mean(0)) / (inputs[train].std(0) + 1e-6)
    labels = torch.tensor(touched, dtype=torch.float32)
    network = nn.Sequential(
        nn.Linear(inputs.shape[1], 64), nn.ReLU(), nn.Dropout(0.3), nn.Linear(64, 64), nn.ReLU(), nn.Linear(64, 1)
    )
    optimizer = torch.optim.AdamW(network.parameters(), 1e-3, weight_decay=0.01)
    weight = (~touched & ~held_out).sum() / (touched & ~held_out).sum()
    loss_of = nn.BCEWithLogitsLoss(pos_weight=torch.tensor(float(weight)))
    frames = train.nonzero().squeeze(1)
    for _ in range(2000):
        batch = frames[torch.randint(len(frames), (256,))]
        loss = loss_of(network(inputs[batch]).squeeze(1), labels[batch])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    network.eval()
    with torch.no_grad():
        scores = network(inputs[~train]).squeeze(1).numpy()
    return area_under_curve(scores, touched[held_out])


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--n_episodes", type=int, default=200)
    n_episodes = parser.parse_args().n_episodes
    report = {}
    for name, sensors in _SENSORS.items():
        windows, touched, seeds = twin_sweeps(sensors, range(3000, 3000 + n_episodes))
        held_out = seeds % 4 == 0
        report[name] = {
            part: round(contact_auc(windows, touched, held_out, list(dims)), 3) for part, dims in _PARTS.items()
        }
        print(name, f"{touched.sum()} of {len(touched)} frames in contact", json.dumps(report[name]), flush=True)
    save(RESULTS / "leaks.json", report, indent=1)


if __name__ == "__main__":
    main()
