"""Two classifiers in numpy and scipy, for the question whether two sets of measurements can be told apart."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.stats import rankdata

Scores = Callable[[np.ndarray], np.ndarray]
"""Features (N, F) to scores (N,): higher is more likely positive."""


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


def fit_logistic(features: np.ndarray, positive: np.ndarray, penalty: float = 3.0) -> Scores:
    """Logistic regression on standardised features and their squares, with an L2 penalty.

    Args:
        features: (N, F)
        positive: (N,) bool
        penalty: Of the squared weights, in examples.
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


@dataclass(frozen=True)
class _Split:
    feature: int
    bin: int
    below: "_Split | float"
    above: "_Split | float"


def fit_boosted_trees(
    features: np.ndarray, positive: np.ndarray, n_trees: int = 80, depth: int = 2, rate: float = 0.1, n_bins: int = 16
) -> Scores:
    """Gradient boosting of small trees on features in quantile bins.

    Args:
        features: (N, F)
        positive: (N,) bool
        n_trees, depth, rate, n_bins: As usual.
    """
    edges = np.quantile(features, np.linspace(0, 1, n_bins + 1)[1:-1], axis=0)  # (n_bins - 1, F)

    def to_bins(values: np.ndarray) -> np.ndarray:
        return np.stack([np.searchsorted(edges[:, i], values[:, i]) for i in range(values.shape[1])], axis=1)

    bins = to_bins(features)  # (N, F)
    cells = bins + n_bins * np.arange(bins.shape[1])
    scores = np.zeros(len(bins))
    trees: list[_Split | float] = []
    for _ in range(n_trees):
        chance = 1 / (1 + np.exp(-scores))
        tree = _grow(bins, cells, positive - chance, chance * (1 - chance), depth, n_bins)
        trees.append(tree)
        scores += rate * _values(tree, bins)
    return lambda values: rate * sum((_values(tree, to_bins(values)) for tree in trees), np.zeros(len(values)))


def _grow(
    bins: np.ndarray, cells: np.ndarray, slope: np.ndarray, curve: np.ndarray, depth: int, n_bins: int
) -> _Split | float:
    """A tree that fits `slope / curve` (N,), by histograms."""
    if depth == 0 or len(bins) < 20:
        return float(slope.sum() / (curve.sum() + 1.0))
    shape, n_cells = (bins.shape[1], n_bins), bins.shape[1] * n_bins
    sums = [
        np.bincount(cells.ravel(), np.repeat(weight, bins.shape[1]), n_cells).reshape(shape).cumsum(axis=1)[:, :-1]
        for weight in (slope, curve)
    ]
    below_slope, below_curve = sums
    above_slope, above_curve = slope.sum() - below_slope, curve.sum() - below_curve
    gain = below_slope**2 / (below_curve + 1.0) + above_slope**2 / (above_curve + 1.0)
    feature, at = np.unravel_index(int(gain.argmax()), gain.shape)
    is_below = bins[:, feature] <= at
    if is_below.all() or not is_below.any():
        return float(slope.sum() / (curve.sum() + 1.0))
    parts = [
        _grow(bins[part], cells[part], slope[part], curve[part], depth - 1, n_bins) for part in (is_below, ~is_below)
    ]
    return _Split(int(feature), int(at), *parts)


def _values(tree: _Split | float, bins: np.ndarray) -> np.ndarray:
    """What the tree says of each row (N,)."""
    if not isinstance(tree, _Split):
        return np.full(len(bins), tree)
    is_below = bins[:, tree.feature] <= tree.bin
    return np.where(is_below, _values(tree.below, bins), _values(tree.above, bins))


CLASSIFIERS: dict[str, Callable[[np.ndarray, np.ndarray], Scores]] = {
    "logistic regression": fit_logistic,
    "boosted trees": fit_boosted_trees,
}
