"""Beads under a round nozzle: volume, the still dome, the pressed bead's width."""

import numpy as np
import pytest

from seal_gym.core.frames import axis_angle
from seal_gym.sealant.bead import _lay_rows
from seal_gym.sealant.deposition import _SIDE_M
from tests.unit.sealant.plates import plate

STIFF = np.array([[1400.0, 200.0, 250.0, 2.5]])


def drag(strip, flow_mm3_s, speed_mm_s, gap_mm, turn=None, start=0.01, end=0.05):
    """Moves a nozzle along the strip; gives heights, volumes and what was missed."""
    shape = (1, *strip.area.shape)
    volume, height, missed = np.zeros(shape), np.zeros(shape), np.zeros(1)
    total, lost, dt = 0.0, 0.0, 1 / 30
    turn = np.eye(3) if turn is None else turn
    window = np.array([[0, len(strip.arc)]])
    y = start
    before = np.array([[0.0, y, 1e-3 * gap_mm]])
    while y < end:
        y += 1e-3 * speed_mm_s * dt
        tip = np.array([[0.0, y, 1e-3 * gap_mm]])
        amount = np.array([1e-9 * flow_mm3_s * dt])
        _lay_rows(strip, volume, height, amount, before, tip, turn[None], STIFF, dt, missed, window, 0, 1)
        before, total, lost = tip, total + amount[0], lost + missed[0]
    return height[0], volume[0], total, lost


def test_a_still_nozzle_makes_a_paraboloid():
    strip = plate(spacing=0.25e-3, length=0.02)
    volume, height = np.zeros((1, *strip.area.shape)), np.zeros((1, *strip.area.shape))
    tip = np.array([[0.0, 0.01, 6e-3]])
    amount, missed = np.array([6e-9]), np.zeros(1)
    window = np.array([[0, 81]])
    _lay_rows(strip, volume, height, amount, tip, tip, np.eye(3)[None], STIFF, 1 / 30, missed, window, 0, 1)
    # z = h0 - r^2 / (2 c) holds pi c h0^2.
    assert height.max() == pytest.approx(np.sqrt(6e-9 / (np.pi * _SIDE_M)), rel=0.02)
    assert volume.sum() == pytest.approx(6e-9, rel=1e-12)


@pytest.mark.parametrize(("section", "gap"), [(6.0, 1.5), (9.0, 2.0), (12.0, 3.0)])
def test_a_pressed_bead_is_as_wide_as_an_obround(section, gap):
    strip = plate(spacing=0.25e-3)
    height, volume, total, _ = drag(strip, 10 * section, 10, gap)
    middle = len(strip.arc) // 2
    wet = height[middle] > 0.5e-3 * gap
    width = 0.25 * wet.sum()
    assert height.max() == pytest.approx(1e-3 * gap, rel=1e-6)
    # At half its height an obround has its full width, H / 2 (1 + pi / 4) less at top and bottom on average.
    assert width == pytest.approx(section / gap + gap * (1 - np.pi / 4), rel=0.12)
    assert volume.sum() == pytest.approx(total, rel=1e-12)
    assert 1e9 * volume[middle].sum() / 0.25 == pytest.approx(section, rel=0.02)


def test_faster_travel_lays_a_thinner_bead():
    strip = plate()
    sections = [drag(strip, 70, speed, 3.0)[1][60].sum() / 0.5e-3 for speed in (5, 10, 20, 60)]
    np.testing.assert_allclose(1e6 * np.array(sections), [14.0, 7.0, 3.5, 7 / 6], rtol=0.03)


def test_a_leaning_nozzle_lays_where_it_points():
    strip = plate()
    turn = axis_angle(np.array([0.0, 1.0, 0.0]), 0.3)
    height = drag(strip, 70, 10, 3.0, turn)[0]
    middle = height[60]
    centre = (middle * strip.across).sum() / middle.sum()
    # The axis -z of the tip meets the plate at -gap tan(lean).
    assert centre == pytest.approx(-3e-3 * np.tan(0.3), abs=0.3e-3)


def test_what_falls_beside_the_strip_is_counted_not_laid():
    strip = plate(half=4e-3)
    area = strip.area.copy()
    area[:, 5:] = 0.0  # nothing from 1.5 mm left of the axis on: the nearest column is 2 mm off
    _, volume, total, lost = drag(strip._replace(area=area[:]), 70, 10, 3.0)
    assert volume.sum() + lost == pytest.approx(total, rel=1e-12)
    area[:, 4:] = 0.0
    _, volume, total, lost = drag(strip._replace(area=area), 70, 10, 3.0)
    assert volume.sum() == 0.0
    assert lost == pytest.approx(total, rel=1e-12)


def test_a_drowned_mouth_lifts_the_bead_round_it():
    strip = plate(length=0.03)
    height, volume, total, lost = drag(strip, 4000, 1, 1.0, start=0.0149, end=0.0151)
    assert lost == 0.0
    assert volume.sum() == pytest.approx(total, rel=1e-12)
    assert height.max() > 1e-3
