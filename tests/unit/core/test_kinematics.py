"""The closed-form tip kinematics against pinocchio's UR5 and against finite differences."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from seal_gym.core import kinematics
from seal_gym.core.frames import transform
from seal_gym.core.kinematics import JOINT_LOWER, JOINT_SPEED, JOINT_UPPER, TipKinematics, tip_kinematics

N = 200
URDF = "share/example-robot-data/robots/ur_description/urdf/ur5_robot.urdf"
# Written out again, so that a slip in the module shows: the mouth 250 mm out on the flange's z, z back.
T_TOOL0_TIP = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.25], [0, 0, 0, 1]])
# The URDF's base_link is turned by pi about z against the DH base frame.
T_BASE_URDF = np.diag([-1.0, -1.0, 1.0, 1.0])


@pytest.fixture(scope="module")
def states():
    rng = np.random.default_rng(8)
    return rng.uniform(JOINT_LOWER, JOINT_UPPER, (N, 6)), rng.uniform(-JOINT_SPEED, JOINT_SPEED, (N, 6))


def random_tool():
    rng = np.random.default_rng(9)
    return transform(Rotation.random(rng=rng).as_matrix(), rng.uniform(-0.3, 0.3, 3))


@pytest.fixture(scope="module")
def pinocchio():
    return pytest.importorskip("pinocchio", reason="the reference UR5 needs pin and example-robot-data")


@pytest.fixture(scope="module")
def urdf_arm(pinocchio):
    return pinocchio.buildModelFromUrdf(str(Path(pinocchio.__file__).parents[4] / URDF))


def reference(pinocchio, arm, tool, q, qd):
    """The same quantities from pinocchio, one state at a time."""
    arm = pinocchio.Model(arm)
    flange = arm.frames[arm.getFrameId("tool0")]
    placement = flange.placement * pinocchio.SE3(tool)
    tip = arm.addFrame(pinocchio.Frame("tip", flange.parentJoint, placement, pinocchio.FrameType.OP_FRAME))
    data, local = arm.createData(), pinocchio.ReferenceFrame.LOCAL
    rows = []
    for angles, rates in zip(q, qd, strict=True):
        pinocchio.computeJointJacobiansTimeVariation(arm, data, angles, rates)
        pinocchio.updateFramePlacements(arm, data)
        jacobian = pinocchio.getFrameJacobian(arm, data, tip, local)
        rate = pinocchio.getFrameJacobianTimeVariation(arm, data, tip, local)
        twist = pinocchio.getFrameVelocity(arm, data, tip, local).vector
        rows.append((T_BASE_URDF @ data.oMf[tip].homogeneous, jacobian, rate @ rates, twist))
    return TipKinematics(*map(np.stack, zip(*rows, strict=True)))


@pytest.mark.parametrize("field", TipKinematics._fields)
@pytest.mark.parametrize("tool", ["nozzle", "other"])
def test_equal_to_pinocchio(pinocchio, urdf_arm, states, tool, field):
    other = random_tool()
    expected = reference(pinocchio, urdf_arm, T_TOOL0_TIP if tool == "nozzle" else other, *states)
    ours = tip_kinematics(*states) if tool == "nozzle" else tip_kinematics(*states, other)
    np.testing.assert_allclose(getattr(ours, field), getattr(expected, field), rtol=0, atol=1e-9)


def test_limits_are_the_published_ones(urdf_arm):
    np.testing.assert_allclose(kinematics.JOINT_LOWER, urdf_arm.lowerPositionLimit, rtol=0, atol=1e-6)
    np.testing.assert_allclose(kinematics.JOINT_UPPER, urdf_arm.upperPositionLimit, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(kinematics.JOINT_SPEED, urdf_arm.velocityLimit)
    np.testing.assert_array_equal(kinematics.JOINT_TORQUE, urdf_arm.effortLimit)


def test_twist_is_the_rate_of_the_pose(states):
    q, qd = states
    h = 1e-6
    here = tip_kinematics(q, qd)
    after, before = tip_kinematics(q + h * qd, qd).pose, tip_kinematics(q - h * qd, qd).pose
    # In the tip frame, T^-1 dT/dt is the twist: its last column the velocity, its rest the angular one.
    rate = np.linalg.inv(here.pose) @ (after - before) / (2 * h)
    angular = np.stack((rate[:, 2, 1], rate[:, 0, 2], rate[:, 1, 0]), axis=-1)
    np.testing.assert_allclose(here.twist, np.hstack((rate[:, :3, 3], angular)), rtol=0, atol=1e-7)


def test_jacobian_maps_joint_speeds_to_the_twist(states):
    q, qd = states
    for joint, rates in enumerate(np.eye(6)):
        one = tip_kinematics(q, np.tile(rates, (N, 1)))
        np.testing.assert_allclose(one.jacobian[:, :, joint], one.twist, rtol=0, atol=1e-13)
    here = tip_kinematics(q, qd)
    np.testing.assert_allclose((here.jacobian @ qd[:, :, None])[..., 0], here.twist, rtol=0, atol=1e-13)


def test_drift_is_the_acceleration_at_constant_joint_speeds(states):
    q, qd = states
    h = 1e-5
    rate = (tip_kinematics(q + h * qd, qd).twist - tip_kinematics(q - h * qd, qd).twist) / (2 * h)
    drift = tip_kinematics(q, qd).drift
    np.testing.assert_allclose(drift, rate, rtol=0, atol=1e-6)
    assert np.abs(drift).max() > 1.0


def test_twist_rate_along_an_accelerated_motion(states):
    q, qd = states
    qdd = np.random.default_rng(10).uniform(-10, 10, q.shape)
    h = 1e-5
    ahead, behind = (tip_kinematics(q + t * qd + 0.5 * t * t * qdd, qd + t * qdd).twist for t in (h, -h))
    here = tip_kinematics(q, qd)
    predicted = (here.jacobian @ qdd[:, :, None])[..., 0] + here.drift
    np.testing.assert_allclose(predicted, (ahead - behind) / (2 * h), rtol=0, atol=1e-6)


def test_at_rest_there_is_no_drift_and_no_twist(states):
    still = tip_kinematics(states[0], np.zeros((N, 6)))
    assert not still.drift.any()
    assert not still.twist.any()


def test_a_batch_equals_its_members_to_the_bit(states):
    q, qd = states
    batch = tip_kinematics(q, qd)
    for i in range(N):
        single = tip_kinematics(q[i : i + 1], qd[i : i + 1])
        for name in TipKinematics._fields:
            np.testing.assert_array_equal(getattr(single, name)[0], getattr(batch, name)[i])


def test_an_empty_batch_has_empty_results():
    none = tip_kinematics(np.empty((0, 6)), np.empty((0, 6)))
    assert [x.shape for x in none] == [(0, 4, 4), (0, 6, 6), (0, 6), (0, 6)]
