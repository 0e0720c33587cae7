"""Data larger than memory: the store on disk, under a hard limit of memory.

    python benchmarks/large.py                       # 50 episodes of 30 s; half an hour and 25 GB of disk
    python benchmarks/large.py --episodes=4 --seconds=5 --limit_gib=8

Two cameras of 640 x 480 at 30 fps, as video of a scene that moves with a camera's noise, and two microphones of 48 kHz. The
store is made, and a policy trained from it, in processes of their own that may not allocate more than the limit
(`RLIMIT_DATA`, on Linux; what is mapped from files does not count, since the system takes it back when it needs the room).
Then windows are drawn, in turns: from the disk, from memory with the same rows, and by LeRobotDataset, which decodes video. The
files are in the page cache then, as far as they fit into memory.
"""

import argparse
import os
import shutil
import sys
import tempfile
from pathlib import Path

import torch
from common import Row, in_turns, machine, medians, parser_for, report
from lerobot.datasets import LeRobotDataset
from long_episode import FPS, HEIGHT, SAMPLE_RATE, WIDTH, make_episodes
from memory import GIB, measure
from scenes import CAMERAS, MICROPHONES
from torch.utils.data import default_collate
from windows import drawing

from lerobot_playbyear.datasets import EpisodeStore, audio_keys
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.training.heap import keep_freed_memory

REPO_ID = "benchmark/large"
WANTED_SHARE, WANTED_TIMES, WANTED_FRAMES = 0.8, 100, 20_000
_COMPARED = 8  # episodes of which memory holds a copy
_BATCH, _WINDOW = 32, 74  # windows; frames of one: 2 s of sound before ten encodings, K = 5


def load(root: Path, cache: Path, image_size: int, episodes: list[int] | None = None) -> EpisodeStore:
    """The store on disk; made where it is not there yet."""
    keys = [*CAMERAS, *MICROPHONES, "observation.state", "action"]
    options = {"keys": keys, "device": "cpu", "video_backend": "pyav", "place": "disk", "image_size": image_size}
    return EpisodeStore.load(REPO_ID, str(root), episodes, cache=cache, **options)


def under_limit(root: Path, cache: Path, folder: Path, args: argparse.Namespace) -> list[Row]:
    """Makes the store, and trains from it, with no more memory than the limit."""
    limit = round(args.limit_gib * GIB)
    build = [sys.executable, __file__, "--build", f"--folder={folder}", f"--image_size={args.image_size}"]
    train = [
        *(sys.executable, "-m", "lerobot_playbyear.scripts.train", "--policy.type=playbyear", "--policy.device=cpu"),
        *(f"--policy.fps={FPS}", f"--policy.image_size={args.image_size}", "--policy.vision_width=16"),
        *("--policy.push_to_hub=false", f"--dataset.repo_id={REPO_ID}", f"--dataset.root={root}"),
        *("--dataset.video_backend=pyav", "--store=disk", f"--store.cache={cache}", "--steps=20", "--batch_size=1"),
        *("--log_freq=5", "--save_freq=20", f"--output_dir={folder / 'train'}"),
    ]
    shutil.rmtree(folder / "train", ignore_errors=True)
    shutil.rmtree(cache, ignore_errors=True)
    minutes = args.episodes * args.seconds / 60
    n_pictures = args.episodes * round(args.seconds * FPS) * len(CAMERAS)
    rows = []
    for name, command in (("building the store", build), ("training from it, 20 updates", train)):
        result = measure(name, command, minutes, limit, {"HF_HOME": str(folder / "home")})
        print(result, flush=True)
        if result.failure:
            raise RuntimeError(f"{name}: {result.failure}; see {folder}")
        wanted = f"under {args.limit_gib:g} GiB"
        figures = {"limit_is": "recorded pictures", "limit": n_pictures * HEIGHT * WIDTH * 3 / 2**20, "wanted": wanted}
        rows.append(Row(f"memory of {name}", result.own_gib * 1024, "MiB", **figures, holds=True))
        if name == "building the store":
            rows.append(Row("pictures decoded, shrunk and written", n_pictures / result.seconds, "frames/s"))
        else:
            rows.append(Row("training from the store that is there, start to end", result.seconds, "s"))
    return rows


def drawn(root: Path, cache: Path, args: argparse.Namespace) -> list[Row]:
    """Windows as training draws them: from the disk, from memory, and by LeRobotDataset."""
    policy = PlaybyearConfig(fps=FPS, sample_rate=SAMPLE_RATE, device="cpu")
    disk = load(root, cache, args.image_size)
    n = min(_COMPARED, args.episodes) * round(args.seconds * FPS)
    ends = disk.ends[: min(_COMPARED, args.episodes)]
    memory = EpisodeStore({k: disk.column(k)[:n].clone() for k in disk.keys}, disk.starts[: len(ends)], ends, FPS)
    lengths = {key: policy.n_run_frames for key in disk.keys if key.startswith("observation.") or key == "action"}
    lengths |= dict.fromkeys(CAMERAS, policy.n_image_frames) | dict.fromkeys(
        audio_keys(disk.keys), policy.n_audio_frames
    )
    deltas = {key: range(1 - length, 1) for key, length in lengths.items()}
    timestamps = {key: [delta / FPS for delta in offsets] for key, offsets in deltas.items()}
    stock = LeRobotDataset(REPO_ID, root, delta_timestamps=timestamps, video_backend="pyav")
    only_pictures = {key: deltas[key] for key in CAMERAS}
    n_pictures = _BATCH * policy.n_image_frames * len(CAMERAS)
    works = {
        "disk": drawing(lambda i: disk.windows(i, deltas), n, 8),
        "memory": drawing(lambda i: memory.windows(i, deltas), n, 8),
        "all": drawing(lambda i: disk.windows(i, deltas), len(disk), 8),
        "pictures": drawing(lambda i: disk.windows(i, only_pictures), n, 8),
        "stock": drawing(lambda i: default_collate([stock[j] for j in i[:4]]), n, 1),
    }
    seconds = medians(in_turns(works, args.turns, warm_up=2))
    rates = {name: (4 if name == "stock" else 8 * _BATCH) / took for name, took in seconds.items()}
    frames = 8 * n_pictures / seconds["pictures"]
    return [
        Row(
            f"items of {policy.n_supervised_steps} windows from the disk",
            rates["disk"],
            "items/s",
            beside="from memory",
            theirs=rates["memory"],
            wanted=f"at least {WANTED_SHARE} times",
            holds=rates["disk"] >= WANTED_SHARE * rates["memory"],
        ),
        Row(
            "the same",
            rates["disk"],
            "items/s",
            beside="stock LeRobotDataset",
            theirs=rates["stock"],
            wanted=f"at least {WANTED_TIMES} times",
            holds=rates["disk"] >= WANTED_TIMES * rates["stock"],
        ),
        Row(
            f"the same over all {disk.nbytes / GIB:.1f} GiB, as far as they are in the page cache",
            rates["all"],
            "items/s",
            beside="stock LeRobotDataset",
            theirs=rates["stock"],
        ),
        Row(
            f"pictures of {args.image_size} px in batches",
            frames,
            "frames/s",
            wanted=f"at least {WANTED_FRAMES:,}",
            holds=frames >= WANTED_FRAMES,
        ),
    ]


def main() -> None:
    parser = parser_for(__doc__, turns=5)
    parser.add_argument("--folder", type=Path, help="where dataset and store are kept; a temporary one without it")
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--seconds", type=float, default=30, help="of an episode")
    parser.add_argument("--image_size", type=int, default=224, help="pixels, of the policy")
    parser.add_argument("--limit_gib", type=float, default=4)
    parser.add_argument("--draw", action="store_true", help="only draw windows, from the store in --folder")
    parser.add_argument("--build", action="store_true", help="only make the store; a part of the benchmark")
    args = parser.parse_args()
    if args.build:
        load(args.folder / "data", args.folder / "cache", args.image_size)
        return
    keep_freed_memory()  # as playbyear-train does
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", os.cpu_count() or 1)))
    started = machine()
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.folder or Path(temporary)
        root, cache = folder / "data", folder / "cache"
        if not (root / "meta" / "info.json").is_file():
            make_episodes(root, args.episodes, round(args.seconds * FPS), folder / "sound" / "0.wav")
        rows = [] if args.draw else under_limit(root, cache, folder, args)
        report("large draws" if args.draw else "large", [*rows, *drawn(root, cache, args)], args.output, started)


if __name__ == "__main__":
    main()
