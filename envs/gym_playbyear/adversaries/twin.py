"""Twin worlds: one with the hidden object and one without, in which the hand does the same.

Until the hand touches the object, nothing but sound may differ at all. After it, the arm's measurements may differ by less than
their noise: a classifier that sees the last half second of them must not tell the worlds apart.

The hand moves as the scripted expert does in the world with the object; its actions are replayed in the other.
"""

import hashlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from gym_playbyear.adversaries.classifier import CLASSIFIERS, area_under_curve
from gym_playbyear.adversaries.view import DeafTask
from gym_playbyear.arm import ACTION_SCALE

_HISTORY = 10  # steps in a window
_AFTER = 10  # steps after the touch that are judged
_FAR_AWAY = (-50.0, -50.0, 0.0)  # m: where no camera looks
_N_DRAWS = 500


@dataclass(frozen=True)
class Spread:
    """An estimate, and the ends of its 90 % interval when the held-out episodes are drawn again."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class TwinResult:
    """What tells twin worlds apart.

    Attributes:
        n_episodes: Those in which the object was touched, of which half trained the classifiers.
        n_windows: Judged windows of the held-out half.
        equal_until_touch: Whether every observation but sound was the same, byte for byte, until the touch.
        first_difference: Where it was not: the seed, the step and the observation; None if it was.
        pictures_after_touch: Share of compared pictures after the touch that differ.
        auc: Area under the curve of each classifier.
    """

    n_episodes: int
    n_windows: int
    equal_until_touch: bool
    first_difference: str | None
    pictures_after_touch: float
    auc: dict[str, Spread]


@dataclass
class _Run:
    """One world's episode: what was measured (T, 7), and which step touched first."""

    measured: np.ndarray
    touched_at: int | None


class Twins:
    """Both worlds of a task.

    Args:
        task: Its name.
        options: For `gymnasium.make`.
    """

    def __init__(self, task: str, **options: Any):
        self.present = DeafTask(task, **options)
        try:
            self.absent, self._must_remove = DeafTask(task, hidden_object=False, **options), False
        except TypeError:  # an older task: its object is taken far away after the reset
            self.absent, self._must_remove = DeafTask(task, **options), True

    def expert_run(self, seed: int) -> tuple[_Run, list[np.ndarray]]:
        """The expert's episode until some steps after its first touch, and its actions."""
        view = self.present.begin(seed)
        expert = self.present.env.scripted_expert()
        measured, actions, touched_at, done = [view.agent_pos], [], None, False
        while not done and (touched_at is None or len(actions) < touched_at + _AFTER):
            actions.append(expert.act())
            view, done, _ = self.present.advance(actions[-1])
            measured.append(view.agent_pos)
            if touched_at is None and self.present.has_touched:
                touched_at = len(actions)
        return _Run(np.stack(measured), touched_at), actions

    def replay(self, seed: int, actions: list[np.ndarray]) -> _Run:
        """The same actions in the world without the object."""
        measured = [self.absent.begin(seed).agent_pos]
        self._remove()
        for action in actions:
            view, done, _ = self.absent.advance(action)
            measured.append(view.agent_pos)
            if done and not self._must_remove:  # a removed object is taken for one that was shoved
                break
        return _Run(np.stack(measured), None)

    def differing_observations(
        self, seed: int, actions: list[np.ndarray], touched_at: int
    ) -> tuple[list[str], list[bool]]:
        """Compares whole observations, pictures included.

        Returns:
            Where they differ before the touch, and for each picture after it whether it differs.
        """
        first = _digests(self.present.env, seed, actions, lambda: None)
        second = _digests(self.absent.env, seed, actions, self._remove)
        before, after = [], []
        for step, (one, other) in enumerate(zip(first, second, strict=False)):
            different = [key for key in one if one[key] != other.get(key)]
            if step < touched_at:
                before += [f"seed {seed}, step {step}: {key}" for key in different]
            else:
                after.append(any(key.startswith("pixels") for key in different))
        return before, after

    def close(self) -> None:
        self.present.close()
        self.absent.close()

    def _remove(self) -> None:
        if self._must_remove:
            data = self.absent.env.data
            address = self.absent.env.model.joint("cube").qposadr[0]
            data.qpos[address : address + 3] = _FAR_AWAY


def _digests(env: Any, seed: int, actions: list[np.ndarray], begun) -> list[dict[str, str]]:
    """A digest of every observation but sound, for each step."""
    observations = [env.reset(seed=seed)[0]]
    begun()
    observations += [env.step(action)[0] for action in actions]
    return [
        {key: hashlib.sha256(value.tobytes()).hexdigest() for key, value in _flat(seen) if not key.startswith("audio")}
        for seen in observations
    ]


def _flat(observation: dict[str, Any], prefix: str = "") -> list[tuple[str, np.ndarray]]:
    parts: list[tuple[str, np.ndarray]] = []
    for key, value in observation.items():
        parts += _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else [(prefix + key, np.asarray(value))]
    return parts


def windows(run: _Run, actions: list[np.ndarray], steps: range) -> np.ndarray:
    """What a deaf policy with half a second of memory may look at in each of `steps`, (N, F).

    How far the hand is from where it was sent since the window began, the fingers, their velocities, and what was sent.
    """
    sent = np.cumsum([np.zeros(3), *(action[:3] * ACTION_SCALE for action in actions)], axis=0)
    features = []
    for step in steps:
        window = slice(step + 1 - _HISTORY, step + 1)
        moved, meant = run.measured[window, :3], sent[window]
        lag = (moved - moved[0]) - (meant - meant[0])
        features.append(np.concatenate([lag.ravel(), run.measured[window, 3:].ravel(), (meant - meant[0]).ravel()]))
    return np.stack(features)


def twin_test(task: str, seeds: range, *, n_pictured: int = 3, **options: Any) -> TwinResult:
    """Whether anything but sound tells that the object was touched.

    Args:
        task: Its name.
        seeds: One episode each; every second one trains the classifiers, the others judge them.
        n_pictured: In so many episodes whole observations are compared, with pictures.
        options: For `gymnasium.make`.

    Raises:
        ValueError: The expert touched the object in fewer than four episodes.
    """
    twins = Twins(task, **options)
    features, labels, episodes = [], [], []
    differences: list[str] = []
    pictures: list[bool] = []
    n_episodes = 0
    for seed in seeds:
        run, actions = twins.expert_run(seed)
        if run.touched_at is None or run.touched_at < _HISTORY:
            continue
        other = twins.replay(seed, actions)
        before = np.flatnonzero((run.measured[: run.touched_at] != other.measured[: run.touched_at]).any(axis=1))
        differences += [f"seed {seed}, step {step}: agent_pos" for step in before]
        steps = range(run.touched_at, min(len(run.measured), len(other.measured)))
        for world, has_object in ((run, True), (other, False)):
            features.append(windows(world, actions, steps))
            labels += [has_object] * len(steps)
            episodes += [n_episodes] * len(steps)
        if n_episodes < n_pictured:
            found, changed = twins.differing_observations(seed, actions, run.touched_at)
            differences += found
            pictures += changed
        n_episodes += 1
    twins.close()
    if n_episodes < 4:
        raise ValueError(f"The expert touched the hidden object in {n_episodes} episodes of {len(seeds)}: give more.")
    of_episode = np.array(episodes)
    held_out = of_episode % 2 == 1
    return TwinResult(
        n_episodes=n_episodes,
        n_windows=int(held_out.sum()),
        equal_until_touch=not differences,
        first_difference=differences[0] if differences else None,
        pictures_after_touch=float(np.mean(pictures)) if pictures else 0.0,
        auc=_areas(np.concatenate(features), np.array(labels), of_episode, held_out),
    )


def _areas(features: np.ndarray, labels: np.ndarray, episodes: np.ndarray, held_out: np.ndarray) -> dict[str, Spread]:
    """Each classifier's area under the curve on the held-out episodes."""
    rng = np.random.default_rng(0)
    rows = {episode: np.flatnonzero(episodes == episode) for episode in np.unique(episodes[held_out])}
    areas = {}
    for name, fit in CLASSIFIERS.items():
        scores = np.zeros(len(labels))
        scores[held_out] = fit(features[~held_out], labels[~held_out])(features[held_out])
        drawn = []
        for _ in range(_N_DRAWS):
            again = np.concatenate([rows[episode] for episode in rng.choice(list(rows), len(rows))])
            drawn.append(area_under_curve(scores[again], labels[again]))
        low, high = np.quantile(drawn, [0.05, 0.95])
        areas[name] = Spread(area_under_curve(scores[held_out], labels[held_out]), float(low), float(high))
    return areas
