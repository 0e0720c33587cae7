"""An expert of your own for an environment of your own: Gymnasium's mountain car learns from someone who knows how to swing.

    python examples/own_expert.py --output_dir=outputs/own_expert

Three steps, each a command of its own in real life: record demonstrations, train a policy on them, and let the expert
correct it while it drives. What you write is `Momentum`, and the few lines that name it for `--expert.type`.
"""

import argparse
import sys
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
from gymnasium.envs.classic_control import Continuous_MountainCarEnv
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs import EnvConfig

from lerobot_playbyear.dagger import Expert, ExpertConfig
from lerobot_playbyear.recording.record import RecordConfig, RecordDatasetConfig, record
from lerobot_playbyear.scripts.commands import dagger, train


def push(velocity: float) -> np.ndarray:
    """The action that pushes the way the car rolls."""
    return np.array([1.0 if velocity >= 0 else -1.0], np.float32)


class Momentum(Expert):
    """Pushes the way the car rolls; takes over for a second when the policy has braked for half a second."""

    def reset(self, env: gym.Env) -> None:
        self.n_braked, self.n_left = 0, 0

    def wants_control(self, observation, policy_action) -> bool:
        self.velocity = observation["agent_pos"][1]
        self.n_left -= 1
        self.n_braked = self.n_braked + 1 if policy_action[0] * self.velocity <= 0 else 0
        if self.n_braked > 15:
            self.n_braked, self.n_left = 0, 30
        return self.n_left > 0

    def act(self) -> np.ndarray:
        return push(self.velocity)


@ExpertConfig.register_subclass("momentum")
@dataclass
class MomentumConfig(ExpertConfig):
    """`--expert.type=momentum`"""

    def make(self, env: gym.Env) -> Expert:
        return Momentum()


# The environment as LeRobot wants one: observations by name, and whether the task is solved.


class Car(Continuous_MountainCarEnv):
    """Gymnasium's `MountainCarContinuous`."""

    task, task_description = "MountainCar", "Drive up the hill on the right."

    def __init__(self, render_mode: str | None = None):
        super().__init__(render_mode=render_mode)
        self.observation_space = gym.spaces.Dict({"agent_pos": self.observation_space})

    def reset(self, *, seed=None, options=None):
        state, info = super().reset(seed=seed)
        return {"agent_pos": state}, info

    def step(self, action):
        state, reward, terminated, truncated, info = super().step(action)
        return {"agent_pos": state}, reward, terminated, truncated, {**info, "is_success": terminated}

    def scripted_expert(self):
        """For the demonstrations: the same idea, from the state itself."""
        return SimpleNamespace(act=lambda: push(self.state[1]))


gym.register("OwnCar-v0", Car, max_episode_steps=200)


@EnvConfig.register_subclass("own_car")
@dataclass
class CarConfig(EnvConfig):
    package_name, gym_id, gym_kwargs = "gymnasium", "OwnCar-v0", {}  # LeRobot has properties

    task: str | None = "OwnCar-v0"
    fps: int = 30
    features: dict[str, PolicyFeature] = field(
        default_factory=lambda: {
            "action": PolicyFeature(FeatureType.ACTION, (1,)),
            "agent_pos": PolicyFeature(FeatureType.STATE, (2,)),
        }
    )
    features_map: dict[str, str] = field(default_factory=lambda: {"action": "action", "agent_pos": "observation.state"})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output_dir", type=Path, default=Path("outputs/own_expert"))
    parser.add_argument("--steps", type=int, default=300, help="updates of the first policy")
    parser.add_argument("--episodes", type=int, default=5, help="attempts with corrections")
    parser.add_argument("--updates", type=int, default=50, help="updates after each of them")
    args = parser.parse_args()
    folder = args.output_dir
    demos = f"--dataset.repo_id=me/demos --dataset.root={folder / 'demos'}".split()
    small = ["--policy.use_vision=false", "--policy.use_audio=false", "--policy.hidden_size=64"]

    record(
        RecordConfig(CarConfig(), RecordDatasetConfig("me/demos", str(folder / "demos"), num_episodes=3), num_workers=0)
    )

    new = f"--policy.type=playbyear --policy.device=cpu --policy.push_to_hub=false --output_dir={folder / 'train'}".split()
    sys.argv[1:] = [*new, *small, *demos, f"--steps={args.steps}", "--batch_size=8"]
    train()

    sys.argv[1:] = [
        f"--policy.path={folder / 'train/checkpoints/last/pretrained_model'}",
        "--dataset.repo_id=me/demos",
        f"--dataset.root={folder / 'demos'}",
        "--interventions.repo_id=me/corrections",
        f"--interventions.root={folder / 'corrections'}",
        "--env.type=own_car",
        "--expert.type=momentum",
        f"--num_episodes={args.episodes}",
        f"--updates_per_episode={args.updates}",
        "--warmup_episodes=1",
        "--batch_size=8",
        "--eval.n_episodes=10",
        f"--output_dir={folder / 'dagger'}",
    ]
    dagger()


if __name__ == "__main__":
    main()
