"""Open a dataset with sound, and hear an episode: one WAV file per microphone.

python examples/listen_to_dataset.py --repo_id=demo/occluded --root=outputs/demo/dataset --episode=0
"""

import argparse
from pathlib import Path

from lerobot.datasets import LeRobotDataset

from lerobot_playbyear.audio import write_audio
from lerobot_playbyear.datasets import audio_keys, episode_waveform


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repo_id", required=True)
    parser.add_argument("--root", help="a local folder; without it the dataset comes from the Hub")
    parser.add_argument("--episode", type=int, default=0)
    parser.add_argument("--output_dir", type=Path, default=Path("outputs/listen"))
    args = parser.parse_args()

    dataset = LeRobotDataset(args.repo_id, root=args.root, video_backend="pyav")
    args.output_dir.mkdir(parents=True, exist_ok=True)
    for key in audio_keys(dataset.meta.features):
        waveform, sample_rate = episode_waveform(dataset, args.episode, key)
        path = args.output_dir / f"episode_{args.episode}_{key.rsplit('.', 1)[-1]}.wav"
        write_audio(path, waveform, sample_rate)
        print(f"{path}: {len(waveform) / sample_rate:.2f} s at {sample_rate} Hz")


if __name__ == "__main__":
    main()
