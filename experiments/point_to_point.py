"""Motions of one axis from rest to rest under limits: tau-Jerk and what it is compared with."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from seal_gym.core.errors import ConfigError
from seal_gym.core.frames import Array
from seal_gym.planning import tau_jerk
from seal_gym.planning.tau_jerk import Motion

try:
    import ruckig
except ImportError:  # an extra
    ruckig = None


class Limits(NamedTuple):
    """What all keep to, but the trapezoid, which knows no jerk.

    Attributes:
        speed: [u/s].
        acceleration: [u/s^2].
        jerk: [u/s^3].
    """

    speed: float
    acceleration: float
    jerk: float


class Profile(NamedTuple):
    """A motion of one axis.

    Attributes:
        name: For people.
        duration_s: From rest to rest [s].
        sample: Position and derivatives within the duration, at times of shape (m,); each of shape (m,).
        peaks: Largest speed, acceleration and jerk; infinite where the acceleration jumps.
        end_jerk: Jerk right after the start and right before the end [u/s^3].
    """

    name: str
    duration_s: float
    sample: Callable[[Array], Motion]
    peaks: tuple[float, float, float]
    end_jerk: tuple[float, float]


def tau_jerk_profile(way: float, limits: Limits, k: float = tau_jerk.DEFAULT_K) -> Profile:
    """The tau-Jerk motion.

    Args:
        way: Positive, u.
        limits: What it keeps to.
        k: See ``tau_jerk``.

    Returns:
        The profile.
    """
    motion = tau_jerk.plan(np.zeros(1), np.array([way]), tau_jerk.RateLimitsCfg(**limits._asdict()), k)
    t = float(motion.duration_s)
    peaks = tau_jerk.peaks(k)
    first, last = (float(motion.sample(s).jerk[0, 0]) for s in (0.0, t))
    return Profile(
        f"tau-Jerk, k = {k:.3g}",
        t,
        lambda time: Motion(*(x[:, 0] for x in motion.sample(time))),
        (
            float(peaks.speed) * way / t,
            float(peaks.acceleration) * way / t**2,
            float(peaks.jerk) * way / t**3,
        ),
        (first, last),
    )


def quintic(way: float, limits: Limits) -> Profile:
    """The polynomial of fifth degree with no speed and no acceleration at its ends.

    Args:
        way: Positive, u.
        limits: What it keeps to.

    Returns:
        The profile: largest speed 15/8, acceleration 10/sqrt(3) and jerk 60 in the unit of way and time.
    """
    unit = (15 / 8, 10 / np.sqrt(3), 60.0)
    t = max((way * p / limit) ** (1 / o) for o, (p, limit) in enumerate(zip(unit, limits, strict=True), 1))
    basis = np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])

    def sample(time: Array) -> Motion:
        return Motion(*(way / t**o * basis.deriv(o)(time / t) for o in range(4)))

    peaks = tuple(way * p / t**o for o, p in enumerate(unit, 1))
    return Profile("quintic", t, sample, (peaks[0], peaks[1], peaks[2]), (peaks[2], peaks[2]))


def trapezoidal(way: float, limits: Limits) -> Profile:
    """Full acceleration, full speed, full braking: the fastest if the acceleration may jump.

    Args:
        way: Positive, u.
        limits: Speed and acceleration are kept to.

    Returns:
        The profile.
    """
    top = min(limits.speed, float(np.sqrt(way * limits.acceleration)))
    ramp = top / limits.acceleration
    t = way / top + ramp
    a = limits.acceleration

    def sample(time: Array) -> Motion:
        up, down = time < ramp, time > t - ramp
        position = np.select(
            [up, down], [a * time**2 / 2, way - a * (t - time) ** 2 / 2], top * (time - ramp / 2)
        )
        velocity = np.select([up, down], [a * time, a * (t - time)], top)
        return Motion(position, velocity, np.select([up, down], [a, -a], 0.0), np.zeros_like(time))

    return Profile("trapezoidal", t, sample, (top, a, np.inf), (np.inf, np.inf))


def time_optimal(way: float, limits: Limits) -> Profile:
    """Ruckig's motion, the fastest with a bounded jerk.

    Args:
        way: Positive, u.
        limits: What it keeps to.

    Returns:
        The profile.

    Raises:
        ConfigError: If Ruckig is not installed.
    """
    found = _ruckig(np.array([way]), limits)
    part = found.profiles[0][0]
    used = [(dt, j) for dt, j in zip(part.t, part.j, strict=True) if dt > 0]
    ends = np.cumsum([dt for dt, _ in used])

    def sample(time: Array) -> Motion:
        position, velocity, acceleration = np.array([[x[0] for x in found.at_time(float(s))] for s in time]).T
        phase = np.minimum(np.searchsorted(ends, time, side="right"), len(used) - 1)
        return Motion(position, velocity, acceleration, np.array([j for _, j in used])[phase])

    # The acceleration is extreme where phases meet; the speed may be within one.
    dense = sample(np.union1d(ends, np.linspace(0.0, found.duration, 2001)))
    peaks = [float(np.abs(x).max()) for x in dense[1:]]
    return Profile(
        "Ruckig", float(found.duration), sample, (peaks[0], peaks[1], peaks[2]), (used[0][1], used[-1][1])
    )


def _ruckig(way: Array, limits: Limits) -> "ruckig.Trajectory":
    if ruckig is None:
        raise ConfigError("the comparison needs Ruckig: pip install 'seal-gym[planning]'")
    d = len(way)
    given = ruckig.InputParameter(d)
    given.current_position, given.target_position = [0.0] * d, way.tolist()
    given.max_velocity, given.max_acceleration, given.max_jerk = ([limit] * d for limit in limits)
    found = ruckig.Trajectory(d)
    ruckig.Ruckig(d).calculate(given, found)
    return found


def fastest_s(way: Array, limits: Limits) -> float:
    """Duration of Ruckig's motion of several axes that end together.

    Args:
        way: Shape (d,), u.
        limits: Of each.

    Returns:
        [s].

    Raises:
        ConfigError: If Ruckig is not installed.
    """
    return float(_ruckig(way, limits).duration)


def all_profiles(way: float, limits: Limits) -> list[Profile]:
    """The motions that are compared.

    Args:
        way: Positive, u.
        limits: What they keep to.

    Returns:
        Tau-Jerk first.

    Raises:
        ConfigError: If Ruckig is not installed.
    """
    makers = (tau_jerk_profile, quintic, trapezoidal, time_optimal)
    return [make(way, limits) for make in makers]
