"""A dataset in LeRobot's format 2.1: a file for each episode, and metadata as lines of JSON."""

import json
import shutil
from pathlib import Path
from typing import Any

import pyarrow.compute as pc
import pyarrow.parquet as pq
from support.recording import edit_info

from lerobot_playbyear.datasets.statistics import row_stats


def as_v21(root: Path) -> None:
    """Gives a dataset of the format 3.0 without films, in one file, that layout."""
    rows = pq.read_table(root / "meta/episodes").to_pylist()
    tasks = pq.read_table(root / "meta/tasks.parquet").to_pandas()
    (path,) = root.glob("data/*/*.parquet")
    table = pq.read_table(path)
    for row in rows:
        number = row["episode_index"]
        pq.write_table(
            table.filter(pc.equal(table["episode_index"], number)), path.with_name(f"episode_{number:06d}.parquet")
        )
    path.unlink()
    shutil.rmtree(root / "meta/episodes")
    (root / "meta/tasks.parquet").unlink()
    (root / "meta/stats.json").unlink()
    stats = [
        {key: {name: value.tolist() for name, value in own.items()} for key, own in row_stats(row).items()}
        for row in rows
    ]
    _write(root, "episodes", [{name: row[name] for name in ("episode_index", "tasks", "length")} for row in rows])
    _write(root, "episodes_stats", [{"episode_index": i, "stats": own} for i, own in enumerate(stats)])
    _write(root, "tasks", [{"task_index": int(i), "task": text} for text, i in tasks["task_index"].items()])
    edit_info(root, lambda info: info.update(OLD, total_chunks=1, total_videos=0))


OLD = {
    "codebase_version": "v2.1",
    "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
    "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
}


def _write(root: Path, name: str, lines: list[dict[str, Any]]) -> None:
    (root / f"meta/{name}.jsonl").write_text("".join(f"{json.dumps(line)}\n" for line in lines))
