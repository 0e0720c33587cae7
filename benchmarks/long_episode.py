"""One very long episode, assembled instead of recorded: the files of a LeRobotDataset v3.0 as LeRobot lays them out.

A minute of each camera is encoded and its packets are repeated; the sound is noise with knocks, different throughout.
"""

import itertools
import json
import shutil
import wave
from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.datasets.io_utils import write_info, write_tasks
from lerobot.datasets.utils import DEFAULT_DATA_PATH, DEFAULT_EPISODES_PATH, DEFAULT_VIDEO_PATH
from scenes import pictures

from lerobot_playbyear.datasets import audio_feature
from lerobot_playbyear.datasets.statistics import numeric_stats, write_stats

REPO_ID = "benchmark/long"
FPS, SAMPLE_RATE = 30, 48000
HEIGHT, WIDTH = 480, 640
CAMERAS = ("observation.images.front", "observation.images.wrist")
MICROPHONES = ("observation.audio.left", "observation.audio.right")
_BLOCK = SAMPLE_RATE // FPS  # samples of a frame
_PLACE = {"chunk_index": 0, "file_index": 0}
_PICTURE_STATS = {"min": 0.0, "max": 1.0, "mean": 0.5, "std": 0.25, "q01": 0.0, "q10": 0.2, "q50": 0.5, "q90": 0.8}


def make(folder: Path, minutes: float) -> None:
    """Makes `heard` and `silent`, the same episode with and without its microphones, and `sound/0.wav`, which has both.

    Args:
        folder: Where; it is made.
        minutes: The length of the episode.
    """
    n_frames = round(minutes * 60 * FPS)
    wav = folder / "sound" / "0.wav"
    _write_wav(wav, n_frames)
    for number, camera in enumerate(CAMERAS):
        _write_video(folder / "heard" / _video(camera), n_frames, number)
    _write_tables(folder / "heard", n_frames, wav)
    for camera in CAMERAS:
        path = folder / "silent" / _video(camera)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.hardlink_to(folder / "heard" / _video(camera))
    _write_tables(folder / "silent", n_frames, None)
    for name in ("heard", "silent"):
        dataset = LeRobotDataset(f"benchmark/{name}", root=folder / name, video_backend="pyav")
        assert dataset[n_frames - 2][CAMERAS[1]].shape == (3, HEIGHT, WIDTH)
    (folder / "minutes").write_text(str(minutes))


def _video(camera: str) -> str:
    return DEFAULT_VIDEO_PATH.format(video_key=camera, **_PLACE)


def _write_wav(path: Path, n_frames: int) -> None:
    """Noise of varying loudness, with knocks, a second at a time."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    knock = 8000 * np.exp(-np.arange(4800) / 600) * np.sin(np.arange(4800) * 0.2)
    with wave.open(str(path), "wb") as file:
        file.setnchannels(len(MICROPHONES))
        file.setsampwidth(2)
        file.setframerate(SAMPLE_RATE)
        for second in range(-(-n_frames // FPS)):
            n_samples = min(FPS, n_frames - second * FPS) * _BLOCK
            sound = rng.normal(0, 200 + 100 * np.sin(second / 20), (n_samples, len(MICROPHONES)))
            if second % 3 == 0 and n_samples > 20000:
                sound[9600 : 9600 + len(knock)] += knock[:, None]
            file.writeframes(sound.astype("<i2").tobytes())


def _blocks(wav: Path) -> Iterator[np.ndarray]:
    """A minute of sound at a time, (n, S, microphones)."""
    with wave.open(str(wav), "rb") as file:
        while data := file.readframes(60 * SAMPLE_RATE):
            yield np.frombuffer(data, "<i2").reshape(-1, _BLOCK, len(MICROPHONES))


def _write_video(path: Path, n_frames: int, seed: int) -> None:
    minute = path.with_name("minute.mp4")
    path.parent.mkdir(parents=True, exist_ok=True)
    n_encoded = min(60 * FPS, n_frames)
    picture = pictures(HEIGHT, WIDTH, np.random.default_rng(seed))
    with av.open(str(minute), "w") as container:
        stream = container.add_stream("libx264", rate=FPS)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.options = {"preset": "veryfast", "crf": "32", "g": str(FPS)}
        for i in range(n_encoded):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture(i), "rgb24")))
        container.mux(stream.encode(None))
    with av.open(str(path), "w") as container:
        out = None
        for turn in range(-(-n_frames // n_encoded)):
            with av.open(str(minute)) as source:
                stream = source.streams.video[0]
                out = out or container.add_stream_from_template(stream)
                shift = round(turn * n_encoded / FPS / stream.time_base)
                for packet in source.demux(stream):
                    if packet.pts is not None and packet.dts is not None:
                        packet.pts, packet.dts, packet.stream = packet.pts + shift, packet.dts + shift, out
                        container.mux(packet)
    minute.unlink()


def _features(with_sound: bool) -> dict[str, dict]:
    camera = {"dtype": "video", "shape": (HEIGHT, WIDTH, 3), "names": ["height", "width", "channels"]}
    return {
        **{key: dict(camera) for key in CAMERAS},
        **({key: audio_feature(SAMPLE_RATE, FPS) for key in MICROPHONES} if with_sound else {}),
        "observation.state": {"dtype": "float32", "shape": (7,), "names": None},
        "action": {"dtype": "float32", "shape": (4,), "names": None},
    }


def _write_tables(root: Path, n_frames: int, wav: Path | None) -> None:
    """The data file, in one row group as LeRobot writes an episode, and everything in `meta`."""
    scratch = root.with_name("scratch")
    dataset = LeRobotDataset.create(REPO_ID, FPS, _features(wav is not None), root=scratch, use_videos=True)
    info = dataset.meta.info
    shutil.rmtree(scratch)
    (root / "meta").mkdir(parents=True)
    info.total_episodes, info.total_frames, info.total_tasks = 1, n_frames, 1
    info.splits = {"train": "0:1"}
    rng = np.random.default_rng(1)
    columns: dict[str, np.ndarray] = {
        "observation.state": np.cumsum(rng.normal(0, 0.01, (n_frames, 7)), axis=0).astype(np.float32),
        "action": rng.uniform(-1, 1, (n_frames, 4)).astype(np.float32),
        "timestamp": (np.arange(n_frames) / FPS).astype(np.float32),
        "frame_index": np.arange(n_frames),
        "episode_index": np.zeros(n_frames, np.int64),
        "index": np.arange(n_frames),
        "task_index": np.zeros(n_frames, np.int64),
    }
    if wav is not None:
        for i, key in enumerate(MICROPHONES):
            columns[key] = np.concatenate([block[..., i] for block in _blocks(wav)])
    schema = get_hf_features_from_features(info.features).arrow_schema
    arrays = []
    for field in schema:
        values = columns[field.name]
        flat = pa.array(values.reshape(-1))
        array = flat if values.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
        arrays.append(array.cast(field.type))
    path = root / DEFAULT_DATA_PATH.format(**_PLACE)
    path.parent.mkdir(parents=True)
    pq.write_table(pa.Table.from_arrays(arrays, schema=schema), path, compression="snappy", use_dictionary=True)
    del arrays
    stats = numeric_stats(columns, info.features)
    picture_stats = {name: np.full((3, 1, 1), value) for name, value in {**_PICTURE_STATS, "q99": 1.0}.items()}
    stats |= {key: {**picture_stats, "count": np.array([100])} for key in CAMERAS}
    row = {
        "episode_index": 0,
        "tasks": ["Listen."],
        "length": n_frames,
        **{f"data/{name}": value for name, value in _PLACE.items()},
        "dataset_from_index": 0,
        "dataset_to_index": n_frames,
        **{f"videos/{key}/{name}": value for key, (name, value) in itertools.product(CAMERAS, _PLACE.items())},
        **{f"videos/{key}/from_timestamp": 0.0 for key in CAMERAS},
        **{f"videos/{key}/to_timestamp": n_frames / FPS for key in CAMERAS},
        **{f"stats/{key}/{name}": value.tolist() for key, own in stats.items() for name, value in own.items()},
        **{f"meta/episodes/{name}": value for name, value in _PLACE.items()},
    }
    rows = root / DEFAULT_EPISODES_PATH.format(**_PLACE)
    rows.parent.mkdir(parents=True)
    pq.write_table(pa.Table.from_pylist([row]), rows)
    write_tasks(_tasks(), root)
    write_stats(stats, root)
    write_info(info, root)
    assert json.loads((root / "meta/info.json").read_text())["total_frames"] == n_frames


def _tasks():
    import pandas as pd

    return pd.DataFrame({"task_index": [0]}, index=pd.Index(["Listen."], name="task"))
