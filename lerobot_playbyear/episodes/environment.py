"""How an environment is made, and what there is to know about it before its first episode."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import gymnasium as gym

from lerobot_playbyear.datasets.errors import PlaybyearError
from lerobot_playbyear.datasets.frame_rate import frame_rate

if TYPE_CHECKING:  # a process that plays scripts imports nothing of LeRobot
    from lerobot.envs import EnvConfig


class RolloutError(PlaybyearError, RuntimeError):
    """No episode can be played in the environment; the message says why."""


@dataclass(frozen=True)
class EnvSpec:
    """How to make an environment: what `gymnasium.make` is given.

    Args:
        id: Its id, with the package that registers it: `package:namespace/Name-v0`.
        kwargs: Its arguments.
    """

    id: str
    kwargs: dict[str, Any] = field(default_factory=dict)

    def make(self) -> gym.Env:
        """Makes the environment and resets it once, so that whatever is missing shows now.

        Raises:
            RolloutError: It cannot be made: not installed, a wrong argument, no OpenGL library.
        """
        try:
            env = gym.make(self.id, disable_env_checker=True, **self.kwargs)
            env.reset(seed=0)
        except Exception as error:
            raise RolloutError(f"{self.id} does not start: {error}") from error
        return env


def env_spec(env: "EnvConfig") -> EnvSpec:
    """How Gymnasium makes the environment that a LeRobot configuration describes.

    Raises:
        RolloutError: It asks for pictures of sound: datasets get them from the sound that is recorded.
    """
    if getattr(env, "spectrogram", None) is not None:
        raise RolloutError(
            f"--env.spectrogram={env.spectrogram}: these pictures are for policies of LeRobot that act in lerobot-eval, "
            "lerobot-train or playbyear-video. Leave it out here: playbyear-attach-spectrogram makes them of what is recorded."
        )
    return EnvSpec(f"{env.package_name}:{env.gym_id}", dict(env.gym_kwargs))


@dataclass(frozen=True)
class EnvFacts:
    """What a dataset needs to know about an environment before its first episode."""

    observation_space: gym.spaces.Dict
    action_space: gym.spaces.Box
    fps: int
    has_expert: bool
    state_names: list[str] | None = None
    action_names: list[str] | None = None


def env_facts(env: gym.Env) -> EnvFacts:
    """Reads off an environment what a dataset of it looks like.

    Raises:
        RolloutError: Its observation or action space is not of the kind that LeRobot's datasets hold.
    """
    if not isinstance(env.observation_space, gym.spaces.Dict):
        raise RolloutError(f"The observation space must be a Dict, but it is {env.observation_space}.")
    if not isinstance(env.action_space, gym.spaces.Box):
        raise RolloutError(f"The action space must be a Box, but it is {env.action_space}.")
    fps = frame_rate(env.metadata.get("render_fps") or 0)
    if not isinstance(fps, int):
        raise RolloutError(f"metadata['render_fps'] is {fps}; wanted whole steps per second, such as {round(fps)}.")
    has_expert = callable(getattr(env.unwrapped, "scripted_expert", None))
    names = (getattr(env.unwrapped, name, None) for name in ("state_names", "action_names"))
    return EnvFacts(env.observation_space, env.action_space, fps, has_expert, *names)


def task_description(env: gym.Env) -> str:
    """What is to be done, in words, as LeRobot asks an environment; empty if it does not say."""
    for name in ("task_description", "task"):
        if env.has_wrapper_attr(name):
            return str(env.get_wrapper_attr(name))
    return ""
