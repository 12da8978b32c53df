"""The nozzle's flow against quadrature and closed forms, the line's lag against its solution."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad

from seal_gym.core.errors import ConfigError
from seal_gym.sealant.pneumatics import (
    SEALANTS,
    GunCfg,
    PressureLine,
    Sealant,
    get_sealant,
    pressure_for,
    tube_flow,
)

GUN = GunCfg()
SILICONE = SEALANTS["neutral_silicone"]


def fluid(sealant):
    return sealant.yield_stress_pa, sealant.consistency_pa_sn, sealant.flow_index


def flow_by_quadrature(pressure, sealant, gun):
    """The flow as the integral of pi r^2 gamma(r): each shear rate carries the disc inside it."""
    yield_stress, consistency, index = fluid(sealant)

    def carried(r):
        stress = pressure * r / (2 * gun.length_m)
        return np.pi * r**2 * (max(stress - yield_stress, 0.0) / consistency) ** (1 / index)

    plug = min(2 * gun.length_m * yield_stress / pressure, gun.bore_m)
    return quad(carried, plug, gun.bore_m, epsabs=0, epsrel=1e-11)[0]


@pytest.mark.parametrize("name", sorted(SEALANTS))
@pytest.mark.parametrize("pressure", [3e4, 6e4, 1.2e5, 4e5])
def test_flow_equals_the_integral_of_the_velocity_profile(name, pressure):
    sealant = SEALANTS[name]
    expected = flow_by_quadrature(pressure, sealant, GUN)
    assert tube_flow(pressure, *fluid(sealant), GUN) == pytest.approx(expected, rel=1e-9, abs=1e-30)


def test_flow_is_buckingham_reiner_at_index_one():
    phi = 2 * GUN.length_m * 200.0 / (9e4 * GUN.bore_m)
    newtonian = np.pi * GUN.bore_m**4 * 9e4 / (8 * 50.0 * GUN.length_m)
    expected = newtonian * (1 - 4 / 3 * phi + phi**4 / 3)
    assert tube_flow(9e4, 200.0, 50.0, 1.0, GUN) == pytest.approx(expected, rel=1e-12)
    assert tube_flow(9e4, 0.0, 50.0, 1.0, GUN) == pytest.approx(newtonian, rel=1e-12)


def test_nothing_flows_below_the_yield_stress():
    onset = 2 * GUN.length_m * SILICONE.yield_stress_pa / GUN.bore_m
    np.testing.assert_array_equal(
        tube_flow(np.array([-5.0, 0.0, 0.999 * onset]), *fluid(SILICONE), GUN), np.zeros(3)
    )
    assert tube_flow(1.001 * onset, *fluid(SILICONE), GUN) > 0


def test_pressure_for_is_the_inverse_within_the_guns_range():
    flow = np.array([1e-10, 9e-8, 1.5e-7])
    pressure = pressure_for(flow, SILICONE, GUN)
    np.testing.assert_allclose(tube_flow(pressure, *fluid(SILICONE), GUN), flow, rtol=1e-9)
    np.testing.assert_array_equal(pressure_for([0.0, -1.0, 1.0], SILICONE, GUN), [0, 0, GUN.pressure_max_pa])


def test_the_line_follows_its_command_exponentially():
    line = PressureLine(2, GUN)
    for i in range(2):
        line.reset(i, SILICONE)
    command = np.array([1e5, 5e5])  # the second beyond the range
    for _ in range(6):
        line.step(command, 1 / 30)
    held = np.array([1e5, GUN.pressure_max_pa])
    np.testing.assert_allclose(line.pressure_pa, held * (1 - np.exp(-0.2 / GUN.lag_s)), rtol=1e-12)
    np.testing.assert_array_equal(line.flow_m3_s, tube_flow(line.pressure_pa, *fluid(SILICONE), GUN))


@pytest.mark.parametrize("name", sorted(SEALANTS))
def test_the_volume_is_the_integral_of_the_flow(name):
    sealant = SEALANTS[name]
    line = PressureLine(1, GUN)
    line.reset(0, sealant)
    line.step(np.array([7e4]), 0.2)  # flowing
    start = line.pressure_pa[0]

    def flow(t):
        pressure = 1.1e5 + (start - 1.1e5) * np.exp(-t / GUN.lag_s)
        return tube_flow(pressure, *fluid(sealant), GUN)

    expected = quad(flow, 0, 1 / 30, epsabs=0, epsrel=1e-11)[0]
    assert line.step(np.array([1.1e5]), 1 / 30)[0] == pytest.approx(expected, rel=1e-9)


def test_without_lag_the_pressure_is_the_command():
    line = PressureLine(1, replace(GUN, lag_s=0.0))
    line.reset(0, SILICONE)
    volume = line.step(np.array([9e4]), 0.1)
    assert line.pressure_pa[0] == 9e4
    assert volume[0] == pytest.approx(0.1 * tube_flow(9e4, *fluid(SILICONE), GUN), rel=1e-12)


def test_rows_do_not_mix():
    both, alone = PressureLine(2, GUN), PressureLine(1, GUN)
    both.reset(0, SILICONE)
    both.reset(1, SEALANTS["polyurethane"])
    alone.reset(0, SEALANTS["polyurethane"])
    for command in (1.4e5, 0.0, 8e4):
        two = both.step(np.array([3e4, command]), 1 / 30)
        assert two[1] == alone.step(np.array([command]), 1 / 30)[0]
    both.reset(1, SILICONE)
    assert both.pressure_pa[1] == 0.0 < both.pressure_pa[0]


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: replace(SILICONE, flow_index=0.0), "flow_index = 0.0: must be a number in 0.1..1.5"),
        (lambda: replace(SILICONE, yield_stress_pa=np.nan), "yield_stress_pa = nan"),
        (lambda: replace(SILICONE, rgb=(2, 0, 0)), "rgb = "),
        (lambda: GunCfg(bore_m=1.2), "bore_m = 1.2: .* at most 0.02; check the unit"),
        (lambda: GunCfg(lag_s=-0.1), "lag_s = -0.1"),
        (lambda: get_sealant("chewing gum"), "chewing gum.*neutral_silicone"),
    ],
)
def test_bad_values_are_named(make, match):
    with pytest.raises(ConfigError, match=match):
        make()


def test_a_sealant_of_ones_own_passes_through():
    own = Sealant(name="own", density_kg_m3=1e3, yield_stress_pa=10.0, consistency_pa_sn=5.0, flow_index=0.5)
    assert get_sealant(own) is own
    assert get_sealant("polyurethane") is SEALANTS["polyurethane"]
