"""The pressure policies against hand calculations, and against the line and nozzle they press."""

from dataclasses import replace

import numpy as np
import pytest

from agents.pressure import ConstantPressure, PressureRegulator, RegulatorCfg, with_pressure
from agents.reading import Reading
from seal_gym.core.cell import load_cell
from seal_gym.core.errors import ConfigError
from seal_gym.rmp import SeamErrors
from seal_gym.sealant.config import SealantCfg
from seal_gym.sealant.pneumatics import GunCfg, PressureLine, tube_flow

CELL, SEALANT = load_cell(), SealantCfg()
FLUID = SEALANT.fluid
FRAME = CELL.timing.frame_s


def reading(n=1, speed=0.01, about_x=0.0, about_z=0.0, d=0.0, seen=True):
    twist, seam = np.zeros((n, 6)), np.zeros((n, 6))
    twist[:, 1], twist[:, 3], twist[:, 5] = speed, about_x, about_z
    seam[:, 3:] = twist[:, 3:]  # as the seam under a gun in a bend seems to turn
    d = np.full(n, d)
    return Reading(
        seen=np.full(n, seen),
        errors=SeamErrors(d, 0 * d, d, 0 * d, 0 * d),
        twist=twist,
        seam_twist=seam,
        tip_accel=np.zeros((n, 6)),
    )


def rows(pressure_pa=0.0, width_m=0.0, seen=0.0, n=1):
    return np.tile([1e-3 * pressure_pa, 1e3 * width_m, seen], (n, 1))


def flow_of(command, gun=SEALANT.gun):
    pressure = 0.5 * (command + 1) * gun.pressure_max_pa
    return tube_flow(pressure, FLUID.yield_stress_pa, FLUID.consistency_pa_sn, FLUID.flow_index, gun)


def without_lag():
    return replace(SEALANT, gun=replace(SEALANT.gun, lag_s=0.0))


@pytest.mark.parametrize("speed", [0.005, 0.01, 0.03])
def test_the_flow_is_the_wanted_section_times_the_speed(speed):
    act = PressureRegulator(CELL, without_lag())
    command = act(reading(speed=speed), rows(), np.zeros((1, 2)))
    # To the table's spacing of pressures.
    assert flow_of(command[0]) == pytest.approx(7e-6 * speed, rel=2e-3)


def test_in_a_bend_the_centroid_counts_not_the_tip():
    act = PressureRegulator(CELL, without_lag())
    command = act(reading(about_x=-1.0), rows(), np.zeros((1, 2)))
    # The centroid of the filled angle is 2/3 sqrt(7) mm from the seam, 1.236 mm before the mouth at 3 mm.
    arm = 3e-3 - 2 / 3 * np.sqrt(7e-6)
    assert flow_of(command[0]) == pytest.approx(7e-6 * (0.01 - arm), rel=2e-3)


@pytest.mark.parametrize("change", [{"d": 6e-3}, {"seen": False}, {"speed": 0.0}, {"speed": -0.01}])
def test_nothing_is_pressed_where_nothing_is_sealed(change):
    act = PressureRegulator(CELL, SEALANT)
    assert act(reading(**change), rows(), np.zeros((1, 2)))[0] == -1.0


def test_the_lines_lag_is_led():
    act, line = PressureRegulator(CELL, SEALANT), PressureLine(1, SEALANT.gun)
    line.reset(0, FLUID)
    state = np.zeros((1, 2))
    for speed in (0.01, 0.01, 0.006, 0.012):
        command = act(reading(speed=speed), rows(line.pressure_pa[0]), state)
        line.step(0.5 * (command + 1) * SEALANT.gun.pressure_max_pa, FRAME)
        # One frame after the first, which starts at the gun's limit, the flow is what was asked for.
        flow = line.flow_m3_s[0]
    assert flow == pytest.approx(7e-6 * 0.012, rel=5e-3)


def test_a_wide_bead_lowers_the_flow_and_a_narrow_one_raises_it():
    cfg = RegulatorCfg()
    for width, sign in ((cfg.width_m + 1e-3, -1), (cfg.width_m - 1e-3, 1), (cfg.width_m, 0)):
        act, state = PressureRegulator(CELL, without_lag()), np.zeros((1, 2))
        for _ in range(90):
            command = act(reading(), rows(width_m=width, seen=1.0), state)
        # 0.7 s until the bend before the start is behind, then 2.3 s of integration.
        moved = 90 * FRAME - np.ceil(cfg.settled_m / (0.01 * FRAME) + 1e-9) * FRAME
        trim = sign * cfg.integral_s * moved * 1e-3 / cfg.width_slope_m
        assert state[0, 0] == pytest.approx(trim, abs=0.02)
        assert flow_of(command[0]) == pytest.approx(7e-8 * np.exp(state[0, 0]), rel=5e-3)


@pytest.mark.parametrize("change", [{"about_z": 1.0}, {"speed": 1e-3}, {"d": 6e-3}])
def test_the_width_counts_on_straight_stretches_alone(change):
    act, state = PressureRegulator(CELL, SEALANT), np.zeros((1, 2))
    for _ in range(90):
        act(reading(**change), rows(width_m=8e-3, seen=1.0), state)
    assert state[0, 0] == 0.0


def test_the_trim_is_bounded():
    act, state = PressureRegulator(CELL, SEALANT, RegulatorCfg(most_trim=1.2)), np.zeros((1, 2))
    for _ in range(900):
        act(reading(), rows(width_m=20e-3, seen=1.0), state)
    assert np.exp(state[0, 0]) == pytest.approx(1 / 1.2)


def test_constant_pressure_opens_at_the_seam_and_stays_open():
    act, state = ConstantPressure(CELL, SEALANT), np.zeros((1, 2))
    assert act(reading(d=8e-3), rows(), state)[0] == -1.0
    opened = act(reading(d=2e-3), rows(), state)[0]
    assert flow_of(opened) == pytest.approx(7e-8, rel=1e-9)
    for now in (reading(speed=0.0), reading(seen=False), reading(d=9e-3)):
        assert act(now, rows(), state)[0] == opened


class Still:
    control = "rmp"

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        del episode_start, deterministic
        return np.zeros((*np.shape(observation)[:-1], 27), np.float32), (state or 0) + 1


def test_a_new_episode_forgets_the_last_ones_trim():
    policy = with_pressure(Still(), CELL, SEALANT, "regulated")
    observation = np.zeros((2, 38), np.float32)
    observation[:, [2, 5, 37]] = 1.0
    observation[:, 12], observation[:, 36] = 10.0, 8.0
    state = None
    for _ in range(60):
        action, state = policy.predict(observation, state)
    assert action.shape == (2, 28)
    assert state[0] == 60
    assert (state[1][:, 0] < -0.1).all()
    _, state = policy.predict(observation, state, np.array([True, False]))
    assert state[1][0, 0] == 0.0
    assert state[1][1, 0] < -0.1


def test_bad_gains_are_named():
    with pytest.raises(ConfigError, match=r"RegulatorCfg.near_m = -1: must be a number >= 0"):
        RegulatorCfg(near_m=-1)
    with pytest.raises(ConfigError, match=r"most_trim must be >= 1"):
        RegulatorCfg(most_trim=0.5)
    assert GunCfg().pressure_max_pa == SEALANT.gun.pressure_max_pa
