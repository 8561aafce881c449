"""Statistics over few runs: against rliable, and by identities."""

from __future__ import annotations

import numpy as np
import pytest

from agents.statistics import (
    Floats,
    bounds,
    interquartile_mean,
    interval,
    probability_of_improvement,
    share_above,
)

X = np.array([[0.9, 0.41, 0.77], [0.35, 0.52, 0.81], [0.6, 0.47, 0.2], [0.75, 0.9, 0.66], [0.1, 0.3, 0.72]])
Y = np.array([[0.4, 0.41, 0.5], [0.55, 0.33, 0.83], [0.2, 0.44, 0.6], [0.7, 0.1, 0.66]])
THRESHOLDS = [0.0, 0.3, 0.5, 0.7, 0.85, 1.0]

# rliable 1.2.0 (arch 7.2.0, NumPy 2.4.6) on these scores: aggregate_iqm, probability_of_improvement and
# create_performance_profile; intervals of get_interval_estimates, 50000 resamples (of the probability: 20000) from
# numpy.random.seed(0).
IQM = {"X": 0.5833333333333334, "Y": 0.48333333333333334}
IQM_INTERVAL = {"X": (0.42333333333333334, 0.7244444444444444), "Y": (0.38166666666666665, 0.5733333333333334)}
IMPROVEMENT, IMPROVEMENT_INTERVAL = 0.65, (0.425, 0.8583333333333334)
PROFILE = [1.0, 0.8, 0.6, 0.4, 0.13333333333333333, 0.0]
PROFILE_INTERVAL = [
    [1.0, 0.6, 0.4, 0.2, 0.0, 0.0],
    [1.0, 1.0, 0.8, 0.6666666666666666, 0.3333333333333333, 0.0],
]
ONE_SCORE = 1 / 15
"""By which a share of 15 scores may differ where a quantile falls between two values."""


@pytest.mark.parametrize(("name", "scores"), [("X", X), ("Y", Y)])
def test_interquartile_mean_is_that_of_rliable(name: str, scores: Floats) -> None:
    assert float(interquartile_mean(scores)) == pytest.approx(IQM[name], rel=1e-12)
    assert interval(interquartile_mean, scores) == pytest.approx(IQM_INTERVAL[name], abs=0.01)


def test_probability_of_improvement_is_that_of_rliable() -> None:
    assert float(probability_of_improvement(X, Y)) == pytest.approx(IMPROVEMENT, rel=1e-12)
    assert interval(probability_of_improvement, X, Y) == pytest.approx(IMPROVEMENT_INTERVAL, abs=0.02)


def test_profiles_are_those_of_rliable() -> None:
    assert share_above(X, THRESHOLDS) == pytest.approx(PROFILE, rel=1e-12)
    found = bounds(lambda scores: share_above(scores, THRESHOLDS), X)
    assert found == pytest.approx(np.array(PROFILE_INTERVAL), abs=ONE_SCORE + 1e-12)


def test_improvements_of_both_over_each_other_are_one_in_sum(rng: np.random.Generator) -> None:
    mine, theirs = rng.integers(0, 5, (6, 9)), rng.integers(0, 5, (4, 9))
    total = probability_of_improvement(mine, theirs) + probability_of_improvement(theirs, mine)
    assert float(total) == pytest.approx(1.0)
    assert float(probability_of_improvement(mine, mine)) == 0.5


def test_the_worst_is_as_bad_as_the_worst() -> None:
    lost, held = np.full((1, 4), -np.inf), np.array([[-1.0, -1.0, -np.inf, -1.0]])
    assert float(probability_of_improvement(lost, lost)) == 0.5
    assert float(probability_of_improvement(held, lost)) == 0.875


def test_statistics_of_many_matrices_are_those_of_each(rng: np.random.Generator) -> None:
    many, others = rng.normal(size=(7, 5, 3)), rng.normal(size=(7, 2, 3))
    for k in range(7):
        assert interquartile_mean(many)[k] == interquartile_mean(many[k])
        assert np.array_equal(share_above(many, [0.0, 1.0])[k], share_above(many[k], [0.0, 1.0]))
        assert probability_of_improvement(many, others)[k] == probability_of_improvement(many[k], others[k])


def test_the_interquartile_mean_forgets_outliers() -> None:
    scores = np.arange(12.0).reshape(3, 4)
    worse = scores.copy()
    worse[-1, -1] = 1e9
    assert float(interquartile_mean(scores)) == float(interquartile_mean(worse)) == np.mean(np.arange(3.0, 9.0))


def test_runs_are_resampled_within_each_task() -> None:
    """Tasks differ, runs do not: nothing is resampled among tasks."""
    same = np.tile([1.0, 5.0, 9.0], (4, 1))
    for whole in (False, True):
        assert interval(lambda scores: scores.mean(axis=(-2, -1)), same, whole_runs=whole) == (5.0, 5.0)


def test_scores_that_go_together_leave_more_doubt(rng: np.random.Generator) -> None:
    """Runs that are good or bad on all tasks: the whole run is what is drawn, as if there were one task."""
    quality = rng.normal(size=(5, 1))
    alike = np.tile(quality, (1, 20))

    def mean(scores: Floats) -> Floats:
        return np.asarray(scores.mean(axis=(-2, -1)))

    apart, whole = interval(mean, alike), interval(mean, alike, whole_runs=True)
    assert whole[1] - whole[0] > 3 * (apart[1] - apart[0])
    assert whole == pytest.approx(interval(mean, quality), abs=0.05)


def test_a_single_run_has_no_interval_and_intervals_are_always_the_same() -> None:
    assert interval(interquartile_mean, X[:1]) == (interquartile_mean(X[:1]),) * 2
    assert interval(interquartile_mean, X) == interval(interquartile_mean, X)
    assert interval(interquartile_mean, X) != interval(interquartile_mean, X, seed=1)


@pytest.mark.parametrize("scores", [[1.0, 2.0], np.zeros((0, 3)), [[1.0, np.nan]]], ids=["vector", "empty", "NaN"])
def test_what_is_no_matrix_is_refused(scores: object) -> None:
    with pytest.raises(ValueError, match=r"^Input scores must be a matrix of runs and tasks without NaN; instead"):
        interval(interquartile_mean, scores)  # type: ignore[arg-type]
