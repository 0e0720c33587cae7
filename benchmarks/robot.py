"""A robot in real time on this machine: how late ticks are, and whether ten minutes of two cameras and microphones fit.

    python benchmarks/robot.py
    python benchmarks/robot.py --seconds=60

1. 20 Hz: a 224-pixel policy of full width acts, with one camera and one microphone.
2. 30 Hz: two cameras of 640x480 and two microphones of 48 kHz are recorded as video, as `playbyear-record` does it.

The arm and its cameras are made up (tests/sim_robot), the sound comes through a PulseAudio server and PortAudio where these
are installed, and otherwise from a file in real time. The table's limit is that 1 % of ticks may come more than 5 ms late.
"""

import contextlib
import os
import resource
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import torch
from common import Row, machine, parser_for, report

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from robot_factory import joint_config, noise_file, robot_env
from sound_server import SoundServer, playing_elsewhere, why_not

from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.episodes.environment import env_facts
from lerobot_playbyear.episodes.frames import dataset_features
from lerobot_playbyear.episodes.play import play
from lerobot_playbyear.episodes.streaming import FrameStream
from lerobot_playbyear.microphones.config import FileMicrophoneConfig, PortAudioMicrophoneConfig

RATE = 48000
LATE_PERCENT = 1.0
CAMERA_LATENCY_S = 0.02  # as of a quick USB camera: sound that is as old has come already
_LOOK_S = 1.0


class Wave:
    """An actor that moves the joints to and fro."""

    def reset(self, env: Any) -> None:
        self.n = 0

    def act(self, observation: Any) -> np.ndarray:
        self.n += 1
        return np.full(3, 5 * np.sin(self.n / 20), np.float32)


@contextlib.contextmanager
def microphones(names: tuple[str, ...], folder: Path) -> Iterator[dict[str, Any]]:
    """Channels of one sound card."""
    if why_not():
        print(f"Sound from a file: {why_not()}")
        path = noise_file(folder, RATE, channels=len(names))
        yield {name: FileMicrophoneConfig(path=str(path), channel=n) for n, name in enumerate(names)}
        return
    with (
        SoundServer(folder, {"bench": len(names)}, RATE) as server,
        playing_elsewhere(server.fifo("bench"), len(names), RATE),
    ):
        yield {name: PortAudioMicrophoneConfig(device="bench", channel=n) for n, name in enumerate(names)}


def arm(**pictures: tuple[int, int]) -> Any:
    from lerobot_robot_playbyear_sim import JointArmConfig

    return JointArmConfig(pictures=pictures)


def acting(seconds: float, folder: Path, image_size: int, threads: int) -> Row:
    """Ticks of a policy at 20 Hz."""
    from lerobot.policies import make_policy, make_pre_post_processors

    from lerobot_playbyear.episodes.policy_actor import PolicyActor
    from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig

    torch.set_num_threads(threads)
    with microphones(("gripper",), folder) as ears:
        config = joint_config(
            fps=20,
            robot=arm(front=(image_size, image_size)),
            microphones=ears,
            episode_s=seconds,
            max_step=None,
            camera_latency_s=CAMERA_LATENCY_S,
        )
        with robot_env(config) as env:
            config.describe(env.observation_space, env.action_space)
            policy_cfg = PlaybyearConfig(device="cpu", sample_rate=RATE, fps=20, image_size=image_size)
            policy = make_policy(cfg=policy_cfg, env_cfg=config)
            actor = PolicyActor(policy, config, *make_pre_post_processors(policy_cfg))
            ready = _Warm(actor)
            episode = play(env, ready, seed=0)
    facts = episode.facts or {}
    late = 100 * facts["late_ticks"] / facts["ticks"]
    print(f"acting: {facts | {'drop_outs': count(facts)}}; a policy step takes {1000 * np.median(ready.took):.1f} ms")
    return Row(
        f"ticks more than 5 ms late, 20 Hz, policy of {image_size} px, camera, microphone",
        late,
        "%",
        beside="a policy step",
        theirs=1000 * float(np.median(ready.took)),
        wanted=f"at most {LATE_PERCENT} %",
        holds=late <= LATE_PERCENT,
    )


class _Warm:
    """Lets a policy act once before the time counts, and times its steps."""

    def __init__(self, actor: Any) -> None:
        self._actor, self.took = actor, []

    def reset(self, env: Any) -> None:
        self._actor.reset(env)
        for _ in range(3):
            self._actor.act(env.unwrapped._last)
        self._actor.reset(env)
        env.unwrapped._ticks.start()
        env.unwrapped._rig.ears.restart(time.perf_counter())

    def act(self, observation: Any) -> np.ndarray:
        start = time.perf_counter()
        action = self._actor.act(observation)
        self.took.append(time.perf_counter() - start)
        return np.clip(action, -1, 1)


def recording(seconds: float, episode_s: float, folder: Path) -> list[Row]:
    """Ticks and memory of a recording at 30 Hz."""
    from lerobot.configs.video import RGBEncoderConfig

    memory: list[float] = []
    ended = threading.Event()

    def watch() -> None:
        while not ended.wait(_LOOK_S):
            memory.append(psutil.Process().memory_info().rss / 2**30)

    with microphones(("left", "right"), folder) as ears:
        robot = arm(front=(480, 640), wrist=(480, 640))
        config = joint_config(fps=30, robot=robot, microphones=ears, episode_s=episode_s, max_step=None)
        with robot_env(config) as env, contextlib.ExitStack() as stack:
            env.connect()
            facts = env_facts(env)
            root = folder / "data"
            encoder = RGBEncoderConfig(vcodec="h264", preset="ultrafast")
            writer = stack.enter_context(
                DurableWriter(
                    "benchmark/robot",
                    root,
                    30,
                    dataset_features(facts, video=True),
                    streaming_encoding=True,
                    rgb_encoder=encoder,
                )
            )
            thread = threading.Thread(target=watch, daemon=True)
            thread.start()
            notes, saving = [], []
            for seed in range(max(round(seconds / episode_s), 1)):
                stream = FrameStream(writer, seed, "wave")
                episode = play(env, Wave(), seed, sink=stream)
                start = time.perf_counter()
                stream.finish()
                writer.save_episode()
                saving.append(time.perf_counter() - start)
                notes.append(episode.facts or {})
            ended.set()
            n_frames = writer.num_frames
    ticks, late = (sum(note[name] for note in notes) for name in ("ticks", "late_ticks"))
    n = max(len(memory) // 10, 1)
    early, end = max(memory[n : 3 * n] or memory), max(memory[-2 * n :])
    drops = sum(count(note) for note in notes)
    print(
        f"recording: {len(notes)} episodes of {episode_s} s, {n_frames} frames, {late} of {ticks} ticks late, worst "
        f"{1000 * max(note['worst_lateness_s'] for note in notes):.1f} ms, {drops} drop-outs, saving took "
        f"{np.median(saving):.1f} s; memory {early:.2f} GiB early, {end:.2f} GiB at the end"
    )
    limit = f"at most {LATE_PERCENT} %"
    percent = 100 * late / ticks
    return [
        Row(
            "frames recorded, 30 Hz, 2 x 640x480, 2 x 48 kHz",
            n_frames,
            "frames",
            beside="ticks",
            theirs=ticks,
            wanted="all",
            holds=n_frames == ticks and drops == 0,
        ),
        Row("ticks more than 5 ms late, the same", percent, "%", wanted=limit, holds=percent <= LATE_PERCENT),
        Row(
            "memory at the end, the same",
            end,
            "GiB",
            beside="early",
            theirs=early,
            wanted="flat",
            holds=end <= 1.1 * early,
        ),
    ]


def count(note: dict[str, Any]) -> int:
    """Drop-outs; the channels of a card lose the same."""
    return max((len(drops) for drops in note.get("drop_outs", {}).values()), default=0)


def main() -> None:
    parser = parser_for(__doc__, turns=1)
    parser.add_argument("--seconds", type=float, default=600, help="of recording, and a fifth of it of acting")
    parser.add_argument("--episode_s", type=float, default=30, help="of each recorded episode")
    parser.add_argument("--image_size", type=int, default=224, help="of the policy [pixels]")
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1, help="of the policy")
    args = parser.parse_args()
    started = machine()
    with tempfile.TemporaryDirectory(dir="/tmp") as one, tempfile.TemporaryDirectory(dir="/tmp") as other:
        rows = [acting(args.seconds / 5, Path(one), args.image_size, args.threads)]
        rows += recording(args.seconds, min(args.episode_s, args.seconds), Path(other))
    print(f"most memory: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB")
    report("robot", rows, args.output, started)


if __name__ == "__main__":
    main()
