"""`--env.type=knock`: what LeRobot wants to know about the environment."""

from dataclasses import dataclass, field
from typing import Any

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs import EnvConfig
from lerobot.processor import PolicyProcessorPipeline

from gym_knock.environment import FPS, SAMPLE_RATE, SIZE
from lerobot_playbyear.policy.processor_playbyear import Pcm16ToFloatProcessorStep


@EnvConfig.register_subclass("knock")
@dataclass
class KnockConfig(EnvConfig):
    """The box; `package_name` and `gym_id` are LeRobot's defaults, `gym_knock` and `gym_knock/Knock-v0`."""

    task: str | None = "Knock-v0"
    fps: int = FPS
    features: dict[str, PolicyFeature] = field(
        default_factory=lambda: {
            "action": PolicyFeature(FeatureType.ACTION, (2,)),
            "pixels/front": PolicyFeature(FeatureType.VISUAL, (SIZE, SIZE, 3)),
            "agent_pos": PolicyFeature(FeatureType.STATE, (1,)),
            "audio.finger": PolicyFeature(FeatureType.STATE, (SAMPLE_RATE // FPS,)),
        }
    )
    features_map: dict[str, str] = field(
        default_factory=lambda: {
            "action": "action",
            "pixels/front": "observation.images.front",
            "agent_pos": "observation.state",
            "audio.finger": "observation.audio.finger",
        }
    )

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {"render_mode": "rgb_array"}

    def get_env_processors(self) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
        """What LeRobot runs between the environment and any policy: int16 sound becomes floats in [-1, 1]."""
        return PolicyProcessorPipeline(steps=[Pcm16ToFloatProcessorStep()]), PolicyProcessorPipeline(steps=[])
