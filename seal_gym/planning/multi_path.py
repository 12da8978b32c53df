"""Multi-path planning: cubic ways from many starts, the best by length and inflections.

Source: Carvajal and Martinez-Garcia, section V (Eqs. 50-56, Fig. 7). From each start, equidistant points on
the line to the goal are pushed aside until none collides; a cubic is fitted to them in each of the two planes
that contain the line (the paper's y(x)), and what still collides is pushed further. Of the ways that are free
the one is chosen that is short and bends to and fro least. The paper says neither how its points get round
obstacles nor how length and inflections are weighed, and takes the least minimum of the polynomials for
the shortest way, which it is not: both are this module's.

Frame of a way: origin at its start, x along the line to the goal, z as near to the given up as can be.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from seal_gym.core.errors import is_number, require
from seal_gym.core.frames import Array, cross, normalise

Free = Callable[[Array], NDArray[np.bool_]]
"""Whether the tool may be at each of some points: shape (m, 3), m, to shape (m,)."""
_QUADRATURE = np.polynomial.legendre.leggauss(24)
_TABLE = 513
_LEADING = 1e-9
"""A coefficient of a cubic on -1..1 as small as this beside the largest counts as zero."""


class Stationary(NamedTuple):
    """Where a cubic is extreme (Eqs. 52-56).

    Attributes:
        x: Shape (k,), k <= 2, ascending.
        y: Shape (k,).
        is_maximum: By the sign of the second derivative, shape (k,).
    """

    x: Array
    y: Array
    is_maximum: NDArray[np.bool_]


def fit_cubic(x: Array, y: Array) -> Polynomial:
    """Least-squares cubic y(x); Eq. 50, whose last right-hand entry has to be sum y x^3.

    On a basis scaled to -1..1, which keeps the condition of the normal equations near 8, not 3e6.

    Args:
        x: Shape (n,), n >= 4 different values.
        y: Shape (n,).

    Returns:
        The polynomial, its domain the range of x.

    Raises:
        ConfigError: If there are too few different values of x.
    """
    require(
        x.shape == y.shape and len(np.unique(x)) >= 4,
        f"fit_cubic: x {x.shape} and y {y.shape} must be of one length with at least 4 different x",
    )
    return Polynomial.fit(x, y, 3)


def fit_pinned(x: Array, y: Array) -> Polynomial:
    """Least-squares cubic that is 0 at the first and the last x: a way keeps its start and its goal.

    Args:
        x: Ascending, shape (n,), n >= 4.
        y: Shape (n,); its first and last entries do not count.

    Returns:
        The polynomial, its domain the range of x.
    """
    u = 2.0 * (x - x[0]) / (x[-1] - x[0]) - 1.0
    ends = 1.0 - u**2
    a, b = np.linalg.lstsq(np.column_stack((ends, u * ends)), y, rcond=None)[0]
    return Polynomial([a, b, -a, -b], domain=[x[0], x[-1]], window=[-1, 1])


def _scaled(cubic: Polynomial) -> tuple[Array, float]:
    """Coefficients on -1..1, padded to four, and the largest magnitude."""
    coefficients = np.zeros(4)
    coefficients[: len(cubic.coef)] = cubic.coef
    return coefficients, float(np.abs(coefficients).max())


def _inside(cubic: Polynomial, u: list[float]) -> Array:
    low, high = cubic.domain
    within = np.array(sorted(v for v in u if -1.0 < v < 1.0))
    return low + 0.5 * (within + 1.0) * (high - low)


def extrema(cubic: Polynomial) -> Stationary:
    """Extrema inside the domain, in closed form: x = (-a2 +- sqrt(a2^2 - 3 a1 a3)) / (3 a3).

    Args:
        cubic: Of degree 3 or less, on the window -1..1.

    Returns:
        None, one or two of them.
    """
    (_, a1, a2, a3), size = _scaled(cubic)
    roots: list[float] = []
    if abs(a3) > _LEADING * size:
        discriminant = a2 * a2 - 3.0 * a1 * a3
        if discriminant > 0.0:
            roots = [(-a2 + sign * np.sqrt(discriminant)) / (3.0 * a3) for sign in (-1.0, 1.0)]
    elif abs(a2) > _LEADING * size:
        roots = [-a1 / (2.0 * a2)]
    x = _inside(cubic, roots)
    return Stationary(x, np.asarray(cubic(x)), np.asarray(cubic.deriv(2)(x) < 0.0))


def inflections(cubic: Polynomial) -> Array:
    """Inflections inside the domain: x = -a2 / (3 a3).

    Args:
        cubic: Of degree 3 or less, on the window -1..1.

    Returns:
        Shape (0,) or (1,).
    """
    (_, _, a2, a3), size = _scaled(cubic)
    return _inside(cubic, [-a2 / (3.0 * a3)] if abs(a3) > _LEADING * size else [])


def length(*cubics: Polynomial) -> float:
    """Length of the curve (x, y(x), z(x), ...): the integral of sqrt(1 + y'^2 + z'^2 + ...).

    Args:
        *cubics: On one domain.

    Returns:
        Its length, in the unit of x.
    """
    low, high = cubics[0].domain
    half = 0.5 * (high - low)
    x = low + half * (_QUADRATURE[0] + 1.0)
    slope2 = sum((c.deriv()(x) ** 2 for c in cubics), np.zeros_like(x))
    return float(half * (_QUADRATURE[1] @ np.sqrt(1.0 + slope2)))


@dataclass(frozen=True, kw_only=True)
class MultiPathCfg:
    """How ways are sought.

    Attributes:
        points: Equidistant points that are pushed and fitted.
        checked_m: Largest distance of the points at which a way is checked [m].
        push_m: How far a colliding point is pushed at a time [m].
        pushes: How often at most.
        spread: Neighbours to either side of a colliding point that are pushed with it.
        inflection_m: Length that one inflection weighs as much as [m].
    """

    points: int = 24
    checked_m: float = 0.002
    push_m: float = 0.006
    pushes: int = 30
    spread: int = 2
    inflection_m: float = 0.02

    def __post_init__(self) -> None:
        """Checks the ranges."""
        least = {"points": 4, "pushes": 0, "spread": 0}
        for f in fields(self):
            value, low = getattr(self, f.name), least.get(f.name)
            whole = low is None or (is_number(value) and int(value) == value)
            require(
                is_number(value) and whole and (value >= low if low is not None else value > 0),
                f"MultiPathCfg.{f.name} = {value!r}: must be "
                + (f"a whole number >= {low}" if low is not None else "a finite number > 0"),
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class CubicWay:
    """A way from a start to a goal.

    Attributes:
        start: Shape (3,), m.
        goal: Shape (3,), m.
        frame: Columns are the way's x, y and z axes, shape (3, 3).
        y: y(x) in that frame, m.
        z: z(x), m.
    """

    start: Array
    goal: Array
    frame: Array
    y: Polynomial
    z: Polynomial

    @property
    def length_m(self) -> float:
        """Of the curve [m]."""
        return length(self.y, self.z)

    @property
    def inflections(self) -> int:
        """In both planes together."""
        return len(inflections(self.y)) + len(inflections(self.z))

    def along(self, count: int) -> Array:
        """Equidistant places along the line.

        Args:
            count: >= 2, both ends among them.

        Returns:
            Shape (count,), m.
        """
        return np.linspace(float(self.y.domain[0]), float(self.y.domain[1]), count)

    def at(self, x: Array) -> Array:
        """Points of the way.

        Args:
            x: Along the line, shape (m,), m.

        Returns:
            Shape (m, 3), m.
        """
        local = np.column_stack((x, self.y(x), self.z(x)))
        return np.asarray(self.start + local @ self.frame.T)

    def equidistant(self, count: int) -> Array:
        """Points that are equally far apart along the curve.

        Args:
            count: >= 2, both ends among them.

        Returns:
            Shape (count, 3), m.
        """
        x = self.along(_TABLE)
        dense = self.at(x)
        arc = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(dense, axis=0), axis=1))))
        return self.at(np.interp(np.linspace(0.0, arc[-1], count), arc, x))

    def cost_m(self, cfg: MultiPathCfg) -> float:
        """Length and inflections together.

        Args:
            cfg: What an inflection weighs.

        Returns:
            [m].
        """
        return self.length_m + cfg.inflection_m * self.inflections


def way_frame(start: Array, goal: Array, up: Array) -> Array:
    """Axes of a way.

    Args:
        start: Shape (3,), m.
        goal: Shape (3,), m.
        up: Where z should point, shape (3,).

    Returns:
        Columns x, y, z, shape (3, 3).

    Raises:
        ConfigError: If start and goal are one point.
    """
    along = goal - start
    require(bool(np.linalg.norm(along) > 1e-9), f"start and goal are the same point {start}: nothing to plan")
    x = normalise(along)
    z = up - (up @ x) * x
    if np.linalg.norm(z) < 1e-6:  # straight up or down: any side will do
        z = np.eye(3)[int(np.argmin(np.abs(x)))]
        z = z - (z @ x) * x
    z = normalise(z)
    return np.column_stack((x, cross(z, x), z))


def straight(start: Array, goal: Array, up: Array) -> CubicWay:
    """The line.

    Args:
        start: Shape (3,), m.
        goal: Shape (3,), m.
        up: Where z should point, shape (3,).

    Returns:
        A way without bends.
    """
    frame = way_frame(start, goal, up)
    domain = [0.0, float(np.linalg.norm(goal - start))]
    return CubicWay(
        start=start,
        goal=goal,
        frame=frame,
        y=Polynomial([0.0], domain=domain, window=[-1, 1]),
        z=Polynomial([0.0], domain=domain, window=[-1, 1]),
    )


def is_free(way: CubicWay, free: Free, cfg: MultiPathCfg) -> bool:
    """Whether a way collides nowhere, at points as close as ``cfg.checked_m``.

    Args:
        way: The way.
        free: Where the tool may be.
        cfg: How closely to look.

    Returns:
        Whether.
    """
    count = int(np.ceil(way.length_m / cfg.checked_m)) + 1
    return bool(free(way.equidistant(max(count, 2))).all())


# Directions to push in, in a way's (y, z): up first, then up and aside, then aside.
BOWS = np.array([[0.0, 1.0], [0.7, 0.7], [-0.7, 0.7], [1.0, 0.0], [-1.0, 0.0]])


def _bowed(line: CubicWay, bow: Array, free: Free, cfg: MultiPathCfg) -> CubicWay | None:
    """The way pushed aside in one direction until it is free; None if it does not get free."""
    x = line.along(cfg.points)
    pushed = np.zeros(cfg.points)
    way = line
    for _ in range(cfg.pushes):
        if is_free(way, free, cfg):
            return way
        points = line.start + np.column_stack((x, np.outer(pushed, bow))) @ line.frame.T
        # What collides: points pushed so far, and the fitted curve, which need not follow them.
        blocked = ~free(points) | ~free(way.at(x))
        if not blocked.any():  # between the points, then: all but the ends
            blocked[1:-1] = True
        around = np.ones(2 * cfg.spread + 1)
        blocked = np.convolve(blocked, around, mode="same") > 0.0
        blocked[[0, -1]] = False
        pushed[blocked] += cfg.push_m
        way = CubicWay(
            start=line.start,
            goal=line.goal,
            frame=line.frame,
            y=fit_pinned(x, pushed * bow[0]),
            z=fit_pinned(x, pushed * bow[1]),
        )
    return way if is_free(way, free, cfg) else None


def ways(start: Array, goal: Array, free: Free, up: Array, cfg: MultiPathCfg | None = None) -> list[CubicWay]:
    """All free ways from one start.

    Args:
        start: Shape (3,), m.
        goal: Shape (3,), m.
        free: Where the tool may be.
        up: Where the first push goes, shape (3,).
        cfg: How to seek.

    Returns:
        The line alone if it is free, else up to five bows; none if start or goal collide.
    """
    cfg = cfg or MultiPathCfg()
    line = straight(start, goal, up)
    if is_free(line, free, cfg):
        return [line]
    if not free(np.stack((start, goal))).all():
        return []
    found = (_bowed(line, bow, free, cfg) for bow in BOWS)
    return [way for way in found if way is not None]


def choose(candidates: list[CubicWay], cfg: MultiPathCfg | None = None) -> CubicWay | None:
    """The way of the least length and inflections.

    Args:
        candidates: From one start or from many.
        cfg: What an inflection weighs.

    Returns:
        The first of the best; None without candidates.
    """
    cfg = cfg or MultiPathCfg()
    return min(candidates, key=lambda way: way.cost_m(cfg), default=None)
