"""Action adapters: what an action means, as joint accelerations."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.cell import CellCfg, LimitsCfg
from seal_gym.core.errors import ActionError, ConfigError, require
from seal_gym.core.frames import Array
from seal_gym.core.kinematics import JOINT_LOWER, JOINT_UPPER, TipKinematics
from seal_gym.rmp import (
    Leaf,
    SealingCfg,
    SeamErrors,
    TipRmp,
    cholesky_metric,
    fixed_policies,
    joint_limits,
    on_tip,
    reference_twist,
    resolve,
)
from seal_gym.wrappers.moving_obstacle import Obstacle

CONTROLS = ("tip", "rmp", "joint")
# An action entry of 1 is a Cholesky entry of 2, a metric of 4: the expert's weights are at most about 1.
CHOLESKY_SCALE = 2.0
# What ``seal_gym.rmp.fixed_policies`` gives, in its order.
FIXED_POLICIES = ("damping", "regularisation", "lean")


@dataclass(frozen=True, kw_only=True)
class ArmState:
    """What a leaf may depend on, of N simulations.

    Attributes:
        q: Commanded joint angles, shape (N, 6), rad.
        qd: Commanded joint speeds, shape (N, 6), rad/s.
        tip: Kinematics of the commanded motion.
        errors: Where the seam is, by the ROI features.
        seam_twist: Estimated twist of the seam in the tip frame, shape (N, 6), m/s and rad/s.
        tip_accel: Tip acceleration commanded a frame ago, shape (N, 6), m/s^2 and rad/s^2.
        part_pose: ``T_base_part``, shape (N, 4, 4), m: for leaves of the simulation's own (an obstacle's
            pose, say); policies are not told.
        seen: Whether both views show the seam, shape (N,).
        obstacle: Where ``MovingObstacle`` is, if there is one.
    """

    q: Array
    qd: Array
    tip: TipKinematics
    errors: SeamErrors
    seam_twist: Array
    tip_accel: Array
    part_pose: Array
    seen: NDArray[np.bool_]
    obstacle: Obstacle | None = None


class TipState(Protocol):
    """The part of an ``ArmState`` that direct control reads."""

    @property
    def tip(self) -> TipKinematics:
        """Kinematics of the commanded motion."""


LeafFunction = Callable[[ArmState], Leaf]


class Adapter(Protocol):
    """Turns actions into joint accelerations."""

    size: int

    def __call__(self, action: Array, state: ArmState) -> Array:
        """Adapts one frame's actions.

        Args:
            action: In [-1, 1], shape (N, ``size``).
            state: Of the arms.

        Returns:
            Joint accelerations, shape (N, 6), rad/s^2.
        """


def tip_scale(limits: LimitsCfg) -> Array:
    """Tip accelerations that actions of 1 mean.

    Args:
        limits: Of the cell.

    Returns:
        Shape (6,), m/s^2 and rad/s^2.
    """
    return np.array([limits.linear_m_s2] * 3 + [limits.angular_rad_s2] * 3)


class TipAdapter:
    """Direct control: the tip acceleration (d/dt of the body twist) as given, within the limits."""

    size = 6

    def __init__(self, cell: CellCfg) -> None:
        """Takes the limits.

        Args:
            cell: The cell.
        """
        self._scale = tip_scale(cell.limits)
        self._metric = np.eye(6)[None]

    def __call__(self, action: Array, state: TipState) -> Array:
        """See ``Adapter``."""
        metric = np.broadcast_to(self._metric, (len(action), 6, 6))
        leaf = on_tip(action * self._scale, metric, state.tip.jacobian, state.tip.drift)
        return resolve([leaf], state.tip.jacobian)


class RmpAdapter:
    """A policy's (f, A) resolved together with the fixed leaves and the user's.

    Action: 6 entries of f scaled by the tip limits, then the 21 entries of the lower Cholesky factor of A,
    row by row, times ``CHOLESKY_SCALE``. Fixed leaves: damping against the reference twist, regularisation
    towards the last tip acceleration, lean, joint limits (see ``seal_gym.rmp``). Without the seam in view the
    reference is to stand still.

    Attributes:
        leaves: Functions that give one more leaf each; append at any time.
    """

    size = 27

    def __init__(
        self, cell: CellCfg, leaves: tuple[LeafFunction, ...] = (), sealing: SealingCfg | None = None
    ) -> None:
        """Takes the limits and the leaves.

        Args:
            cell: The cell.
            leaves: The user's leaves.
            sealing: Configuration of the fixed leaves.
        """
        self.leaves = list(leaves)
        self._scale = tip_scale(cell.limits)
        self._speed = cell.process.speed_m_s
        self._sealing = sealing or SealingCfg()

    def tip_policies(self, action: Array, state: ArmState) -> dict[str, TipRmp]:
        """The policies on the tip that a call resolves, by name; a look at them changes nothing.

        Args:
            action: In [-1, 1], shape (N, 27).
            state: Of the arms.

        Returns:
            ``policy``, the action's, then the fixed ones: ``damping``, ``regularisation``, ``lean``.
        """
        policy = TipRmp(action[:, :6] * self._scale, cholesky_metric(CHOLESKY_SCALE * action[:, 6:]))
        # Blind, the gun comes to rest.
        speed = np.where(state.seen, self._speed, 0.0)
        reference = reference_twist(speed, state.seam_twist, self._sealing)
        fixed = fixed_policies(state.errors, state.tip.twist, reference, state.tip_accel, self._sealing)
        return {"policy": policy, **dict(zip(FIXED_POLICIES, fixed, strict=True))}

    def __call__(self, action: Array, state: ArmState) -> Array:
        """See ``Adapter``."""
        jacobian, drift = state.tip.jacobian, state.tip.drift
        policies = self.tip_policies(action, state)
        leaves = [on_tip(*policy, jacobian, drift) for policy in policies.values()]
        leaves.append(joint_limits(state.q, state.qd, JOINT_LOWER, JOINT_UPPER))
        leaves += [_checked_leaf(leaf, state) for leaf in self.leaves]
        return resolve(leaves, jacobian)


def _checked_leaf(function: LeafFunction, state: ArmState) -> Leaf:
    """A user's leaf, or a word on what is wrong with it before it reaches the arm."""
    name = getattr(function, "__name__", repr(function))
    leaf = function(state)
    require(
        isinstance(leaf, Leaf), f"leaf {name!r} gave {leaf!r}: must give a seal_gym.rmp.Leaf", ActionError
    )
    for field, values in zip(Leaf._fields, leaf, strict=True):
        require(
            bool(np.isfinite(values).all()),
            f"leaf {name!r} gave a value of {field} that is not finite: give finite numbers, a zero metric "
            "where it has nothing to say",
            ActionError,
        )
    return leaf


def check_leaf_function(leaf: object) -> None:
    """Refuses what cannot be a leaf.

    Args:
        leaf: What the user passed.

    Raises:
        ConfigError: If it cannot be called.
    """
    require(callable(leaf), f"leaf = {leaf!r}: must be a function of an ArmState that gives a Leaf")


class JointAdapter:
    """Raw joint accelerations, within the limits."""

    size = 6

    def __init__(self, cell: CellCfg) -> None:
        """Takes the limit.

        Args:
            cell: The cell.
        """
        self._scale = cell.limits.joint_rad_s2

    def __call__(self, action: Array, state: TipState) -> Array:
        """See ``Adapter``."""
        del state
        return action * self._scale


def make_adapter(
    control: str, cell: CellCfg, leaves: tuple[LeafFunction, ...], sealing: SealingCfg | None = None
) -> Adapter:
    """The adapter of a control mode.

    Args:
        control: ``"tip"``, ``"rmp"`` or ``"joint"``.
        cell: The cell.
        leaves: The user's leaves, for ``"rmp"``.
        sealing: Configuration of the fixed leaves, for ``"rmp"``.

    Returns:
        The adapter.

    Raises:
        ConfigError: If there is no such mode, or leaves come with a mode that does not resolve any.
    """
    if leaves and control != "rmp":
        raise ConfigError(
            f"leaves with control = {control!r}: only control='rmp' resolves leaves; use it or leave them out"
        )
    if control == "tip":
        return TipAdapter(cell)
    if control == "rmp":
        return RmpAdapter(cell, leaves, sealing)
    if control == "joint":
        return JointAdapter(cell)
    raise ConfigError(f"control = {control!r}: must be one of {list(CONTROLS)}")
