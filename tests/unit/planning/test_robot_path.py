"""The robot's time scaling: limits by finite differences, volume per length, poses and errors."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from seal_gym.core.errors import ConfigError
from seal_gym.core.frames import yaw_pose
from seal_gym.core.kinematics import JOINT_LOWER, JOINT_SPEED, JOINT_UPPER, tip_kinematics
from seal_gym.planning import robot_path as rp
from seal_gym.planning.bead_config import BeadCfg, PlanningError
from seal_gym.planning.bead_curves import Edges, offset_polyline
from seal_gym.planning.bead_geometry import BeadPath
from seal_gym.planning.bead_path import naive_path
from seal_gym.planning.bead_projection import footprint

CFG = BeadCfg()
LIMITS = rp.RobotLimitsCfg()
STEPS = 3  # of the time scaling between two knots


@pytest.fixture(scope="module")
def edges():
    points = np.array([[0.0, 0, 0], [0.06, 0, 0], [0.09, 0.052, 0]])
    left, right = (offset_polyline(points, [0, 0, 1], side * 7.5e-3) for side in (1, -1))
    return Edges.smoothed(left, right, 8e-3)


@pytest.fixture(scope="module")
def planned(edges):
    # Too fast for the robot in the bend: 0.4 m/s with 60 deg of turn in a few centimetres.
    return naive_path(edges, 0.28, CFG, 161)


@pytest.fixture(scope="module")
def pose(planned):
    return rp.place(planned)


@pytest.fixture(scope="module")
def robot(planned, pose):
    return rp.robot_path(planned, pose)


def joints_at(robot, time):
    """Joint angles at any time: the knots' spline at tau, whose rate's square is linear between steps."""
    tau, rate, t = robot.planned_s, robot.rate, robot.path.time_s
    k = np.clip(np.searchsorted(t, time, side="right") - 1, 0, len(t) - 2)
    since = time - t[k]
    acceleration = (rate[k + 1] ** 2 - rate[k] ** 2) / (2 * (tau[k + 1] - tau[k]))
    return CubicSpline(tau[::STEPS], robot.q[::STEPS])(tau[k] + rate[k] * since + acceleration * since**2 / 2)


def test_speeds_and_accelerations_keep_their_limits(robot):
    h = 2e-5
    time = np.arange(h, robot.path.time_s[-1] - h, 5e-5)
    before, now, after = (joints_at(robot, time + shift) for shift in (-h, 0.0, h))
    speed, acceleration = (after - before) / (2 * h), (after - 2 * now + before) / h**2
    assert (np.abs(speed).max(axis=0) < 1.001 * JOINT_SPEED).all()
    assert (np.abs(acceleration).max(axis=0) < 1.01 * np.array(LIMITS.joint_rad_s2)).all()
    # Some limit is used: the path is not slower than it must be.
    used = np.maximum(np.abs(speed) / JOINT_SPEED, np.abs(acceleration) / np.array(LIMITS.joint_rad_s2))
    assert used.max() > 0.99
    assert robot.slow_down > 1.05
    # From rest to rest, and the speeds given are the finite differences.
    np.testing.assert_allclose(robot.qd[[0, -1]], 0.0, atol=1e-9)
    given = np.stack([np.interp(time, robot.path.time_s, qd) for qd in robot.qd.T], axis=1)
    np.testing.assert_allclose(given, speed, atol=0.03)
    assert (robot.q > JOINT_LOWER).all()
    assert (robot.q < JOINT_UPPER).all()


def test_the_nozzle_keeps_its_speed_limit(planned, pose):
    slow = rp.robot_path(planned, pose, replace(LIMITS, nozzle_m_s=0.15))
    step = np.linalg.norm(np.diff(slow.path.position_m, axis=0), axis=1)
    speed = step / np.diff(slow.path.time_s)
    assert speed.max() < 0.15 * 1.005
    assert speed.max() > 0.149
    assert slow.slow_down > 2.0


def test_flow_per_length_is_as_planned(planned, robot):
    def per_length(path):
        volume = np.cumsum((path.flow_m3_per_s[1:] + path.flow_m3_per_s[:-1]) / 2 * np.diff(path.time_s))
        along = np.cumsum(np.linalg.norm(np.diff(path.position_m, axis=0), axis=1))
        return along, volume

    along, volume = per_length(robot.path)
    planned_along, planned_volume = per_length(planned)
    assert volume[-1] == pytest.approx(planned_volume[-1], rel=1e-9)
    np.testing.assert_allclose(np.interp(planned_along[5:-5], along, volume), planned_volume[5:-5], rtol=1e-3)
    assert (robot.rate <= 1.0 + 1e-9).all()
    assert (np.diff(robot.planned_s) > 0).all()


def test_the_executed_bead_is_the_planned_one(edges, planned, robot):
    theta = CFG.nozzle.fan_angle_rad
    before, after = footprint(planned, edges, theta), footprint(robot.path, edges, theta)
    np.testing.assert_allclose(after.left_height_m[::STEPS][2:-2], before.left_height_m[2:-2], rtol=2e-2)
    np.testing.assert_allclose(after.left_m[::STEPS], before.left_m, atol=1e-9)


def test_a_path_the_robot_can_follow_is_slowed_at_its_ends_only(edges):
    easy = naive_path(edges, 8.0, CFG, 161)
    robot = rp.robot_path(easy, rp.place(easy))
    assert robot.slow_down < 1.02
    inside = (robot.planned_s > 0.4) & (robot.planned_s < 7.6)
    np.testing.assert_allclose(robot.rate[inside], 1.0, atol=1e-6)


def test_joint_angles_reach_the_poses(planned, pose):
    q = rp.joint_path(planned, pose, LIMITS)
    found = np.linalg.inv(pose) @ tip_kinematics(q, np.zeros_like(q)).pose
    np.testing.assert_allclose(found[:, :3, 3], planned.position_m, atol=1e-9)
    np.testing.assert_allclose(found[:, :3, :3], planned.rotation, atol=1e-9)
    assert np.abs(np.diff(q, axis=0)).max() < 0.2


def test_time_scaling_of_one_joint_by_hand():
    # One joint over 1 rad in 0.1 s planned; 2 rad/s and 10 rad/s^2 allow a trapezoid of 0.2 + 0.3 + 0.2 s.
    limits = rp.RobotLimitsCfg(joint_rad_s=(2.0,) * 6, joint_rad_s2=(10.0,) * 6, nozzle_m_s=5.0)
    tau = np.linspace(0.0, 0.1, 101)
    q = np.zeros((101, 6))
    q[:, 2] = tau / 0.1
    found, rate, time = rp.scale_time(tau, q, np.full(101, 1.0), limits)
    assert time[-1] == pytest.approx(0.7, rel=5e-3)
    assert rate.max() == pytest.approx(0.2, rel=1e-3)
    np.testing.assert_allclose(found[::STEPS], tau)


def test_out_of_reach(planned):
    with pytest.raises(PlanningError, match="cannot follow"):
        rp.robot_path(planned, yaw_pose(2.0, 0.0, 0.0, 0.0))
    huge = BeadPath(
        time_s=planned.time_s,
        position_m=40.0 * planned.position_m,
        rotation=planned.rotation,
        flow_m3_per_s=planned.flow_m3_per_s,
    )
    with pytest.raises(PlanningError, match="nowhere"):
        rp.place(huge)


@pytest.mark.parametrize(
    "values", [{"joint_rad_s": (1.0,) * 5}, {"joint_rad_s2": (0.0,) * 6}, {"nozzle_m_s": -1.0}]
)
def test_bad_limits(values):
    with pytest.raises(ConfigError, match=next(iter(values))):
        rp.RobotLimitsCfg(**values)


def test_without_toppra_the_error_says_how_to_install_it(planned, pose, monkeypatch):
    monkeypatch.setitem(sys.modules, "toppra", None)
    with pytest.raises(PlanningError, match=r'pip install "seal-gym\[planning\]"'):
        rp.robot_path(planned, pose)
