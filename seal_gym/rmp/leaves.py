"""Leaves on the tip: Zhou et al., Table 1, and the forward speed and lean it does not name.

All act on the body twist of the tip, ordered (vx, vy, vz, wx, wy, wz) [m/s, rad/s] in the tip frame: origin
at the nozzle mouth, x to the right of travel, y along travel, z back along the nozzle, away from the seam.
A tip acceleration is the time derivative of that twist.

Gains and metrics. On an axis with error e and velocity v against the reference, an attraction, heading or
lean leaf wants ``k sat(e) - c v`` with weight w(e), and the damping leaf wants ``-c v`` with weight b(e).
Their sum is ``k w / (w + b) sat(e) - c v``: the damping is c = 2 zeta omega whatever the weights, so a weight
can never take it away, and k is chosen so that the stiffness is omega^2 at zero error. w grows with the error
while b falls, so the stiffness rises with it (1.4 times with the defaults); where it does, ``sat`` limits the
speed of approach.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from seal_gym.rmp.algebra import Array, Leaf, apply, identity, solve
from seal_gym.rmp.checks import require_positive, require_share

TWIST = 6
X, Y, Z, ABOUT_X, ABOUT_Y, ABOUT_Z = range(TWIST)

_BLEND_FLOOR = 1e-12
"""Makes a sum of projectors that leaves axes open invertible; other metrics are about 1."""


class TipRmp(NamedTuple):
    """A policy in tip space, before the arm's Jacobian joins it."""

    accel: Array
    """Desired derivative of the tip's body twist [m/s^2, rad/s^2]. Shape (..., 6)."""
    metric: Array
    """Shape (..., 6, 6). Dimensionless: weight 1 charges 1 m/s^2 like 1 rad/s^2."""


@dataclass(frozen=True, kw_only=True)
class ServoCfg:
    """A saturated spring and damper on one axis, with a metric that grows with the error.

    ``threshold``, ``slope`` and ``max_rate`` are in the axis's unit: m on x and z, rad on rotations.
    """

    omega_n: float = 12.0
    """Natural frequency of the combined leaves at zero error [rad/s]. With features one frame late at 30 Hz
    take 8, two frames late 6 (see ``SealingCfg.tuned``)."""
    zeta: float = 0.7
    """Damping ratio at zero error."""
    threshold: float
    """d_c, the error at which sigma is one half. [m] or [rad]."""
    slope: float
    """s, the steepness of sigma. [1/m] or [1/rad]."""
    weight: float = 1.0
    """Metric at large errors."""
    floor: float = 0.5
    """Share of ``weight`` that is left at zero error. Sigma alone is 0.02 there: nothing would act on small
    errors, and the stiffness would change fiftyfold across the threshold."""
    damping_weight: float = 0.25
    """Metric of the damping leaf on this axis at zero error, which the spring makes up for."""
    max_rate: float
    """Bound on the speed of approach that large errors can cause. [m/s] or [rad/s]. It also bounds the
    acceleration that an error can ask for, to 2 zeta omega_n max_rate, and the overshoot when features come
    late: about max_rate times the delay, so 25 mm/s and one frame cost 0.34 mm, two frames 1.1 mm."""

    def __post_init__(self) -> None:
        """Checks the ranges."""
        require_positive(self, "omega_n", "zeta", "weight", "damping_weight")
        require_positive(self, "threshold", "slope", "max_rate")
        require_share(self, "floor")

    @property
    def damping_s(self) -> float:
        """Damping c = 2 zeta omega_n [1/s]."""
        return 2.0 * self.zeta * self.omega_n

    @cached_property
    def stiffness_s2(self) -> float:
        """Spring k [1/s^2]: omega_n^2 divided by the leaf's share of the axis's metric at zero error."""
        at_zero = self.weight * _share(np.zeros(()), self.threshold, self.slope, self.floor)
        return float(self.omega_n**2 * (1.0 + self.damping_weight / at_zero))


@dataclass(frozen=True, kw_only=True)
class AttractionCfg(ServoCfg):
    """Attraction to the seam on x or z, in metres."""

    threshold: float = 2e-3
    slope: float = 2e3
    max_rate: float = 0.025


@dataclass(frozen=True, kw_only=True)
class HeadingCfg(ServoCfg):
    """Alignment with the seam about z or x, in radians (threshold 2 deg, slope 2 per degree)."""

    threshold: float = 0.035
    slope: float = 115.0
    max_rate: float = 1.0


@dataclass(frozen=True, kw_only=True)
class LeanCfg(ServoCfg):
    """Weak alignment about y, the rotation that four features cannot see, in radians."""

    omega_n: float = 4.0
    zeta: float = 2.1
    threshold: float = 0.035
    slope: float = 115.0
    weight: float = 0.1
    floor: float = 1.0
    max_rate: float = 0.3


@dataclass(frozen=True, kw_only=True)
class DampingCfg:
    """Damping of the twist against its reference, with inverse-sigma weights."""

    damping_s: float = 16.8
    """c [1/s]; 2 zeta omega_n of the attraction and heading leaves."""
    weight: float = 0.25
    """Metric at small errors."""
    floor: float = 0.2
    """Share of ``weight`` that is left at large errors; untuned, without it, prototypes collided."""
    threshold_m: float = 2e-3
    slope_per_m: float = 2e3
    threshold_rad: float = 0.035
    slope_per_rad: float = 115.0

    def __post_init__(self) -> None:
        """Checks the ranges."""
        require_positive(self, "damping_s", "weight")
        require_positive(self, "threshold_m", "slope_per_m", "threshold_rad", "slope_per_rad")
        require_share(self, "floor")

    @cached_property
    def thresholds(self) -> Array:
        """Error on each axis of the twist at which sigma is one half [m, rad]. Shape (6,)."""
        return np.repeat((self.threshold_m, self.threshold_rad), 3)

    @cached_property
    def slopes(self) -> Array:
        """Steepness of sigma on each axis [1/m, 1/rad]. Shape (6,)."""
        return np.repeat((self.slope_per_m, self.slope_per_rad), 3)


@dataclass(frozen=True, kw_only=True)
class ForwardSpeedCfg:
    """Holding the speed along the seam."""

    gain_s: float = 12.0
    """k in k (v_ref - v_y) [1/s]."""
    weight: float = 1.0
    max_accel_m_s2: float = 0.5
    """Bound on the acceleration asked for [m/s^2]."""

    def __post_init__(self) -> None:
        """Checks the ranges."""
        require_positive(self, "gain_s", "weight", "max_accel_m_s2")


@dataclass(frozen=True, kw_only=True)
class RegularisationCfg:
    """Pull towards the previous tip acceleration."""

    weight: float = 0.05
    """s in the metric s I_6. The acceleration lags by s / (sum of the axis's weights) of a frame's change;
    the static response is untouched."""

    def __post_init__(self) -> None:
        """Checks the range."""
        require_positive(self, "weight")


ATTRACTION = AttractionCfg()
HEADING = HeadingCfg()
LEAN = LeanCfg()
DAMPING = DampingCfg()
FORWARD_SPEED = ForwardSpeedCfg()
REGULARISATION = RegularisationCfg()


def sigma(magnitude: Array, threshold: float | Array, slope: float | Array) -> Array:
    """Logistic weight ``1 / (1 + exp(-s (|d| - d_c)))`` of an error's magnitude.

    Zhou et al., Table 1, which prints the signed error: that would switch half the errors off. Written with
    tanh, it neither overflows nor warns.

    Args:
        magnitude: Errors; the sign is ignored. Any shape.
        threshold: d_c, in the error's unit.
        slope: s, in the inverse unit.

    Returns:
        In [0, 1], of the broadcast shape.
    """
    weight: Array = 0.5 + 0.5 * np.tanh(0.5 * slope * (np.abs(magnitude) - threshold))
    return weight


def saturate(error: Array, limit: float) -> Array:
    """Smoothly bounds an error: ``limit tanh(error / limit)``, unit slope at zero."""
    bounded: Array = limit * np.tanh(error / limit)
    return bounded


def attraction_front(d_front_m: Array, v: Array, cfg: AttractionCfg = ATTRACTION) -> TipRmp:
    """Attraction to the seam line in the forward view, along x.

    Args:
        d_front_m: x of the seam point in the tip frame [m]; positive: the seam lies right. Shape (...).
        v: Velocity of the tip along x against the seam [m/s]. Shape (...).
        cfg: Gains and metric.

    Returns:
        Accelerates along +x for positive errors; the metric is a projector on x.
    """
    return _servo(X, d_front_m, v, cfg)


def attraction_side(d_side_m: Array, v: Array, cfg: AttractionCfg = ATTRACTION) -> TipRmp:
    """Attraction to the stand-off line in the side view, along z.

    Args:
        d_side_m: z of the stand-off point in the tip frame [m]; positive: the tip is too low. Shape (...).
        v: Velocity of the tip along z against the seam [m/s]. Shape (...).
        cfg: Gains and metric.

    Returns:
        Accelerates along +z for positive errors; the metric is a projector on z.
    """
    return _servo(Z, d_side_m, v, cfg)


def heading_front(theta_front: Array, w: Array, cfg: HeadingCfg = HEADING) -> TipRmp:
    """Alignment with the seam in the forward view, about z.

    Args:
        theta_front: atan2(dx, dy) of the seam's direction in the tip frame [rad]; positive: the seam turns to
            the right, which is a negative rotation about z. Shape (...).
        w: Angular velocity of the tip about z against the seam [rad/s]. Shape (...).
        cfg: Gains and metric.

    Returns:
        Accelerates about -z for positive errors; the metric is a projector on the rotation about z.
    """
    return _servo(ABOUT_Z, -theta_front, w, cfg)


def heading_side(theta_side: Array, w: Array, cfg: HeadingCfg = HEADING) -> TipRmp:
    """Alignment with the seam in the side view, about x.

    Args:
        theta_side: atan2(dz, dy) of the seam's direction in the tip frame [rad]; positive: the seam rises,
            which is a positive rotation about x. Shape (...).
        w: Angular velocity of the tip about x against the seam [rad/s]. Shape (...).
        cfg: Gains and metric.

    Returns:
        Accelerates about +x for positive errors; the metric is a projector on the rotation about x.
    """
    return _servo(ABOUT_X, theta_side, w, cfg)


def lean(error_rad: Array, rate: Array, cfg: LeanCfg = LEAN) -> TipRmp:
    """Weak alignment about y. Not in Table 1, whose four features leave the lean to drift by 5-15 deg.

    Args:
        error_rad: Rotation about the tip's y that would restore the lean [rad]. Shape (...).
        rate: Angular velocity of the tip about y against its reference [rad/s]. Shape (...).
        cfg: Gains and metric.

    Returns:
        Accelerates about +y for positive errors; the metric is a projector on the rotation about y.
    """
    return _servo(ABOUT_Y, error_rad, rate, cfg)


def forward_speed(v_y: Array, v_ref: Array | float, cfg: ForwardSpeedCfg = FORWARD_SPEED) -> TipRmp:
    """Holds the speed along the seam: ``k (v_ref - v_y)`` on y. Zhou et al. name no leaf for it.

    Args:
        v_y: Velocity of the tip along y [m/s]. Shape (...).
        v_ref: Wanted, the seam's own velocity along y included [m/s]. Scalar or shape (...).
        cfg: Gain, weight, bound.

    Returns:
        Acts on y; the metric is a projector on y.
    """
    accel = saturate(cfg.gain_s * (v_ref - v_y), cfg.max_accel_m_s2)
    return _on_axis(Y, accel, np.full(accel.shape, cfg.weight))


def damping(twist: Array, reference_twist: Array, error: Array, cfg: DampingCfg = DAMPING) -> TipRmp:
    """Damps the twist towards its reference on all six axes, most where the error is small.

    Zhou et al., Table 1, in R^6 (the print has R^3), and against the reference: damping the absolute velocity
    would drag the forward speed.

    Args:
        twist: Body twist of the tip [m/s, rad/s]. Shape (..., 6).
        reference_twist: v_ref along y plus the seam's own twist, in the tip frame. Shape (..., 6).
        error: Error on each axis [m, rad], 0 where none is known (y); the sign is ignored. Shape (..., 6).
        cfg: Gain and weights.

    Returns:
        The metric is diagonal, the inverse sigma of each axis's error with a floor.
    """
    share = 1.0 - (1.0 - cfg.floor) * sigma(error, cfg.thresholds, cfg.slopes)
    return TipRmp(accel=cfg.damping_s * (reference_twist - twist), metric=_diagonal(cfg.weight * share))


def regularisation(previous_accel: Array, cfg: RegularisationCfg = REGULARISATION) -> TipRmp:
    """Pulls towards the previous acceleration on all six axes, with the metric s I.

    Zhou et al., Table 1, in R^6 (the print has R^3). It keeps the sum positive definite in tip space, so
    that only the Jacobian can be singular.

    Args:
        previous_accel: Tip acceleration of the last frame [m/s^2, rad/s^2]. Shape (..., 6).
        cfg: Weight.

    Returns:
        Acts on all six axes.
    """
    return TipRmp(accel=previous_accel, metric=_diagonal(np.full(previous_accel.shape, cfg.weight)))


def on_tip(accel: Array, metric: Array, jacobian: Array, drift: Array) -> Leaf:
    """Wraps a tip policy with the tip's body Jacobian: ``on_tip(*policy, jacobian, drift)``.

    Args:
        accel: Shape (..., 6).
        metric: Shape (..., 6, 6).
        jacobian: Body Jacobian: tip twist in the tip frame = J qdot. Shape (..., 6, n).
        drift: Jdot qdot in the tip frame. Shape (..., 6). Pass the same two arrays to every tip leaf of a
            frame and ``gather`` pulls them back at once.

    Returns:
        The leaf.
    """
    return Leaf(jacobian=jacobian, drift=drift, accel=accel, metric=metric)


def blend(policies: Sequence[TipRmp]) -> TipRmp:
    """One tip policy equal to several: metric sum A, acceleration (sum A)^-1 sum A f.

    Args:
        policies: At least one.

    Returns:
        Their sum; the acceleration is 0 in directions on which none of them acts.
    """
    metric = policies[0].metric
    force = apply(metric, policies[0].accel)
    for policy in policies[1:]:
        metric = metric + policy.metric
        force = force + apply(policy.metric, policy.accel)
    solvable = metric + _BLEND_FLOOR * identity(TWIST)
    return TipRmp(accel=solve(solvable, force), metric=metric)


def _servo(axis: int, error: Array, rate: Array, cfg: ServoCfg) -> TipRmp:
    """Saturated spring and damper on one axis."""
    limit = cfg.damping_s * cfg.max_rate / cfg.stiffness_s2
    accel = cfg.stiffness_s2 * saturate(error, limit) - cfg.damping_s * rate
    return _on_axis(axis, accel, cfg.weight * _share(error, cfg.threshold, cfg.slope, cfg.floor))


def _share(error: Array, threshold: float, slope: float, floor: float) -> Array:
    """Sigma raised to a floor: in [floor, 1]."""
    share: Array = floor + (1.0 - floor) * sigma(error, threshold, slope)
    return share


def _on_axis(axis: int, accel: Array, weight: Array) -> TipRmp:
    """Acceleration (...) and weight (...) placed on one axis of the twist."""
    accels = np.zeros((*accel.shape, TWIST))
    metric = np.zeros((*accel.shape, TWIST, TWIST))
    accels[..., axis] = accel
    metric[..., axis, axis] = weight
    return TipRmp(accel=accels, metric=metric)


def _diagonal(weights: Array) -> Array:
    """Diagonal metrics. (..., n) to (..., n, n)."""
    metric: Array = weights[..., None] * identity(weights.shape[-1])
    return metric
