"""What `playbyear-train` can be told: all of `lerobot-train`'s options, and a few of its own."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import draccus
from lerobot.configs import parser
from lerobot.configs.train import TRAIN_CONFIG_NAME, TrainPipelineConfig
from lerobot.utils.utils import flatten_dict

from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.files import parse_json

OWN_CONFIG_NAME = "playbyear_train_config.json"
"""File beside `train_config.json` that holds the options which lerobot-train does not know."""

_OWN_FIELDS = ("preset", "store", "compile", "steps_per_episode")


@dataclass
class StoreConfig:
    """Where the dataset is kept; `--store=disk` is short for `--store.place=disk`.

    Attributes:
        place: "memory", "disk" (files that are mapped into memory) or "auto": memory if the frames fill at most half of what
            is free and one process trains. Pictures are kept no larger than the policy's.
        device: "cpu" or "cuda". None: the GPU if at most half of its free memory is needed, otherwise the CPU.
        cache: Folder of the files. None: one beside LeRobot's cache.
    """

    place: str = "auto"
    device: str | None = None
    cache: str | None = None


@dataclass
class PlaybyearTrainConfig(TrainPipelineConfig):
    """All options of lerobot-train, and `--preset`, `--store.*`, `--compile` and `--steps_per_episode`.

    A checkpoint keeps lerobot-train's options in its `train_config.json` and the others in a file of their own, so
    that lerobot-train can resume what playbyear-train began, and the other way round.

    Attributes:
        preset: A named set of defaults: `cpu`, `gpu` or `paper`.
        store: Where the dataset is kept. `--store=disk` is short for `--store.place=disk`.
        compile: Compile the encoders and the head with torch, which takes half a minute. Meant for GPUs.
        steps_per_episode: Raises `steps` to this many for each learned episode. 0 leaves them as they are, and `--preset=cpu`
            does where `--steps` is given. A checkpoint holds the raised `steps`.
    """

    preset: str | None = None
    store: StoreConfig = field(default_factory=StoreConfig)
    compile: bool = False
    steps_per_episode: int = 0

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
            "--max_eval_samples": self.max_eval_samples > 0,
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
            try:
                content = dict(parse_json(own.read_bytes()))
            except (ValueError, TypeError) as error:
                raise InputError(f"{own} is damaged: {error}. Put it back from a copy, or remove it.") from error
            saved = flatten_dict({name: content.get(name) for name in _OWN_FIELDS}, sep=".").items()
            missing = {k: v for k, v in saved if v is not None and parser.parse_arg(k, cli_args) is None}
            given = [f"--{k}={v if isinstance(v, str) else json.dumps(v)}" for k, v in missing.items()]
            cli_args = given + cli_args
        return super().from_pretrained(pretrained_name_or_path, cli_args=cli_args, **kwargs)  # type: ignore[return-value]
