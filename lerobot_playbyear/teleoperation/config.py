"""`--expert.type=teleop`: its options, and how everything that a person needs is put together."""

from contextlib import ExitStack
from dataclasses import dataclass, field

import gymnasium as gym
from lerobot import teleoperators
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig, make_teleoperator_from_config
from lerobot.teleoperators.gamepad import GamepadTeleop

from lerobot_playbyear.compat import has_gamepad, import_devices
from lerobot_playbyear.episodes.experts import Expert, ExpertConfig, ExpertError
from lerobot_playbyear.teleoperation.controls import MOVES, TAKEN, KeyboardWindowTeleop, KeyboardWindowTeleopConfig
from lerobot_playbyear.teleoperation.expert import TeleopExpert
from lerobot_playbyear.teleoperation.window import NAMED_KEYS, Window

import_devices(teleoperators)  # registers --expert.teleop.type=so101_leader and the others


@ExpertConfig.register_subclass("teleop")
@dataclass
class TeleopExpertConfig(ExpertConfig):
    """A person with any LeRobot teleoperator.

    Args:
        teleop: LeRobot teleoperator that moves the arm: `keyboard_window` (the window's keys; nothing to install),
            `gamepad`, or another registered one, but for `keyboard_ee`, which hears what is typed into other windows.
        speed: Size of a full displacement, as a share of the environment's largest.
        directions: Axes that move the hand along x, y and z, such as `-y,x,z`. None: those that fit the view of our tasks.
        gripper_cooldown_s: Least time between two changes of the gripper [s]. The paper's and our tasks' is 2.
        steps_per_second: Control steps per second. Fewer than the environment's are slow motion. None: the environment's.
        begin_paused: Wait before each episode until the person presses Space.
        takeover: How a person takes over: `toggle` with one key press and hand back with another, or `hold` the key.
        takeover_key: The key, such as `tab` or `b`. Most pedals are keyboards with one key.
        play_sound: Play the first microphone, if the package sounddevice is installed.
    """

    teleop: TeleoperatorConfig = field(default_factory=KeyboardWindowTeleopConfig)
    speed: float = 0.3
    directions: str | None = None
    gripper_cooldown_s: float = 2.0
    steps_per_second: float | None = None
    begin_paused: bool = True
    takeover: str = "toggle"
    takeover_key: str = "tab"
    play_sound: bool = True

    def make(self, env: gym.Env, demonstrates: bool = False) -> Expert:
        """The person, beside a policy or with nobody else at the controls."""
        self._check(env)
        title = env.spec.id.split("/")[-1] if env.spec is not None else type(env.unwrapped).__name__
        with ExitStack() as stack:  # closes what was opened if a later part fails
            window = Window(f"Play it by ear: {title}")
            stack.callback(window.close)
            teleop = connect_teleoperator(self.teleop, window)
            stack.callback(teleop.disconnect)
            expert = TeleopExpert(self, env, window, teleop, demonstrates)
            stack.pop_all()
        return expert

    def _check(self, env: gym.Env) -> None:
        key, fps = self.takeover_key.lower(), self.steps_per_second
        is_key = key in NAMED_KEYS or (len(key) == 1 and key.isprintable() and key != " ")
        taken = {*TAKEN, *(MOVES if isinstance(self.teleop, KeyboardWindowTeleopConfig) else ())}
        for name, is_good, wanted in (
            ("speed", 0 < self.speed <= 1, "give a share above 0 and at most 1"),
            ("gripper_cooldown_s", self.gripper_cooldown_s >= 0, "give 0 or more seconds"),
            ("steps_per_second", fps is None or fps > 0, "give a number above 0"),
            ("takeover", self.takeover in ("hold", "toggle"), "give hold or toggle"),
            ("takeover_key", is_key, f"give a letter, a digit, or one of {', '.join(NAMED_KEYS)}"),
            (
                "takeover_key",
                key not in taken,
                f"it means something else already: give another one than {', '.join(sorted(taken))}, such as tab or b",
            ),
        ):
            if not is_good:
                raise ExpertError(f"--expert.{name}={getattr(self, name)!r}: {wanted}.")
        if env.render_mode != "rgb_array":
            raise ExpertError(
                f"--expert.type=teleop shows what env.render() gives, and the environment's render_mode is "
                f"{env.render_mode!r}: give --env.render_mode=rgb_array."
            )
        if not env.metadata.get("render_fps"):
            raise ExpertError("The environment does not say its steps per second, metadata['render_fps'].")


def connect_teleoperator(config: TeleoperatorConfig, window: Window) -> Teleoperator:
    """Make and connect a LeRobot teleoperator.

    Args:
        config: Its configuration.
        window: Whose keys `keyboard_window` takes.

    Raises:
        ExpertError: Something is not installed or not plugged in; the message says what.
    """
    option = f"--expert.teleop.type={config.type}"
    if config.type == "keyboard_ee":
        raise ExpertError(f"{option} hears what is typed in other windows: give --expert.teleop.type=keyboard_window.")
    try:
        if isinstance(config, KeyboardWindowTeleopConfig):
            teleop: Teleoperator = KeyboardWindowTeleop(config, window.keys)
        else:
            teleop = make_teleoperator_from_config(config)
        teleop.connect()
        _ = teleop.action_features  # LeRobot's `keyboard`, which is for one robot's joints, has none
    except Exception as error:  # also what is not installed, and whatever a device may say
        raise ExpertError(
            f"{option} cannot be connected: {error}. --expert.teleop.type=keyboard_window needs nothing."
        ) from error
    has_pad = not isinstance(teleop, GamepadTeleop) or has_gamepad(teleop)
    if not teleop.is_connected or not has_pad:
        teleop.disconnect() if teleop.is_connected else None
        hint = "no gamepad was found" if config.type == "gamepad" else "it says that it is not connected"
        raise ExpertError(f"{option}: {hint}. Plug it in, or take --expert.teleop.type=keyboard_window.")
    return teleop
