"""Several datasets that are learned from at once: which go together, and what the policy is made for."""

import copy
import logging
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata, aggregate_stats
from lerobot.utils.constants import ACTION
from lerobot.utils.feature_utils import dataset_to_policy_features
from torch import Tensor

from lerobot_playbyear.datasets.audio_feature import audio_keys, check_audio_features
from lerobot_playbyear.datasets.resampling import features_at, sample_rate_in
from lerobot_playbyear.datasets.shrinking import kept_shape
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.training.config import PlaybyearTrainConfig
from lerobot_playbyear.training.reach import action_names
from lerobot_playbyear.training.windows import dataset_names

_CAMERA_DTYPES = ("image", "video")
_STATISTICS = {"min", "max", "mean", "std", "count"}


def open_mix(cfg: PlaybyearTrainConfig) -> list[LeRobotDataset]:
    """Opens the datasets of `--mix` as LeRobot opens that of `--dataset`."""
    return [
        LeRobotDataset(
            other.repo_id,
            root=other.root,
            episodes=other.episodes,
            revision=other.revision,
            video_backend=cfg.dataset.video_backend,
            tolerance_s=cfg.tolerance_s,
        )
        for other in cfg.mix
    ]


def learned_meta(
    cfg: PlaybyearTrainConfig, main: LeRobotDatasetMetadata, *others: LeRobotDatasetMetadata
) -> LeRobotDatasetMetadata:
    """The metadata that a policy is made for: sound at its rate, and the statistics of all datasets.

    Args:
        cfg: The options of the run.
        main: Of `--dataset`; what its features are, those of the others have to be.
        others: Of `--mix`.

    Returns:
        `main` itself where nothing of it changes.

    Raises:
        ValueError: Two datasets do not go together; names both, what was seen, and what to do.
    """
    policy = cfg.policy
    assert policy is not None
    rates = _sample_rates(policy, main)
    features = features_at(main.features, rates, main.fps)
    used = _used(policy, main.features, cfg.rename_map)
    image_size = policy.image_size if isinstance(policy, PlaybyearConfig) else None
    for other in others:
        _Pair(main, other, used, image_size).check(features, features_at(other.features, rates, other.fps))
    if not others and all(features[key] is main.features[key] for key in features):
        return main
    for meta in (main, *others):
        for key, rate in _sound_of(meta, used).items():
            if rate != rates.get(key, rate):
                logging.info(f"{_name(meta)}: '{key}' is resampled from {rate} to {rates[key]} Hz")
    meta = copy.copy(main)
    meta.info = copy.copy(main.info)
    meta.info.features = features
    if others:
        common = _common_statistics([main, *others], cfg.dataset.use_imagenet_stats, used)
        meta.stats = {**(main.stats or {}), **common}
    return meta


def mixed_weights(weights: Sequence[Tensor], cfg: PlaybyearTrainConfig) -> Tensor:
    """The weights of all runs, so that every dataset has its share of them.

    Args:
        weights: (N,) of each dataset by itself, the one of `--dataset` first; sums above 0.
        cfg: The options of the run.

    Returns:
        The weights of all datasets one after the other, in the numbering of a `StoreMixture`.
    """
    if not cfg.mix:
        return weights[0]
    shares = [1.0, *(other.weight for other in cfg.mix)]
    for name, share in zip([cfg.dataset.repo_id, *(other.repo_id for other in cfg.mix)], shares, strict=True):
        logging.info(f"{100 * share / sum(shares):.1f} % of the runs are drawn from '{name}'")
    return torch.cat([each * (share / each.sum()) for each, share in zip(weights, shares, strict=True)])


def _sample_rates(policy: PreTrainedConfig, meta: LeRobotDatasetMetadata) -> dict[str, int]:
    """The rate at which each microphone is learned from [Hz]: the policy's, or that of the dataset."""
    keys = audio_keys(meta.features)
    if isinstance(policy, PlaybyearConfig) and policy.use_audio and policy.sample_rate is not None:
        return dict.fromkeys(keys, policy.sample_rate)
    seen = {key: sample_rate_in(meta.features[key]) for key in keys}
    return {key: rate for key, rate in seen.items() if rate is not None}


def _used(policy: PreTrainedConfig, features: Mapping[str, Any], rename_map: Mapping[str, str]) -> list[str]:
    """What a policy learns from, as the dataset calls it."""
    names = list(dataset_names(policy, rename_map).values()) or [
        key for key in dataset_to_policy_features(dict(features)) if key != ACTION
    ]
    if not getattr(policy, "use_audio", True):
        names = [key for key in names if key not in audio_keys(names)]
    if not getattr(policy, "use_vision", True):
        names = [key for key in names if features.get(key, {}).get("dtype") not in _CAMERA_DTYPES]
    return [key for key in (*names, ACTION) if key in features]  # what is missing, `check_dataset_suits` says


def _sound_of(meta: LeRobotDatasetMetadata, used: Sequence[str]) -> dict[str, int]:
    """The rate of each microphone that is used and says one [Hz]."""
    saying = {key: meta.features[key] for key in audio_keys(used) if sample_rate_in(meta.features[key]) is not None}
    try:
        return check_audio_features(saying, meta.fps)
    except ValueError as error:
        raise ValueError(f"{_name(meta)}: {error}") from error


def _common_statistics(
    metas: Sequence[LeRobotDatasetMetadata], use_imagenet_stats: bool, used: Sequence[str]
) -> dict[str, Any]:
    """The statistics of several datasets as of one. Not those of sound, which the policy takes itself."""
    keys = [key for key in used if key not in audio_keys(used)]
    if use_imagenet_stats:
        keys = [key for key in keys if key not in metas[0].camera_keys]
    for meta in metas:
        missing = [key for key in keys if not set((meta.stats or {}).get(key, ())) >= _STATISTICS]
        if missing:
            raise ValueError(
                f"{_name(meta)} has no statistics of {missing}: write them with lerobot-edit-dataset "
                "--operation.type=recompute_stats, or with playbyear-repair."
            )
    common: dict[str, Any] = aggregate_stats([{key: meta.stats[key] for key in keys} for meta in metas])
    return common


class _Pair:
    """A dataset beside the main one."""

    def __init__(
        self, main: LeRobotDatasetMetadata, other: LeRobotDatasetMetadata, used: Sequence[str], image_size: int | None
    ) -> None:
        self._main, self._other, self._used, self._image_size = main, other, used, image_size

    def check(self, mains: Mapping[str, Any], others: Mapping[str, Any]) -> None:
        """Refuse what cannot be in one batch; the features of both, sound at the rate at which it is learned from."""
        main, other = _name(self._main), _name(self._other)
        if self._main.fps != self._other.fps:
            raise ValueError(
                f"--mix: {other} has {self._other.fps} frames per second, and {main} {self._main.fps}: datasets that are "
                f"learned from together need the same. Leave it out, or record it at {self._main.fps}."
            )
        if missing := [key for key in self._used if key not in others]:
            raise ValueError(
                f"--mix: {other} lacks {missing}, which the policy learns from in {main}; its features are "
                f"{sorted(others)}. Leave it out, or train without them (--policy.use_audio=false, "
                "--policy.use_vision=false; lerobot-edit-dataset removes a feature)."
            )
        for key in self._used:
            self._check_feature(key, mains[key], others[key])

    def _check_feature(self, key: str, mine: Mapping[str, Any], its: Mapping[str, Any]) -> None:
        main, other = _name(self._main), _name(self._other)
        forms = [self._form(feature) for feature in (mine, its)]
        if forms[0] != forms[1]:
            advice = "They have to be equal: leave it out, or convert the column."
            if mine["dtype"] in _CAMERA_DTYPES and its["dtype"] in _CAMERA_DTYPES:
                advice = "Pictures have to be equally large: leave it out, or resize them."
                if self._image_size is not None:
                    advice = (
                        "They have to be equal at the size at which the policy looks at them: give a smaller "
                        "--policy.image_size, or leave it out."
                    )
            raise ValueError(f"--mix: '{key}' is {forms[1]} in {other}, and {forms[0]} in {main}. {advice}")
        names = [action_names(feature) for feature in (mine, its)]
        if mine["dtype"] not in _CAMERA_DTYPES and None not in names and names[0] != names[1]:
            raise ValueError(
                f"--mix: the numbers of '{key}' are {names[1]} in {other}, and {names[0]} in {main}. They have to mean the "
                "same: leave it out."
            )

    def _form(self, feature: Mapping[str, Any]) -> str:
        """In words, what rows of a feature have to have in common to lie in one batch."""
        shape, dtype = tuple(feature["shape"]), feature["dtype"]
        if dtype in _CAMERA_DTYPES:
            channels, height, width = kept_shape(shape, self._image_size)
            return f"pictures of {channels} x {height} x {width}"
        return f"{'float' if dtype.startswith('float') else dtype} {shape}"


def _name(meta: LeRobotDatasetMetadata) -> str:
    return f"'{meta.repo_id}' ({meta.root})"
