"""`--expert.type=teleop`: its options, and how everything that a person needs is put together."""

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
from lerobot import teleoperators
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig, make_teleoperator_from_config
from lerobot.teleoperators.gamepad import GamepadTeleop

from lerobot_playbyear.compat import has_gamepad, import_devices
from lerobot_playbyear.episodes.expert import Expert, ExpertConfig, ExpertError
from lerobot_playbyear.teleoperation.actions import KNOWN_DIRECTIONS, ActionMapping, Gripper
from lerobot_playbyear.teleoperation.controls import OVERRIDE, TAKEN
from lerobot_playbyear.teleoperation.expert import TeleopExpert
from lerobot_playbyear.teleoperation.keyboard import MOVES, KeyboardWindowTeleop, KeyboardWindowTeleopConfig
from lerobot_playbyear.teleoperation.levels import microphone_blocks
from lerobot_playbyear.teleoperation.pace import Pace
from lerobot_playbyear.teleoperation.speaker import Speaker
from lerobot_playbyear.teleoperation.window import Window
from lerobot_playbyear.teleoperation.window_process import PRINTLESS

import_devices(teleoperators)  # registers --expert.teleop.type=so101_leader and the others

_MOVING_KEYS: Mapping[str, list[tuple[str, str]]] = {
    "keyboard_window": [("Arrows", "right, left, away, near"), ("E  D", "up, down")],
    "keyboard_ee": [("Arrows", "right, left, away, near"), ("Shift", "left: down, right: up")],
    "gamepad": [("Sticks", "left: plane, right: height"), ("RB", "hold to take over")],
}


@ExpertConfig.register_subclass("teleop")
@dataclass
class TeleopExpertConfig(ExpertConfig):
    """A person with any LeRobot teleoperator.

    Args:
        teleop: What they move the arm with: `keyboard_window` (the keys of the window, nothing to install), `keyboard_ee`,
            `gamepad`, or another registered one.
        speed: What a full displacement is, as a share of the largest that the environment takes.
        directions: What moves the hand along x, y and z, such as `-y,x,z`. None: what fits the view of our tasks.
        gripper_cooldown_s: For how long after a change the gripper cannot change again [s]; the paper's and our tasks' is 2.
        steps_per_second: Control steps per second; fewer than the environment's are slow motion. None: the environment's.
        begin_paused: Each attempt waits until the person presses P.
        takeover: How a person takes over from a policy: `hold` the key, or `toggle` it with one press, and hand back with
            another.
        takeover_key: The key, such as `space` or `b`; most pedals are keyboards with one key.
        play_sound: Play the first microphone, if the package sounddevice is installed.
    """

    teleop: TeleoperatorConfig = field(default_factory=KeyboardWindowTeleopConfig)
    speed: float = 0.3
    directions: str | None = None
    gripper_cooldown_s: float = 2.0
    steps_per_second: float | None = None
    begin_paused: bool = True
    takeover: str = "hold"
    takeover_key: str = OVERRIDE
    play_sound: bool = True

    def make(self, env: gym.Env, demonstrates: bool = False) -> Expert:
        """The person, beside a policy or with nobody else at the controls."""
        self._check(env)
        kind, env_fps = self.teleop.type, float(env.metadata["render_fps"])
        fps = self.steps_per_second or env_fps
        with ExitStack() as stack:  # closes what was opened if a later part fails
            window = Window(f"Play it by ear: {_title(env)}")
            stack.callback(window.close)
            teleop = connect_teleoperator(self.teleop, window)
            stack.callback(teleop.disconnect)
            directions = self.directions or KNOWN_DIRECTIONS.get(kind, "x,y,z")
            mapping = ActionMapping(_features(teleop), env.action_space, directions, self.speed)
            toggles = self.takeover == "toggle"
            expert = TeleopExpert(
                window=window,
                teleop=teleop,
                mapping=mapping,
                gripper=Gripper(round(self.gripper_cooldown_s * env_fps)),
                pace=Pace(fps),
                speaker=self._make_speaker(env, fps, env_fps),
                keys=key_help(kind, mapping, demonstrates, toggles, self._key),
                begins_paused=self.begin_paused,
                demonstrates=demonstrates,
                toggles=toggles,
                override=self._key,
            )
            stack.pop_all()
        return expert

    @property
    def _key(self) -> str:
        """As the window names it."""
        return self.takeover_key.lower()

    def _check(self, env: gym.Env) -> None:
        if env.render_mode != "rgb_array":
            raise ExpertError(
                f"--expert.type=teleop shows what env.render() gives, and the environment's render_mode is "
                f"{env.render_mode!r}: give --env.render_mode=rgb_array."
            )
        if not 0 < self.speed <= 1:
            raise ExpertError(f"--expert.speed={self.speed}: give a share above 0 and at most 1.")
        if self.gripper_cooldown_s < 0:
            raise ExpertError(f"--expert.gripper_cooldown_s={self.gripper_cooldown_s}: give 0 or more seconds.")
        if self.steps_per_second is not None and not self.steps_per_second > 0:
            raise ExpertError(f"--expert.steps_per_second={self.steps_per_second}: give a number above 0.")
        if not (self._key in PRINTLESS or (len(self._key) == 1 and self._key.isprintable() and self._key != " ")):
            raise ExpertError(
                f"--expert.takeover_key={self.takeover_key!r}: give a letter, a digit, or one of {', '.join(PRINTLESS)}."
            )
        moves = MOVES if isinstance(self.teleop, KeyboardWindowTeleopConfig) else ()
        if self._key in TAKEN or self._key in moves:
            raise ExpertError(
                f"--expert.takeover_key={self.takeover_key!r} means something else already: give another one than "
                f"{', '.join(sorted({*TAKEN, *moves}))}, such as space or b."
            )
        if self.takeover not in ("hold", "toggle"):
            raise ExpertError(f"--expert.takeover={self.takeover!r}: give hold or toggle.")
        if not env.metadata.get("render_fps"):
            raise ExpertError("The environment does not say its steps per second, metadata['render_fps'].")

    def _make_speaker(self, env: gym.Env, fps: float, env_fps: float) -> Speaker:
        assert isinstance(env.observation_space, gym.spaces.Dict)
        blocks = microphone_blocks(env.observation_space.sample())
        size = len(next(iter(blocks.values()), ()))
        reason = "" if blocks else "no microphone"
        if not self.play_sound:
            reason = "--expert.play_sound=false"
        elif fps != env_fps:
            reason = "slow motion"
        return Speaker(round(size * env_fps), size, reason)


def connect_teleoperator(config: TeleoperatorConfig, window: Window) -> Teleoperator:
    """Make and connect a LeRobot teleoperator.

    Args:
        config: Its configuration.
        window: Whose keys `keyboard_window` takes.

    Raises:
        ExpertError: Something is not installed or not plugged in; the message says what.
    """
    option = f"--expert.teleop.type={config.type}"
    try:
        if isinstance(config, KeyboardWindowTeleopConfig):
            teleop: Teleoperator = KeyboardWindowTeleop(config, window.keys)
        else:
            teleop = make_teleoperator_from_config(config)
        teleop.connect()
    except ImportError as error:
        raise ExpertError(
            f"{option}: {error} Or take --expert.teleop.type=keyboard_window, which needs nothing."
        ) from error
    except Exception as error:  # whatever a device may say
        raise ExpertError(f"{option} cannot be connected: {error}") from error
    has_pad = not isinstance(teleop, GamepadTeleop) or has_gamepad(teleop)
    if not teleop.is_connected or not has_pad:
        teleop.disconnect() if teleop.is_connected else None
        hint = {
            "gamepad": "no gamepad was found. Plug one in",
            "keyboard_ee": "pynput hears keys on an X11 screen, Windows and macOS, not on Wayland or without a screen",
        }.get(config.type, "it says that it is not connected. Plug it in")
        raise ExpertError(f"{option}: {hint}, or take --expert.teleop.type=keyboard_window.")
    return teleop


def _features(teleop: Teleoperator) -> dict[str, Any]:
    try:
        return dict(teleop.action_features)
    except AttributeError as error:  # LeRobot's `keyboard`, which is for one robot's joints
        raise ExpertError(
            f"--expert.teleop.type={teleop.name} does not say what it gives: take another one."
        ) from error


def key_help(
    kind: str, mapping: ActionMapping, demonstrates: bool, toggles: bool = False, override: str = OVERRIDE
) -> list[tuple[str, str]]:
    """What to press, and what it does.

    Args:
        kind: The teleoperator's type.
        mapping: Knows whether there is a gripper.
        demonstrates: Whether nobody but the person acts.
        toggles: Whether a press takes over, or hands back.
        override: The key that does.
    """
    takeover = [] if demonstrates else [(override.title(), "take over, hand back" if toggles else "hold to take over")]
    gripper = [("G", "open or close the gripper")] if mapping.has_gripper else []
    return [
        *takeover,
        *_MOVING_KEYS.get(kind, []),
        *gripper,
        ("P", "pause"),
        ("S", "success: end and keep"),
        ("R", "throw away, next one" if not demonstrates else "throw away, once more"),
        ("Q", "end as failed"),
        ("Esc", "leave"),
    ]


def _title(env: gym.Env) -> str:
    return env.spec.id.split("/")[-1] if env.spec is not None else type(env.unwrapped).__name__
