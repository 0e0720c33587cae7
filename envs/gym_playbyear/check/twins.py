"""Twin environments, which differ in nothing but what only sound tells: one with the hidden object and one without, or one with
screws in the pouch and one with peanuts. The hand does the same in both.

Until the hand touches the object, nothing but sound may differ at all; where what is hidden cannot be touched, never. After the
touch, the arm's measurements may differ by less than their noise, and so may what the camera shows in numbers: a
classifier that sees the last ten of them must not tell the worlds apart. One that hears must.

The hand moves as the scripted expert does in the world with the object, or in either of two that nothing can be touched in; its
actions are replayed in the other.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.stats import rankdata

from gym_playbyear.check.deaf import DeafTask, DeafView
from gym_playbyear.panda import ACTION_SCALE
from gym_playbyear.task import Task
from gym_playbyear.wrappers import flat


def area_under_curve(scores: np.ndarray, positive: np.ndarray) -> float:
    """The probability that a positive scores above a negative; a tie counts half.

    Args:
        scores: (N,)
        positive: (N,) bool
    """
    n_positive = int(positive.sum())
    n_negative = len(positive) - n_positive
    if n_positive == 0 or n_negative == 0:
        raise ValueError(f"Both classes are needed, got {n_positive} positives and {n_negative} negatives.")
    above = rankdata(scores)[positive].sum() - n_positive * (n_positive + 1) / 2
    return float(above / (n_positive * n_negative))


def fit_logistic(
    features: np.ndarray, positive: np.ndarray, penalty: float = 3.0
) -> Callable[[np.ndarray], np.ndarray]:
    """Logistic regression on standardised features and their squares, with an L2 penalty.

    Args:
        features: (N, F)
        positive: (N,) bool
        penalty: Of the squared weights, in examples.

    Returns:
        What makes scores (N,) of features (N, F): higher is more likely positive.
    """
    mean, scale = features.mean(axis=0), features.std(axis=0) + 1e-9

    def expand(values: np.ndarray) -> np.ndarray:
        standard = np.clip((values - mean) / scale, -6, 6)
        return np.concatenate([standard, standard**2 - 1, np.ones((len(values), 1))], axis=1)  # (N, 2F + 1)

    inputs, sign = expand(features), np.where(positive, 1.0, -1.0)

    def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        margin = sign * (inputs @ weights)
        slope = -sign / (1 + np.exp(np.clip(margin, -50, 50)))
        penalised = np.append(weights[:-1], 0.0)
        value = np.logaddexp(0, -margin).sum() + penalty * penalised @ penalised
        return float(value), inputs.T @ slope + 2 * penalty * penalised

    found = minimize(loss, np.zeros(inputs.shape[1]), jac=True, method="L-BFGS-B", options={"maxiter": 300})
    return lambda values: expand(values) @ found.x


_HISTORY = 10  # steps in a window
_AFTER = 10  # steps after the touch that are judged
_RINGS = 5  # steps from the touch on whose sound is judged: later, the hand may meet what is there in both worlds
_N_DRAWS = 500
_N_BANDS = 16  # of equal width, in which a microphone's loudness is compared
_SILENCE = 1e-9  # power that is added, relative to full scale


@dataclass(frozen=True)
class Spread:
    """An estimate, and the ends of its 90 % interval when the held-out episodes are drawn again."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class TwinResult:
    """What tells twin environments apart.

    Attributes:
        n_episodes: Those in which the object was touched, of which half trained the classifier; all, if nothing can be.
        n_windows: Judged windows of the held-out half.
        equal_until_touch: Whether every observation but sound was the same, byte for byte, until the touch; to the end, if
            nothing can be touched.
        first_difference: Where it was not: the seed, the step and the observation; None if it was.
        pictures_after_touch: Share of compared pictures after the touch that differ.
        auc: Area under the curve of a logistic regression on all but sound.
        heard: The same on sound: how loud each band was, at most and in the mean, and how that varied, in the first steps from
            the touch on; to the end, if nothing can be touched.
    """

    n_episodes: int
    n_windows: int
    equal_until_touch: bool
    first_difference: str | None
    pictures_after_touch: float
    auc: Spread
    heard: Spread
    can_be_touched: bool = True


@dataclass
class _Run:
    """One world's episode: what was measured and seen (T, 7 + numbers of the camera), how loud each band of each microphone was
    (T, F) [dB], and which step touched first."""

    measured: np.ndarray
    loudness: np.ndarray
    touched_at: int | None


def _run_of(sensed: list[tuple[np.ndarray, np.ndarray]], touched_at: int | None) -> _Run:
    measured, loudness = (np.stack(part) for part in zip(*sensed, strict=True))
    return _Run(measured, loudness, touched_at)


class TwinError(ValueError):
    """A task has no twin environments to compare, or its expert touched too little in them."""


class Twins:
    """Both worlds of a task.

    Args:
        task: Its name, or the task.
        options: Of `TaskEnv`.

    Raises:
        TwinError: The worlds differ by what is hidden, and nothing is.
    """

    def __init__(self, task: str | Task, **options: Any):
        asked = DeafTask(task, **options)
        definition = asked.env.definition
        first, second = definition.twins
        asked.close()
        hides = {True, False} <= {world.get("hidden_object", True) for world in (first, second)}
        if hides and not any(prop.hidden and prop.material for prop in definition.props):
            raise TwinError(
                f"twin environments: {definition.name} hides nothing that can be touched, so both are the same and prove "
                "nothing. Mark the object that only hearing finds with Prop(hidden=True, material=...), or give other twins."
            )
        self.worlds = tuple(DeafTask(task, **{"sound": "waveform", **options, **world}) for world in (first, second))
        self.can_be_touched = self.worlds[0].can_be_touched

    def expert_run(self, seed: int) -> tuple[_Run, list[np.ndarray], DeafTask]:
        """The expert's episode until some steps after its first touch, its actions, and the other world."""
        world, other = self.worlds if self.can_be_touched or seed % 2 else self.worlds[::-1]
        view = world.begin(seed)
        expert = world.env.scripted_expert()
        sensed, actions, touched_at, done = [_sensed(world, view)], [], None, False
        while not done and (touched_at is None or len(actions) < touched_at + _AFTER):
            actions.append(expert.act())
            view, done, _ = world.advance(actions[-1])
            sensed.append(_sensed(world, view))
            if touched_at is None and world.has_touched:
                touched_at = len(actions)
        return _run_of(sensed, touched_at), actions, other

    def replay(self, world: DeafTask, seed: int, actions: list[np.ndarray]) -> _Run:
        """The same actions in the other world, as long as the attempt lasts there."""
        sensed = [_sensed(world, world.begin(seed))]
        for action in actions:
            view, done, _ = world.advance(action)
            sensed.append(_sensed(world, view))
            if done:
                break
        return _run_of(sensed, None)

    def differing_observations(
        self, seed: int, actions: list[np.ndarray], touched_at: int
    ) -> tuple[list[str], list[bool]]:
        """Compares whole observations, pictures included.

        Returns:
            Where they differ before the touch, and for each picture after it whether it differs.
        """
        first, second = (_digests(world.env, seed, actions) for world in self.worlds)
        before, after = [], []
        for step, (one, other) in enumerate(zip(first, second, strict=True)):
            different = [key for key in one if one[key] != other.get(key)]
            if step < touched_at:
                before += [f"seed {seed}, step {step}: {key}" for key in different]
            else:
                after.append(any(key.startswith("pixels") for key in different))
        return before, after

    def close(self) -> None:
        for world in self.worlds:
            world.close()


def _sensed(world: DeafTask, view: DeafView) -> tuple[np.ndarray, np.ndarray]:
    """Of a step: (7 + N,) what the arm measures and the camera shows, (F,) how loud each band of each microphone was [dB]."""
    powers = [np.abs(np.fft.rfft(block / 32768)) ** 2 / len(block) for block in world.env.listen().values()]
    bands = [band.sum() for power in powers for band in np.array_split(power, _N_BANDS)]
    numbers = np.concatenate([view.agent_pos, *(np.ravel(shown) for shown in view.shown.values())])
    return numbers, 10 * np.log10(np.array(bands) + _SILENCE)


def _digests(env: Any, seed: int, actions: list[np.ndarray]) -> list[dict[str, str]]:
    """A digest of every observation but sound, for each step."""
    observations = [env.reset(seed=seed)[0]]
    observations += [env.step(action)[0] for action in actions]
    return [
        {
            key: hashlib.sha256(value.tobytes()).hexdigest()
            for key, value in flat(seen).items()
            if not key.startswith("audio")
        }
        for seen in observations
    ]


def windows(run: _Run, actions: list[np.ndarray], steps: range) -> np.ndarray:
    """What a deaf policy with half a second of memory may look at in each of `steps`, (N, F).

    How far the hand is from where it was sent since the window began, the fingers, their velocities, what was sent, and what
    the camera shows, as far as it changes in the episode.
    """
    seen = run.measured[:, 7:] - run.measured[0, 7:]
    sent = np.cumsum([np.zeros(3), *(action[:3] * ACTION_SCALE for action in actions)], axis=0)
    features = []
    for step in steps:
        window = slice(step + 1 - _HISTORY, step + 1)
        moved, meant = run.measured[window, :3], sent[window]
        lag = (moved - moved[0]) - (meant - meant[0])
        arm = [lag.ravel(), run.measured[window, 3:7].ravel(), (meant - meant[0]).ravel()]
        features.append(np.concatenate([*arm, seen[window].ravel()]))
    return np.stack(features)


def twin_test(task: str | Task, seeds: range, *, n_pictured: int = 3, **options: Any) -> TwinResult:
    """Whether sound tells that the object was touched, and nothing else does.

    Args:
        task: Its name, or the task.
        seeds: One episode each; every second one trains the classifier, the others judge it.
        n_pictured: In so many episodes whole observations are compared, with pictures.
        options: Of `TaskEnv`.

    Raises:
        TwinError: As of `Twins`, or the expert touched the object in fewer than four episodes.
    """
    twins = Twins(task, **options)
    features, labels, episodes, heard, is_heard_first = [], [], [], [], []
    differences: list[str] = []
    pictures: list[bool] = []
    n_episodes = 0
    for seed in seeds:
        run, actions, other_world = twins.expert_run(seed)
        if twins.can_be_touched and (run.touched_at is None or run.touched_at < _HISTORY):
            continue
        other = twins.replay(other_world, seed, actions)
        end = min(len(run.measured), len(other.measured))
        same_until, judged_from = (run.touched_at,) * 2 if run.touched_at else (end, _HISTORY)
        before = np.flatnonzero((run.measured[:same_until] != other.measured[:same_until]).any(axis=1))
        differences += [f"seed {seed}, step {step}: agent_pos, or numbers of the camera" for step in before]
        steps = range(judged_from, end)
        is_first = other_world is twins.worlds[1]
        for world, label in ((run, is_first), (other, not is_first)):
            features.append(windows(world, actions, steps))
            labels += [label] * len(steps)
            episodes += [n_episodes] * len(steps)
            loudness = world.loudness[judged_from : judged_from + _RINGS if run.touched_at else end]
            heard.append(np.concatenate([loudness.max(axis=0), loudness.mean(axis=0), loudness.std(axis=0)]))
            is_heard_first.append(label)
        if n_episodes < n_pictured:
            found, changed = twins.differing_observations(seed, actions[: end - 1], same_until)
            differences += found
            pictures += changed
        n_episodes += 1
    can_be_touched = twins.can_be_touched
    twins.close()
    if n_episodes < 4:
        raise TwinError(
            f"twin environments: the expert touched the hidden object in {n_episodes} of {len(seeds)} episodes, and four are "
            "needed to compare them: give more --episodes, or an expert that touches it more often."
        )
    return TwinResult(
        n_episodes=n_episodes,
        n_windows=int((np.array(episodes) % 2 == 1).sum()),
        equal_until_touch=not differences,
        first_difference=differences[0] if differences else None,
        pictures_after_touch=float(np.mean(pictures)) if pictures else 0.0,
        auc=_area(np.concatenate(features), labels, episodes),
        heard=_area(np.array(heard), is_heard_first, np.repeat(range(n_episodes), 2).tolist()),
        can_be_touched=can_be_touched,
    )


def _area(features: np.ndarray, of_first: list[bool], of_episode: Sequence[int]) -> Spread:
    """The classifier's area under the curve on the held-out episodes, every second one.

    Args:
        features: (N, F)
        of_first: Whether each is of the first world.
        of_episode: Which episode each is of.
    """
    rng = np.random.default_rng(0)
    labels, episodes = np.array(of_first), np.array(of_episode)
    held_out = episodes % 2 == 1
    features = features[:, features.max(axis=0) > features.min(axis=0)]
    rows = {episode: np.flatnonzero(episodes == episode) for episode in np.unique(episodes[held_out])}
    scores = np.zeros(len(labels))
    scores[held_out] = fit_logistic(features[~held_out], labels[~held_out])(features[held_out])
    drawn = []
    for _ in range(_N_DRAWS):
        again = np.concatenate([rows[episode] for episode in rng.choice(list(rows), len(rows))])
        drawn.append(area_under_curve(scores[again], labels[again]))
    low, high = np.quantile(drawn, [0.05, 0.95])
    return Spread(area_under_curve(scores[held_out], labels[held_out]), float(low), float(high))
