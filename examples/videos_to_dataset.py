"""Turn a folder of films with sound into a dataset: every film becomes an episode.

    python examples/videos_to_dataset.py --films=films --root=outputs/films --task="Knock on the table."

Beside `clip.mp4` there may be `clip.csv` with one line of numbers per frame: the actions. Without them the dataset
can be heard, looked at and labelled, but not trained on.
"""

import argparse
from pathlib import Path
from typing import Any

import av
import numpy as np
from PIL import Image

from lerobot_playbyear.audio import cut_into_frames, read_audio, resample
from lerobot_playbyear.datasets import audio_feature
from lerobot_playbyear.datasets.durable import DurableWriter

ENDINGS = (".mp4", ".mov", ".mkv", ".webm", ".avi")


def pictures(film: Path, fps: int, size: int) -> np.ndarray:
    """The film's pictures at `fps` per second, (n, size, size, 3) uint8: at every frame's time the last one shown."""
    shown: list[np.ndarray] = []
    last, at = None, 0.0
    with av.open(str(film)) as container:
        for frame in container.decode(video=0):
            picture = np.asarray(Image.fromarray(frame.to_ndarray(format="rgb24")).resize((size, size)))
            last, at = picture if last is None else last, frame.time
            while len(shown) / fps < at - 1e-6:
                shown.append(last)
            last = picture
    if last is None:
        raise SystemExit(f"{film} has no pictures.")
    if len(shown) / fps <= at + 1e-6:
        shown.append(last)
    return np.stack(shown)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--films", type=Path, required=True)
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--task", required=True)
    parser.add_argument("--fps", type=int, default=20)
    parser.add_argument("--sample_rate", type=int, default=16000)
    parser.add_argument("--size", type=int, default=84, help="pictures become squares of this many pixels")
    args = parser.parse_args()

    films = sorted(path for path in args.films.iterdir() if path.suffix.lower() in ENDINGS)
    actions = {film: film.with_suffix(".csv") for film in films if film.with_suffix(".csv").exists()}
    names = ["height", "width", "channels"]
    features: dict[str, dict[str, Any]] = {
        "observation.images.camera": {"dtype": "video", "shape": (args.size, args.size, 3), "names": names},
        "observation.audio.camera": audio_feature(args.sample_rate, args.fps),
    }
    if len(actions) == len(films):
        width = np.loadtxt(actions[films[0]], delimiter=",", ndmin=2).shape[1]
        features["action"] = {"dtype": "float32", "shape": (width,), "names": None}

    with DurableWriter("me/films", args.root, args.fps, features, resume=True) as writer:
        for film in films[writer.num_episodes :]:  # what an interrupted run has saved is not read again
            frames = pictures(film, args.fps, args.size)
            samples, rate = read_audio(film)
            mono = resample(samples.mean(axis=1).astype(np.int16), rate, args.sample_rate)
            blocks = cut_into_frames(mono, args.sample_rate, args.fps, len(frames), pad=True)
            moves = np.loadtxt(actions[film], delimiter=",", ndmin=2) if "action" in features else None
            if moves is not None and len(moves) != len(frames):
                raise SystemExit(f"{actions[film]} has {len(moves)} lines; the film has {len(frames)} frames.")
            for i, picture in enumerate(frames):
                frame = {"observation.images.camera": picture, "observation.audio.camera": blocks[i], "task": args.task}
                if moves is not None:
                    frame["action"] = moves[i].astype(np.float32)
                writer.add_frame(frame)
            print(f"{film.name}: episode {writer.save_episode()}, {len(frames) / args.fps:.1f} s")


if __name__ == "__main__":
    main()
