"""Datasets with files of sound beside the frames, made from the layout of LeRobot's pull request 2824 alone, with PyAV."""

import itertools
import json
from pathlib import Path

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

PRE_ROLL_S = 1.0
EARS = "observation.audio.ears"
TABLE = "observation.audio.table"


def encode(path: Path, samples: np.ndarray, rate: int, codec: str) -> None:
    """Samples (n, channels) int16 as an M4A file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    layout = "mono" if samples.shape[1] == 1 else "stereo"
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate, layout=layout)
        for start in range(0, len(samples), 1024):
            piece = np.ascontiguousarray(samples[start : start + 1024]).reshape(1, -1)
            frame = av.AudioFrame.from_ndarray(piece, format="s16", layout=layout)
            frame.sample_rate, frame.pts = rate, start
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def add_files_of_sound(
    root: Path, key: str, sounds: list[np.ndarray], rate: int, codec: str = "alac", per_file: int = 2, ends: bool = True
) -> None:
    """Adds a microphone to a dataset.

    Args:
        root: Its folder.
        key: The feature.
        sounds: For each episode (n, channels) int16, from `PRE_ROLL_S` before its first frame on.
        rate: [Hz].
        codec: Of the files.
        per_file: Episodes in one file.
        ends: Whether `to_timestamp` is there.
    """
    columns: dict[str, list] = {"chunk_index": [], "file_index": [], "from_timestamp": [], "to_timestamp": []}
    for first in range(0, len(sounds), per_file):
        part = sounds[first : first + per_file]
        number = first // per_file
        encode(root / f"audio/{key}/chunk-000/file-{number:03d}.m4a", np.concatenate(part), rate, codec)
        edges = np.cumsum([0, *map(len, part)]) / rate
        for start, end in itertools.pairwise(edges):
            for name, value in zip(columns, (0, number, float(start), float(end)), strict=True):
                columns[name].append(value)
    (table,) = root.glob("meta/episodes/*/*.parquet")
    rows = pq.read_table(table)
    for name, values in columns.items():
        if ends or name != "to_timestamp":
            rows = rows.append_column(f"audio/{key}/{name}", pa.array(values))
    pq.write_table(rows, table)
    path = root / "meta/info.json"
    info = json.loads(path.read_text())
    n_channels = sounds[0].shape[1]
    notes = {"sample_rate": rate, "audio.codec": codec, "audio.channels": n_channels, "start_time_s": PRE_ROLL_S}
    info["features"][key] = {"dtype": "audio", "shape": [n_channels], "names": ["channels"], "info": notes}
    info["audio_path"] = "audio/{audio_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.m4a"
    path.write_text(json.dumps(info))
