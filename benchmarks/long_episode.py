"""Hours of recordings, assembled instead of recorded: the files of a LeRobotDataset v3.0 as LeRobot lays them out.

A minute of each camera is encoded and its packets are repeated; the sound is noise with knocks, different throughout.
"""

import itertools
import wave
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.datasets.utils import DEFAULT_DATA_PATH, DEFAULT_VIDEO_PATH
from lerobot.datasets.video_utils import concatenate_video_files
from scenes import CAMERAS, MICROPHONES, dataset_features, pictures

from lerobot_playbyear.datasets.statistics import numeric_stats

REPO_ID, TASK = "benchmark/long", "Listen."
FPS, SAMPLE_RATE = 30, 48000
HEIGHT, WIDTH = 480, 640
_BLOCK = SAMPLE_RATE // FPS  # samples of a frame
_PLACE = {"chunk_index": 0, "file_index": 0}
_PICTURE_STATS = {
    **{"min": 0.0, "max": 1.0, "mean": 0.5, "std": 0.25},
    **{"q01": 0.0, "q10": 0.2, "q50": 0.5, "q90": 0.8, "q99": 1.0},
}


def make(folder: Path, minutes: float) -> None:
    """Makes `heard` and `silent`, the same episode with and without its microphones, and `sound/0.wav`, which has both.

    Args:
        folder: Where; it is made.
        minutes: The length of the episode.
    """
    n_frames = round(minutes * 60 * FPS)
    heard, silent = folder / "heard", folder / "silent"
    make_episodes(heard, 1, n_frames, folder / "sound" / "0.wav", noise_std=2, crf=32)
    _write_tables(silent, 1, n_frames, None)
    for camera in CAMERAS:
        video = DEFAULT_VIDEO_PATH.format(video_key=camera, **_PLACE)
        (silent / video).parent.mkdir(parents=True)
        (silent / video).hardlink_to(heard / video)
    _check(silent, n_frames)
    (folder / "minutes").write_text(str(minutes))


def make_episodes(root: Path, n_episodes: int, n_frames: int, wav: Path, noise_std: float = 12, crf: int = 24) -> None:
    """Makes a dataset of equally long episodes.

    Args:
        root: Its folder.
        n_episodes: How many.
        n_frames: Of each.
        wav: Where all of its sound is put as well.
        noise_std: Of the cameras' noise [levels]; with the defaults a picture takes 20 kB.
        crf: x264's quality; 0 loses nothing.
    """
    _write_tables(root, n_episodes, n_frames, _write_wav(wav, n_episodes * n_frames))
    for number, camera in enumerate(CAMERAS):
        video = root / DEFAULT_VIDEO_PATH.format(video_key=camera, **_PLACE)
        _write_video(
            video, n_episodes * n_frames, pictures(HEIGHT, WIDTH, np.random.default_rng(number), noise_std), crf
        )
    _check(root, n_episodes * n_frames)


def _check(root: Path, n_frames: int) -> None:
    dataset = LeRobotDataset(f"benchmark/{root.name}", root=root, video_backend="pyav")
    assert dataset.num_frames == n_frames
    assert dataset[n_frames - 2][CAMERAS[1]].shape == (3, HEIGHT, WIDTH)


def _write_wav(path: Path, n_frames: int) -> np.ndarray:
    """Noise of varying loudness, with knocks, a second at a time; returns it, (n_frames, S, microphones)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    knock = 8000 * np.exp(-np.arange(4800) / 600) * np.sin(np.arange(4800) * 0.2)
    whole = np.empty((n_frames * _BLOCK, len(MICROPHONES)), np.int16)
    with wave.open(str(path), "wb") as file:
        file.setnchannels(len(MICROPHONES))
        file.setsampwidth(2)
        file.setframerate(SAMPLE_RATE)
        for second, start in enumerate(range(0, len(whole), SAMPLE_RATE)):
            part = whole[start : start + SAMPLE_RATE]
            sound = rng.normal(0, 200 + 100 * np.sin(second / 20), part.shape)
            if second % 3 == 0 and len(part) > 20000:
                sound[9600 : 9600 + len(knock)] += knock[:, None]
            part[:] = sound.astype(np.int16)
            file.writeframes(part.tobytes())
    return whole.reshape(n_frames, _BLOCK, len(MICROPHONES))


def _write_video(path: Path, n_frames: int, picture: Callable[[int], np.ndarray], crf: int) -> None:
    minute = path.with_name("minute.mp4")
    path.parent.mkdir(parents=True, exist_ok=True)
    n_encoded = min(60 * FPS, n_frames)
    with av.open(str(minute), "w") as container:
        stream = container.add_stream("libx264", rate=FPS)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.options = {"preset": "veryfast", "crf": str(crf), "g": str(FPS)}
        for i in range(n_encoded):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture(i), "rgb24")))
        container.mux(stream.encode(None))
    concatenate_video_files([minute] * -(-n_frames // n_encoded), path)
    minute.unlink()


def _write_tables(root: Path, n_episodes: int, length: int, sound: np.ndarray | None) -> None:
    """The data file, a row group for each episode as LeRobot writes it, and everything in `meta`."""
    n_frames = n_episodes * length
    frame_index = np.tile(np.arange(length), n_episodes)
    n_microphones = 0 if sound is None else len(MICROPHONES)
    features = dataset_features((HEIGHT, WIDTH), SAMPLE_RATE, FPS, n_microphones, "video", len(CAMERAS))
    meta = LeRobotDatasetMetadata.create(REPO_ID, FPS, features, root=root)
    rng = np.random.default_rng(1)
    columns: dict[str, np.ndarray] = {
        "observation.state": np.cumsum(rng.normal(0, 0.01, (n_frames, 7)), axis=0).astype(np.float32),
        "action": rng.uniform(-1, 1, (n_frames, 4)).astype(np.float32),
        "timestamp": (frame_index / FPS).astype(np.float32),
        "frame_index": frame_index,
        "episode_index": np.arange(n_episodes).repeat(length),
        "index": np.arange(n_frames),
        "task_index": np.zeros(n_frames, np.int64),
    }
    if sound is not None:
        columns |= {key: np.ascontiguousarray(sound[..., i]) for i, key in enumerate(MICROPHONES)}
    schema = get_hf_features_from_features(meta.features).arrow_schema
    arrays = []
    for field in schema:
        values = columns[field.name]
        flat = pa.array(values.reshape(-1))
        array = flat if values.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
        arrays.append(array.cast(field.type))
    path = root / DEFAULT_DATA_PATH.format(**_PLACE)
    path.parent.mkdir(parents=True)
    table = pa.Table.from_arrays(arrays, schema=schema)
    pq.write_table(table, path, row_group_size=length, compression="snappy", use_dictionary=True)
    del arrays
    stats = numeric_stats(columns, meta.features)
    picture_stats = {name: np.full((3, 1, 1), value) for name, value in _PICTURE_STATS.items()}
    stats |= {key: {**picture_stats, "count": np.array([100])} for key in CAMERAS}
    files = {
        **{f"data/{name}": value for name, value in _PLACE.items()},
        **{f"videos/{key}/{name}": value for key, (name, value) in itertools.product(CAMERAS, _PLACE.items())},
    }
    meta.save_episode_tasks([TASK])
    for episode in range(n_episodes):
        begin, end = episode * length / FPS, (episode + 1) * length / FPS
        times = {
            f"videos/{key}/{edge}": t
            for key in CAMERAS
            for edge, t in (("from_timestamp", begin), ("to_timestamp", end))
        }
        meta.save_episode(episode, length, [TASK], stats, {**files, **times})
    meta.finalize()
