"""Whether policy, demonstrations, corrections and environment go together; before any work is done."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import torch
from lerobot.configs import FeatureType, PreTrainedConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION
from lerobot.utils.random_utils import set_seed

from lerobot_playbyear.dagger.config import DaggerConfig
from lerobot_playbyear.datasets import EpisodeStore
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.episodes.expert import Expert, ExpertError
from lerobot_playbyear.episodes.frames import INTERVENTION
from lerobot_playbyear.training.parts import TrainingParts, check_dataset_suits
from lerobot_playbyear.training.windows import PolicyWindows, dataset_names

Features = Mapping[str, Mapping[str, Any]]


def check_places(cfg: DaggerConfig) -> None:
    """Refuse what would be found out only once data were mixed.

    Raises:
        InputError: Attempts would be written among the demonstrations, or takeovers are to be late where there are none.
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
    if cfg.takeover_delay_s and not cfg.is_online:
        raise InputError(
            f"--takeover_delay_s={cfg.takeover_delay_s}: with --episodes=0 nobody takes over; leave it out, or give --skip_s."
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
    differences = [f"fps is {demos.fps} there and {fps} here"] if demos.fps != fps else []
    for key in (*keys, ACTION):
        there, here = (_signature(features.get(key)) for features in (demos.features, other))
        if there != here:
            differences.append(f"'{key}' is {there} there and {here} here")
    if differences:
        raise InputError(
            f"The demonstrations '{demos.repo_id}' and {what} differ: {'; '.join(differences)}. Record with the same "
            "settings, or choose the environment's options (--env.*) as they were in the demonstrations."
        )


def check_corrections(meta: LeRobotDatasetMetadata) -> None:
    """Refuse a dataset without the feature `intervention`.

    Raises:
        InputError: It is missing or not a bool of shape (1,).
    """
    feature = meta.features.get(INTERVENTION)
    if feature is None or feature["dtype"] != "bool" or tuple(feature["shape"]) != (1,):
        seen = "no such feature" if feature is None else f"{feature['dtype']} {tuple(feature['shape'])}"
        raise InputError(
            f"The dataset '{meta.repo_id}' does not say which frames an expert chose: wanted '{INTERVENTION}', bool (1,), and "
            f"there is {seen}. Give one that playbyear-dagger or lerobot-rollout --strategy.type=dagger wrote."
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


def check_actions_can_be_masked(parts: TrainingParts, windows: PolicyWindows, demonstrations: EpisodeStore) -> None:
    """Refuse a policy that learns several actions at once and cannot leave out those that it chose by itself.

    Whether it can is tried: with all actions masked by `action_is_pad`, no action may matter to the loss.

    Raises:
        InputError: It cannot; with what to do.
    """
    n_actions = len(windows.action_deltas)
    if n_actions <= 1:
        return
    batch = windows.batch(demonstrations, torch.tensor([demonstrations.starts[0], demonstrations.ends[0] - 1]))
    batch[f"{ACTION}_is_pad"] = torch.ones_like(batch[f"{ACTION}_is_pad"])
    losses = []
    for actions in (batch[ACTION], batch[ACTION] + 1):
        set_seed(0)  # of what the loss draws
        losses.append(parts.loss({**batch, ACTION: actions}))
    if np.array_equal(losses[0], losses[1], equal_nan=True):  # a mean over no action may be NaN
        return
    config = parts.accelerator.unwrap_model(parts.policy).config
    remedy = "Take a policy whose loss does, such as act, or one of single actions."
    if getattr(config, "do_mask_loss_for_padding", True) is False:
        remedy = "Give --policy.do_mask_loss_for_padding=true."
    raise InputError(
        f"The policy '{config.type}' learns chunks of {n_actions} actions, and its loss does not leave out those that "
        f"'{ACTION}_is_pad' masks: what the policy itself did before and after a correction would be imitated. {remedy}"
    )


def _signature(feature: Mapping[str, Any] | None) -> str:
    if feature is None:
        return "absent"
    kind = "picture" if feature["dtype"] in ("image", "video") else feature["dtype"]
    rate = (feature.get("info") or {}).get("sample_rate")
    return f"{kind} {tuple(feature['shape'])}" + (f" at {rate} Hz" if rate else "")


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
