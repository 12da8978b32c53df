"""Inverse kinematics by linearisation, as Carvajal and Martinez-Garcia, Eqs. 35-38, damped and within limits.

The paper truncates the Taylor series of the forward kinematics after its linear term and solves
``J Phi_{t+1} = zeta``. Eqs. 36-37 leave the target out of zeta; with it, ``zeta = (p_d - p_t) + J Phi_t``,
this is Newton's method, ``J (Phi_{t+1} - Phi_t) = p_d - p_t``. Here the step is damped near singularities,
``J^T (J J^T + lambda^2 I)^-1 e`` with lambda^2 in proportion to the squared error (after T. Sugihara,
"Solvability-unconcerned inverse kinematics by the Levenberg-Marquardt method", 2011), so that the last steps
are Newton's.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import is_number, require
from seal_gym.core.frames import Array
from seal_gym.core.kinematics import JOINT_LOWER, JOINT_UPPER, T_TOOL0_TIP, tip_kinematics
from seal_gym.planning.ik import within
from seal_gym.planning.tau_jerk_pose import rotation_vector

_MIN_DAMPING = 1e-12  # keeps the system solvable at a singularity that is the goal


class Linearised(NamedTuple):
    """Forward kinematics about some postures.

    Attributes:
        error: What is left to the target, to first order ``jacobian @ (q_target - q)``: three lengths [m] and
            three angles [rad], shape (N, 6).
        jacobian: Shape (N, 6, d).
    """

    error: Array
    jacobian: Array


Model = Callable[[Array, Array], Linearised]
"""Of postures (N, d) and targets (N, ...)."""


@dataclass(frozen=True, kw_only=True)
class NewtonCfg:
    """When the iteration ends and how it is damped."""

    position_m: float = 1e-8
    """Largest distance of a solution to its target [m]."""
    rotation_rad: float = 1e-8
    """Largest angle of a solution to its target [rad]."""
    iterations: int = 20
    """From one posture."""
    restarts: int = 50
    """From random postures, where the given one does not lead to the target."""
    damping: float = 0.1
    """lambda^2 over the squared error, metres and radians alike."""
    step_rad: float = 1.0
    """Largest change of a joint in an iteration: beyond, the linearisation says nothing."""

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for name in ("position_m", "rotation_rad", "step_rad", "damping"):
            value = getattr(self, name)
            require(is_number(value) and value > 0.0, f"NewtonCfg.{name} = {value!r}: must be positive")
        for name, least in (("iterations", 1), ("restarts", 0)):
            value = getattr(self, name)
            require(
                isinstance(value, int) and value >= least,
                f"NewtonCfg.{name} = {value!r}: must be a whole number, at least {least}",
            )


class NewtonSolution(NamedTuple):
    """What came of the iteration.

    Attributes:
        q: Within the limits, shape (N, d), rad; NaN where no posture was found.
        iterations: In all, shape (N,).
        restarts: Shape (N,).
    """

    q: Array
    iterations: NDArray[np.int64]
    restarts: NDArray[np.int64]


def ur5_tip(q: Array, pose_tip: Array, tool: Array = T_TOOL0_TIP) -> Linearised:
    """The UR5's tip about some postures, with its body Jacobian.

    Args:
        q: Shape (N, 6), rad.
        pose_tip: Targets ``T_base_tip``, shape (N, 4, 4), m.
        tool: ``T_tool0_tip``, shape (4, 4), m.

    Returns:
        Errors resolved in the tip frame.
    """
    here = tip_kinematics(q, np.zeros_like(q), tool)
    back = np.swapaxes(here.pose[:, :3, :3], -1, -2)
    away = back @ (pose_tip[:, :3, 3] - here.pose[:, :3, 3])[..., None]
    turn = rotation_vector(back @ pose_tip[:, :3, :3])
    return Linearised(np.concatenate((away[..., 0], turn), axis=-1), here.jacobian)


def solve(
    target: Array,
    start_q: Array,
    rng: np.random.Generator,
    *,
    model: Model = ur5_tip,
    lower: Array = JOINT_LOWER,
    upper: Array = JOINT_UPPER,
    cfg: NewtonCfg | None = None,
) -> NewtonSolution:
    """Postures that put the tip at its targets.

    Args:
        target: Targets of the model, shape (N, ...).
        start_q: Postures to begin from, shape (N, d) or (d,), rad.
        rng: Draws the postures of restarts; they depend on which targets of the batch need one.
        model: Forward kinematics and Jacobian, by default the UR5's tip with its gun.
        lower: Smallest joint angles, shape (d,), rad.
        upper: Largest joint angles, shape (d,), rad.
        cfg: When the iteration ends and how it is damped.

    Returns:
        Postures, and what they took.

    Raises:
        ConfigError: If a limit is not above the other.
    """
    require(bool(np.all(lower < upper)), f"lower = {lower}, upper = {upper}: must be in this order")
    cfg = cfg or NewtonCfg()
    n, d = len(target), len(lower)
    found = np.full((n, d), np.nan)
    iterations, restarts = np.zeros((2, n), dtype=np.int64)
    left = np.arange(n)
    q = within(np.broadcast_to(start_q, (n, d)), lower, upper)
    for attempt in range(cfg.restarts + 1):
        if attempt:
            restarts[left] += 1
            q = rng.uniform(lower, upper, (len(left), d))
        q, took, there = _descend(model, target[left], q, lower, upper, cfg)
        iterations[left] += took
        found[left[there]] = q[there]
        left = left[~there]
        if not len(left):
            break
    return NewtonSolution(found, iterations, restarts)


def _descend(
    model: Model, target: Array, q: Array, lower: Array, upper: Array, cfg: NewtonCfg
) -> tuple[Array, NDArray[np.int64], NDArray[np.bool_]]:
    """Iterates from one posture for each target; gives postures, iterations and which are there."""
    q = q.copy()
    took = np.zeros(len(q), dtype=np.int64)
    there = np.zeros(len(q), dtype=np.bool_)
    active = np.arange(len(q))
    for step in range(cfg.iterations + 1):
        error, jacobian = model(q[active], target[active])
        done = (np.linalg.norm(error[:, :3], axis=1) <= cfg.position_m) & (
            np.linalg.norm(error[:, 3:], axis=1) <= cfg.rotation_rad
        )
        there[active[done]] = True
        if step == cfg.iterations or done.all():
            break
        active = active[~done]
        change = _step(error[~done], jacobian[~done], cfg)
        q[active] = within(q[active] + change, lower, upper)
        took[active] += 1
    return q, took, there


def _step(error: Array, jacobian: Array, cfg: NewtonCfg) -> Array:
    """Damped Newton step, shape (N, d), rad."""
    transposed = np.swapaxes(jacobian, -1, -2)
    damping = cfg.damping * np.sum(error**2, axis=-1) + _MIN_DAMPING
    system = jacobian @ transposed + damping[:, None, None] * np.eye(error.shape[1])
    change = (transposed @ np.linalg.solve(system, error[..., None]))[..., 0]
    largest = np.abs(change).max(axis=-1, keepdims=True)
    return np.asarray(change * np.minimum(1.0, cfg.step_rad / np.maximum(largest, 1e-300)))
