"""What `playbyear-train` can be told: all of `lerobot-train`'s options, and a few of its own."""

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import draccus
from lerobot.configs import parser
from lerobot.configs.train import TRAIN_CONFIG_NAME, TrainPipelineConfig
from lerobot.utils.utils import flatten_dict

OWN_CONFIG_NAME = "playbyear_train_config.json"
"""File beside `train_config.json` that holds the options which lerobot-train does not know."""

_OWN_FIELDS = ("preset", "sampling", "store", "mix", "compile", "save_best")


@dataclass
class SamplingConfig:
    """Which moments are learned from more often than others. Weights of 1 draw all frames alike.

    Attributes:
        start_weight: How many times as often the first frames of an episode are drawn; only they may show what
            has to be remembered.
        start_s: How long the first frames last [s].
        loud_weight: How many times as often frames after a sudden sound are drawn.
        loud_s: How long such a moment lasts [s].
        loud_db: How far above the median a frame's power is when something sounds [dB].
    """

    start_weight: float = 1.0
    start_s: float = 0.5
    loud_weight: float = 1.0
    loud_s: float = 0.5
    loud_db: float = 12.0

    def check(self) -> None:
        """Raise a ValueError if a number is out of its range."""
        for name in ("start_weight", "loud_weight"):
            if not getattr(self, name) > 0:
                raise ValueError(f"--sampling.{name} must be above 0, got {getattr(self, name)}.")
        for name in ("start_s", "loud_s"):
            if getattr(self, name) < 0:
                raise ValueError(f"--sampling.{name} must be at least 0 seconds, got {getattr(self, name)}.")


@dataclass
class StoreConfig:
    """Where the dataset is kept; `--store=disk` is short for `--store.place=disk`.

    Attributes:
        place: "memory"; "disk" for files that are mapped into memory, with pictures no larger than the policy looks at them;
            "auto" is memory where the recorded frames fill at most half of what is free and one process trains.
        device: "cpu" or "cuda"; None means the GPU when at most half of its free memory is needed, otherwise the CPU.
        cache: Folder of the files; None means one beside LeRobot's cache.
    """

    place: str = "auto"
    device: str | None = None
    cache: str | None = None


@dataclass
class MixConfig:
    """One more dataset to learn from.

    Attributes:
        repo_id: Its name.
        root: Its folder; None: LeRobot's cache, or the Hub.
        revision: Of the dataset on the Hub.
        episodes: Only these; None: all.
        weight: How many runs are drawn from it for every one of `--dataset`, whatever the sizes of both.
    """

    repo_id: str
    root: str | None = None
    revision: str | None = None
    episodes: list[int] | None = None
    weight: float = 1.0

    def check(self) -> None:
        """Raise a ValueError if the weight is out of its range."""
        if not 0 < self.weight < math.inf:
            raise ValueError(
                f"--mix: the weight of '{self.repo_id}' must be above 0 and finite, got {self.weight}. It is how many runs are "
                "drawn from it for every one of --dataset."
            )


@dataclass
class PlaybyearTrainConfig(TrainPipelineConfig):
    """All options of lerobot-train and, beside them, `--preset`, `--sampling.*`, `--store.*`, `--mix` and so on.

    A checkpoint keeps lerobot-train's options in its `train_config.json` and the others in a file of their own, so
    that lerobot-train can resume what playbyear-train began, and the other way round.

    Attributes:
        preset: A named set of defaults, see `lerobot_playbyear.training.presets`.
        sampling: Which moments are learned from more often.
        store: Where the dataset is kept.
        mix: Further datasets that are learned from at the same time.
        compile: Whether torch compiles the encoders and the head, which takes a minute or more before the first update. Meant
            for GPUs; what it is worth there was not measured.
        save_best: Whether every checkpoint's loss on the held-out episodes is measured, and `checkpoints/best` is the one where
            it is lowest.
    """

    preset: str | None = None
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    store: StoreConfig = field(default_factory=StoreConfig)
    mix: list[MixConfig] = field(default_factory=list)
    compile: bool = False
    save_best: bool = False

    def validate(self) -> None:
        """As for lerobot-train; options that need its data loader are refused.

        Raises:
            ValueError: Naming the option and what to do instead.
        """
        newer = ("accelerator", "ema", "parallelism")  # options of LeRobot after 0.6.1
        accelerator, ema, parallelism = (vars(self).get(name) for name in newer)
        refused = {
            "--accelerator": accelerator is not None and accelerator != type(accelerator)(),
            "--ema.enable": ema is not None and ema.enable,
            "--parallelism.dp_shard": parallelism is not None and parallelism.is_sharded,
            "--job.target": self.job.is_remote,
            "--dataset.image_transforms.enable": self.dataset.image_transforms.enable,
            "--reward_model": self.is_reward_model_training,
            "--peft": self.peft is not None,
            "--sample_weighting": self.sample_weighting is not None,
        }
        for option, is_used in refused.items():
            if is_used:
                raise ValueError(f"{option} does not work in playbyear-train: leave it out, or use lerobot-train.")
        if self.dataset.streaming:
            raise ValueError(
                "--dataset.streaming does not work in playbyear-train: give --store=disk, which keeps decoded frames in files "
                "instead of in memory, or use lerobot-train."
            )
        if self.save_best and not (self.dataset.eval_split > 0 and self.save_checkpoint):
            raise ValueError(
                f"--save_best=true compares checkpoints on held-out episodes: give --dataset.eval_split=0.1 (got "
                f"{self.dataset.eval_split}) and --save_checkpoint=true (got {str(self.save_checkpoint).lower()})."
            )
        self.sampling.check()
        for other in self.mix:
            other.check()
        super().validate()

    def _save_pretrained(self, save_directory: Path) -> None:
        options = draccus.encode(self)
        own = {name: options.pop(name) for name in _OWN_FIELDS}
        for name, content in ((TRAIN_CONFIG_NAME, options), (OWN_CONFIG_NAME, own)):
            (save_directory / name).write_text(json.dumps(content, indent=4))

    @classmethod
    def from_pretrained(  # type: ignore[override]
        cls, pretrained_name_or_path: str | Path, **kwargs: Any
    ) -> "PlaybyearTrainConfig":
        """Read the options of a run, playbyear-train's or lerobot-train's.

        Args:
            pretrained_name_or_path: A `train_config.json`, its folder, or a model on the Hub. From the Hub only
                lerobot-train's options are read.
            **kwargs: As for `TrainPipelineConfig.from_pretrained`; `cli_args` win over what is read.
        """
        cli_args = list(kwargs.pop("cli_args", []))
        path = Path(pretrained_name_or_path)
        own = (path if path.is_dir() else path.parent) / OWN_CONFIG_NAME
        if own.is_file():
            saved = flatten_dict(json.loads(own.read_text()), sep=".").items()
            missing = {k: v for k, v in saved if v is not None and parser.parse_arg(k, cli_args) is None}
            given = [f"--{k}={v if isinstance(v, str) else json.dumps(v)}" for k, v in missing.items()]
            cli_args = given + cli_args
        return super().from_pretrained(pretrained_name_or_path, cli_args=cli_args, **kwargs)  # type: ignore[return-value]
