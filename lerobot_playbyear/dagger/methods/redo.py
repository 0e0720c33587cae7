"""The expert shows the whole of what the policy failed at, from its beginning."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from lerobot_playbyear.dagger.batches import frames_by_expert
from lerobot_playbyear.dagger.methods.base import Learned, Method, MethodConfig, Tools
from lerobot_playbyear.dagger.methods.beside import Redoing
from lerobot_playbyear.datasets import EpisodeStore
from lerobot_playbyear.episodes.episode import Episode, Verdict
from lerobot_playbyear.episodes.expert import Expert
from lerobot_playbyear.episodes.play import Seconds

if TYPE_CHECKING:
    from lerobot_playbyear.dagger.attempt import Scene
    from lerobot_playbyear.dagger.config import DaggerConfig

NOTE = "last_try.txt"
"""File in the output folder: for how many steps the policy tried before the last demonstration."""


@MethodConfig.register_subclass("redo")
@dataclass
class RedoConfig(MethodConfig):
    """Where the policy fails, the scene is set up again, and the expert demonstrates the task in it from the first step on."""

    expert_decides: ClassVar[bool] = False
    chooses_frames: ClassVar[bool] = True
    needs_judge: ClassVar[bool] = False

    def make(self, cfg: "DaggerConfig") -> Method:
        return Redo(cfg)


class Redo(Method):
    """Demonstrations of the scenes that the policy fails in; they weigh as much as those that are there, frame by frame.

    The policy tries first, until the expert would take over or the attempt ends. After a failure the environment is reset with
    the same seed, which sets up the same scene. An attempt that is kept holds the demonstration alone.
    """

    def beside(self, expert: Expert) -> Expert:
        self._expert = Redoing(expert)
        return self._expert

    def begin(self, tools: Tools) -> None:
        self._folder, self._fps = tools.folder, tools.demonstrations.fps

    def attempt(self, scene: "Scene", seed: int, random_seed: int, seconds: Seconds) -> Episode:
        self._n_tried, self._expert.demonstrates = 0, False
        tried = scene.attempt(seed, random_seed, seconds)
        is_void = tried.verdict is Verdict.DISCARD and not self._expert.was_needed
        if is_void or (tried.success and not self._expert.was_needed):
            return tried
        self._n_tried, self._expert.demonstrates = len(tried), True
        self._folder.note(NOTE, str(self._n_tried))  # for a run that is killed before the attempt counts
        shown = scene.attempt(seed, random_seed, seconds)
        self._n_shown = len(shown)
        return shown

    def figures(self) -> Mapping[str, float]:
        return self._cost(self._n_tried, self._n_shown) if self._n_tried else {}

    def recovered_figures(self, cost: Mapping[str, Any]) -> Mapping[str, float]:
        return self._cost(int(self._folder.noted(NOTE)), cost["n_expert_steps"])

    def _cost(self, n_tried: int, n_shown: int) -> dict[str, float]:
        n, fps = n_tried + n_shown, self._expert.clock_fps or self._fps
        return {
            "n_tried_steps": n_tried,
            "n_switches": 1,
            "autonomy": round(n_tried / n, 4),
            "person_seconds": round(n / fps, 2),
        }

    @property
    def weighs_frames(self) -> bool:
        return True

    def learned(self, n_demonstrated: int, attempts: EpisodeStore) -> Learned:
        weights = frames_by_expert(attempts).cpu().double()  # of attempts of another method, only what the expert chose
        return Learned(weights, n_demonstrated / (n_demonstrated + float(weights.sum())))
