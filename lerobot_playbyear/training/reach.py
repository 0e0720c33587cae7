"""Which actions lie out of a policy's reach: it cannot learn them, however often an expert shows them."""

import logging
import math
from collections.abc import Mapping, Sequence
from typing import Any

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.processor import PolicyProcessorPipeline, TransitionKey, create_transition
from torch import Tensor

from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig

_TOLERANCE = 0.01  # of the range: what is learned a hundredth too small is not worth a word
_SLACK = 1.1  # tanh gets to its ends only slowly
_LARGEST = 10.0  # what is normalised and would need more than this has not been demonstrated at all


class Reach:
    """How far a policy's actions go.

    The policy `playbyear` ends at `action_range` times the normalised range of the actions that its statistics were made
    of. Other policies are taken to have no end.

    Args:
        policy: The policy's configuration.
        preprocessor: Its own, whose statistics say what is normal.
        names: Of the action's dimensions; None numbers them.
    """

    def __init__(
        self, policy: PreTrainedConfig, preprocessor: PolicyProcessorPipeline, names: Sequence[str] | None
    ) -> None:
        self._policy, self._preprocessor, self._names = policy, preprocessor, names

    def warn(self, actions: Tensor, what: str) -> None:
        """Log the warning about actions that cannot be learned, if there are any; arguments as for `warning`."""
        if text := self.warning(actions, what):
            logging.warning(text)

    def warning(self, actions: Tensor, what: str) -> str | None:
        """What to tell a person about actions that cannot be learned; None if there are none.

        Args:
            actions: (N, n_actions), as recorded; (N,) of a single one, as LeRobot keeps it.
            what: What they are, for the message.
        """
        if not isinstance(self._policy, PlaybyearConfig) or len(actions) == 0:
            return None
        actions = actions.reshape(len(actions), -1)
        needed = self._normalized(actions).abs().cpu()  # (N, n_actions)
        is_out = needed > self._policy.action_range * (1 + _TOLERANCE)
        if not is_out.any():
            return None
        names = self._names or [f"action[{i}]" for i in range(actions.shape[1])]
        shares = {name: float(share) for name, share in zip(names, is_out.float().mean(dim=0), strict=True) if share}
        farthest = dict(zip(names, needed.amax(dim=0).tolist(), strict=True))
        is_normalized = self._policy.normalization_mapping.get("ACTION") != NormalizationMode.IDENTITY
        largest = _LARGEST if is_normalized else math.inf
        unmoved = [f"'{name}'" for name in shares if farthest[name] > largest]
        reachable = [farthest[name] for name in shares if farthest[name] <= largest]
        listed = ", ".join(f"'{name}' in {100 * share:.1f} %" for name, share in shares.items())
        text = (
            f"Some actions of {what} are out of the policy's reach: {listed} of {len(actions)} frames lie beyond the end of "
            f"its last layer (action_range={self._policy.action_range:g}, normalised), and are learned as that end."
        )
        if reachable:
            option = f"--policy.action_range={math.ceil(10 * _SLACK * max(reachable)) / 10:g}"
            text += (
                f" Train with {option}; a trained policy gets it with playbyear-train --policy.path=... {option} on its "
                "demonstrations."
            )
        if unmoved:
            text += f" {', '.join(unmoved)} hardly moves in the demonstrations: demonstrate it too."
        return text

    def _normalized(self, actions: Tensor) -> Tensor:
        transition = create_transition(observation={}, action=actions.float())
        for step in self._preprocessor.steps:  # `process_action` would stop at a step that wants an observation
            transition = step(transition)
        normalized: Tensor = transition[TransitionKey.ACTION]  # type: ignore[assignment]
        return normalized


def action_names(feature: Mapping[str, Any]) -> list[str] | None:
    """The names of an action's dimensions, as a dataset's features hold them; None if there are none."""
    names = feature.get("names")
    if isinstance(names, Mapping):  # LeRobot also writes {"motors": [...]}
        names = next(iter(names.values()), None)
    size = math.prod(feature["shape"])
    return [str(name) for name in names] if isinstance(names, Sequence) and len(names) == size else None
