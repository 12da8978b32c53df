"""Random tip paths: within the thesis's bounds, pointing at their centre path."""

import math

import numpy as np
import pytest

from seal_gym.sealant.laydown import jet, paths
from seal_gym.sealant.laydown.config import THESIS_FLOW_M3S, LaydownCfg
from seal_gym.sealant.laydown.run import expected_peak_m, with_room
from seal_gym.sealant.laydown.substrates import SUBSTRATES
from tests.unit.sealant.laydown.cases import straight

ALL = paths.TRAINING + paths.VALIDATION


def test_there_are_25_and_12_unseen_ones():
    assert (len(paths.TRAINING), len(paths.VALIDATION)) == (25, 12)
    assert len({p.name for p in ALL}) == 37
    taught, unseen = ({p.substrate for p in group} for group in (paths.TRAINING, paths.VALIDATION))
    assert not taught & unseen and taught | unseen == set(SUBSTRATES)
    assert all(50e-3 <= p.length_m <= 80e-3 for p in ALL)


def test_draws_spread_as_the_thesis_says():
    rng = np.random.default_rng(3)
    draws = np.array([paths.Bounds().draw(4, rng) for _ in range(4000)])
    low = [0.02, 0.2, -math.pi / 6, -math.pi / 12, -math.radians(75)]
    high = [0.04, 0.5, math.pi / 6, math.pi / 12, math.radians(75)]
    assert (draws >= low).all() and (draws <= high).all()
    width = np.subtract(high, low)
    np.testing.assert_allclose(draws[:, 0].mean(0), np.add(low, high) / 2, atol=0.02 * width.max())
    np.testing.assert_allclose(draws[:, 0].std(0), width / math.sqrt(12), rtol=0.03)
    middle = np.abs(draws[:, 0, 1] - 0.35) < 0.05  # far from the bounds: not clipped
    np.testing.assert_allclose((draws[:, 1:, 1] - draws[:, :1, 1])[middle].std(), 0.02, rtol=0.03)


@pytest.mark.parametrize("centre", ALL, ids=lambda p: p.name)
def test_the_nozzle_points_at_the_centre_path_and_the_jet_lands(centre):
    path = paths.random_tip_path(centre, np.random.default_rng(4))
    arcs = np.linspace(0.0, centre.length_m, len(path.times_s))
    points, upright = centre.frames(arcs)
    to_tip = path.positions - points
    offset = np.linalg.norm(to_tip, axis=1)
    assert ((offset >= 0.02 - 1e-12) & (offset <= 0.04 + 1e-12)).all()
    np.testing.assert_allclose(path.rotations[:, :, 2], to_tip / offset[:, None], atol=1e-9)
    np.testing.assert_allclose(points[:, 2], SUBSTRATES[centre.substrate].height(*points[:, :2].T))
    lean = np.arccos((upright[:, :, 2] * path.rotations[:, :, 2]).sum(1))
    assert lean.max() <= math.acos(math.cos(math.pi / 6) * math.cos(math.pi / 12)) + 1e-9
    speeds = np.linalg.norm(np.diff(path.positions, axis=0), axis=1) / np.diff(path.times_s)
    assert ((speeds >= 0.2 - 1e-9) & (speeds <= 0.5 + 1e-9)).all()
    cfg = LaydownCfg(path=path, substrate=centre.substrate, gravity_mps2=centre.gravity_mps2)
    parcels, _, place = jet.landings(cfg)
    assert parcels.volumes_m3.sum() == pytest.approx(THESIS_FLOW_M3S * path.times_s[-1])
    # the jet flies 10 to 40 mm at 3 m/s, the tip moves at most 0.5 m/s: its middle lands near the path
    assert np.linalg.norm(np.average(place, 0, parcels.volumes_m3) - points.mean(0)) < 0.02


def test_a_hairpin_turns_by_half_a_circle():
    hairpin = next(p for p in paths.TRAINING if p.name == "plane_hairpin")
    points, frames = hairpin.frames(np.array([0.0, hairpin.length_m]))
    np.testing.assert_allclose(frames[1, :, 1], -frames[0, :, 1], atol=1e-3)
    assert np.linalg.norm(points[1] - points[0]) == pytest.approx(30e-3, abs=1e-4)


def test_the_seed_decides():
    centre = paths.TRAINING[0]
    one, two, other = (paths.random_tip_path(centre, np.random.default_rng(s)) for s in (5, 5, 6))
    np.testing.assert_array_equal(one.positions, two.positions)
    assert not np.array_equal(one.positions, other.positions)


def test_the_mesh_gets_room_for_the_bead():
    cfg = straight(speed_mps=0.1)
    # 12e-6 / 0.1 = 120 mm^2 over 2 x 30 tan(20 deg) = 21.8 mm, thicker in the middle by at most 1 / cos^2
    assert expected_peak_m(cfg) == pytest.approx(5.5e-3, rel=0.15)
    assert with_room(cfg).grid.clearance_m == pytest.approx(3e-3 + 1.6 * expected_peak_m(cfg))
    assert with_room(straight(speed_mps=1.0)).grid.clearance_m == 6e-3
