"""What the window tells a person, and how it looks: a frame for the scene in the colour of who acts, and a panel beside it."""

import math
import textwrap
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cache

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from lerobot_playbyear.teleoperation.speaker import FLOOR_DB

HISTORY_S = 4.0
"""How far back the microphones' levels are shown [s]."""

SIZE = (1000, 748)
"""Width and height of the window's picture."""

_BANNER, _BORDER, _VIEW = 56, 12, 680
SCENE = (_BORDER, _BANNER, _VIEW, _VIEW)
"""Where the scene is in it: left, top, width, height."""


class Control(StrEnum):
    """Who acts; where a person is called, it is the policy that asks them to take over."""

    POLICY = "policy"
    CALLED = "called"
    PERSON = "person"
    PAUSED = "paused"
    WAITING = "waiting"


@dataclass
class Status:
    """One frame's worth of facts.

    Attributes:
        control: Who acts.
        task: What is to be done, in words.
        attempt: Its number, counted from 1.
        step, n_steps: Steps done, and the most that there are.
        fps: Steps per second that are wanted.
        achieved_fps: Those of the last second; 0 while unknown.
        gripper: `open`, `closed`, or nothing for an arm without one.
        cooldown_s: Until the gripper may change again [s].
        levels_db: Of each microphone over each of the last steps, the newest last [dB of full scale].
        sound: Why nothing is heard; empty if it is.
        keys: What to press, and what it does.
        note: What happened last.
        waiting: What goes on when no frame comes.
    """

    control: Control = Control.WAITING
    task: str = ""
    attempt: int = 0
    step: int = 0
    n_steps: int = 0
    fps: float = 0.0
    achieved_fps: float = 0.0
    gripper: str = ""
    cooldown_s: float = 0.0
    levels_db: dict[str, list[float]] = field(default_factory=dict)
    sound: str = ""
    keys: list[tuple[str, str]] = field(default_factory=list)
    note: str = ""
    waiting: str = ""

    @property
    def is_slow(self) -> bool:
        """Whether simulation and policy do not keep up."""
        return 0 < self.achieved_fps < 0.93 * self.fps


_LOOKS = {
    Control.POLICY: ("#0072b2", "#ffffff", "The policy is in control"),
    Control.CALLED: ("#d55e00", "#ffffff", "The robot asks for help"),
    Control.PERSON: ("#e69f00", "#000000", "You are in control"),
    Control.PAUSED: ("#999999", "#000000", "Paused"),
    Control.WAITING: ("#5a5f66", "#ffffff", "Please wait"),
}
"""Per state the frame's colour, the colour of letters on it, and the title."""

FRAME = {control: frame for control, (frame, _, _) in _LOOKS.items()}
"""Border per state, from the colours of Okabe and Ito, which people tell apart whatever colours they see."""

_BACKGROUND, _TEXT, _DIM, _LINE, _WARNING = "#15181c", "#f2f3f4", "#9aa3ad", "#343a42", "#e69f00"
_BAR, _LOUD = "#56b4e9", "#f0e442"
_LEFT, _RIGHT = 728, 976  # of the panel's content
_TASK_LETTERS, _SOUND_LETTERS = 28, 38  # that fit between them
_LOUD_DB = -20.0


def draw(status: Status) -> np.ndarray:
    """All but the scene: the window's picture (height, width, 3) uint8."""
    image = Image.new("RGB", SIZE, _BACKGROUND)
    canvas = ImageDraw.Draw(image)
    _draw_frame(canvas, status)
    y = _draw_progress(canvas, status, 24)
    y = _draw_levels(canvas, status, y + 22)
    if status.gripper:
        y += 22
        wait = f", changes in {status.cooldown_s:.1f} s" if status.cooldown_s > 0 else ""
        _draw_fact(canvas, y, "Gripper", status.gripper + wait)
    if status.is_slow:
        slow = f"slow: {status.achieved_fps:.0f} of {status.fps:.0f} steps/s"
        _draw_fact(canvas, y + 22, "Pace", slow, _WARNING)
    elif status.fps:
        _draw_fact(canvas, y + 22, "Pace", f"{status.fps:.0f} steps/s")
    keys = _keys(tuple(status.keys))
    image.paste(keys, (_LEFT, SIZE[1] - 18 - keys.height))
    return np.asarray(image)


def _draw_frame(draw: ImageDraw.ImageDraw, status: Status) -> None:
    colour, on_colour, title = _LOOKS[status.control]
    draw.rectangle((0, 0, _VIEW + 2 * _BORDER - 1, SIZE[1] - 1), fill=colour)
    draw.rectangle((_BORDER, _BANNER, _BORDER + _VIEW - 1, _BANNER + _VIEW - 1), fill=_LINE)
    middle = _BANNER // 2
    draw.text((_BORDER + 6, middle), title, on_colour, _font(27), "lm")
    note = status.waiting if status.control is Control.WAITING else status.note
    draw.text((_VIEW + _BORDER - 6, middle), note, on_colour, _font(16), "rm")


def _draw_progress(draw: ImageDraw.ImageDraw, status: Status, y: int) -> int:
    for line in textwrap.wrap(status.task, _TASK_LETTERS)[:3]:
        draw.text((_LEFT, y), line, _TEXT, _font(17), "lm")
        y += 22
    if not status.n_steps:
        return y
    draw.text((_LEFT, y + 6), f"Attempt {status.attempt}", _DIM, _font(14), "lm")
    draw.text((_RIGHT, y + 6), f"step {status.step} of {status.n_steps}", _DIM, _font(14), "rm")
    _bar(draw, y + 20, 4, status.step / status.n_steps, _DIM)
    return y + 24


def _draw_levels(draw: ImageDraw.ImageDraw, status: Status, y: int) -> int:
    for name, levels in status.levels_db.items():
        level = levels[-1]
        _draw_fact(draw, y, f"Microphone {name}", "silence" if level <= FLOOR_DB else f"{level:.0f} dB")
        _bar(draw, y + 15, 10, 1 - level / FLOOR_DB, _LOUD if level > _LOUD_DB else _BAR)
        _draw_history(draw, levels, max(round(HISTORY_S * status.fps), 1), y + 31)
        y += 92
    if not status.levels_db:
        return y
    sound = f"Not played: {status.sound}" if status.sound else "Played on the loudspeaker"
    draw.text((_LEFT, y), textwrap.shorten(sound, _SOUND_LETTERS, placeholder="..."), _DIM, _font(13), "lm")
    return y + 8


def _draw_history(draw: ImageDraw.ImageDraw, levels: list[float], n_shown: int, y: int) -> None:
    height, step = 46, (_RIGHT - _LEFT + 1) / n_shown
    draw.rectangle((_LEFT, y, _RIGHT, y + height), fill="#1d2126")
    for age, level in enumerate(reversed(levels[-n_shown:])):
        left, right = round(_RIGHT + 1 - (age + 1) * step), round(_RIGHT + 1 - age * step) - 1
        top = y + height - round(height * (1 - level / FLOOR_DB))
        draw.rectangle((left, top, max(right, left), y + height), fill=_BAR)


def _draw_fact(draw: ImageDraw.ImageDraw, y: int, name: str, value: str, colour: str = _DIM) -> None:
    draw.text((_LEFT, y), name, _TEXT, _font(15), "lm")
    draw.text((_RIGHT, y), value, colour, _font(14), "rm")


@cache
def _keys(keys: tuple[tuple[str, str], ...]) -> Image.Image:
    """What to press: a picture as wide as the panel."""
    row = 31
    image = Image.new("RGB", (_RIGHT - _LEFT + 1, row * len(keys) + 8), _BACKGROUND)
    draw = ImageDraw.Draw(image)
    draw.line((0, 0, image.width, 0), _LINE)
    for number, (key, meaning) in enumerate(keys):
        y = 8 + row * number
        width = max(round(_font(14).getlength(key)) + 18, 30)
        draw.rounded_rectangle((0, y + 4, width, y + 27), 4, fill="#2a2f36", outline="#4a525c")
        draw.text((width / 2, y + 15), key, _TEXT, _font(14), "mm")
        draw.text((max(width + 10, 84), y + 15), meaning, _DIM, _font(14), "lm")
    return image


def _bar(draw: ImageDraw.ImageDraw, y: int, height: int, share: float, colour: str) -> None:
    draw.rectangle((_LEFT, y, _RIGHT, y + height - 1), fill=_LINE)
    width = math.floor((_RIGHT - _LEFT) * min(max(share, 0.0), 1.0))
    if width:
        draw.rectangle((_LEFT, y, _LEFT + width, y + height - 1), fill=colour)


@cache
def _font(size: int) -> ImageFont.FreeTypeFont:
    font = ImageFont.load_default(size)
    assert isinstance(font, ImageFont.FreeTypeFont), "Pillow was built without FreeType"
    return font
