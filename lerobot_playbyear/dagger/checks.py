"""Whether policy, demonstrations, corrections and environment go together; before any work is done."""

import os
from collections.abc import Iterable, Mapping
from typing import Any

from lerobot.configs import FeatureType, PreTrainedConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION

from lerobot_playbyear.dagger.config import DaggerConfig
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.features import differences
from lerobot_playbyear.episodes.experts import Expert, ExpertError
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.training.batches import dataset_names
from lerobot_playbyear.training.learner import check_dataset_suits

Features = Mapping[str, Mapping[str, Any]]


def check_places(cfg: DaggerConfig) -> None:
    """Refuse what would be found out only once data were mixed.

    Raises:
        InputError: Attempts would be written among the demonstrations.
    """
    demos, interventions = (source.folder.resolve() for source in (cfg.demos, cfg.interventions))
    if cfg.is_online and demos == interventions:
        raise InputError(
            f"--demos and --interventions are the same dataset, {demos}: attempts would be written among the demonstrations, "
            "with what the policy did wrong in them. Give --interventions.repo_id and --interventions.root of their own."
        )
    if (
        cfg.is_online
        and cfg.output_dir.resolve().is_relative_to(interventions)
        and not (interventions / "meta").exists()
    ):
        raise InputError(
            f"--output_dir={cfg.output_dir} lies in the folder of --interventions, {interventions}, where a dataset is to be "
            "made: give another one."
        )


def check_policy(policy: PreTrainedConfig) -> None:
    """Refuse what only `playbyear` learns from corrections.

    Raises:
        InputError: It is another policy, or several processes were started.
    """
    if not isinstance(policy, PlaybyearConfig):
        raise InputError(
            f"--policy.path is of the type '{policy.type}': playbyear-dagger corrects policies of --policy.type=playbyear. "
            "For others collect with LeRobot's lerobot-rollout --strategy.type=dagger, and learn with lerobot-train."
        )
    n_processes = int(os.environ.get("WORLD_SIZE", "1"))
    if n_processes > 1:
        raise InputError(
            f"{n_processes} processes were started, and playbyear-dagger works in one: start it without accelerate launch."
        )


def check_dataset(policy: PreTrainedConfig, meta: LeRobotDatasetMetadata, rename_map: Mapping[str, str]) -> None:
    """Refuse a dataset that the policy was not made for.

    Raises:
        ValueError: Frames per second, a missing feature, a shape, or a sample rate; what was seen and what is wanted.
    """
    check_dataset_suits(policy, meta, rename_map)
    names = dataset_names(policy, rename_map)
    rate = getattr(policy, "sample_rate", None)
    for key, feature in {**(policy.input_features or {}), **(policy.output_features or {})}.items():
        name = names.get(key, key)
        if name not in meta.features:
            raise InputError(f"The dataset '{meta.repo_id}' lacks '{name}', which the policy needs.")
        seen_rate = (meta.features[name].get("info") or {}).get("sample_rate")
        if rate is not None and seen_rate is not None and int(seen_rate) != int(rate):
            raise InputError(
                f"'{name}' was recorded at {seen_rate} Hz in the dataset '{meta.repo_id}', and the policy was trained with "
                f"{rate} Hz: use data recorded at {rate} Hz, or train a policy for {seen_rate} Hz first."
            )
        seen, wanted = tuple(meta.features[name]["shape"]), tuple(feature.shape)
        same = sorted(seen) == sorted(wanted) if feature.type is FeatureType.VISUAL else seen == wanted
        if not same:
            raise InputError(
                f"'{name}' has shape {seen} in the dataset '{meta.repo_id}', and the policy was trained with {wanted}: use "
                "the data that it was trained with, or data recorded alike."
            )


def check_alike(keys: Iterable[str], demos: LeRobotDatasetMetadata, other: Features, fps: int, what: str) -> None:
    """Refuse what cannot share a batch with the demonstrations.

    Args:
        keys: The observations that matter; the action always does.
        demos: The demonstrations' metadata.
        other: Features of a dataset, or of what the environment would write.
        fps: Their frames per second.
        what: What `other` is, for the message.

    Raises:
        InputError: With every difference.
    """
    found = [f"fps is {demos.fps} there and {fps} here"] if demos.fps != fps else []
    found += differences(demos.features, other, [*keys, ACTION], pictures_as_stored=False)
    if found:
        raise InputError(
            f"The demonstrations '{demos.repo_id}' and {what} differ: {'; '.join(found)}. Record with the same "
            "settings, or choose the environment's options (--env.*) as they were in the demonstrations."
        )


def check_action_range(policy: PreTrainedConfig, trained: PreTrainedConfig) -> None:
    """Refuse a policy whose actions would all become larger, or smaller, before it has learned anything.

    Args:
        policy: As it shall be improved.
        trained: As its checkpoint says.

    Raises:
        InputError: Their action ranges differ.
    """
    wanted, seen = (getattr(config, "action_range", None) for config in (policy, trained))
    if wanted != seen:
        raise InputError(
            f"--policy.action_range={wanted}: the policy was trained with {seen}, and would act differently from now on. "
            f"Train it on its demonstrations first: playbyear-train --policy.path={policy.pretrained_path} "
            f"--policy.action_range={wanted}."
        )


def check_expert(cfg: DaggerConfig, expert: Expert) -> None:
    """Refuse an expert that cannot do what the method asks of it.

    Raises:
        ExpertError: It never takes over by itself.
    """
    if cfg.method.needs_judge and not expert.judges:
        task = getattr(cfg.env, "task", None)
        raise ExpertError(
            f"--env.task={task} has a script that demonstrates, and none that says when a policy has to be corrected "
            f"(`intervention_gate()`): --method.type={cfg.method.type} needs one. Give --method.type=redo, which demonstrates "
            "the scenes that the policy fails in, or an expert of your own with --expert.type (examples/own_expert.py)."
        )
