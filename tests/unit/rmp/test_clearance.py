"""Clearances of the gun from a ball, and the leaf that lets the ball pass."""

import mujoco
import numpy as np
import pytest

from seal_gym.core.cell import load_cell
from seal_gym.core.errors import ConfigError
from seal_gym.core.kinematics import JOINT_LOWER, tip_kinematics
from seal_gym.rmp import (
    SEALING_GUN,
    Capsules,
    LetPassCfg,
    ObstacleCfg,
    allowed_speed,
    clearances,
    gather,
    joint_limits,
    let_pass,
    pullback,
)
from seal_gym.sim.scene import GUN_PREFIX, cached_scene
from seal_gym.workpieces import catalogue

Q = np.deg2rad([[-4.0, -117.8, -94.7, -102.4, 87.2, -92.8], [-22.8, -111.4, -110.8, -68.9, 130.7, -30.7]])
QD = np.array([[0.3, -0.2, 0.4, 0.1, -0.5, 0.6], [-0.1, 0.5, 0.2, -0.3, 0.4, -0.2]])
QDD = np.array([[1.0, -2.0, 0.5, 1.5, -1.0, 2.0], [0.4, 1.2, -0.8, 2.0, 1.0, -1.5]])
BALL = np.array([[0.02, 0.13, 0.12], [-0.05, 0.09, 0.03]])  # in the tip frame
SPEED = np.array([[0.1, -0.05, 0.08], [-0.04, 0.12, 0.02]])


def ball_in_base(radius=0.045):
    pose = tip_kinematics(Q, QD).pose
    centre = np.einsum("nij,nj->ni", pose[:, :3, :3], BALL) + pose[:, :3, 3]
    return centre, SPEED, radius


def at(t):
    """Clearances along a motion with constant joint accelerations and ball speed."""
    centre, velocity, radius = ball_in_base()
    q, qd = Q + t * QD + 0.5 * t**2 * QDD, QD + t * QDD
    tip = tip_kinematics(q, qd)
    return clearances(tip, centre + t * velocity, velocity, radius), tip


def test_distance_by_hand():
    tip = tip_kinematics(Q[:1], np.zeros((1, 6)))
    rod = Capsules(("rod",), np.array([[0.0, 0.0, 0.1]]), np.array([[0.0, 0.0, 0.3]]), np.array([0.02]))
    for place, point, distance in (
        ((0.1, 0.0, 0.2), (0.0, 0.0, 0.2), 0.1),  # beside the rod
        ((0.0, 0.0, 0.05), (0.0, 0.0, 0.1), 0.05),  # below its end
        ((0.3, 0.0, 0.7), (0.0, 0.0, 0.3), 0.5),  # beyond the other
    ):
        centre = tip.pose[:, :3, :3] @ np.array(place) + tip.pose[:, :3, 3]
        near = clearances(tip, centre, np.zeros((1, 3)), 0.03, rod)
        np.testing.assert_allclose(near.point[0, 0], point, atol=1e-12)
        assert near.distance[0, 0] == pytest.approx(distance - 0.05, abs=1e-12)


def test_jacobian_of_the_control_points_against_finite_differences():
    near, tip = at(0.0)
    jacobian = near.gradient @ tip.jacobian
    centre, _, radius = ball_in_base()
    step, still = 1e-6, np.zeros((2, 3))
    for k in range(6):
        moved = step * np.eye(6)[k]
        ahead, behind = (
            clearances(tip_kinematics(Q + sign * moved, QD), centre, still, radius).distance
            for sign in (1.0, -1.0)
        )
        np.testing.assert_allclose(jacobian[..., k], (ahead - behind) / (2 * step), atol=1e-8)


def test_rate_and_second_derivative_against_finite_differences():
    near, tip = at(0.0)
    step = 1e-4
    ahead, behind = at(step)[0].distance, at(-step)[0].distance
    np.testing.assert_allclose(near.rate, (ahead - behind) / (2 * step), atol=1e-6)
    second = (ahead - 2 * near.distance + behind) / step**2
    twist_rate = np.einsum("nij,nj->ni", tip.jacobian, QDD) + tip.drift
    got = np.einsum("nki,ni->nk", near.gradient, twist_rate) + near.drift
    np.testing.assert_allclose(got, second, atol=1e-4)
    # The case is one in which what is left out would show.
    assert np.abs(near.drift).max() > 0.05


def test_the_capsules_hold_the_gun():
    """Every collision geom of gun, wrist 3 and wrist 2 lies within them: the simulator's own distances."""
    scene = cached_scene(catalogue.get("flat"), load_cell(), 0.045)
    model = scene.model
    data = mujoco.MjData(model)
    data.qpos[:] = Q[0]
    tip = tip_kinematics(Q[:1], np.zeros((1, 6)))
    names = [model.geom(g).name for g in range(model.ngeom)]
    own = [g for g, n in enumerate(names) if n.startswith(GUN_PREFIX + "col_")]
    own += [names.index("col_wrist_2"), names.index("col_wrist_3")]
    ball, rng = names.index("obstacle"), np.random.default_rng(0)
    excess = []
    for _ in range(300):
        place = rng.uniform((-0.15, -0.2, -0.05), (0.15, 0.2, 0.42))
        data.mocap_pos[1] = tip.pose[0, :3, :3] @ place + tip.pose[0, :3, 3]
        mujoco.mj_forward(model, data)
        true = min(mujoco.mj_geomDistance(model, data, g, ball, 1.0, None) for g in own)
        got = clearances(tip, data.mocap_pos[1:2], np.zeros((1, 3)), 0.045).distance.min()
        if true > 0.0:
            excess.append(true - got)
    assert len(excess) > 100
    assert min(excess) > -2e-4  # never told more room than there is
    assert np.median(excess) < 5e-3 and max(excess) < 0.025


def test_nothing_beyond_the_margin():
    tip = tip_kinematics(Q, QD)
    far, _, radius = ball_in_base()
    near = clearances(tip, far + np.array([0.0, 0.0, 0.5]), SPEED, radius)
    leaf = let_pass(tip, near)
    assert not leaf.metric.any()
    other = joint_limits(Q, QD, JOINT_LOWER + 2.5, -JOINT_LOWER)
    assert np.abs(pullback(other).force).max() > 0.0
    for a, b in zip(gather([other, leaf]), gather([other]), strict=True):
        np.testing.assert_array_equal(a, b)


def ahead_of_camera(gap, speed):
    """A gun that travels along y towards a ball ahead of its front camera."""
    still = tip_kinematics(Q[:1], np.zeros((1, 6)))
    qd = np.linalg.solve(still.jacobian[0], [0.0, speed, 0.0, 0.0, 0.0, 0.0])
    tip = tip_kinematics(Q[:1], qd[None])
    y = SEALING_GUN.end[2, 1] + SEALING_GUN.radius[2] + gap + 0.045
    place = np.array([0.0, y, SEALING_GUN.end[2, 2]])
    centre = tip.pose[:, :3, :3] @ place + tip.pose[:, :3, 3]
    return tip, clearances(tip, centre, np.zeros((1, 3)), 0.045)


def test_it_bounds_the_speed_along_the_seam_and_nothing_else():
    cfg = LetPassCfg(margin=0.03, room=0.01, closing_s=1.0, gain_s=8.0, weight=100.0, excess_m_s=0.002)
    tip, near = ahead_of_camera(0.012, 0.01)
    assert near.distance.argmin() == 2 and near.distance.min() == pytest.approx(0.012, abs=1e-9)
    assert allowed_speed(near, cfg)[0, 2] == pytest.approx(0.002, abs=1e-9)  # 2 mm of room, 1 / s
    leaf = let_pass(tip, near, cfg)
    assert leaf.accel[0, 2] == pytest.approx(-8.0 * 0.008, abs=1e-6)
    assert leaf.metric[0, 2, 2] == pytest.approx(100.0 * (1 - 12 / 30) ** 2, rel=1e-6)
    weights = np.diag(leaf.metric[0])
    assert not weights[7:].any()  # no push: there is room
    np.testing.assert_array_equal(leaf.jacobian[0, 2], tip.jacobian[0, 1])
    slow, near = ahead_of_camera(0.012, 0.001)
    assert not let_pass(slow, near, cfg).metric.any()


def test_it_pushes_off_what_is_too_near():
    cfg = LetPassCfg(away=ObstacleCfg(margin=0.008), retreat_m_s=0.002)
    tip, near = ahead_of_camera(0.004, 0.0)
    leaf = let_pass(tip, near, cfg)
    row = 7 + 2
    assert leaf.metric[0, row, row] == pytest.approx(100.0 * 0.25, rel=1e-6)
    assert leaf.accel[0, row] == pytest.approx(12.0**2 * 0.004, rel=1e-6)
    assert leaf.accel[0, 2] == pytest.approx(-8.0 * 0.002, abs=1e-6)  # and back along the seam, slowly


@pytest.mark.parametrize("wrong", [{"margin": 0.005}, {"room": 0.001}, {"gain_s": 0.0}])
def test_wrong_gains_are_refused(wrong):
    with pytest.raises(ConfigError, match="LetPassCfg"):
        LetPassCfg(**wrong)
