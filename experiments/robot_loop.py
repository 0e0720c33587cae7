"""A round on a robot that is simulated in real time, with LeRobot's commands: record, attach, train, rollout, correct, dagger.

    python -m experiments.robot_loop record attach train rollout eval --folder=outputs/loop
    python -m experiments.robot_loop train --name=deaf -- --policy.use_audio=false
    python -m experiments.robot_loop rollout --name=hearing --rollout=elsewhere \\
        --camera='{gripper: {type: microphone, file: outputs/other.wav, sample_rate: 16000}}'
    python -m experiments.robot_loop correct dagger --name=hearing
    python -m experiments.robot_loop dagger --name=hearing --heard=shuffled

The arm runs in a process of its own; its sound is played into a PulseAudio server and comes back through PortAudio as from any
sound card. Each step prints its command, keeps what the command says, and adds a line to results.jsonl. Recorded, attached and
trained once, these are not made again. What stands after `--` goes to the steps' commands as typed. Debian: pulseaudio,
libportaudio2, libasound2-plugins.
"""

import argparse
import json
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_playbyear.datasets.parquet import with_values

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from lerobot_operator import Corrections, Done, Episodes, Operator, run_command
from lerobot_robot_playbyear_sim.process import simulation
from sound_server import SoundServer

FPS, RATE = 20, 16000
DESCRIPTION = "Find the cube behind the wall by touch and sound, grasp it and lift it."
CAMERA = f"{{gripper: {{type: microphone, device: gripper, sample_rate: {RATE}}}}}"


@dataclass(frozen=True)
class Robot:
    """The arm and its sound card: the options that name them, and the environment of a command."""

    socket: str
    options: tuple[str, ...]
    leader: tuple[str, ...]
    environment: dict[str, str]


class Loop:
    """The steps. Each is a method by its name.

    Args:
        args: The options, see `main`.
    """

    def __init__(self, args: argparse.Namespace) -> None:
        self.args, self.folder = args, args.folder.resolve()
        self.demos, self.attached = self.folder / "demos", self.folder / "attached"
        self.corrections, self.attached_corrections = (self.own / name for name in ("corrections", "attached"))
        self.folder.mkdir(parents=True, exist_ok=True)
        self.own.mkdir(exist_ok=True)
        (self.folder / "logs").mkdir(exist_ok=True)

    @property
    def own(self) -> Path:
        """What belongs to one policy."""
        return self.folder / self.args.name

    @property
    def checkpoint(self) -> Path:
        """The policy that acts."""
        return self.args.policy or self.own / "train" / "checkpoints" / "last" / "pretrained_model"

    def record(self) -> None:
        """Demonstrations by the script at the leader, as many as are missing."""
        wanted, outcomes = self.args.demonstrations, self.folder / "demos.jsonl"
        n_there, first = n_episodes(self.demos), next_seed(outcomes, self.args.demonstration_seed)
        if n_there >= wanted:
            return print(f"{self.demos} holds {n_there} episodes.")
        if n_there == 0:
            shutil.rmtree(self.demos, ignore_errors=True)
        with self.robot() as robot:
            command = [
                *("lerobot-record", *robot.options, *robot.leader, "--teleop.demonstrates=true"),
                *self.dataset("me/demos", self.demos),
                *(f"--dataset.num_episodes={wanted - n_there}", f"--dataset.single_task={DESCRIPTION}"),
                f"--resume={str(n_there > 0).lower()}",
            ]
            operator = Episodes(robot.socket, range(first, first + 10 * wanted), re_record=True)
            self.operate("record", command, operator, robot, outcomes)

    def attach(self) -> None:
        """Sound in columns, from what the microphones' pictures carry."""
        self._attach("attach", "demos", self.demos, "heard", self.attached)

    def train(self) -> None:
        train = self.own / "train"
        if self.checkpoint.is_dir():
            return print(f"{self.checkpoint} is there.")
        shutil.rmtree(train, ignore_errors=True)
        preset = [f"--preset={self.args.preset}"] if self.args.preset else []
        command = [
            *("playbyear-train", *preset, "--policy.type=playbyear", "--policy.push_to_hub=false"),
            *("--dataset.repo_id=me/heard", f"--dataset.root={self.attached}", f"--output_dir={train}"),
            "--wandb.enable=false",
        ]
        self.run("train", command)

    def rollout(self) -> None:
        """The policy on the robot, in held-out scenes."""
        name, n, first = self.args.rollout, self.args.episodes, self.args.seed
        data, outcomes = self.fresh(self.own / name), self.own / f"{name}.jsonl"
        outcomes.unlink(missing_ok=True)
        with self.robot() as robot:
            command = [
                *("lerobot-rollout", "--strategy.type=episodic", f"--policy.path={self.checkpoint}"),
                *(*robot.options, f"--fps={FPS}", *self.dataset(f"me/rollout_{name}", data)),
                *(f"--dataset.num_episodes={n}", f"--task={DESCRIPTION}"),
            ]
            operator = Episodes(robot.socket, range(first, first + n))
            self.operate(name, command, operator, robot, outcomes)

    def eval(self) -> None:
        """The same policy in the same scenes, in the simulator without clock and sound card."""
        command = [
            *("lerobot-eval", f"--policy.path={self.checkpoint}", "--env.type=playbyear"),
            *(f"--env.task={self.args.task}", f"--eval.n_episodes={self.args.episodes}", "--eval.batch_size=10"),
            *("--eval.use_async_envs=false", f"--seed={self.args.seed}", f"--output_dir={self.own / 'eval'}"),
        ]
        shutil.rmtree(self.own / "eval", ignore_errors=True)
        self.run("eval", command, lambda: json.loads((self.own / "eval" / "eval_info.json").read_text())["overall"])

    def correct(self) -> None:
        """The policy acts, and the script takes over where it goes wrong."""
        n, first = self.args.corrected, self.args.correction_seed
        data, outcomes = self.fresh(self.corrections), self.own / "corrections.jsonl"
        self.fresh(self.attached_corrections)
        outcomes.unlink(missing_ok=True)
        with self.robot() as robot:
            command = [
                *("lerobot-rollout", "--strategy.type=dagger", "--strategy.record_autonomous=true"),
                *("--strategy.smooth_handover=false", f"--policy.path={self.checkpoint}", *robot.options),
                *(*robot.leader, f"--fps={FPS}", *self.dataset("me/rollout_corrections", data)),
                f"--task={DESCRIPTION}",
            ]
            operator = Corrections(robot.socket, range(first, first + n))
            self.operate("correct", command, operator, robot, outcomes)

    def dagger(self) -> None:
        """What is learned from the corrections."""
        self._attach(
            "attach-corrections", "rollout_corrections", self.corrections, "corrections", self.attached_corrections
        )
        kind = self.args.heard
        heard = self.attached_corrections.with_name(f"attached_{kind}") if kind else self.attached_corrections
        if kind:
            shutil.copytree(self.attached_corrections, self.fresh(heard))
            take_sound_away(heard, kind)
        output = self.fresh(self.own / (f"dagger_{kind}" if kind else "dagger"))
        command = [
            *("playbyear-dagger", "--num_episodes=0", f"--steps={self.args.updates}"),
            *(f"--policy.path={self.checkpoint}", "--dataset.repo_id=me/heard", f"--dataset.root={self.attached}"),
            *("--interventions.repo_id=me/corrections", f"--interventions.root={heard}"),
            f"--output_dir={output}",
        ]
        self.run("dagger", command)

    def _attach(self, name: str, repo: str, source: Path, heard: str, target: Path) -> None:
        if n_episodes(target):
            return print(f"{target} is there.")
        shutil.rmtree(target, ignore_errors=True)
        command = [
            *("playbyear-attach-audio", f"--dataset.repo_id=me/{repo}", f"--dataset.root={source}"),
            *(f"--output.repo_id=me/{heard}", f"--output.root={target}"),
        ]
        self.run(name, command)

    # What the steps share

    def fresh(self, folder: Path) -> Path:
        """A folder that is not there: LeRobot makes it."""
        shutil.rmtree(folder, ignore_errors=True)
        return folder

    @contextmanager
    def robot(self) -> Iterator[Robot]:
        """Sound server and arm, as long as a step needs them."""
        with ExitStack() as stack:
            stack.enter_context(urgent())
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(dir="/tmp")))  # a socket's path is short
            server = SoundServer(folder, {"gripper": 1}, RATE)
            server.start()
            stack.callback(server.kill)
            scene = [f"--task={self.args.task}", f"--image_size={self.args.pixels}", *["--twin"] * self.args.twin]
            socket = stack.enter_context(simulation(folder, server.fifo("gripper"), *scene))
            options = (
                *("--robot.type=playbyear_sim", f"--robot.socket={socket}", f"--robot.image_size={self.args.pixels}"),
                *(f"--robot.cameras={self.args.camera}", "--play_sounds=false"),
            )
            leader = ("--teleop.type=playbyear_sim_leader", f"--teleop.socket={socket}")
            yield Robot(socket, options, leader, self.environment() | server.environment)

    def dataset(self, repo: str, root: Path) -> tuple[str, ...]:
        """What a recording is told; its episodes are ended by the operator, long before its own time is up."""
        return (
            *(f"--dataset.repo_id={repo}", "--dataset.no_stamp=true", f"--dataset.root={root}", f"--dataset.fps={FPS}"),
            *("--dataset.video=false", "--dataset.push_to_hub=false"),
            *("--dataset.episode_time_s=60", "--dataset.reset_time_s=60"),
        )

    def environment(self) -> dict[str, str]:
        """With the commands of this Python, and the sound of sessions beside the data."""
        programs = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
        fixed = {"PATH": programs, "HF_LEROBOT_HOME": str(self.folder / "home")}
        defaults = {"MUJOCO_GL": "egl", "OMP_NUM_THREADS": "1"}
        return defaults | os.environ | fixed

    def operate(self, name: str, command: list[str], operator: Operator, robot: Robot, outcomes: Path) -> None:
        """Runs a command that needs the robot, and a person before it."""
        command = [*command, *self.args.more]
        print(f"$ PYTHONPATH=tests/sim_robot:tests {shlex.join(command)}", flush=True)
        start, log = time.perf_counter(), self.log(name)
        done = run_command(command, operator, robot.environment, outcomes=outcomes, log=log, timeout_s=self.args.most_s)
        self.note(name, command, time.perf_counter() - start, done.status, figures(done))

    def run(self, name: str, command: list[str], read: Any = dict) -> None:
        """Runs a command that needs nobody; `read` gives its figures."""
        command = [*command, *(self.args.more if name in STEPS else [])]
        print(f"$ {shlex.join(command)}", flush=True)
        start = time.perf_counter()
        with self.log(name).open("w") as log:
            status = subprocess.run(command, env=self.environment(), stdout=log, stderr=log).returncode
        self.note(name, command, time.perf_counter() - start, status, read() if status == 0 else {})

    def log(self, name: str) -> Path:
        return self.folder / "logs" / f"{self.args.name}-{name}.log"

    def note(self, name: str, command: list[str], seconds: float, status: int, more: dict[str, Any]) -> None:
        """A line of results.jsonl, which is printed as well."""
        line = {"step": name, "name": self.args.name, "status": status, "seconds": round(seconds, 1), **more}
        print(json.dumps(line), flush=True)
        with (self.folder / "results.jsonl").open("a") as file:
            file.write(json.dumps(line | {"command": shlex.join(command)}) + "\n")
        if status:
            raise SystemExit(f"{name} ended with {status}; see {self.log(name)}")


@contextmanager
def urgent() -> Iterator[None]:
    """A robot's computer is its own: what is started in here goes before what else runs on this one, where that is allowed."""
    before = os.getpriority(os.PRIO_PROCESS, 0)
    with suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, before - 10)
    try:
        yield
    finally:
        os.setpriority(os.PRIO_PROCESS, 0, before)


def figures(done: Done) -> dict[str, Any]:
    """Success, and how well time was kept."""
    scenes = done.outcomes
    steps, holds = sum(each.steps for each in scenes), sum(each.holds for each in scenes)
    seconds = sum(each.seconds for each in scenes)
    return {
        "scenes": len(scenes),
        "successes": sum(each.success for each in scenes),
        "closed": sum(each.closings > 0 for each in scenes),
        "solved_without_help": sum(each.success and not each.takeovers for each in scenes),
        "takeovers": sum(each.takeovers for each in scenes),
        "steps": steps,
        "holds_percent": round(100 * holds / max(steps, 1), 2),
        "late_percent": round(100 * done.late / max(steps, 1), 2),
        "steps_per_second": round((steps - len(scenes)) / max(seconds, 1e-9), 2),
    }


def take_sound_away(root: Path, kind: str) -> None:
    """Gives a dataset silence, or to every stretch between two marks the sound of another one ("shuffled")."""
    files = sorted((root / "data").glob("*/*.parquet"))
    tables = [pq.read_table(path) for path in files]
    whole = pa.concat_tables(tables)
    sound, begins = (np.stack(whole.column(key).to_numpy()) for key in ("observation.audio.gripper", "is_first"))
    episodes = np.stack(whole.column("episode_index").to_numpy()).reshape(-1)
    changes = np.flatnonzero(begins.reshape(-1).astype(bool) | np.diff(episodes, prepend=-1).astype(bool))
    new, stretches = np.zeros_like(sound), np.split(sound, changes[1:])
    if kind == "shuffled":
        rng, order = np.random.default_rng(0), np.arange(len(stretches))
        while (order == np.arange(len(stretches))).any():
            order = rng.permutation(len(stretches))
        for place, other in zip(np.split(new, changes[1:]), order, strict=True):
            place[:] = stretches[other][np.arange(len(place)) % len(stretches[other])]
    rows = iter(np.split(new, np.cumsum([len(table) for table in tables])[:-1]))
    for path, table in zip(files, tables, strict=True):
        pq.write_table(with_values(table, "observation.audio.gripper", next(rows).tolist()), path)


def n_episodes(root: Path) -> int:
    """How many episodes a dataset has; 0 if it is not there."""
    info = root / "meta" / "info.json"
    return int(json.loads(info.read_text())["total_episodes"]) if info.is_file() else 0


def next_seed(outcomes: Path, first: int) -> int:
    """After those of the scenes so far."""
    lines = outcomes.read_text().splitlines() if outcomes.is_file() else []
    return max([first - 1, *(json.loads(line)["seed"] for line in lines)]) + 1


STEPS = ("record", "attach", "train", "rollout", "eval", "correct", "dagger")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("steps", nargs="+", choices=STEPS)
    parser.add_argument("--folder", type=Path, default=Path("outputs/robot_loop"), help="for all that comes of it")
    parser.add_argument("--name", default="hearing", help="the policy's: what belongs to it has a folder of that name")
    parser.add_argument("--policy", type=Path, help="another policy's folder, instead of the one that was trained")
    parser.add_argument("--task", default="OccludedGrasp-v1")
    parser.add_argument("--camera", default=CAMERA, help="--robot.cameras, microphones among them")
    parser.add_argument("--pixels", type=int, default=84, help="of the arm's own camera")
    parser.add_argument("--twin", action="store_true", help="the hand passes through the hidden object, unheard")
    parser.add_argument("--preset", default="cpu", help="of playbyear-train; empty: none")
    parser.add_argument("--demonstrations", type=int, default=50)
    parser.add_argument("--demonstration_seed", type=int, default=0, help="of the first scene")
    parser.add_argument("--rollout", default="rollout", help="another name, so that it stands beside the first")
    parser.add_argument("--episodes", type=int, default=50, help="of rollout and eval")
    parser.add_argument("--seed", type=int, default=70000, help="of their first scene; 70000 to 70099 are held out")
    parser.add_argument("--corrected", type=int, default=25, help="scenes in which the policy is corrected")
    parser.add_argument("--correction_seed", type=int, default=10000, help="of the first of them")
    parser.add_argument("--heard", choices=("silent", "shuffled"), help="what corrections have in place of their sound")
    parser.add_argument("--updates", type=int, default=2000, help="of playbyear-dagger")
    parser.add_argument("--most_s", type=float, default=7200, help="after which a step on the robot is given up")
    at = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)
    args = parser.parse_args(sys.argv[1:at])
    args.more = sys.argv[at + 1 :]
    loop = Loop(args)
    for step in args.steps:
        getattr(loop, step)()


if __name__ == "__main__":
    main()
