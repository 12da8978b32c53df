"""The batched arms: servo, limits, contacts, independence of the rows."""

import mujoco
import numpy as np
import pytest

from seal_gym.core.cell import load_cell
from seal_gym.core.frames import yaw_pose
from seal_gym.core.kinematics import JOINT_SPEED, JOINT_TORQUE, JOINT_UPPER, tip_kinematics
from seal_gym.sim.arm import ArmBatch
from seal_gym.sim.scene import cached_scene
from seal_gym.workpieces import catalogue

CELL = load_cell()
SCENE = cached_scene(catalogue.get("rectangular"), CELL)
START = np.deg2rad([-26, -106.8, -116.9, -70, 129.5, -34.6])
DT = CELL.timing.frame_s


def arms(n=1, threads=1):
    batch = ArmBatch(SCENE, n, threads)
    for i in range(n):
        batch.reset(i, START, SCENE.workpiece.pose)
    return batch


def test_gravity_is_compensated():
    batch = arms()
    for _ in range(60):
        assert not batch.step(np.zeros((1, 6))).any()
    np.testing.assert_allclose(batch.q[0], START, atol=1e-6)


def test_the_servo_follows_an_accelerated_motion():
    batch, rng = arms(), np.random.default_rng(0)
    phase = rng.uniform(0, 2 * np.pi, 6)
    q, qd = START.copy(), np.zeros(6)
    for k in range(90):
        qdd = 0.5 * np.sin(2 * np.pi * 0.5 * k * DT + phase)
        q, qd = q + qd * DT + 0.5 * qdd * DT**2, qd + qdd * DT
        batch.step(qdd[None])
        np.testing.assert_allclose(batch.q_command[0], q, atol=1e-12)
        assert np.abs(batch.q[0] - q).max() < 2e-4
    np.testing.assert_allclose(batch.qd[0], qd, atol=2e-2)


def test_speed_and_torque_stay_within_the_published_limits():
    batch = arms()
    qdd = np.array([[40.0, 0, 0, 0, 0, 40.0]])
    for _ in range(30):
        batch.step(qdd)
        assert np.all(np.abs(batch.qd_command[0]) <= JOINT_SPEED)
        # Gravity compensation included: the model counts it as the actuators' work.
        assert np.all(np.abs(batch.data(0).qfrc_actuator) <= JOINT_TORQUE + 1e-9)
    assert batch.qd_command[0, 5] == JOINT_SPEED[5]


def test_a_joint_at_its_limit_stops_there():
    batch = arms()
    start = START.copy()
    start[5] = JOINT_UPPER[5] - 0.01
    batch.reset(0, start, SCENE.workpiece.pose)
    for _ in range(30):
        batch.step(np.array([[0, 0, 0, 0, 0, 20.0]]))
    assert batch.q_command[0, 5] == JOINT_UPPER[5]
    assert batch.qd_command[0, 5] == 0.0
    assert batch.q[0, 5] <= JOINT_UPPER[5] + 1e-3


def test_a_contact_is_reported_with_names():
    batch = arms()
    # Straight down: the tip is about 2.2 mm above the plate.
    for _ in range(40):
        kin = tip_kinematics(batch.q_command, batch.qd_command)
        down = np.zeros(6)
        down[:3] = kin.pose[0, :3, :3].T @ [0.0, 0.0, -0.05]
        qdd = np.linalg.solve(kin.jacobian[0], down - kin.drift[0])
        if batch.step(qdd[None])[0]:
            break
    else:
        pytest.fail("the nozzle went through the plate")
    pairs = batch.contacts(0)
    assert any("gun/col_nozzle" in pair for pair in pairs)
    mouth = tip_kinematics(batch.q, batch.qd).pose[0, 2, 3]
    assert abs(mouth - SCENE.workpiece.pose[2, 3]) < 3e-3


def test_the_part_goes_where_it_is_put():
    batch = arms(2)
    pose = yaw_pose(0.4, 0.1, -0.05, 0.3)
    batch.reset(1, START + 0.6 * np.eye(6)[0], pose)
    for i, expected in ((0, SCENE.workpiece.pose), (1, pose)):
        body = batch.data(i).body("part")
        np.testing.assert_allclose(body.xpos, expected[:3, 3], atol=1e-12)
        np.testing.assert_allclose(body.xmat.reshape(3, 3), expected[:3, :3], atol=1e-12)


def test_rows_do_not_depend_on_their_number_or_on_threads():
    rng = np.random.default_rng(2)
    accelerations = rng.normal(size=(20, 5, 6))
    alone = [arms() for _ in range(5)]
    together = [arms(5, threads) for threads in (1, 2)]
    for qdd in accelerations:
        for batch in together:
            batch.step(qdd)
        for i, single in enumerate(alone):
            single.step(qdd[i : i + 1])
    for batch in together:
        np.testing.assert_array_equal(batch.q, np.concatenate([single.q for single in alone]))


def test_it_is_mujocos_own_step():
    batch = arms()
    model, data = SCENE.model, mujoco.MjData(SCENE.model)
    data.qpos[:] = START
    data.mocap_pos[0] = SCENE.workpiece.pose[:3, 3]
    qdd, lead = np.full(6, 0.3), np.array([0.04, 0.04, 0.04, 0.03, 0.03, 0.03])
    batch.step(qdd[None])
    for k in range(1, CELL.timing.substeps + 1):
        start, end = (k - 1) * CELL.timing.step_s, k * CELL.timing.step_s
        data.ctrl[:] = START + 0.5 * qdd * start**2 + lead * qdd * end
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(batch.q[0], data.qpos, atol=1e-12)


def test_a_command_waits_for_an_arm_without_the_torque_for_it():
    """All joints full ahead and back, beyond the motors: the command stays within the servos' pull."""
    model = cached_scene(catalogue.get("flat"), CELL).model
    kp, kv = model.actuator_gainprm[:, 0], -model.actuator_biasprm[:, 2]
    batch, rng = arms(), np.random.default_rng(0)
    furthest = 0.0
    for k in range(60):
        if k % 6 == 0:
            qdd = rng.choice([-30.0, 30.0], (1, 6))
        before, speed = batch.q.copy(), np.abs(batch.qd[0]) + JOINT_TORQUE / kv
        batch.step(qdd)
        # From within the pull of where the arm was, one frame on at no more than its speed or the limit.
        lead = np.abs(batch.q_command - before)[0] - JOINT_TORQUE / kp
        assert np.all(lead <= np.maximum(speed, JOINT_SPEED) * DT + 1e-9)
        furthest = max(furthest, np.abs(batch.q_command - batch.q).max())
    assert furthest > 1e-3  # the motion was indeed too much for it
