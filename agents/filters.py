"""Safety filters for policies that command the tip's acceleration: direct control's answer to a leaf.

They know what the obstacle leaf knows: the same clearances of the same capsules, the ball's motion included.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from agents import Policy
from seal_gym.core.cell import LimitsCfg
from seal_gym.core.errors import ConfigError, require
from seal_gym.core.frames import Array
from seal_gym.envs.core import SealCore
from seal_gym.rmp import Clearances, LetPassCfg, allowed_speed, clearances
from seal_gym.rmp.leaves import TWIST, Y

_SWEEPS = 2000  # at most: without rows in force one is enough, nearly parallel ones take hundreds
_SETTLED = 1e-9  # change of an acceleration in a sweep


@dataclass(frozen=True, kw_only=True)
class CbfCfg:
    """A control barrier function on each clearance, of relative degree two.

    Attributes:
        room_m: Clearance that it keeps [m].
        omega_n: Both poles of ``h'' + 2 omega h' + omega^2 h >= 0`` [rad/s].
        cross_cost: Price of changing the acceleration across the seam, relative to along it; a radian counts
            as 0.1 m. Dear, so that the gun brakes rather than leave the seam.
    """

    room_m: float = 0.010
    omega_n: float = 12.0
    cross_cost: float = 100.0

    def __post_init__(self) -> None:
        """Checks the ranges."""
        _positive(self, "room_m", "omega_n", "cross_cost")


def _positive(cfg: object, *names: str) -> None:
    for name in names:
        value = getattr(cfg, name)
        require(0.0 < value < np.inf, f"{type(cfg).__name__}.{name} is {value}: must be positive and finite")


class Filter(Protocol):
    """Corrects tip accelerations."""

    def __call__(self, accel: Array, twist: Array, near: Clearances) -> Array:
        """The accelerations to command instead.

        Args:
            accel: Wanted, shape (N, 6), m/s^2 and rad/s^2.
            twist: Of the tips, shape (N, 6), m/s and rad/s.
            near: Clearances of N guns.

        Returns:
            Shape (N, 6).
        """


class Brake:
    """Bounds the speed along the seam as the leaf does: a protective stop (ISO/TS 15066) that eases in."""

    def __init__(self, cfg: LetPassCfg | None = None) -> None:
        """Takes the gains.

        Args:
            cfg: Of the leaf; its margin, room and rates.
        """
        self._cfg = cfg or LetPassCfg()

    def __call__(self, accel: Array, twist: Array, near: Clearances) -> Array:
        """See ``Filter``."""
        cfg = self._cfg
        within = near.distance < cfg.margin
        allowed = np.where(within, allowed_speed(near, cfg), np.inf).min(axis=1)
        out = accel.copy()
        out[:, Y] = np.minimum(accel[:, Y], cfg.gain_s * (allowed - twist[:, Y]))
        return out


class Cbf:
    """The least change of the acceleration under which no clearance falls below its barrier.

    An exponential control barrier function (Nguyen and Sreenath 2016, Eq. 19; Ames et al. 2019) for each
    capsule, solved as one quadratic programme: ``min (u - u0)^T W (u - u0)`` so that
    ``G u + drift + 2 omega rate + omega^2 (distance - room) >= 0``.
    """

    def __init__(self, cfg: CbfCfg | None = None) -> None:
        """Takes the gains.

        Args:
            cfg: Room, poles and weights.
        """
        self._cfg = cfg or CbfCfg()
        weight = self._cfg.cross_cost * np.array([1.0, 1.0, 1.0, 0.01, 0.01, 0.01])
        weight[Y] = 1.0
        self._inverse = 1.0 / weight

    def __call__(self, accel: Array, twist: Array, near: Clearances) -> Array:
        """See ``Filter``."""
        del twist
        omega = self._cfg.omega_n
        least = -near.drift - 2.0 * omega * near.rate - omega**2 * (near.distance - self._cfg.room_m)
        return least_change(accel, near.gradient, least, self._inverse)


def least_change(wanted: Array, rows: Array, least: Array, inverse_weight: Array) -> Array:
    """The vector nearest a wanted one with ``rows @ u >= least``, by dual coordinate ascent (Hildreth 1957).

    Args:
        wanted: Shape (N, n).
        rows: Shape (N, K, n), none of them zero.
        least: Shape (N, K).
        inverse_weight: Of the diagonal metric of nearness, shape (n,).

    Returns:
        Shape (N, n); where no vector fulfils all rows, a compromise.
    """
    out = wanted.copy()
    pull = rows * inverse_weight
    curvature = (rows * pull).sum(axis=-1)
    force = np.zeros_like(least)
    for _ in range(_SWEEPS):
        before = out
        for k in range(rows.shape[1]):
            short = (least[:, k] - (rows[:, k] * out).sum(axis=-1)) / curvature[:, k]
            step = np.maximum(short, -force[:, k])
            force[:, k] += step
            out = out + step[:, None] * pull[:, k]
        if np.abs(out - before).max() < _SETTLED:
            break
    return out


class BrakeThenCbf:
    """A ``Brake`` with a ``Cbf`` behind it that keeps less room: the two stages of the leaf."""

    def __init__(self) -> None:
        """Builds both; the barrier acts where the leaf's push begins."""
        self._brake, self._cbf = Brake(), Cbf(CbfCfg(room_m=LetPassCfg().away.margin))

    def __call__(self, accel: Array, twist: Array, near: Clearances) -> Array:
        """See ``Filter``."""
        return self._cbf(self._brake(accel, twist, near), twist, near)


FILTERS: dict[str, Callable[[], Filter]] = {"brake": Brake, "cbf": Cbf, "brake_cbf": BrakeThenCbf}
"""What can stand between direct control and the arm."""


class Filtered:
    """A policy of tip accelerations behind a filter, in one environment or N of one core.

    Attributes:
        control: ``"tip"``.
    """

    control = "tip"

    def __init__(self, policy: Policy, core: SealCore, keep_off: Filter) -> None:
        """Puts a filter behind a policy.

        Args:
            policy: With ``control = "tip"``.
            core: The environment's, which knows the obstacle and the tips' motion.
            keep_off: The filter.

        Raises:
            ConfigError: If the policy commands something else.
        """
        if policy.control != self.control:
            raise ConfigError(f"a filter of tip accelerations on control = {policy.control!r}: must be 'tip'")
        limits: LimitsCfg = core.cfg.cell.limits
        self._policy, self._core, self._filter = policy, core, keep_off
        self._scale = np.array([limits.linear_m_s2] * 3 + [limits.angular_rad_s2] * 3)

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], Any]:
        """The policy's actions, filtered.

        Args:
            observation: As the policy takes it.
            state: The policy's.
            episode_start: As the policy takes it.
            deterministic: As the policy takes it.

        Returns:
            Actions of shape (6,) or (N, 6), and the policy's state.
        """
        action, state = self._policy.predict(observation, state, episode_start, deterministic)
        arms = self._core.arm_state()
        ball = arms.obstacle
        if ball is None:
            return action, state
        near = clearances(arms.tip, ball.position, ball.velocity, ball.radius)
        wanted = np.clip(action, -1.0, 1.0).reshape(-1, TWIST).astype(np.float64) * self._scale
        accel = self._filter(wanted, arms.tip.twist, near) / self._scale
        return np.clip(accel, -1.0, 1.0).astype(np.float32).reshape(action.shape), state
