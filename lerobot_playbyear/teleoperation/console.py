"""Where a person beside a robot sees what goes on, and presses keys: a window, a terminal, or nothing."""

import contextlib
import os
import re
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any, Protocol

import numpy as np

from lerobot_playbyear.episodes.expert import ExpertError
from lerobot_playbyear.episodes.terminal import READERS
from lerobot_playbyear.teleoperation.keyboard import WindowKeys
from lerobot_playbyear.teleoperation.status import Status
from lerobot_playbyear.teleoperation.window import Window

_KEY = re.compile(r"\x1b\[[0-9;]*[ -/]*[@-~]|\x1bO.|[\s\S]")
_ESCAPES = {"\x1b[A": "up", "\x1b[B": "down", "\x1b[C": "right", "\x1b[D": "left"}
_NAMES = {" ": "space", "\x1b": "escape", "\x03": "escape", "\r": "enter", "\n": "enter"}
_LINE_EVERY_S = 0.2


class Console(Protocol):
    """What a person sees and presses.

    Attributes:
        keys: What is pressed.
        is_open: Whether anybody is there.
        has_key_releases: Whether it knows when a key is let go.
    """

    keys: WindowKeys
    is_open: bool
    has_key_releases: bool

    def show(self, status: Status, picture: np.ndarray | None = None) -> None:
        """Shows this as soon as possible; returns at once."""

    def close(self) -> None:
        """Ends it."""


class TerminalConsole:
    """The terminal that the program was started in: one line that tells how it goes, and keys without Enter.

    Raises:
        ExpertError: The program has no terminal.
    """

    has_key_releases = False

    def __init__(self) -> None:
        try:
            import termios
            import tty
        except ImportError as error:
            raise ExpertError("--env.console=terminal needs Linux or macOS: give window or none.") from error
        if not (sys.stdin and sys.stdin.isatty()):
            raise ExpertError("--env.console=terminal, and the program has no terminal: give window or none.")
        self.keys = WindowKeys()
        self.keys.has_focus = True
        self.is_open = True
        is_seen = sys.stderr.isatty() or sys.__stderr__ is None  # somebody may silence it, now or later
        self._out: Any = sys.stderr if is_seen else sys.__stderr__
        self._file = sys.stdin.fileno()
        self._termios: Any = termios
        self._before = termios.tcgetattr(self._file)
        self._note, self._shown = "", 0.0
        self._stop_read, self._stop_write = os.pipe()
        self._set_cbreak: Any = tty.setcbreak
        self._begin()
        READERS.append(self._given_up)

    def show(self, status: Status, picture: np.ndarray | None = None) -> None:
        now = time.monotonic()
        if status.note != self._note and status.note:
            self._write(f"\r\x1b[K{status.note}\n")
        elif now - self._shown < _LINE_EVERY_S:
            return
        self._note, self._shown = status.note, now
        levels = ", ".join(f"{name} {values[-1]:.0f} dB" for name, values in status.levels_db.items() if values)
        rate = f"{status.achieved_fps:.1f} Hz" if status.achieved_fps else ""
        lost = f"{status.drop_outs} drop-outs" if status.drop_outs else ""
        parts = [
            f"attempt {status.attempt}, step {status.step} of {status.n_steps}",
            status.control,
            rate,
            levels,
            lost,
        ]
        self._write("\r\x1b[K" + "  ".join(part for part in parts if part))

    def close(self) -> None:
        if self.is_open:
            self.is_open = False
            READERS.remove(self._given_up)
            self._end(self._termios.TCSADRAIN)
            for end in (self._stop_read, self._stop_write):
                os.close(end)
            self._write("\n")

    def _begin(self) -> None:
        """Takes the terminal: keys without Enter, noted as they come."""
        with contextlib.suppress(self._termios.error):  # it is gone, as the thread will note
            self._set_cbreak(self._file)
        self._thread = threading.Thread(target=self._read, name="terminal", daemon=True)
        self._thread.start()

    def _end(self, when: int) -> None:
        """Gives the terminal back as it was found; `when` is of `termios.tcsetattr`."""
        os.write(self._stop_write, b"x")
        self._thread.join()
        os.read(self._stop_read, 1)
        with contextlib.suppress(self._termios.error):
            self._termios.tcsetattr(self._file, when, self._before)

    @contextlib.contextmanager
    def _given_up(self) -> Iterator[None]:
        self._end(self._termios.TCSAFLUSH)  # what was pressed before is no answer
        try:
            yield
        finally:
            self._begin()

    def _write(self, text: str) -> None:
        self._out.write(text)
        self._out.flush()

    def _read(self) -> None:
        import select

        while self.is_open:
            ready, _, _ = select.select([self._file, self._stop_read], [], [])
            if self._stop_read in ready:
                return
            try:
                text = os.read(self._file, 64).decode(errors="replace")
            except OSError:
                text = ""
            if not text:  # the terminal is gone
                self.keys.note("escape", True)
                return
            for name in _names(text):
                self.keys.note(name, True)
                self.keys.note(name, False)


class NoConsole:
    """Nobody: attempts begin by themselves and end with their time, or as the expert says."""

    has_key_releases = False

    def __init__(self) -> None:
        self.keys, self.is_open = WindowKeys(), True

    def show(self, status: Status, picture: np.ndarray | None = None) -> None:
        """Nobody looks."""

    def close(self) -> None:
        """Nothing is open."""


def make_console(kind: str, title: str) -> Console:
    """A console of a kind: `window`, `terminal`, `none`, or `auto`: a window where there is a screen, else a terminal.

    Raises:
        ExpertError: There is no screen, or no terminal.
    """
    if kind == "auto":
        screen = sys.platform in ("darwin", "win32") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        if not screen and not (sys.stdin and sys.stdin.isatty()):
            raise ExpertError(
                "There is neither a screen nor a terminal in which a person could say when an attempt begins: give "
                "--env.console=none if all shall begin by themselves."
            )
        kind = "window" if screen else "terminal"
    if kind == "window":
        return Window(title)
    return TerminalConsole() if kind == "terminal" else NoConsole()


def _names(text: str) -> list[str]:
    """The keys in what a terminal sends."""
    return [name for code in _KEY.findall(text) if (name := _ESCAPES.get(code) or _plain(code))]


def _plain(code: str) -> str:
    """The name of a key that sends one letter; none of those that send an escape sequence, such as F1 and Delete."""
    return "" if len(code) > 1 else _NAMES.get(code, code.lower())
