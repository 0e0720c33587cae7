"""Does things with datasets while one call to the disk fails; see `faulty_disk.py`.

Reads orders as lines of JSON, forks for each a child that begins like a fresh process, and answers with one line.
"""

import contextlib
import json
import mmap
import os
import struct
import sys
import tempfile
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

_LAYOUT = "=qqiii1024s1024s"


class Control:
    """What is to fail, shared with `fault_shim.c` and all processes that are started from here."""

    def __init__(self, path: str) -> None:
        with open(path, "r+b") as file:
            self._shared = mmap.mmap(file.fileno(), struct.calcsize(_LAYOUT))

    def set(self, folder: str, at: int, error: int, kinds: int) -> None:
        """From now on call number `at` below a folder fails, once; -1: none does."""
        self._shared[:] = struct.pack(_LAYOUT, 0, at, error, kinds, 0, folder.encode(), b"")

    def stop(self) -> dict[str, Any]:
        """Nothing fails any more. Returns how many calls there were, and which one failed."""
        calls, *_, fired, _, what = struct.unpack(_LAYOUT, self._shared[:])
        self.set("", -1, 0, 0)
        return {"calls": calls, "failed": what.split(b"\0")[0].decode() if fired else None}


def check(root: str) -> dict[str, Any]:
    from lerobot_playbyear.repair.repair import look

    return _told(look(Path(root)))


def repair(root: str) -> dict[str, Any]:
    from lerobot_playbyear.repair import repair_dataset

    return _told(repair_dataset(root))


def _told(report: Any) -> dict[str, Any]:
    return {"kept": sorted(report.kept.items()), "dropped": report.dropped, "said": str(report)}


def inspect(root: str) -> dict[str, Any]:
    from recording_factory import REPO_ID

    from lerobot_playbyear.datasets.reader import SurveyedDataset
    from lerobot_playbyear.inspection.inspect import InspectConfig, InspectDatasetConfig
    from lerobot_playbyear.inspection.inspect import inspect as inspect_dataset

    inspect_dataset(InspectConfig(dataset=InspectDatasetConfig(repo_id=REPO_ID, root=root)))
    return {"episodes": len(SurveyedDataset.open(REPO_ID, root).episodes)}


def record(root: str) -> dict[str, Any]:
    """Appends an episode. That it fails is an answer as well: what the writer then says is on the disk."""
    from lerobot.configs.video import RGBEncoderConfig
    from recording_factory import FPS, REPO_ID, RICH_FEATURES, episode_frames

    from lerobot_playbyear.datasets.durable import DatasetWriteError, DurableWriter

    answer: dict[str, Any] = {"saved": None}
    encoder = RGBEncoderConfig(vcodec="h264", preset="ultrafast")
    with DurableWriter(REPO_ID, root, FPS, RICH_FEATURES, resume=True, rgb_encoder=encoder) as writer:
        answer["opened"] = writer.num_episodes
        try:
            for frame in episode_frames(writer.num_episodes, RICH_FEATURES):
                writer.add_frame(frame)
            answer["saved"] = writer.save_episode()
        except DatasetWriteError as error:
            answer["said"] = str(error)
        answer["counted"] = writer.num_episodes
    return answer


def load(root: str) -> dict[str, Any]:
    from recording_factory import RICH_FEATURES, differences
    from recording_factory import load as load_dataset

    dataset = load_dataset(root)
    numbers = {number: number for number in range(dataset.num_episodes)}
    return {"episodes": dataset.num_episodes, "wrong": differences(dataset, numbers, RICH_FEATURES)}


def store(root: str) -> dict[str, Any]:
    from recording_factory import REPO_ID, episode_length

    from lerobot_playbyear.training import EpisodeStore

    read = EpisodeStore.load(REPO_ID, root)
    lengths = [end - start for start, end in zip(read.starts, read.ends, strict=True)]
    wrong = [] if lengths == [episode_length(number) for number in range(len(lengths))] else [f"lengths {lengths}"]
    return {"episodes": read.n_episodes, "wrong": wrong}


OPERATIONS: dict[str, Callable[[str], dict[str, Any]]] = {
    operation.__name__: operation for operation in (check, repair, inspect, record, load, store)
}


def run(control: Control, order: dict[str, Any]) -> dict[str, Any]:
    """Does one thing, with at most one call failing."""
    import datasets

    with tempfile.TemporaryDirectory() as cache:
        datasets.config.HF_DATASETS_CACHE = cache  # or what an earlier child read would be found there
        control.set(order["folder"], order["at"], order["error"], order["kinds"])
        try:
            answer = OPERATIONS[order["operation"]](order["root"])
        except BaseException as error:
            stack = traceback.extract_tb(error.__traceback__)
            where = [f"{os.path.basename(frame.filename)}:{frame.lineno}" for frame in stack]
            answer = {"error": f"{type(error).__name__}: {error}", "raised_in": where}
        return {**answer, **control.stop()}


def answer_in_child(control: Control, order: dict[str, Any]) -> str:
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        with contextlib.suppress(BaseException), os.fdopen(writing, "w") as pipe:
            os.dup2(2, 1)  # the answers are what the test reads from standard output
            pipe.write(json.dumps(run(control, order)))
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading) as pipe:
        text = pipe.read()
    _, status = os.waitpid(child, 0)
    return text or json.dumps({"error": f"the process ended with {status}", "crashed": True, **control.stop()})


def main() -> None:

    import lerobot_playbyear.datasets.durable
    import lerobot_playbyear.inspection.inspect  # noqa: F401

    control = Control(os.environ["FAULT_CONTROL"])
    print(json.dumps({"ready": True}), flush=True)
    for line in sys.stdin:
        print(answer_in_child(control, json.loads(line)), flush=True)


if __name__ == "__main__":
    main()
