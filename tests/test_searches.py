"""Where plans and trims are sought: statics, poses beside others, and the doubt by which they are compared."""

from __future__ import annotations

import numpy as np
import pytest
from foreseen import PAPER, UNMOVED, Floats, end_of, held, on_the_way, paper_model
from lane import magnets

from agents.searches import Statics, beside
from magenv.params import System


@pytest.mark.parametrize("pushing", [UNMOVED, np.array([2e-3, -1e-3, 2e-6, -1e-3, 2e-3, -2e-6])])
@pytest.mark.parametrize("n_epm", [2, 3])
def test_statics_keep_robots_on_their_way(rng: np.random.Generator, n_epm: int, pushing: Floats) -> None:
    """After a twentieth of a second rates are what they were, drag and a push notwithstanding; without EPMs, not."""
    state, model = on_the_way(0.06, 30.0), paper_model(n_epm)
    substeps, rates = round(0.05 / PAPER.substep_s), state[6:]
    epms = Statics(System(n_epm=n_epm), PAPER).hold(state[:6], rates, pushing, rng)
    assert epms is not None
    assert epms.shape == (n_epm, 6)
    kept = end_of(model, state, pushing, held(epms, substeps))[6:] - rates
    far = epms * [1e3, 1e3, 1e3, 1, 1, 1]
    lost = end_of(model, state, pushing, held(far, substeps))[6:] - rates
    assert np.linalg.norm(kept[[0, 1, 3, 4]]) < 0.02 * np.linalg.norm(lost[[0, 1, 3, 4]])


def test_statics_find_nothing_where_nothing_can_be_sought(rng: np.random.Generator) -> None:
    statics = Statics(System(), PAPER)
    assert statics.hold(np.zeros(6), np.zeros(6), UNMOVED, rng) is None
    assert statics.hold(np.full(6, np.nan), np.zeros(6), UNMOVED, rng) is None


def test_beside_is_near_and_of_unit_moment(rng: np.random.Generator) -> None:
    epms = magnets(rng)
    moved = np.stack([beside(epms, np.repeat([0.01, 0.05], 3), rng) for _ in range(2000)])
    np.testing.assert_allclose(np.linalg.norm(moved[..., 3:], axis=-1), 1.0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(moved[..., :3].std(axis=0), 0.01, rtol=0.1)
    np.testing.assert_allclose(moved.mean(axis=0), epms, rtol=0, atol=5e-3)
