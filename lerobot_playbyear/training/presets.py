"""Named defaults for `playbyear-train`: `--preset=cpu` stands for the options listed here.

Options on the command line win over the preset, and the preset wins over a configuration file. On CPUs that compute in
bfloat16 the preset `cpu` switches `policy.use_amp` on.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.training.command_line import given_options


@dataclass(frozen=True)
class Preset:
    """A recipe.

    Attributes:
        purpose: When to choose it, in one line.
        network: Options that fix what the network looks like; they do not apply to `--policy.path`, where the
            checkpoint says it.
        training: Options for how it is trained.
    """

    purpose: str
    network: dict[str, str] = field(default_factory=dict)
    training: dict[str, str] = field(default_factory=dict)


PRESETS = {
    "cpu": Preset(
        purpose="two CPU cores, within the hour",
        network={
            "policy.type": "playbyear",
            "policy.device": "cpu",
            "policy.image_size": "48",
            "policy.vision_width": "16",
        },
        training={
            "policy.n_supervised_steps": "16",
            "policy.optimizer_lr": "1e-3",
            "policy.low_dimensional_noise": "0.03",
            "policy.audio_noise_db": "18",
            "policy.optimizer_grad_clip_norm": "1.0",
            "policy.push_to_hub": "false",
            "batch_size": "12",
            "steps": "3000",
            "log_freq": "100",
            "save_freq": "1000",
            "env_eval_freq": "3000",
        },
    ),
    "paper": Preset(  # what it is, and what differs from the publication on purpose: docs/training.md
        purpose="the published experiment: 1.6 million windows at 224 pixels, for a GPU",
        network={
            "policy.type": "playbyear",
            "policy.image_size": "224",
            "policy.vision_width": "64",
            "policy.normalize_encodings": "false",
            "policy.low_dimensional_gain": "1",
        },
        training={
            "policy.n_supervised_steps": "1",
            "policy.low_dimensional_noise": "0",
            "policy.optimizer_lr": "1e-3",
            "policy.optimizer_grad_clip_norm": "0",
            "policy.scheduler_warmup_share": "0",
            "policy.scheduler_final_share": "1",
            "policy.push_to_hub": "false",
            "batch_size": "16",
            "steps": "100000",
        },
    ),
}


def apply_preset(args: Sequence[str]) -> list[str]:
    """Put a preset's options before those of a command line, as far as that does not give them itself.

    Args:
        args: Command-line arguments; without `--preset` they are returned as they are. When a run is resumed, its
            checkpoint holds all options and the preset changes nothing.

    Raises:
        InputError: If there is no such preset, or the policy is of another type.
    """
    given, _ = given_options(args)
    name = given.get("preset")
    if name is None or (given.get("resume") or "").lower() in ("true", "1", "yes"):
        return list(args)
    if name not in PRESETS:
        known = "; ".join(f"{key} ({preset.purpose})" for key, preset in PRESETS.items())
        raise InputError(f"--preset={name} is not known. The presets are: {known}.")
    preset = PRESETS[name]
    policy_type = given.get("policy.type")
    if policy_type not in (None, preset.network["policy.type"]):
        raise InputError(
            f"--preset={name} is for --policy.type={preset.network['policy.type']}, not for {policy_type}: "
            "leave one of the two out."
        )
    from_checkpoint = given.get("policy.path") is not None
    options = preset.training if from_checkpoint else {**preset.network, **preset.training}
    if name == "cpu" and _computes_bfloat16():
        options = {**options, "policy.use_amp": "true"}
    if "policy.repo_id" in given:  # whoever names a place on the Hub wants it used
        options = {key: value for key, value in options.items() if key != "policy.push_to_hub"}
    return [*(f"--{key}={value}" for key, value in options.items() if key not in given), *args]


def _computes_bfloat16() -> bool:
    from lerobot_playbyear.policy.precision import computes_bfloat16  # imports torch

    return computes_bfloat16()
