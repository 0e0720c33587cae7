"""Makes `0.1.0.tar.gz`: what the commands of version 0.1.0 leave on the disk, for tests that later ones still read it.

    MUJOCO_GL=egl python tests/old_formats/make.py tests/old_formats/0.1.0.tar.gz

The archive was made once, while the modules of `lerobot_playbyear` lay in one folder, and is not made again: a format that
changes gets an archive of its own beside it. It is one file because tests change what they unpack, and because that is
less than half as large. It holds, with relative paths only:

    demos/        a dataset with sound, two episodes of OccludedGrasp-v0 by playbyear-record
    train/        a run of playbyear-train on it that stopped after 4 of 6 updates
    corrections/  attempts with corrections, by playbyear-dagger
    dagger/       its output folder, as of a run that is killed when attempt 2 is on disk and not yet counted
    expected/     the policy's actions, and the figures of both runs where nothing stops them
"""

import json
import shutil
import sys
import tarfile
from collections.abc import Callable
from contextlib import chdir
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.envs import make_env_pre_post_processors, preprocess_observation
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.utils.constants import ACTION
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_env_playbyear import PlaybyearEnvConfig

SIZE, SAMPLE_RATE = 8, 8000  # of pictures [pixels]; the least that the tasks know [Hz]
ENV = (  # without background noise, which cannot be compressed
    "--env.type=playbyear",
    "--env.task=OccludedGrasp-v0",
    f"--env.image_size={SIZE}",
    f"--env.sample_rate={SAMPLE_RATE}",
    "--env.noise_level=0",
)
POLICY = (  # as small as can be; rate, gain and seed make its actions depend on all that it observes
    "--policy.type=playbyear",
    "--policy.device=cpu",
    "--policy.push_to_hub=false",
    "--policy.image_size=16",
    "--policy.vision_width=1",
    "--policy.audio_window_s=0.5",
    "--policy.audio_channels=[4,4]",
    "--policy.n_frequency_bins=16",
    "--policy.n_memory_steps=3",
    "--policy.n_supervised_steps=2",
    "--policy.hidden_size=16",
    "--policy.embedding_size=8",
    "--policy.low_dimensional_gain=0.5",
    "--policy.optimizer_lr=0.03",
    "--seed=8",
)
DEMOS = ("--dataset.repo_id=old/demos", "--dataset.root=demos")
TRAIN = ("--steps=6", "--save_freq=4", "--log_freq=1", "--batch_size=4", "--sampling.start_weight=2")
DAGGER = (
    "--policy.path=train/checkpoints/last/pretrained_model",
    "--demos.repo_id=old/demos",
    "--demos.root=demos",
    "--interventions.repo_id=old/corrections",
    "--interventions.root=corrections",
    "--warmup_episodes=1",
    "--updates_per_episode=2",
    "--learning_rate=0.001",
    "--batch_size=4",
    "--eval_every=1",
    "--eval.n_episodes=1",
    "--eval.batch_size=1",
)
STATE_LOW = (0.38, -0.23, 0.02, 0.0185, 0.019, -0.05, -0.05)
STATE_HIGH = (0.51, 0.19, 0.17, 0.027, 0.027, 0.01, 0.01)
"""What `observation.state` (7,) reaches in the demonstrations: place of the hand and of the fingers [m], and speed [m/s]."""


def run(main: Callable[[], None], *arguments: str) -> None:
    """Runs a command in this process."""
    with patch.object(sys, "argv", ["command", *arguments]):
        main()


def act(policy: Path, n_frames: int = 30) -> np.ndarray:
    """The actions (n_frames, 4) of a checkpoint in an episode of noise; all steps are those of lerobot-eval.

    Args:
        policy: Its folder `pretrained_model`.
        n_frames: Length of the episode.
    """
    register_third_party_plugins()
    env_cfg = PlaybyearEnvConfig(image_size=SIZE, sample_rate=SAMPLE_RATE)
    policy_cfg = PreTrainedConfig.from_pretrained(policy)
    policy_cfg.pretrained_path = policy
    network = make_policy(cfg=policy_cfg, env_cfg=env_cfg)
    network.eval()
    preprocessor, postprocessor = make_pre_post_processors(policy_cfg, pretrained_path=str(policy))
    env_preprocessor, env_postprocessor = make_env_pre_post_processors(env_cfg=env_cfg, policy_cfg=policy_cfg)
    rng, n_samples = np.random.default_rng(0), SAMPLE_RATE // env_cfg.fps
    actions = []
    for _ in range(n_frames):
        raw = {
            "pixels": {"front": rng.integers(0, 256, (1, SIZE, SIZE, 3), dtype=np.uint8)},
            "audio.gripper": rng.normal(0, 10 ** rng.uniform(0, 4), (1, n_samples)).astype(np.int16),
            "agent_pos": rng.uniform(STATE_LOW, STATE_HIGH, (1, 7)).astype(np.float32),
        }
        observation = {**preprocess_observation(raw), "task": [""]}
        with torch.inference_mode():
            action = network.select_action(preprocessor(env_preprocessor(observation)))
        actions.append(env_postprocessor({ACTION: postprocessor(action)})[ACTION].cpu().numpy())
    return np.concatenate(actions).astype(np.float32)


def make_train() -> None:
    """Trains to the end, and takes the run back to its checkpoint after 4 updates."""
    from lerobot_playbyear.scripts import train

    run(train.main, *POLICY, *DEMOS, *TRAIN, "--num_workers=0", "--output_dir=train")
    metrics = Path("train/metrics.jsonl")
    shutil.copy(metrics, "expected/train_metrics.jsonl")
    lines = [line for line in metrics.read_text().splitlines() if json.loads(line)["step"] <= 4]
    metrics.write_text("\n".join(lines) + "\n")
    shutil.rmtree("train/checkpoints/000006")
    Path("train/checkpoints/last").unlink()
    Path("train/checkpoints/last").symlink_to("000004")


def make_dagger() -> None:
    """Makes two attempts, and takes the run, but for its options and the dataset, back to where it had made one."""
    from lerobot_playbyear.scripts import dagger

    run(dagger.main, *DAGGER, *ENV, "--episodes=1", "--output_dir=dagger")
    shutil.copytree("dagger", "before", symlinks=True)
    run(dagger.main, "--resume=true", "--output_dir=dagger", "--episodes=2")
    shutil.copy("dagger/metrics.jsonl", "expected/dagger_metrics.jsonl")
    shutil.copy("dagger/dagger_config.json", "before/dagger_config.json")
    shutil.rmtree("dagger")
    Path("before").rename("dagger")


def pack(folder: Path, archive: Path) -> None:
    """Packs a folder; owners and times stay out."""

    def anonymous(entry: tarfile.TarInfo) -> tarfile.TarInfo:
        entry.uid = entry.gid = 0
        entry.uname = entry.gname = ""
        entry.mtime = 0
        return entry

    with tarfile.open(archive, "w:gz") as file:
        for path in sorted(folder.iterdir()):
            file.add(path, path.name, filter=anonymous)


def main(archive: Path) -> None:
    """Makes everything in a temporary folder and packs it."""
    from lerobot_playbyear.scripts import record

    with TemporaryDirectory() as folder:
        with chdir(folder):
            Path("expected").mkdir()
            run(record.main, *ENV, *DEMOS, "--dataset.num_episodes=2", "--num_workers=0")
            make_train()
            np.save("expected/actions.npy", act(Path("train/checkpoints/000004/pretrained_model")), allow_pickle=False)
            make_dagger()
        pack(Path(folder), archive)


if __name__ == "__main__":
    main(Path(sys.argv[1]).absolute())
