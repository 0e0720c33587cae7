"""Whether a dataset's features, its sample rate and its frame rate are those that a policy is configured for."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from lerobot_playbyear.audio.microphone_pictures import audio_key_of, microphone_pictures
from lerobot_playbyear.datasets.features import AUDIO_PREFIX

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDatasetMetadata

    from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig


def sample_rate_of(features: Mapping[str, Any], config: "PlaybyearConfig") -> int | None:
    """The sample rate of a dataset's microphones; of a deaf policy the configured one.

    Raises:
        ValueError: There is no sound, or a microphone's rate or frame length is missing or differs from the configuration.
    """
    if not config.use_audio:
        return config.sample_rate
    microphones = {key: feature for key, feature in features.items() if key.startswith(AUDIO_PREFIX)}
    if not microphones:
        raise ValueError(
            f"No '{AUDIO_PREFIX}<microphone>' among the dataset's features {sorted(features)}: record with sound, attach it "
            "(playbyear-attach-audio, also where a microphone was recorded as a camera), or set --policy.use_audio=false to "
            "train a deaf policy."
        )
    wanted = config.sample_rate
    for key, feature in microphones.items():
        seen = (feature.get("info") or {}).get("sample_rate", wanted)
        if seen is None:
            raise ValueError(
                f"{key} has no info.sample_rate in the dataset: give it with --policy.sample_rate, or write it into "
                "the dataset's meta/info.json."
            )
        if wanted is not None and int(seen) != wanted:
            raise ValueError(
                f"{key} was recorded at {seen} Hz, but the policy is configured for {wanted} Hz: train with "
                f"playbyear-train, which resamples, or a new policy with --policy.sample_rate={seen}."
            )
        wanted = int(seen)
        _check_samples(key, int(feature["shape"][0]), wanted, config.fps)
    return wanted


def check_features(config: "PlaybyearConfig") -> None:
    """Checks that the features of a configuration are ones that the policy can use.

    Raises:
        ValueError: Names what is missing or does not fit, and what to do.
    """
    features = config.input_features or {}
    if config.action_feature is None:
        raise ValueError("The dataset has no 'action': a policy cannot be trained without.")
    if config.use_vision and not config.camera_keys:
        raise ValueError(
            f"No camera among the observations {sorted(features)}: set --policy.use_vision=false to train without."
        )
    if not config.use_audio:
        return
    if not config.audio_keys:
        raise ValueError(
            f"No '{AUDIO_PREFIX}<microphone>' among the observations {sorted(features)}: record with sound, or set "
            "--policy.use_audio=false to train a deaf policy."
        )
    if config.sample_rate is None:
        raise ValueError(f"The sample rate of {config.audio_keys} is not known: set --policy.sample_rate.")
    for key in config.audio_keys:
        _check_samples(key, int(features[key].shape[0]), config.sample_rate, config.fps)


def check_fps(fps: int, config: "PlaybyearConfig") -> None:
    """Checks a dataset's frame rate.

    Raises:
        ValueError: It is not the configured one.
    """
    if fps != config.fps:
        raise ValueError(
            f"The dataset has fps={fps}, but the policy is configured for fps={config.fps}: set --policy.fps={fps}, "
            "or train a new policy for this dataset."
        )


def refuse_unheard_microphones(meta: "LeRobotDatasetMetadata", config: "PlaybyearConfig") -> None:
    """Leaves microphones' pictures out of a configuration's observations.

    Raises:
        ValueError: The sound of one is not attached: a policy would see it instead of hearing it.
    """
    seen = [key for key in microphone_pictures(meta) if key in (config.input_features or {})]
    for key in seen:
        if audio_key_of(key) not in meta.features:
            raise ValueError(
                f"'{key}' is a microphone's picture, and its sound is not attached: playbyear-attach-audio "
                f"--dataset.repo_id={meta.repo_id} --dataset.root={meta.root}. Then train on {meta.repo_id}_with_sound, in "
                f"{meta.root}_with_sound."
            )
        assert config.input_features is not None
        del config.input_features[key]


def _check_samples(key: str, samples: int, sample_rate: int, fps: int) -> None:
    if sample_rate % fps:
        raise ValueError(
            f"sample_rate {sample_rate} / fps {fps} is not an integer: {key} cannot hold whole frames. Set "
            "--policy.fps to the dataset's."
        )
    if samples * fps != sample_rate:
        raise ValueError(
            f"{key} has {samples} samples per frame, which at {sample_rate} Hz means {sample_rate / samples:g} frames per "
            f"second, but the policy is configured for fps={fps}: set --policy.fps={sample_rate / samples:g}."
        )
