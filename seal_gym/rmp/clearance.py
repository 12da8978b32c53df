"""How far the gun is from a ball, and the leaf that lets the ball pass.

The gun is a handful of capsules on the tip's body. Of each the point nearest the ball is a control point: the
ball's clearance from the capsule is a one-dimensional task, whose Jacobian is that of the point's position
along the line to the ball.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from seal_gym.core.errors import require
from seal_gym.core.frames import cross
from seal_gym.core.kinematics import TipKinematics
from seal_gym.rmp.algebra import Array, Leaf, apply
from seal_gym.rmp.barriers import ObstacleCfg, barrier
from seal_gym.rmp.checks import require_positive
from seal_gym.rmp.leaves import Y

_SIDEWAYS = 1e-3  # share of the travel that counts as towards a body at its side
_TINY_M = 1e-9  # a ball centred on a segment has no direction


class Capsules(NamedTuple):
    """Bodies that move with the tip, each all points within a radius of a line segment.

    Attributes:
        names: K of them.
        start: Ends of the segments in the tip frame, shape (K, 3), m.
        end: Their other ends, shape (K, 3), m.
        radius: Shape (K,), m.
    """

    names: tuple[str, ...]
    start: Array
    end: Array
    radius: Array


def _capsules(**rows: tuple[tuple[float, ...], tuple[float, ...], float]) -> Capsules:
    """Rows of start and end [mm] and radius [mm]."""
    starts, ends, radii = zip(*rows.values(), strict=True)
    arrays = tuple(1e-3 * np.array(values, dtype=np.float64) for values in (starts, ends, radii))
    for array in arrays:
        array.flags.writeable = False
    return Capsules(tuple(rows), *arrays)


SEALING_GUN = _capsules(
    mouth=((0.0, 0.0, 5.5), (0.0, 0.0, 60.0), 6.1),
    cartridge=((0.0, 0.0, 58.0), (0.0, 0.0, 118.0), 25.7),
    front_camera=((0.0, 57.46, 100.14), (0.0, 69.31, 124.84), 14.8),
    side_camera=((61.29, 8.0, 98.16), (75.64, 8.0, 121.49), 14.8),
    holder=((0.0, 0.0, 128.0), (0.0, 0.0, 250.0), 38.9),
    valve=((0.0, -68.5, 221.0), (0.0, -32.5, 221.0), 27.5),
    wrist=((0.0, 0.0, 250.0), (0.0, 0.0, 379.0), 41.0),
)
"""The collision geoms of ``assets/ur5_sealgun`` from the mouth to wrist 2. That one lies on the last joint's
axis, so that it moves with the tip but for the turning about itself. Nothing further up is in reach of what
stands beside a part: wrist 1 came no closer than 0.17 m to a fist that the front camera touched."""


class Clearances(NamedTuple):
    """Clearances of K capsules from a ball in N simulations.

    Attributes:
        distance: Negative inside, shape (N, K), m.
        rate: Its time derivative with the ball's own motion, shape (N, K), m/s.
        gradient: G, with respect to the motion of the tip: ``rate`` is ``G twist`` for a ball at rest, and
            its derivative ``G d/dt twist + drift``, shape (N, K, 6).
        drift: What is left of the second derivative with a constant body twist and a ball that does not
            accelerate, shape (N, K), m/s^2.
        point: The control points, nearest the ball on the segments, in the tip frame, shape (N, K, 3), m.
    """

    distance: Array
    rate: Array
    gradient: Array
    drift: Array
    point: Array


def clearances(
    tip: TipKinematics, centre: Array, velocity: Array, radius: float, bodies: Capsules = SEALING_GUN
) -> Clearances:
    """Clearances of capsules on the tip from a ball, with their derivatives.

    Args:
        tip: Kinematics of N arms.
        centre: Of the ball in the base frame, shape (N, 3), m.
        velocity: Of the ball, shape (N, 3), m/s.
        radius: Of the ball [m].
        bodies: K capsules.

    Returns:
        Of N simulations.
    """
    rotation = tip.pose[:, :3, :3]
    ball = _turned_back(rotation, centre - tip.pose[:, :3, 3])
    along = bodies.end - bodies.start
    share = _dot(ball[:, None] - bodies.start, along) / _dot(along, along)
    point = bodies.start + np.minimum(np.maximum(share, 0.0), 1.0)[..., None] * along
    offset = point - ball[:, None]
    length = np.maximum(np.sqrt(_dot(offset, offset)), _TINY_M)
    normal = offset / length[..., None]

    linear, angular = tip.twist[:, None, :3], np.broadcast_to(tip.twist[:, None, 3:], point.shape)
    moving = linear + cross(angular, point)
    relative = moving - _turned_back(rotation, velocity)[:, None]
    rate = _dot(normal, relative)
    sideways = relative - rate[..., None] * normal
    # The nearest point slides along its segment, which takes this much of the curvature away.
    slide = _dot(sideways, along) / length + _dot(normal, cross(angular, np.broadcast_to(along, point.shape)))
    slides = (share > 0.0) & (share < 1.0)
    drift = (
        _dot(normal, cross(angular, moving))
        + _dot(sideways, sideways) / length
        - np.where(slides, slide**2 * length / _dot(along, along), 0.0)
    )
    return Clearances(
        distance=length - bodies.radius - radius,
        rate=rate,
        gradient=np.concatenate((normal, cross(point, normal)), axis=-1),
        drift=drift,
        point=point,
    )


@dataclass(frozen=True, kw_only=True)
class LetPassCfg:
    """How the gun lets an obstacle pass: it stops along the seam first, and leaves the seam last."""

    margin: float = 0.06
    """Clearance below which the speed along the seam is bounded [m]."""
    room: float = 0.025
    """Clearance at which the gun stands [m]."""
    closing_s: float = 1.0
    """Allowed speed towards the obstacle for each metre of clearance beyond ``room`` [1/s]."""
    retreat_m_s: float = 0.0002
    """Largest speed back along the seam [m/s]. Small: policies have not learned to go back."""
    gain_s: float = 8.0
    """Deceleration for each m/s of excess speed [1/s]."""
    excess_m_s: float = 0.002
    """Excess speed at which the bound has its full metric [m/s]; there is none below the bound."""
    weight: float = 100.0
    """Metric of the bound at distance zero; tip leaves have about 1."""
    away: ObstacleCfg = field(default_factory=lambda: ObstacleCfg(margin=0.010))
    """Spring, damper and metric of the clearance itself, in whatever direction it takes."""

    def __post_init__(self) -> None:
        """Checks the ranges, and that stopping comes first."""
        require_positive(self, "margin", "room", "closing_s", "retreat_m_s", "gain_s", "excess_m_s", "weight")
        require(
            self.away.margin <= self.room <= self.margin,
            f"LetPassCfg has away.margin {self.away.margin}, room {self.room} and margin {self.margin}; give "
            "them in rising order, or the gun leaves the seam before it stops",
        )


LET_PASS = LetPassCfg()


def allowed_speed(near: Clearances, cfg: LetPassCfg = LET_PASS) -> Array:
    """Speed along the seam at which each clearance shrinks no faster than its room allows.

    Args:
        near: Clearances of K capsules in N simulations.
        cfg: Room and rates.

    Returns:
        At least ``-retreat_m_s``; huge where going on costs no clearance. Shape (N, K), m/s.
    """
    towards = np.maximum(-near.gradient[..., Y], _SIDEWAYS)
    return np.maximum(cfg.closing_s * (near.distance - cfg.room) / towards, -cfg.retreat_m_s)


def let_pass(tip: TipKinematics, near: Clearances, cfg: LetPassCfg = LET_PASS) -> Leaf:
    """Keeps the gun clear of a ball: stops it along the seam, and pushes it off where that is too little.

    Two rows for each capsule. One acts on the travel (the tip's y): below ``margin`` it bounds its speed by
    ``allowed_speed``, in the measure in which going back helps, and never drives the gun forward. It leaves
    the directions across the seam to those who follow it, so that a gun that waits stays on the seam. The
    other is ``obstacle``: below ``away.margin`` it acts on the clearance, for a ball that comes from the side
    or too fast.

    Args:
        tip: Kinematics of N arms.
        near: Their K clearances.
        cfg: Margins and gains.

    Returns:
        A leaf on 2 K tasks, with a metric of zero beyond the margins.
    """
    distance, rate, gradient, bend, _ = near
    excess = np.maximum(tip.twist[:, None, Y] - allowed_speed(near, cfg), 0.0)
    depth = np.maximum(1.0 - distance / cfg.margin, 0.0)
    towards = np.maximum(-gradient[..., Y], 0.0)
    bound = cfg.weight * (depth * towards) ** 2 * np.minimum(excess / cfg.excess_m_s, 1.0)
    accel, push = barrier(distance, rate, cfg.away)

    travel = np.broadcast_to(tip.jacobian[:, None, Y], (*distance.shape, tip.jacobian.shape[-1]))
    still = np.broadcast_to(tip.drift[:, None, Y], distance.shape)
    drift = apply(gradient, tip.drift) + bend
    weights = np.concatenate((bound, push), axis=-1)
    return Leaf(
        jacobian=np.concatenate((travel, np.matmul(gradient, tip.jacobian)), axis=-2),
        drift=np.concatenate((still, drift), axis=-1),
        accel=np.concatenate((-cfg.gain_s * excess, accel), axis=-1),
        metric=weights[..., None] * np.eye(weights.shape[-1]),
    )


def _dot(a: Array, b: Array) -> Array:
    return np.asarray((a * b).sum(axis=-1))


def _turned_back(rotation: Array, vector: Array) -> Array:
    """Vectors of the base frame in the tip frames. Shape (N, 3)."""
    return np.asarray(np.matmul(vector[:, None], rotation)[:, 0])
