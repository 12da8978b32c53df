"""Creep of a layer against the velocity profile, the slump of a yield-stress fluid against its last shape."""

import numpy as np
import pytest
from scipy.integrate import quad

from seal_gym.sealant.levelling import GRAVITY_M_S2, _flux, level
from tests.unit.sealant.plates import plate

WEIGHT = 1350.0 * GRAVITY_M_S2


@pytest.mark.parametrize("index", [0.4, 0.8, 1.0])
@pytest.mark.parametrize(("thick", "slope"), [(5e-3, 1.0), (8e-3, 0.3)])
def test_flux_is_the_integral_of_the_velocity_profile(index, thick, slope):
    yield_stress, consistency = 15.0, 20.0

    def rate(z):  # shear rate at a height z over the wall
        return max((WEIGHT * slope * (thick - z) - yield_stress) / consistency, 0.0) ** (1 / index)

    sheared = max(thick - yield_stress / (WEIGHT * slope), 0.0)
    expected = quad(lambda z: rate(z) * (thick - z), 0, sheared, epsabs=0, epsrel=1e-11)[0]
    assert expected > 0
    found = _flux(thick, slope, WEIGHT, yield_stress, consistency, 1 / index)
    assert found == pytest.approx(expected, rel=1e-9)


def run(strip, height, seconds, yield_stress, consistency=2.0, m=1.0, dt=1 / 30):
    volume = strip.volume(height)
    for _ in range(int(seconds / dt)):
        level(strip, volume, height, dt, 1350.0, yield_stress, consistency, m, 0, len(strip.arc))
    return volume


def test_a_heap_slumps_to_the_parabola_at_which_it_yields_no_more():
    strip = plate(length=2e-3, half=60e-3, spacing=0.5e-3)
    height = np.zeros(strip.area.shape)
    height[:, np.abs(strip.across) <= 12e-3] = 10e-3
    yield_stress = 20.0
    half_volume = 0.5 * strip.volume(height).sum() / (len(strip.arc) * 0.5e-3)
    run(strip, height, 400.0, yield_stress)
    # h^2 = 2 tau_y / (rho g) (x_f - x); its area 2/3 h0 x_f is half the heap's.
    bend = 2 * yield_stress / WEIGHT
    front = (1.5 * half_volume / np.sqrt(bend)) ** (2 / 3)
    assert height[:, len(strip.across) // 2].max() == pytest.approx(np.sqrt(bend * front), rel=0.03)
    x = strip.across[np.abs(strip.across) < 0.8 * front]
    shape = height[1, np.abs(strip.across) < 0.8 * front]
    np.testing.assert_allclose(shape, np.sqrt(bend * (front - np.abs(x))), rtol=0.04)


def test_volume_is_conserved_whatever_runs():
    rng = np.random.default_rng(1)
    strip = plate(tilt_rad=0.7)
    height = rng.uniform(0, 6e-3, strip.area.shape)
    before = strip.volume(height).sum()
    volume = run(strip, height, 5.0, 1.0)
    assert volume.sum() == pytest.approx(before, rel=1e-12)
    assert volume.min() >= 0.0
    np.testing.assert_allclose(strip.volume(height), volume, rtol=1e-9, atol=1e-18)


def test_on_a_wall_a_layer_sags_when_its_weight_exceeds_the_yield_stress():
    strip = plate(tilt_rad=np.pi / 2, half=20e-3)
    inner = np.abs(strip.across) <= 5e-3
    for share, moves in ((0.95, False), (1.3, True)):
        height = np.zeros(strip.area.shape)
        height[:, inner] = share * 60.0 / WEIGHT
        before = height.copy()
        run(strip, height, 2.0, 60.0)
        assert (not np.array_equal(height, before)) == moves
        if moves:  # downwards, which is to the left
            assert height[:, ~inner & (strip.across < 0)].max() > 0.0
            assert height[:, ~inner & (strip.across > 0)].max() == 0.0


def test_a_silicone_bead_stays_as_it_is_laid():
    strip = plate()
    height = np.zeros(strip.area.shape)
    height[20:60, 18:23] = 5e-3
    before = height.copy()
    run(strip, height, 2.0, 200.0, 250.0, 2.5)
    np.testing.assert_array_equal(height, before)


def test_columns_that_are_not_there_take_nothing():
    strip = plate(half=6e-3)
    area = strip.area.copy()
    area[:, 16:] = 0.0
    strip = strip._replace(area=area)
    height = np.zeros(area.shape)
    height[:, 10:16] = 8e-3
    volume = run(strip, height, 5.0, 1.0)
    assert volume[:, 16:].max() == height[:, 16:].max() == 0.0
