"""What the card of a policy says beside LeRobot's template: what it hears, and how to try it."""

import re
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pandas as pd
from huggingface_hub import ModelCard
from lerobot.configs import PreTrainedConfig

from lerobot_playbyear.datasets.frame_rate import frame_rate
from lerobot_playbyear.datasets.markdown import code, plain, repository_name, word
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig

_BEFORE = "## Model Details"
_PLAIN_NAME = re.compile(r"[\w ./-]+")


def write_card(
    generate: Callable[..., ModelCard],
    config: PreTrainedConfig,
    dataset_repo_id: str | None,
    *args: Any,
    dataset_meta: Any = None,
    **kwargs: Any,
) -> ModelCard:
    """LeRobot's card of a policy. What a stranger's dataset is called and says is shown there, and nothing more.

    Args:
        generate: LeRobot's `generate_model_card`.
        config: The policy's configuration.
        dataset_repo_id: As LeRobot's function takes it, like all that follows.
    """
    facts = _facts(dataset_meta) if dataset_meta is not None else None
    card = generate(repository_name(dataset_repo_id), *args, dataset_meta=facts, **kwargs)
    names = [*(config.input_features or {}), *(config.output_features or {})]
    for name in sorted(names, key=len, reverse=True):
        if not _PLAIN_NAME.fullmatch(name):
            card.text = card.text.replace(f"`{name}`", code(name))
    return card


def with_hearing(card: ModelCard, config: PlaybyearConfig) -> ModelCard:
    """Adds what is particular to the policy `playbyear` to LeRobot's card.

    Args:
        card: From LeRobot's `generate_model_card`; it is changed.
        config: The policy's configuration.
    """
    tags = {"audio", "multimodal"} if config.use_audio and config.audio_keys else set()
    card.data["tags"] = sorted({*card.data.get("tags", []), *tags})
    card.text = card.text.replace(_BEFORE, f"{_section(config)}\n\n{_BEFORE}", 1)
    return card


def _section(config: PlaybyearConfig) -> str:
    features = config.input_features or {}
    ears = config.audio_keys if config.use_audio else []
    heard = [f"{code(key)}: {config.sample_rate:,} Hz, {features[key].shape[0]:,} samples a step" for key in ears]
    if ears and config.reference_key:
        heard.append(f"{code(config.reference_key)} is the reference, away from the arm")
    seen = [code(key) for key in config.camera_keys] if config.use_vision else []
    rows = [
        ("Microphones", "<br>".join(heard) or "none: it is deaf"),
        ("Cameras", "<br>".join(seen) or "none: it is blind"),
        ("Steps per second", f"{config.control_hz}"),
        ("Sound behind each step", f"{config.audio_window_s:g} s" if heard else ""),
        ("Memory", f"{config.memory_steps} steps, {config.frame_stack} images each" if config.use_memory else "none"),
    ]
    name = config.repo_id or "<user>/<name>"
    paragraphs = (
        "## Hearing",
        "An audio-visual LSTM after *Play it by Ear* (Du et al., RSS 2022). LeRobot runs it where its plugin "
        "`lerobot_policy_playbyear` is installed, and finds that by itself.",
        "\n".join(["| | |", "|---|---|", *(f"| {what} | {value} |" for what, value in rows if value)]),
        "In simulation, with the tasks of `lerobot_env_playbyear`:",
        f"```bash\nlerobot-eval --policy.path={name} --env.type=playbyear --env.task=OccludedGrasp-v1\n```",
    )
    return "\n\n".join(paragraphs)


def _facts(meta: Any) -> SimpleNamespace:
    """What LeRobot's card asks of a `LeRobotDatasetMetadata`, in words that mean nothing to Markdown, HTML or a shell."""
    texts = [] if meta.tasks is None else [plain(str(task)) for task in meta.tasks.index]
    return SimpleNamespace(
        repo_id=repository_name(meta.repo_id) or word(meta.repo_id),
        total_episodes=int(meta.total_episodes),
        total_frames=int(meta.total_frames),
        fps=frame_rate(meta.fps),
        tasks=pd.DataFrame(index=texts),
        robot_type=word(meta.robot_type) if meta.robot_type else None,
        camera_keys=[plain(key) for key in meta.camera_keys],
    )
