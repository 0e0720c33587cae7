"""A person's terminal: what is pressed, and questions that are asked there meanwhile."""

import contextlib
import io
import os
import pty
import select
import shutil
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from lerobot_playbyear.datasets.errors import DatasetWriteError
from lerobot_playbyear.episodes.saving import check_room, save_or_ask
from lerobot_playbyear.episodes.terminal import READERS
from lerobot_playbyear.teleoperation.console import TerminalConsole
from lerobot_playbyear.teleoperation.status import Status


@pytest.fixture
def terminal(monkeypatch):
    """Where a person types, and what the program reads it from."""
    ours, theirs = pty.openpty()
    with os.fdopen(theirs, "r", closefd=True) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        yield ours
    os.close(ours)


class FullDisk:
    """A writer whose disk has room after some tries."""

    def __init__(self, n_failures):
        self.root, self.n_failures, self.n_tries = Path("nowhere"), n_failures, 0

    def save_episode(self):
        self.n_tries += 1
        if self.n_tries <= self.n_failures:
            raise DatasetWriteError("The disk is full.", can_be_repeated=True)
        return 7


def waits_for(condition):
    end = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_an_answer_about_a_full_disk_is_no_key(terminal, monkeypatch):
    """Without the console stepping back each key went to one of two readers, by chance."""
    console = TerminalConsole()
    pressed = []
    monkeypatch.setattr(console.keys, "note", lambda name, down: pressed.append(name))
    os.write(terminal, b"a")
    waits_for(lambda: pressed.count("a") == 2)
    questions = []

    def asks(prompt):
        questions.append(prompt)
        os.write(terminal, b"\n")
        time.sleep(0.05)  # a reader that is still there has it by now
        assert select.select([console._file], [], [], 0)[0], "the answer went to the console"
        return os.read(console._file, 64).decode()

    monkeypatch.setattr("builtins.input", asks)
    disk = FullDisk(20)
    assert save_or_ask(disk) == 7
    assert len(questions) == 20
    assert "enter" not in pressed
    os.write(terminal, b"b")
    waits_for(lambda: pressed.count("b") == 2)
    console.close()
    assert not READERS


def test_a_console_that_is_made_during_an_evaluation_is_seen(terminal, monkeypatch):
    """There standard error is silenced, for LeRobot's own progress bars."""
    seen = io.StringIO()
    monkeypatch.setattr("sys.__stderr__", seen)
    with contextlib.redirect_stderr(io.StringIO()):
        console = TerminalConsole()
        console.show(Status(note="Press P to begin"))
    console.close()
    assert "Press P to begin" in seen.getvalue()


def test_a_line_can_be_edited_while_a_question_is_asked(terminal, monkeypatch):
    import termios

    def is_by_line():
        return bool(termios.tcgetattr(console._file)[3] & termios.ICANON)

    console = TerminalConsole()
    seen = []
    monkeypatch.setattr("builtins.input", lambda prompt: seen.append(is_by_line()) or "q")
    assert not is_by_line()
    with pytest.raises(DatasetWriteError):
        save_or_ask(FullDisk(1))
    assert seen == [True]
    assert not is_by_line()
    console.close()
    assert is_by_line()


@pytest.fixture
def disk(monkeypatch, tmp_path):
    """The MiB that are left on a disk, first to last, as often as they are looked at."""
    left = []
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=left.pop(0) << 20))
    return left


def answers(monkeypatch, *given):
    """What is typed, in turn; the questions that it answers."""
    asked, typed = [], list(given)
    monkeypatch.setattr("builtins.input", lambda prompt: asked.append(prompt) or typed.pop(0))
    return asked


ROOM = SimpleNamespace(root=Path("nowhere"), num_episodes=4)


def test_a_person_makes_room_before_they_show_anything(terminal, monkeypatch, disk, capsys):
    asked = answers(monkeypatch, "", "what?", "b", "q")
    disk += [20, 35, 36]  # twice 10 and 16 are wanted
    check_room(ROOM, 10 << 20)
    assert len(asked) == 2
    assert "has 20 MiB left; wanted 36 MiB" in capsys.readouterr().err
    disk += [35]
    check_room(ROOM, 10 << 20)  # they begin all the same
    disk += [255]
    with pytest.raises(DatasetWriteError, match=r"has 255 MiB left; wanted 256 MiB.*4 episodes.*--resume=true"):
        check_room(ROOM, None)


def test_where_nobody_is_at_the_terminal_a_guess_stops_nobody(monkeypatch, disk, caplog):
    monkeypatch.setattr("sys.stdin", None)
    disk += [20]
    check_room(ROOM, None)
    assert "has 20 MiB left; wanted 256 MiB" in caplog.text
    disk += [18, 18]
    check_room(ROOM, 1 << 20)  # an episode of 1 MiB needs no 256
    with pytest.raises(DatasetWriteError, match="wanted 20 MiB"):
        check_room(ROOM, 2 << 20)
