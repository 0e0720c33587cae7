"""A process of its own: the task's arm in real time, its sound played into a sound server's FIFO.

    python -m lerobot_robot_playbyear_sim.simulation --socket=PATH --fifo=PATH --task=OccludedGrasp-v1

An action moves the arm for one control step; where none comes in time, it holds. The picture is that of the last step's
end. The sound of a step is played while it is made, behind it by `LAG_S`; between episodes the room is heard. A scene that
was set up with `waits` stays as it is, whatever the arm is told, until `begin`.
"""

import argparse
import json
import os
import queue
import sys
import threading
import time
from multiprocessing.connection import Connection, Listener
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from sound_server import Player

STEP_S, GRACE_S = 0.05, 0.03
LAG_S, JITTER_S, CHUNK_S = 0.01, 0.008, 0.004


class Loudspeaker:
    """Plays blocks one after the other in real time, and a quiet room between them."""

    def __init__(self, fifo: str, sample_rate: int) -> None:
        self._player = Player(Path(fifo), channels=1, sample_rate=sample_rate, noise=2.0, chunk_s=CHUNK_S)
        self._player.start()
        self._rate, self._end = sample_rate, 0.0

    def play(self, block: np.ndarray) -> None:
        """Plays it now, as a contact is heard when it happens."""
        begins = time.perf_counter() + LAG_S
        if abs(begins - self._end) < JITTER_S:  # joins the one before
            begins = self._end
        self._player.play(block, begins)
        self._end = begins + len(block) / self._rate


class Simulation:
    """The task, stepped by whoever asks, in one thread."""

    def __init__(self, task: str, fifo: str, image_size: int, sample_rate: int, hidden_object: bool = True) -> None:
        self.env = gym.make(
            f"gym_playbyear:gym_playbyear/{task}",
            disable_env_checker=True,
            image_size=image_size,
            sample_rate=sample_rate,
            render_mode="rgb_array",
            hidden_object=hidden_object,
        ).unwrapped
        self.speaker = Loudspeaker(fifo, sample_rate) if fifo else None
        self.requests: queue.Queue = queue.Queue()
        self._seed = 0
        self.reset(0)

    def reset(self, seed: int | None, waits: bool = False) -> dict[str, Any]:
        """A person sets the scene up, and keeps a hand on the arm if it `waits`."""
        self.is_waiting = waits
        self._seed = self._seed + 1 if seed is None else seed
        self.observation, _ = self.env.reset(seed=self._seed)
        self.room = self.observation["audio.gripper"]
        self.success = self.failed = self.wants_control = False
        self.gate, self.demonstrator = self.env.intervention_gate(), self.env.scripted_expert()
        self.scripted: dict[tuple[int, bool], list[float]] = {}
        self.n_steps, self.last_grip, self.n_holds, self.n_closings = 0, -1.0, 0, 0
        self.first_step_s = self.last_step_s = 0.0
        self.next_hold, self.next_room = time.perf_counter() + 1e9, time.perf_counter()
        if self.speaker:
            self._hear()
        return {}

    def begin(self) -> dict[str, Any]:
        """The arm may move."""
        self.is_waiting = False
        return {}

    def act(self, action: list[float]) -> None:
        if self.is_waiting:
            return
        self._step(np.array(action, np.float32))
        self.wants_control = bool(self.gate.wants_control(np.array(action, np.float32)))

    def observe(self) -> dict[str, Any]:
        return {"state": self.observation["agent_pos"].tolist(), "picture": self.observation["pixels"]["front"]}

    def script(self, demonstrates: bool) -> dict[str, Any]:
        if self.is_waiting:
            return {"action": [0.0, 0.0, 0.0, self.last_grip]}
        key = (self.n_steps, demonstrates)  # asked twice in a step, it says the same
        if key not in self.scripted:
            script = self.demonstrator if demonstrates else self.gate
            self.scripted[key] = np.asarray(script.act(), float).tolist()
        return {"action": self.scripted[key]}

    def status(self) -> dict[str, Any]:
        names = ("success", "failed", "wants_control", "is_waiting", "n_steps", "n_holds", "n_closings")
        now = {name: getattr(self, name) for name in names}
        seconds = round(self.last_step_s - self.first_step_s, 3)  # what n_steps - 1 steps took
        return {**now, "seed": self._seed, "most_steps": self.env._max_episode_steps, "seconds": seconds}

    def run(self) -> None:
        while True:
            try:
                due = min(self.next_hold, self.next_room) - time.perf_counter()
                request, answer = self.requests.get(timeout=max(min(due, 1), 0))
            except queue.Empty:
                if time.perf_counter() > self.next_room:
                    self._hear_the_room()
                if time.perf_counter() > self.next_hold:
                    self.n_holds += 1
                    self._step(np.array([0, 0, 0, self.last_grip], np.float32))
                continue
            what = request.pop("what")
            if what == "act":  # as motors do: they take it, and move
                answer.put({})
                self.act(**request)
                continue
            try:
                answer.put(getattr(self, what)(**request))
            except Exception as error:
                answer.put({"error": repr(error)})

    def _step(self, action: np.ndarray) -> None:
        if self.success or self.failed:
            self.next_hold = time.perf_counter() + 1e9
            return
        self.observation, _, terminated, _, info = self.env.step(action)
        self.last_step_s = time.perf_counter()
        self.first_step_s = self.first_step_s or self.last_step_s
        self.last_grip, self.n_steps = float(action[3]), self.n_steps + 1
        self.success = bool(info["is_success"])
        self.n_closings = int(info.get("n_closings", 0))
        self.failed = terminated and not self.success
        self._hear()
        self.next_hold = time.perf_counter() + STEP_S + GRACE_S

    def _hear_the_room(self) -> None:
        """Before the first step and after the last nothing touches anything."""
        self.next_room = time.perf_counter() + STEP_S
        is_moving = self.n_steps > 0 and not (self.success or self.failed)
        if self.speaker and not is_moving:
            self.speaker.play(self.room)

    def _hear(self) -> None:
        if self.speaker:
            self.speaker.play(self.observation["audio.gripper"])


def answer(connection: Connection, simulation: Simulation) -> None:
    reply: queue.Queue = queue.Queue()
    while True:
        try:
            simulation.requests.put((json.loads(connection.recv_bytes()), reply))
            told = reply.get()
            picture = told.get("picture")
            if picture is not None:
                told = {**told, "picture": list(picture.shape)}
            connection.send_bytes(json.dumps(told).encode())
            if picture is not None:
                connection.send_bytes(np.ascontiguousarray(picture).tobytes())
        except (OSError, EOFError):
            return


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--socket", required=True)
    parser.add_argument("--fifo", default="")
    parser.add_argument("--task", default="OccludedGrasp-v1")
    parser.add_argument("--image_size", type=int, default=84)
    parser.add_argument("--sample_rate", type=int, default=16000)
    parser.add_argument(
        "--twin", action="store_true", help="the hand passes through the hidden object: nothing to hear"
    )
    args = parser.parse_args()
    simulation = Simulation(args.task, args.fifo, args.image_size, args.sample_rate, not args.twin)
    listener = Listener(args.socket, "AF_UNIX")

    def accept() -> None:
        while True:
            connection = listener.accept()
            threading.Thread(target=answer, args=(connection, simulation), daemon=True).start()

    def end_with_parent() -> None:
        sys.stdin.read()
        os._exit(0)

    for work in (accept, end_with_parent):
        threading.Thread(target=work, daemon=True).start()
    print("ready", flush=True)
    simulation.run()


if __name__ == "__main__":
    main()
