"""Who sits before LeRobot's commands: looks at the simulated arm, presses keys, and sets the scene up between episodes.

    with simulation(folder, fifo) as socket:
        done = run_command(["lerobot-record", ...], Episodes(socket, seeds, re_record=True), outcomes=Path("outcomes.jsonl"))
        done = run_command(["lerobot-rollout", "--strategy.type=dagger", ...], Corrections(socket, seeds))

LeRobot reads keys from its terminal where there is no display: the command gets a pseudo-terminal of its own. A phase has
begun when the command says so in a line; no key is pressed before, and none twice, as LeRobot 0.6.1 remembers a key that comes
after its phase and ends the next episode with it, empty.
"""

import codecs
import json
import os
import pty
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent / "sim_robot"))

from lerobot_robot_playbyear_sim.link import Link
from lerobot_robot_playbyear_sim.process import with_sim_robot

KEYS = {"space": b" ", "tab": b"\t", "esc": b"\x1b", "right": b"\x1b[C", "left": b"\x1b[D"}
LOOK_EVERY_S = 0.02


@dataclass(frozen=True)
class Outcome:
    """How a scene went.

    Args:
        seed: Of the scene.
        success: Whether the task was solved.
        end: `success`, `failed`, or `time`.
        steps: Control steps that the arm made, `holds` of them because no action came in time.
        seconds: What they took.
        takeovers: How often a person took over.
        kept: Whether it is in the dataset.
        closings: How often the hand closed.
    """

    seed: int
    success: bool
    end: str
    steps: int
    holds: int
    seconds: float
    takeovers: int = 0
    kept: bool = True
    closings: int = 0


@dataclass
class Done:
    """What came of a command.

    Args:
        status: Its exit status; -9 where it was killed.
        outcomes: Of its scenes.
        late: How many of its control steps took longer than they may.
        output: What it said.
    """

    status: int
    outcomes: list[Outcome] = field(default_factory=list)
    late: int = 0
    output: str = ""


class Episodes:
    """For `lerobot-record`, and `lerobot-rollout --strategy.type=episodic`: an episode a scene, a reset phase between two.

    Args:
        socket: Of the simulation.
        seeds: Of the scenes, one after the other; when there are no more the command is ended.
        re_record: Whether an episode in which the task was not solved is recorded again, in the next scene.
    """

    def __init__(self, socket: str, seeds: Iterable[int], re_record: bool = False) -> None:
        self._link, self._seeds, self._re_record = Link(socket), iter(seeds), re_record
        self._phase = "before"
        self.outcomes: list[Outcome] = []

    def prepare(self) -> None:
        self._link.ask("reset", seed=next(self._seeds), waits=True)

    def hears(self, line: str) -> str | None:
        if "Recording episode" in line:
            self._link.ask("begin")
            self._phase = "episode"
        elif "Reset the environment" in line:
            if self._phase == "episode":  # its time was up before the arm's
                self._note(kept=True)
            self._phase = "reset"
            seed = next(self._seeds, None)
            if seed is None:
                return "esc"
            self._link.ask("reset", seed=seed, waits=True)
            return "right"
        elif "Stop recording" in line and self._phase == "episode":
            self._note(kept=True)
            self._phase = "after"
        return None

    def looks(self) -> str | None:
        if self._phase != "episode" or ending(self._link.ask("status")) is None:
            return None
        self._phase = "ended"
        is_again = self._re_record and not self._link.ask("status")["success"]
        self._note(kept=not is_again)
        return "left" if is_again else "right"

    def _note(self, kept: bool) -> None:
        self.outcomes.append(outcome(self._link.ask("status"), kept=kept))


class Corrections:
    """For `lerobot-rollout --strategy.type=dagger`: takes over when the script would, hands back when it would.

    Args:
        socket: Of the simulation.
        seeds: Of the scenes; after the last one the command is ended.
    """

    def __init__(self, socket: str, seeds: Iterable[int]) -> None:
        self._link, self._seeds = Link(socket), list(seeds)
        self._phase, self._is_asked = "before", False
        self._takeovers = 0
        self.outcomes: list[Outcome] = []

    def prepare(self) -> None:
        self._set_up()

    def _set_up(self) -> None:
        self._takeovers = 0
        self._link.ask("reset", seed=self._seeds.pop(0), waits=True)

    def hears(self, line: str) -> str | None:
        if "recording started" in line:
            self._enter("autonomous")
        elif "Phase transition: " in line:
            self._enter(line.split("-> ")[1].split()[0])
        return None

    def _enter(self, phase: str) -> None:
        self._came_from, self._phase, self._is_asked = self._phase, phase, False
        if phase == "autonomous":
            self._link.ask("begin")
        self._takeovers += phase == "correcting"

    def looks(self) -> str | None:
        """A key for the next phase; none while it is waited for, as LeRobot takes one at a time."""
        if self._is_asked or self._phase not in ("autonomous", "paused", "correcting"):
            return None
        now = self._link.ask("status")
        key = getattr(self, f"_{self._phase}")(now, ending(now))
        self._is_asked = key is not None
        return key

    def _autonomous(self, now: Mapping[str, Any], end: str | None) -> str | None:
        return "space" if end or now["wants_control"] else None

    def _correcting(self, now: Mapping[str, Any], end: str | None) -> str | None:
        return "tab" if end or not now["wants_control"] else None

    def _paused(self, now: Mapping[str, Any], end: str | None) -> str | None:
        if end:
            self.outcomes.append(outcome(now, takeovers=self._takeovers))
            if not self._seeds:
                return "esc"
            self._set_up()
            return "space"
        return "space" if self._came_from == "correcting" else "tab"


class Watches:
    """For commands that need no keys, such as `lerobot-rollout`: sets a scene up, and lets it be.

    Args:
        socket: Of the simulation.
        ends_after_s: How long `lerobot-teleoperate` moves the arm until Ctrl+C ends it; None: a command ends by itself.
    """

    def __init__(self, socket: str, ends_after_s: float | None = None) -> None:
        self._link, self._ends_after_s = Link(socket), ends_after_s
        self._deadline: float | None = None
        self.outcomes: list[Outcome] = []

    def prepare(self) -> None:
        self._link.ask("reset", seed=200)

    def hears(self, line: str) -> str | None:
        if self._ends_after_s is not None and self._deadline is None and "Teleop loop time" in line:
            self._deadline = time.monotonic() + self._ends_after_s
        return None

    def looks(self) -> str | None:
        if self._deadline is None or time.monotonic() < self._deadline:
            return None
        self._deadline = float("inf")
        return "ctrl-c"


Operator = Episodes | Corrections | Watches
"""Each prepares before the command begins, hears its lines and looks at the arm, and may return a key then."""


def ending(now: Mapping[str, Any]) -> str | None:
    """How a scene ended, by the simulation's status; None as long as it goes on."""
    if now["success"] or now["failed"]:
        return "success" if now["success"] else "failed"
    return "time" if now["n_steps"] >= now["most_steps"] else None


def outcome(now: Mapping[str, Any], **more: Any) -> Outcome:
    """Of the scene with this status."""
    counts = {
        "steps": now["n_steps"],
        "holds": now["n_holds"],
        "seconds": now["seconds"],
        "closings": now["n_closings"],
    }
    return Outcome(now["seed"], now["success"], ending(now) or "time", **counts, **more)


class Terminal:
    """A command in a pseudo-terminal of its own, in which its keys are pressed.

    Args:
        command: The command.
        environment: Its own; the display is taken out of it, the simulated devices come into it.
        log: Where what it says is written as it comes.
    """

    def __init__(self, command: Sequence[str], environment: Mapping[str, str], log: Path | None = None) -> None:
        environment = with_sim_robot(dict(environment))
        for name in ("DISPLAY", "WAYLAND_DISPLAY", "PYTHONDONTWRITEBYTECODE"):
            environment.pop(name, None)
        if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # in a shell's background; who ignores it hands that on
            signal.signal(signal.SIGINT, signal.default_int_handler)
        self._ours, theirs = pty.openpty()
        self.process = subprocess.Popen(
            command, stdin=theirs, stdout=theirs, stderr=theirs, env=environment, start_new_session=True
        )
        os.close(theirs)
        self._decoder = codecs.getincrementaldecoder("utf-8")(errors="replace")
        self._log = log.open("w") if log else None
        self.output, self._begun = "", ""

    def lines(self, timeout_s: float) -> list[str] | None:
        """The lines that came, after this time at the latest; None at the end."""
        ready, _, _ = select.select([self._ours], [], [], timeout_s)
        if not ready:
            return []
        try:
            text = self._decoder.decode(os.read(self._ours, 65536))
        except OSError:  # the other end is closed
            return None
        self.output += text
        if self._log:
            self._log.write(text)
            self._log.flush()
        *lines, self._begun = (self._begun + text).split("\n")
        return lines

    def press(self, key: str) -> None:
        if key == "ctrl-c":
            os.killpg(self.process.pid, signal.SIGINT)
        else:
            os.write(self._ours, KEYS[key])

    def close(self) -> int:
        """Ends the command if it still runs, and returns its exit status."""
        try:
            self.process.wait(timeout=20)  # it has closed its terminal
        except subprocess.TimeoutExpired:
            self.kill()
        os.close(self._ours)
        if self._log:
            self._log.close()
        return self.process.wait()

    def kill(self) -> None:
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGKILL)


def run_command(
    command: Sequence[str],
    operator: Operator,
    environment: Mapping[str, str] | None = None,
    *,
    outcomes: Path | None = None,
    log: Path | None = None,
    timeout_s: float = 600,
    patience_s: float = 120,
) -> Done:
    """Runs one of LeRobot's commands with an operator before it.

    Args:
        command: The command.
        operator: Who presses its keys.
        environment: Its own; else this process'.
        outcomes: Where each scene's outcome is added, a JSON line each.
        log: Where what it says is written.
        timeout_s: After which it is killed.
        patience_s: After which it is killed if it says nothing and no scene ends.
    """
    operator.prepare()
    terminal = Terminal(command, os.environ if environment is None else environment, log)
    done, deadline, quiet_since = Done(status=-9, outcomes=operator.outcomes), time.monotonic() + timeout_s, None
    n_written = 0
    try:
        while (lines := terminal.lines(LOOK_EVERY_S)) is not None:
            keys = [*(operator.hears(line) for line in lines), operator.looks()]
            for key in filter(None, keys):
                terminal.press(key)
            done.late += sum("running slower" in line for line in lines)
            if outcomes and len(done.outcomes) > n_written:
                with outcomes.open("a") as file:
                    file.writelines(json.dumps(asdict(each)) + "\n" for each in done.outcomes[n_written:])
            now = time.monotonic()
            if quiet_since is None or lines or len(done.outcomes) > n_written:
                quiet_since = now
            n_written = len(done.outcomes)
            if now > deadline or now > quiet_since + patience_s:
                terminal.kill()
    except BaseException:
        terminal.kill()
        raise
    finally:
        done.status, done.output = terminal.close(), terminal.output
    return done
