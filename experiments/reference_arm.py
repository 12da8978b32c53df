"""Pinocchio's UR5 with the gun's tip: forward and inverse kinematics that share no line with ours."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from seal_gym.core.errors import ConfigError
from seal_gym.core.frames import Array
from seal_gym.core.kinematics import T_TOOL0_TIP

_URDF = "share/example-robot-data/robots/ur_description/urdf/ur5_robot.urdf"
_T_BASE_URDF = np.diag([-1.0, -1.0, 1.0, 1.0])  # the URDF's base_link is turned by pi about z
# Of the loop in pinocchio's example "inverse kinematics (clik)".
_GAIN, _DAMPING, _ITERATIONS = 0.1, 1e-12, 1000


class Loop(NamedTuple):
    """What came of closed-loop inverse kinematics.

    Attributes:
        q: Shape (6,), rad; NaN if it did not get there.
        iterations: In all.
    """

    q: Array
    iterations: int


class ReferenceArm:
    """The model of example-robot-data."""

    def __init__(self) -> None:
        """Reads the model.

        Raises:
            ConfigError: If pinocchio is not installed.
        """
        try:
            import pinocchio
        except ImportError as error:
            raise ConfigError(
                "the reference arm needs pinocchio: pip install pin example-robot-data"
            ) from error
        self._pin: Any = pinocchio
        self._model = pinocchio.buildModelFromUrdf(str(Path(pinocchio.__file__).parents[4] / _URDF))
        self._data, self._frame = self._model.createData(), self._model.getFrameId("tool0")

    def tip(self, q: Array) -> Array:
        """Forward kinematics.

        Args:
            q: Shape (N, 6), rad.

        Returns:
            ``T_base_tip``, shape (N, 4, 4), m.
        """
        poses = np.empty((len(q), 4, 4))
        for posture, pose in zip(q, poses, strict=True):
            self._pin.framesForwardKinematics(self._model, self._data, posture)
            pose[:] = self._data.oMf[self._frame].homogeneous
        return np.asarray(_T_BASE_URDF @ poses @ T_TOOL0_TIP)

    def loop(self, pose_tip: Array, start_q: Array, tolerance: float) -> Loop:
        """The loop of pinocchio's example: a tenth of a damped Newton step at a time.

        Args:
            pose_tip: ``T_base_tip``, shape (4, 4), m.
            start_q: Shape (6,), rad.
            tolerance: Of the pose's logarithm, m and rad alike.

        Returns:
            A posture, not kept within the limits.
        """
        pin, model, data = self._pin, self._model, self._data
        target = pin.SE3(np.linalg.inv(_T_BASE_URDF) @ pose_tip @ np.linalg.inv(T_TOOL0_TIP))
        q = start_q.copy()
        for iteration in range(_ITERATIONS):
            pin.framesForwardKinematics(model, data, q)
            left = data.oMf[self._frame].actInv(target)
            error = pin.log(left).vector
            if np.linalg.norm(error) < tolerance:
                return Loop(q, iteration)
            jacobian = pin.computeFrameJacobian(model, data, q, self._frame)
            jacobian = -pin.Jlog6(left.inverse()) @ jacobian
            system = jacobian @ jacobian.T + _DAMPING * np.eye(6)
            q = pin.integrate(model, q, -_GAIN * jacobian.T @ np.linalg.solve(system, error))
        return Loop(np.full(6, np.nan), _ITERATIONS)
