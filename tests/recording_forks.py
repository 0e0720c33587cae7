"""Processes to be killed and processes to read what they left; see `test_durable.py`.

Reads orders as lines of JSON, forks for each a child that begins like a fresh process, and answers with one line.
"""

import json
import os
import random
import signal
import sys
import time
import traceback
from importlib.abc import MetaPathFinder
from typing import Any


class WithoutThePlugin(MetaPathFinder):
    """As if only LeRobot were installed."""

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> None:
        if name.startswith(("lerobot_playbyear", "lerobot_policy_playbyear", "gym_playbyear")):
            raise ImportError(f"{name} is not here")


def record_forever(root: str, report: int) -> None:
    """Appends episodes, and says how many there are after each."""
    from lerobot.configs.video import RGBEncoderConfig
    from recording_factory import FPS, REPO_ID, RICH_FEATURES, episode_frames

    from lerobot_playbyear.datasets.durable import DurableWriter

    encoder = RGBEncoderConfig(vcodec="h264", preset="ultrafast")
    writer = DurableWriter(REPO_ID, root, FPS, RICH_FEATURES, resume=True, rgb_encoder=encoder)
    while True:
        os.write(report, f"{writer.num_episodes}\n".encode())
        for frame in episode_frames(writer.num_episodes, RICH_FEATURES):
            writer.add_frame(frame)
        writer.save_episode()


def record(root: str, episodes: int, share: float) -> dict[str, Any]:
    """Has a child record, and kills it.

    Args:
        root: The dataset's folder.
        episodes: How many it may save first; -1: it is killed while it opens the dataset.
        share: When it is killed, as a share of the time that the last episode, or the opening, took.

    Returns:
        How many episodes it reported in all, and what went wrong.
    """
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            record_forever(root, writing)
        except BaseException:
            os.write(writing, f"error {json.dumps(traceback.format_exc())}\n".encode())
        os._exit(1)
    os.close(writing)
    pipe = os.fdopen(reading)
    lines: list[str] = []
    last, took = time.monotonic(), 0.5
    while len(lines) < episodes + 1:
        lines.append(pipe.readline())
        took, last = time.monotonic() - last, time.monotonic()
        if not lines[-1]:
            break
    time.sleep(share * took)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    with pipe:
        lines = [line for line in [*lines, *pipe.read().split("\n")[:-1]] if line]
    error = next((json.loads(line[6:]) for line in lines if line.startswith("error")), None)
    counts = [int(line) for line in lines if not line.startswith("error")]
    return {"saved": counts[-1] if counts else 0, "error": error}


def read(root: str, begin: int) -> dict[str, Any]:
    """Has a child compare what is there with what was recorded: all episodes from `begin` on, and some before it."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        answer: dict[str, Any] = {"error": None}
        try:
            from recording_factory import RICH_FEATURES, differences, load

            dataset = load(root)
            answer["episodes"] = dataset.num_episodes
            before = random.Random(begin).sample(range(begin), min(begin, 5))
            numbers = [*before, *range(begin, dataset.num_episodes)]
            answer["wrong"] = differences(dataset, {n: n for n in numbers}, RICH_FEATURES)[:5]
            answer["rows"] = len(dataset.hf_dataset)
            answer["frames"] = dataset.num_frames
            assert not [name for name in sys.modules if name.startswith("lerobot_playbyear")]
        except BaseException:
            answer["error"] = traceback.format_exc()
        os.write(writing, json.dumps(answer).encode())
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading) as pipe:
        answer = json.loads(pipe.read())
    os.waitpid(child, 0)
    return answer


def main() -> None:
    role = sys.argv[1]
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print is no answer
    if role == "read":
        sys.meta_path.insert(0, WithoutThePlugin())
        import lerobot.datasets.lerobot_dataset  # noqa: F401
    else:
        import lerobot_playbyear.datasets.durable  # noqa: F401
    import recording_factory  # noqa: F401

    for line in sys.stdin:
        answer = record(**json.loads(line)) if role == "record" else read(**json.loads(line))
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
