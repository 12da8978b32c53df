"""The sealing policy: the leaves of Zhou et al., Table 1, put together.

``seam_policies`` are what an expert or a network replaces (attractions, headings, forward speed);
``fixed_policies`` stay beside any of them (damping, regularisation, lean).
"""

from dataclasses import dataclass, field
from typing import NamedTuple, Self

import numpy as np

from seal_gym.core.errors import require
from seal_gym.rmp.algebra import Array
from seal_gym.rmp.checks import require_positive
from seal_gym.rmp.leaves import (
    ABOUT_X,
    ABOUT_Y,
    ABOUT_Z,
    TWIST,
    AttractionCfg,
    DampingCfg,
    ForwardSpeedCfg,
    HeadingCfg,
    LeanCfg,
    RegularisationCfg,
    TipRmp,
    X,
    Y,
    Z,
    attraction_front,
    attraction_side,
    damping,
    forward_speed,
    heading_front,
    heading_side,
    lean,
    regularisation,
)


class SeamErrors(NamedTuple):
    """Where the seam lies in the tip frame; each of shape (...)."""

    d_front_m: Array
    """x of the seam point [m]."""
    theta_front: Array
    """atan2(dx, dy) of the seam's direction [rad]."""
    d_side_m: Array
    """z of the stand-off point [m]."""
    theta_side: Array
    """atan2(dz, dy) of the seam's direction [rad]."""
    lean_rad: Array
    """Rotation about y that restores the lean [rad]; 0 if unknown."""


@dataclass(frozen=True, kw_only=True)
class TravelCfg:
    """Travel slows down where the seam turns faster under the tip than the gun follows well.

    A part that comes towards the gun doubles the rate at which it takes a corner; neither view shows that
    motion on a straight seam, but the turning shows it in the corner.

    Attributes:
        turn_rad_s: Rate up to which the gun travels at full speed [rad/s].
        slope: Share of the speed that is lost between that rate and twice that rate; the rest stops at 0.
    """

    turn_rad_s: float = 1.6
    slope: float = 2.0

    def __post_init__(self) -> None:
        """Checks the ranges."""
        require_positive(self, "turn_rad_s", "slope")


@dataclass(frozen=True, kw_only=True)
class SealingCfg:
    """The configurations of the eight leaves and of the travel, made for each other."""

    attraction: AttractionCfg = field(default_factory=AttractionCfg)
    heading: HeadingCfg = field(default_factory=HeadingCfg)
    forward_speed: ForwardSpeedCfg = field(default_factory=ForwardSpeedCfg)
    damping: DampingCfg = field(default_factory=DampingCfg)
    regularisation: RegularisationCfg = field(default_factory=RegularisationCfg)
    lean: LeanCfg = field(default_factory=LeanCfg)
    travel: TravelCfg = field(default_factory=TravelCfg)

    @classmethod
    def tuned(cls, omega_n: float, zeta: float = 0.7) -> Self:
        """The defaults with another natural frequency and damping ratio on x, z and both headings.

        Args:
            omega_n: [rad/s]. At 30 frames/s 12 suits fresh features (small errors overshoot by 1 %). One
                frame late, 12 overshoots by 13 % and 8 by 9 %; two frames late, 12 by 37 % and 6 by 16 %.
            zeta: Damping ratio; below 0.7 the tip overshoots towards the seam.

        Returns:
            Consistent configurations: spring, damper and lean share one damping coefficient.
        """
        damping_s = 2.0 * zeta * omega_n
        return cls(
            attraction=AttractionCfg(omega_n=omega_n, zeta=zeta),
            heading=HeadingCfg(omega_n=omega_n, zeta=zeta),
            damping=DampingCfg(damping_s=damping_s),
            lean=LeanCfg(omega_n=omega_n / 3.0, zeta=3.0 * zeta),
        )

    def __post_init__(self) -> None:
        """Checks that the springs make up for the damping leaf that is there."""
        for name in ("attraction", "heading", "lean"):
            assumed, actual = getattr(self, name).damping_weight, self.damping.weight
            require(
                bool(np.isclose(assumed, actual)),
                f"{name}.damping_weight is {assumed} but damping.weight is {actual}; make them equal, "
                "or omega_n and zeta do not hold",
            )


DEFAULT_SEALING = SealingCfg()


def reference_twist(v_ref: Array | float, seam_twist: Array, cfg: SealingCfg = DEFAULT_SEALING) -> Array:
    """Twist to damp against: travel along y plus the seam's own twist.

    Args:
        v_ref: Speed along the seam where it turns slowly [m/s]. Scalar or shape (...).
        seam_twist: Twist of the seam at the tip, in the tip frame; zeros if it is straight and stands still.
            Shape (..., 6).
        cfg: How travel slows down in turns.

    Returns:
        Shape (..., 6).
    """
    turn = np.hypot(seam_twist[..., ABOUT_X], seam_twist[..., ABOUT_Z])
    share = 1.0 - cfg.travel.slope * (turn / cfg.travel.turn_rad_s - 1.0)
    reference = seam_twist.copy()
    reference[..., Y] += v_ref * np.minimum(np.maximum(share, 0.0), 1.0)
    return reference


def axis_errors(errors: SeamErrors) -> Array:
    """The errors placed on the axes of the twist, with the signs of the motion that removes them.

    Args:
        errors: Each (...).

    Returns:
        (x, 0, z, about x, about y, about z) [m, rad]. Shape (..., 6).
    """
    placed = np.zeros((*errors.d_front_m.shape, TWIST))
    placed[..., X] = errors.d_front_m
    placed[..., Z] = errors.d_side_m
    placed[..., ABOUT_X] = errors.theta_side
    placed[..., ABOUT_Y] = errors.lean_rad
    placed[..., ABOUT_Z] = -errors.theta_front
    return placed


def seam_policies(
    errors: SeamErrors, twist: Array, reference: Array, cfg: SealingCfg = DEFAULT_SEALING
) -> list[TipRmp]:
    """Attractions, headings and forward speed: what follows the seam.

    Args:
        errors: Where the seam is, each (...).
        twist: Body twist of the tip [m/s, rad/s]. Shape (..., 6).
        reference: From ``reference_twist``. Shape (..., 6).
        cfg: The leaves' configurations.

    Returns:
        Five tip policies.
    """
    relative = twist - reference
    return [
        attraction_front(errors.d_front_m, relative[..., X], cfg.attraction),
        heading_front(errors.theta_front, relative[..., ABOUT_Z], cfg.heading),
        attraction_side(errors.d_side_m, relative[..., Z], cfg.attraction),
        heading_side(errors.theta_side, relative[..., ABOUT_X], cfg.heading),
        forward_speed(twist[..., Y], reference[..., Y], cfg.forward_speed),
    ]


def fixed_policies(
    errors: SeamErrors,
    twist: Array,
    reference: Array,
    previous_accel: Array,
    cfg: SealingCfg = DEFAULT_SEALING,
) -> list[TipRmp]:
    """Damping, regularisation and lean: what stays beside any policy that follows the seam.

    Args:
        errors: Where the seam is, each (...).
        twist: Body twist of the tip [m/s, rad/s]. Shape (..., 6).
        reference: From ``reference_twist``. Shape (..., 6).
        previous_accel: Tip acceleration of the last frame. Shape (..., 6).
        cfg: The leaves' configurations.

    Returns:
        Three tip policies.
    """
    relative = twist - reference
    return [
        damping(twist, reference, axis_errors(errors), cfg.damping),
        regularisation(previous_accel, cfg.regularisation),
        lean(errors.lean_rad, relative[..., ABOUT_Y], cfg.lean),
    ]
