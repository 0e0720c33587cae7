"""What the card of a policy says beside LeRobot's template: what it hears, and how to try it."""

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
from huggingface_hub import ModelCard
from lerobot.configs import PreTrainedConfig

from lerobot_playbyear.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.hub.markdown import code, plain, repository_name, word
from lerobot_playbyear.tracking import METRICS_NAME

_BEFORE = "## Model Details"
_NO_RESULTS = "_No evaluation results have been provided for this policy yet._"

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
    facts = _DatasetFacts.of(dataset_meta) if dataset_meta is not None else None
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
    section = _section(config)
    if _BEFORE in card.text:
        card.text = card.text.replace(_BEFORE, f"{section}\n\n{_BEFORE}", 1)
    else:
        card.text = f"{card.text.rstrip()}\n\n{section}\n"
    return card


def with_film(card: ModelCard, url: str) -> ModelCard:
    """Shows a film at the card's head."""
    card.text = f'\n<video controls width="480" src="{url}"></video>\n{card.text}'
    return card


def with_evaluation(card: ModelCard, checkpoint: Path) -> ModelCard:
    """Writes into the card how often the policy succeeded, where its run evaluated this very checkpoint.

    Args:
        card: It is changed.
        checkpoint: A folder `<run>/checkpoints/<step>/pretrained_model`.
    """
    figures = _evaluation(checkpoint)
    if figures is not None:
        result = f"Success in simulation: **{figures['pc_success']:.0f} %**, at step {figures['step']} of its training."
        card.text = card.text.replace(_NO_RESULTS, result)
    return card


def _section(config: PlaybyearConfig) -> str:
    features = config.input_features or {}
    if config.use_audio:
        heard = [
            f"{code(key)}: {config.sample_rate:,} Hz, {features[key].shape[0]:,} samples a step"
            for key in config.audio_keys
        ]
    else:
        heard = []
    seen = [code(key) for key in config.camera_keys] if config.use_vision else []
    rows = [
        ("Microphones", "<br>".join(heard) or "none: it is deaf"),
        ("Cameras", "<br>".join(seen) or "none: it is blind"),
        ("Steps per second", f"{config.fps}"),
        ("Sound behind each step", f"{config.audio_window_s:g} s" if heard else ""),
        ("Memory", f"{config.memory_steps} steps, {config.frame_stack} images each" if config.use_memory else "none"),
    ]
    name = config.repo_id or "<user>/<name>"
    return "\n".join(
        [
            "## Hearing",
            "",
            "An audio-visual LSTM after *Play it by Ear* (Du et al., RSS 2022). LeRobot runs it where its plugin "
            "`lerobot_policy_playbyear` is installed, and finds that by itself.",
            "",
            "| | |",
            "|---|---|",
            *(f"| {what} | {value} |" for what, value in rows if value),
            "",
            "In simulation, with the tasks of `lerobot_env_playbyear`:",
            "",
            f"```bash\nlerobot-eval --policy.path={name} --env.type=playbyear --env.task=OccludedGrasp-v0\n```",
        ]
    )


def _evaluation(checkpoint: Path) -> dict[str, float] | None:
    """The figures of the last evaluation, if it was of this checkpoint."""
    folder = checkpoint.resolve()
    state, metrics = folder.parent / "training_state" / "training_step.json", folder.parent.parent.parent / METRICS_NAME
    if not (state.is_file() and metrics.is_file()):
        return None
    step = json.loads(state.read_text())["step"]
    lines = [_figures(line) for line in metrics.read_text().splitlines()]
    found = [line for line in lines if line.get("kind") == "eval" and line.get("step") == step and "pc_success" in line]
    return found[-1] if found else None


def _figures(line: str) -> dict[str, Any]:
    """What a line says; nothing if a run that was killed, or a full disk, cut it off."""
    try:
        figures = json.loads(line)
    except ValueError:
        return {}
    return figures if isinstance(figures, dict) else {}


@dataclass(frozen=True)
class _DatasetFacts:
    """What LeRobot's card asks of a dataset's metadata, in words that mean nothing to Markdown, HTML or a shell."""

    repo_id: str
    total_episodes: int
    total_frames: int
    fps: int
    tasks: pd.DataFrame
    robot_type: str | None
    camera_keys: list[str]

    @classmethod
    def of(cls, meta: Any) -> "_DatasetFacts":
        """From a `LeRobotDatasetMetadata`."""
        texts = [] if meta.tasks is None else [plain(str(task)) for task in meta.tasks.index]
        return cls(
            repo_id=repository_name(meta.repo_id) or word(meta.repo_id),
            total_episodes=int(meta.total_episodes),
            total_frames=int(meta.total_frames),
            fps=int(meta.fps),
            tasks=pd.DataFrame(index=texts),
            robot_type=word(meta.robot_type) if meta.robot_type else None,
            camera_keys=[plain(key) for key in meta.camera_keys],
        )
