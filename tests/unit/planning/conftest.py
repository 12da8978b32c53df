"""The reference UR5: pinocchio's."""

from pathlib import Path

import numpy as np
import pytest

from seal_gym.core.kinematics import JOINT_LOWER, JOINT_UPPER, T_TOOL0_TIP

URDF = "share/example-robot-data/robots/ur_description/urdf/ur5_robot.urdf"
T_BASE_URDF = np.diag([-1.0, -1.0, 1.0, 1.0])  # the URDF's base_link is turned by pi about z
N = 10_000


class ReferenceArm:
    """Forward kinematics that share no line with ours."""

    def __init__(self, pinocchio):
        self._pinocchio = pinocchio
        self._model = pinocchio.buildModelFromUrdf(str(Path(pinocchio.__file__).parents[4] / URDF))
        self._data, self._frame = self._model.createData(), self._model.getFrameId("tool0")

    def tip(self, q):
        poses = np.empty((len(q), 4, 4))
        for posture, pose in zip(q, poses, strict=True):
            self._pinocchio.framesForwardKinematics(self._model, self._data, posture)
            pose[:] = self._data.oMf[self._frame].homogeneous
        return T_BASE_URDF @ poses @ T_TOOL0_TIP


@pytest.fixture(scope="session")
def reference_arm():
    return ReferenceArm(
        pytest.importorskip("pinocchio", reason="the reference UR5 needs pin and example-robot-data")
    )


@pytest.fixture(scope="session")
def reachable(reference_arm):
    """Postures drawn over the joints' whole range, and their poses by the reference. (N, 6), (N, 4, 4)."""
    q = np.random.default_rng(500_000).uniform(JOINT_LOWER, JOINT_UPPER, (N, 6))
    return q, reference_arm.tip(q)
