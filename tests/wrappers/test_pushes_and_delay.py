"""Pushes against the servos' joint-space compliance; delayed actions against shifted ones."""

import numpy as np
import pytest

from seal_gym.core.cell import load_cell
from seal_gym.core.errors import ConfigError
from seal_gym.core.kinematics import tip_kinematics
from seal_gym.sim.arm import ArmBatch, Outside
from seal_gym.sim.scene import cached_scene
from seal_gym.workpieces import catalogue
from seal_gym.wrappers.actuation_delay import ActuationDelayCfg, Delay
from seal_gym.wrappers.external_push import BODIES, ExternalPushCfg, Pushes

CELL = load_cell()
SCENE = cached_scene(catalogue.get("flat"), CELL)
START = np.deg2rad([-4, -117.8, -94.7, -102.4, 87.2, -92.8])
STEPS = CELL.timing.substeps


@pytest.mark.parametrize("body", BODIES)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_steady_push_moves_the_tip_by_the_servos_compliance(body, axis):
    """dq = K^-1 J_body^T F with the actuators' stiffness, dx = J_tip dq; MuJoCo's Jacobian of the body."""
    import mujoco

    arm = ArmBatch(SCENE, 1)
    arm.reset(0, START, SCENE.workpiece.pose)
    force = np.zeros(3)
    force[axis] = 10.0
    data = arm.data(0)
    jacobian = np.zeros((3, 6))
    body_id = SCENE.model.body(BODIES[body]).id
    mujoco.mj_jacBodyCom(SCENE.model, data, jacobian, None, body_id)
    bent = jacobian.T @ force / SCENE.model.actuator_gainprm[:, 0]
    before = data.site("gun/tip").xpos.copy()
    push = Outside(force=np.tile(force, (1, STEPS, 1)), pushed=BODIES[body])
    for _ in range(60):
        arm.step(np.zeros((1, 6)), push)
    np.testing.assert_allclose(arm.q[0] - START, bent, atol=2e-2 * np.abs(bent).max())
    tip = tip_kinematics(START[None], np.zeros((1, 6)))
    expected = tip.pose[0, :3, :3] @ (tip.jacobian[0] @ bent)[:3]
    moved = arm.data(0).site("gun/tip").xpos - before
    np.testing.assert_allclose(moved, expected, atol=3e-2 * np.linalg.norm(expected) + 1e-6)
    assert 1e-5 < np.linalg.norm(moved) < 2e-3
    for _ in range(60):
        arm.step(np.zeros((1, 6)))
    np.testing.assert_allclose(arm.data(0).site("gun/tip").xpos, before, atol=1e-5)


def test_pushes_are_half_sines_of_the_stated_force_and_length():
    cfg = ExternalPushCfg(severity=2.0, force_n=10.0, duration_s=0.4, pause_s=2.0)
    dt = 1 / 240
    t = np.arange(0.0, 60.0, dt)
    for seed in range(5):
        pushes = Pushes(1, cfg)
        pushes.reset(0, np.random.default_rng(seed))
        size = np.linalg.norm(pushes.at(t[None])[0], axis=1)
        on = size > 0
        edges = np.flatnonzero(np.diff(on.astype(int)))
        starts, ends = edges[0::2], edges[1::2]
        assert not on[0] and len(starts) > 15
        lengths = (ends - starts[: len(ends)]) * dt
        np.testing.assert_allclose(lengths, 0.4, atol=2 * dt)
        pauses = (starts[1:] - ends[: len(starts) - 1]) * dt
        assert pauses.min() > 1.0 - 2 * dt and pauses.max() < 3.0 + 2 * dt
        assert size.max() == pytest.approx(20.0, rel=1e-3)
        impulse = size[starts[0] : ends[0] + 1].sum() * dt
        assert impulse == pytest.approx(20.0 * 0.4 * 2 / np.pi, rel=0.02)


def test_pushes_come_in_all_directions():
    pushes = Pushes(1, ExternalPushCfg())
    peaks = []
    for seed in range(40):
        pushes.reset(0, np.random.default_rng(seed))
        peaks.append(pushes._peak[0].copy())
    unit = np.concatenate(peaks) / 10.0
    np.testing.assert_allclose(np.linalg.norm(unit, axis=1), 1.0, atol=1e-12)
    assert np.abs(unit.mean(axis=0)).max() < 0.05
    np.testing.assert_allclose(unit.T @ unit / len(unit), np.eye(3) / 3, atol=0.03)


def test_a_push_in_an_episode_displaces_the_gun(make):
    bare, env = make(), make(disturbances=[{"name": "ExternalPush", "severity": 2.0, "pause_s": 0.5}])
    tips = []
    for e in (bare, env):
        e.reset(seed=1)
        core = e.unwrapped.core
        tips.append([])
        for _ in range(45):
            e.step(np.zeros(6, np.float32))
            tips[-1].append(core.arm.data(0).site("gun/tip").xpos.copy())
    off = 1e3 * np.linalg.norm(np.subtract(*tips), axis=1)
    assert off[:5].max() == 0.0 and 0.1 < off.max() < 3.0


# -- delay --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("control", ["tip", "rmp", "joint"])
@pytest.mark.parametrize("late", [1, 3])
def test_a_delay_of_whole_frames_is_a_shift_of_the_actions(make, control, late):
    """To the bit in the physics; the reward sees the policy's own actions."""
    delayed = make(control=control, disturbances=[{"name": "ActuationDelay", "severity": late}])
    bare = make(control=control)
    size = bare.action_space.shape
    actions = (0.1 * np.random.default_rng(0).uniform(-1, 1, (12, *size))).astype(np.float32)
    shifted = np.concatenate((np.zeros((late, *size), np.float32), actions[:-late]))
    a, b = delayed.reset(seed=7)[0], bare.reset(seed=7)[0]
    for mine, theirs in zip(actions, shifted, strict=True):
        np.testing.assert_array_equal(a, b)
        a, b = delayed.step(mine)[0], bare.step(theirs)[0]
    np.testing.assert_array_equal(delayed.unwrapped.core.arm.q_command, bare.unwrapped.core.arm.q_command)


def test_half_a_frame_is_the_mean_of_two_actions():
    delay = Delay(2, 3, ActuationDelayCfg(frames=1.25))
    actions = np.random.default_rng(0).normal(size=(6, 2, 3))
    out = [delay(a) for a in actions]
    for k in range(2, 6):
        np.testing.assert_allclose(out[k], 0.75 * actions[k - 1] + 0.25 * actions[k - 2], atol=1e-15)
    np.testing.assert_array_equal(out[0], 0.0)
    delay.reset(1)
    after = delay(actions[0])
    np.testing.assert_allclose(after[0], 0.75 * actions[5, 0] + 0.25 * actions[4, 0], atol=1e-15)
    np.testing.assert_array_equal(after[1], 0.0)


@pytest.mark.parametrize(
    ("kind", "wrong"),
    [
        (ExternalPushCfg, {"on": "table"}),
        (ExternalPushCfg, {"force_n": -1.0}),
        (ExternalPushCfg, {"duration_s": 0.0}),
        (ExternalPushCfg, {"pause_s": 0.0}),
        (ActuationDelayCfg, {"frames": -1}),
    ],
)
def test_values_out_of_range_are_refused(kind, wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        kind(**wrong)
