"""Tau-Jerk motion: gaps to the goal that close together, as Carvajal and Martinez-Garcia, section III.

A gap is what is left to go. It is coupled to an intrinsic one that a constant jerk closes in the time T, with
ratio k; with n = 1/k and s = t/T it is

    gap(s) = (1 - s^3)^n                    (Eqs. 32-34 with the gap frozen at t = 0)

of what it was at first. The motion starts from rest with a step of the jerk, -6 n gap0 / T^3. At the end
the speed comes to rest for k < 1, the acceleration for k < 1/2 and the jerk for k < 1/3; at k = 1/3 it is
finite there. The paper's k = 0.4 has an unbounded jerk at the end.

Several gaps close at the same moment if they share T. A gap coupled to a tau-Jerk gap with ratio r (Eq. 25,
tau_q = r tau_p) is q = q0 (p/p0)^(1/r) (Eqs. 26-28): again a tau-Jerk gap, with k_q = r k_p.
"""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from seal_gym.core.errors import require
from seal_gym.core.frames import Array

DEFAULT_K = 0.25
"""Within 0.1 % of the least peak acceleration of any k, with a jerk that comes to rest at the goal."""
LARGEST_K = {"speed": 1.0, "acceleration": 0.5, "jerk": 1.0 / 3.0}
"""Largest k for which each is bounded; with k = 1 the speed does not come to rest."""


class Motion(NamedTuple):
    """A motion at some times, in the unit u of what moves (m or rad).

    Attributes:
        position: Shape (..., m, d), u.
        velocity: Shape (..., m, d), u/s.
        acceleration: Shape (..., m, d), u/s^2.
        jerk: Shape (..., m, d), u/s^3.
    """

    position: Array
    velocity: Array
    acceleration: Array
    jerk: Array


class Peaks(NamedTuple):
    """Largest magnitudes on the way of a gap of 1 that closes in 1 s; infinite where unbounded.

    Attributes:
        speed: Shape of k.
        acceleration: Shape of k.
        jerk: Shape of k, both ends included.
    """

    speed: Array
    acceleration: Array
    jerk: Array


@dataclass(frozen=True, kw_only=True)
class RateLimitsCfg:
    """What a motion keeps to, in the unit u of what moves: a number for all axes or one for each.

    ``math.inf`` sets no limit.
    """

    speed: float | tuple[float, ...]
    """[u/s]."""
    acceleration: float | tuple[float, ...]
    """[u/s^2]."""
    jerk: float | tuple[float, ...]
    """[u/s^3]."""

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for name, value in vars(self).items():
            require(
                bool(np.all(np.asarray(value, dtype=np.float64) > 0.0)),
                f"RateLimitsCfg.{name} = {value!r}: must be positive, math.inf for no limit",
            )

    def scaled(self, share: float) -> Self:
        """The limits of the same motion slowed down, a share of each.

        Args:
            share: In (0, 1].

        Returns:
            The limits.

        Raises:
            ConfigError: If the share is out of range.
        """
        require(0.0 < share <= 1.0, f"share = {share!r}: must be in (0, 1]")
        return type(self)(
            **{
                name: tuple(share * v for v in value) if isinstance(value, tuple) else share * value
                for name, value in vars(self).items()
            }
        )


def _checked_k(k: Array | float) -> Array:
    k = np.asarray(k, dtype=np.float64)
    require(
        bool(np.all((k > 0.0) & (k < 1.0))),
        f"k = {k}: must be in (0, 1); below 1/3 (say {DEFAULT_K}) for a jerk that comes to rest",
    )
    return k


def couple(k: Array | float, ratio: Array | float) -> Array:
    """The k of a gap whose tau is ``ratio`` times that of a tau-Jerk gap; Eqs. 25-28.

    With a ratio below 1 the gap closes ahead of the one it is coupled to, though both end together.

    Args:
        k: Of the gap that leads, in (0, 1), shape (...).
        ratio: k_qp, positive, shape (...).

    Returns:
        Shape (...).

    Raises:
        ConfigError: If a value is out of range: the product has to be below 1 for the gap to come to rest.
    """
    require(bool(np.all(np.asarray(ratio) > 0.0)), f"ratio = {ratio}: must be positive")
    coupled = np.asarray(_checked_k(k) * ratio)
    require(
        bool(np.all(coupled < 1.0)),
        f"k {k} coupled with ratio {ratio} gives {coupled}: must be below 1, choose a smaller ratio",
    )
    return coupled


def unit_gap(s: Array, k: Array | float) -> Motion:
    """A gap of 1 that closes in 1 s, with its derivatives in closed form; Eq. 32.

    Args:
        s: Times in [0, 1], any shape.
        k: In (0, 1), broadcast against it.

    Returns:
        Of the broadcast shape. At s = 1 the acceleration is infinite for k > 1/2, the jerk for k > 1/3 but
        for k = 1/2, where it is finite up to the end and the acceleration falls to rest in a step.

    Raises:
        ConfigError: If k is out of range.
    """
    n = 1.0 / _checked_k(k)
    s = np.asarray(s, dtype=np.float64)
    v = s**3
    u = (1.0 - s) * (1.0 + s + s * s)  # 1 - s^3 without its cancellation near the end
    with np.errstate(divide="ignore", invalid="ignore"):
        velocity = -3.0 * n * s**2 * u ** (n - 1.0)
        acceleration = 3.0 * n * s * u ** (n - 2.0) * (3.0 * (n - 1.0) * v - 2.0 * u)
        bracket = 2.0 * u * u - 18.0 * (n - 1.0) * u * v + 9.0 * (n - 1.0) * (n - 2.0) * v * v
        jerk = -3.0 * n * u ** (n - 3.0) * bracket
    # k = 1/2: the bracket ends at 0 and the power at infinity, their product at 108.
    jerk = np.where((n == 2.0) & (u == 0.0), 108.0, jerk)
    return Motion(u**n, velocity, acceleration, jerk)


def peaks(k: Array | float) -> Peaks:
    """Largest speed, acceleration and jerk of a gap of 1 that closes in 1 s, in closed form.

    With v = s^3 the acceleration is extreme at the roots of a quadratic in v, and so is the jerk, which is a
    function of v alone: (1 - v)^(n-3) times a quadratic.

    Args:
        k: In (0, 1), any shape.

    Returns:
        Of the shape of k.

    Raises:
        ConfigError: If k is out of range.
    """
    k = _checked_k(k)
    n = 1.0 / k
    speed = np.abs(unit_gap(np.cbrt(2.0 / (3.0 * n - 1.0)), k).velocity)

    # Roots of the jerk: c0 + c1 v + c2 v^2 = 0.
    c0, c1, c2 = 2.0, 14.0 - 18.0 * n, 2.0 + 9.0 * n * (n - 1.0)
    acceleration = _largest(k, c0, c1, c2, LARGEST_K["acceleration"], 2)
    # Roots of its derivative in v: (n - 3)(c0 + c1 v + c2 v^2) = (1 - v)(c1 + 2 c2 v).
    jerk = _largest(k, (3.0 - n) * c0 + c1, 2.0 * c2 - (n - 2.0) * c1, -(n - 1.0) * c2, LARGEST_K["jerk"], 3)
    return Peaks(speed, acceleration, jerk)


def _largest(k: Array, c0: Array | float, c1: Array, c2: Array, bounded_to: float, derivative: int) -> Array:
    """Largest magnitude of a derivative of the unit gap: at its ends or its extrema, infinite above a k."""
    root = np.sqrt(np.maximum(c1 * c1 - 4.0 * c0 * c2, 0.0))
    v = np.stack([np.zeros_like(k), (-c1 - root) / (2.0 * c2), (-c1 + root) / (2.0 * c2), np.ones_like(k)])
    found = np.abs(unit_gap(np.cbrt(np.clip(v, 0.0, 1.0)), k)[derivative])
    return np.asarray(np.where(k <= bounded_to, np.max(found, axis=0), np.inf))


def shortest_duration(distance: Array, limits: RateLimitsCfg, k: Array | float = DEFAULT_K) -> Array:
    """Time in which all gaps close together within the limits, in closed form.

    Speed, acceleration and jerk scale with distance over T, T^2 and T^3: T is the largest that any asks for.

    Args:
        distance: Size of each gap at first, shape (..., d), u.
        limits: Speed, acceleration and jerk of each.
        k: Of each gap, shape (d,), or of all.

    Returns:
        Shape (...), s; 0 where nothing moves.

    Raises:
        ConfigError: If k is out of range, or a limit asks for a smaller one (acceleration 1/2, jerk 1/3).
    """
    k = _checked_k(k)
    for name in ("acceleration", "jerk"):
        bounded = np.isinf(np.asarray(getattr(limits, name))) | (k <= LARGEST_K[name])
        require(
            bool(np.all(bounded)),
            f"k = {k}: the {name} is unbounded at the end above k = {LARGEST_K[name]:.3g}; choose a smaller "
            f"k, or math.inf for RateLimitsCfg.{name}",
        )
    moves = np.abs(distance)
    asked = [np.zeros_like(moves)]
    for order, (peak, limit) in enumerate(zip(peaks(k), vars(limits).values(), strict=True), start=1):
        bound = np.isfinite(np.asarray(limit, dtype=np.float64))
        each = np.where(bound, peak, 0.0) / np.where(bound, limit, 1.0)
        asked.append((moves * each) ** (1.0 / order))
    return np.asarray(np.max(asked, axis=(0, -1)))


@dataclass(frozen=True, kw_only=True, eq=False)
class TauJerk:
    """Motion of d axes from rest to rest that ends at one moment, or a batch of such motions.

    Attributes:
        start: Shape (..., d), u.
        goal: Shape (..., d), u.
        duration_s: T, shape (...), s; 0 only where start and goal are the same.
        k: Of each axis, shape (d,), in (0, 1).
    """

    start: Array
    goal: Array
    duration_s: Array
    k: Array

    def __post_init__(self) -> None:
        """Checks shapes and ranges."""
        d = self.start.shape[-1]
        require(
            self.start.shape == self.goal.shape and self.duration_s.shape == self.start.shape[:-1],
            f"TauJerk: start {self.start.shape}, goal {self.goal.shape} and duration_s "
            f"{self.duration_s.shape}: must be (..., d), (..., d) and (...)",
        )
        require(
            self.k.shape == (d,), f"TauJerk.k has shape {self.k.shape}: must be one number an axis, ({d},)"
        )
        _checked_k(self.k)
        moves = (self.start != self.goal).any(axis=-1)
        require(
            bool(np.all(np.isfinite(self.start) & np.isfinite(self.goal)))
            and bool(np.all(np.isfinite(self.duration_s) & (self.duration_s >= 0.0))),
            "TauJerk: start, goal and duration_s must be finite, duration_s not negative",
        )
        require(
            bool(np.all(self.duration_s[moves] > 0.0)),
            f"TauJerk.duration_s = {self.duration_s}: must be positive where something moves",
        )

    def sample(self, time_s: Array | float) -> Motion:
        """The motion at some times; at rest before 0 and after T.

        Args:
            time_s: Since the start, shape (m,), or (..., m) with times for each of the batch, s.

        Returns:
            Shapes (..., m, d). At 0 and T the derivatives from within.
        """
        time = np.atleast_1d(np.asarray(time_s, dtype=np.float64))[..., None]
        duration = self.duration_s[..., None, None]
        still = duration == 0.0
        unit = np.where(still, 1.0, duration)
        s = np.where(still, 1.0, np.clip(time / unit, 0.0, 1.0))
        gap = unit_gap(s, self.k)
        way = (self.start - self.goal)[..., None, :]
        moving = (time >= 0.0) & (time <= duration) & (way != 0.0)
        with np.errstate(invalid="ignore"):  # 0 times infinite where nothing moves
            rates = (np.where(moving, way * gap[order] / unit**order, 0.0) for order in (1, 2, 3))
            return Motion(self.goal[..., None, :] + way * gap.position, *rates)


def plan(start: Array, goal: Array, limits: RateLimitsCfg, k: Array | float = DEFAULT_K) -> TauJerk:
    """The fastest tau-Jerk motion between two points that keeps to the limits.

    Args:
        start: Shape (..., d), u; broadcast against the goal.
        goal: Shape (..., d), u.
        limits: Speed, acceleration and jerk of each axis.
        k: Of each axis, shape (d,), or of all; see ``couple``.

    Returns:
        The motion.

    Raises:
        ConfigError: See ``shortest_duration``.
    """
    start, goal = (np.array(x, dtype=np.float64) for x in np.broadcast_arrays(start, goal))
    k = np.broadcast_to(_checked_k(k), start.shape[-1:])
    return TauJerk(start=start, goal=goal, duration_s=shortest_duration(goal - start, limits, k), k=k)
