"""How far the remembered seam has moved, against shifts that are known."""

import numpy as np
import pytest

from seal_gym.vision.seam_memory import seam_motion

SIGMA, CLIP = 2e-3, 0.15e-3


def bend(y, radius, start):
    """A straight seam, then an arc: across at a place along [m]."""
    past = np.maximum(y - start, 0.0)
    return radius - np.sqrt(radius**2 - past**2)


def moved(curve, across, along, noise=0.0, seed=0):
    """What is made of old edges on ``curve`` and new ones on it after it moved."""
    rng = np.random.default_rng(seed)
    new = np.arange(-5e-3, 5.5e-3, 0.56e-3)
    old = rng.uniform(-5e-3, 5.5e-3, 300)
    y = np.concatenate((old, new))
    x = np.concatenate((curve(old), curve(new - along) + across)) + rng.normal(0.0, noise, len(y))
    fit = np.stack((y / SIGMA, x, np.ones(len(y)), np.arange(len(y)) >= len(old)))
    out = np.empty(3)
    seam_motion(np.ascontiguousarray(fit), len(y), SIGMA, CLIP, out)
    return out


def corner(y):
    return bend(y, 5e-3, 1e-3)


@pytest.mark.parametrize("across", [-0.1e-3, 0.0, 0.08e-3])
@pytest.mark.parametrize("along", [-0.1e-3, 0.0, 0.08e-3])
def test_a_corner_shows_motion_across_and_along(across, along):
    shift = moved(corner, across, along)
    assert shift[0] == pytest.approx(across, abs=0.01e-3)
    # The prior leaves more than half of what is along, and chords between edges lie inside the arc.
    assert 0.5 < shift[2] < 0.7
    assert shift[1] == pytest.approx(shift[2] * along, abs=0.025e-3)


@pytest.mark.parametrize("slope", [0.0, 0.3, -0.5])
def test_a_straight_seam_shows_motion_across_and_nothing_along(slope):
    shift = moved(lambda y: slope * y, 0.1e-3, 0.2e-3)
    assert shift[0] == pytest.approx(0.1e-3 - slope * 0.2e-3, abs=1e-9)
    assert shift[1] == pytest.approx(0.0, abs=1e-9)
    assert shift[2] < 1e-6


def test_noise_on_a_straight_seam_is_not_taken_for_motion_along_it():
    shifts = [moved(lambda y: 0.0 * y, 0.0, 0.0, noise=0.08e-3, seed=k) for k in range(50)]
    assert np.std([s[1] for s in shifts]) < 0.02e-3  # of a frame, at 0.08 mm an edge
    assert max(s[2] for s in shifts) < 0.2


def test_without_old_edges_nothing_has_moved():
    fit = np.stack((np.arange(20) / 4 - 2.5, np.zeros(20), np.ones(20), np.ones(20)))
    out = np.full(3, 7.0)
    seam_motion(fit, 20, SIGMA, CLIP, out)
    np.testing.assert_array_equal(out, 0.0)
