"""Edge curves of a bead: a user's points, Bezier-smoothed, by arc length."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline, make_interp_spline
from scipy.special import gammaln, xlog1py, xlogy

from seal_gym.core.errors import SeamError, is_number, require
from seal_gym.core.frames import Array, cross, normalise

SPLINE_DEGREE = 5  # tangents are differentiated twice by the solver: they have to be smooth
_SPREADS = 8.0  # binomial weights further than so many standard deviations away are below 1e-13
_SAMPLES_PER_SPREAD = 12
_SHORTEST_M = 1e-6


def _points(points: ArrayLike, name: str) -> Array:
    array = np.asarray(points, dtype=np.float64)
    require(
        array.ndim == 2 and array.shape[1] == 3 and len(array) >= 2,
        f"{name}: shape {array.shape}: must be (n, 3) with n >= 2, in metres, in order of travel",
        SeamError,
    )
    require(bool(np.all(np.isfinite(array))), f"{name}: every coordinate must be finite", SeamError)
    steps = np.linalg.norm(np.diff(array, axis=0), axis=1)
    k = int(np.argmin(steps))
    require(
        bool(steps[k] > _SHORTEST_M),
        f"{name}: points {k} and {k + 1} are {steps[k]:.2g} m apart: remove repeated points "
        f"(at least {_SHORTEST_M} m)",
        SeamError,
    )
    return array


def bezier(control: Array, t: Array) -> Array:
    """Points of one Bezier curve of any degree.

    The Bernstein weights are computed in logarithms and in a band about their peak, so that thousands of
    control points neither underflow nor cost a full matrix.

    Args:
        control: Control points, shape (m + 1, d).
        t: Parameters in [0, 1], shape (n,).

    Returns:
        Shape (n, d).
    """
    m = len(control) - 1
    half = int(np.ceil(_SPREADS * np.sqrt(m) / 2)) + 20
    width = min(2 * half + 1, m + 1)
    k = np.clip(np.rint(m * t).astype(int) - half, 0, m + 1 - width)[:, None] + np.arange(width)
    log_count = gammaln(m + 1) - gammaln(k + 1) - gammaln(m - k + 1)
    weight = np.exp(log_count + xlogy(k, t[:, None]) + xlog1py(m - k, -t[:, None]))
    weight /= weight.sum(axis=1, keepdims=True)
    return np.asarray(np.einsum("nk,nkd->nd", weight, control[k]))


def bezier_smooth(points: ArrayLike, spread_m: float) -> Array:
    """Smooths a polyline with a Bezier curve.

    Source: Berg 3.1.4: the points are interpolated and become control points of a Bezier curve, which
    follows them the closer the more there are. Its weights are binomial: the polyline is averaged over a
    standard deviation of L sqrt(t (1 - t) / m) of its length L. The number m of control points follows from
    the wanted deviation at mid-length; towards the ends it shrinks to nothing, so that the curve starts and
    ends in the polyline's end points and along its end legs.

    Args:
        points: In order of travel, shape (n, 3), m.
        spread_m: Standard deviation of the averaging at mid-length [m]; rounds corners by about 2 spreads.

    Returns:
        Dense points of the smooth curve, shape (k, 3), m.

    Raises:
        SeamError: If points are too few, not finite or repeated, or the spread is not in (0, L / 4].
    """
    polyline = _points(points, "points")
    s = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(polyline, axis=0), axis=1))))
    length = float(s[-1])
    require(
        is_number(spread_m) and 0.0 < spread_m <= length / 4,
        f"spread_m = {spread_m!r}: must be in (0, {length / 4:.4g}], a quarter of the polyline's length",
        SeamError,
    )
    m = int(np.ceil((length / (2 * spread_m)) ** 2))
    along = np.linspace(0.0, length, m + 1)
    control = np.stack([np.interp(along, s, column) for column in polyline.T], axis=1)
    # Towards the ends the averaging is narrower. Samples equidistant in arcsin sqrt t would follow it all the
    # way down to nothing; half of that is enough.
    x = np.linspace(0.0, 1.0, int(np.ceil(2 * _SAMPLES_PER_SPREAD * np.sqrt(m))) + 1)
    return bezier(control, (x + np.sin(x * np.pi / 2) ** 2) / 2)


@dataclass(frozen=True, eq=False)
class Curve:
    """A smooth curve by arc length.

    Attributes:
        spline: Position over arc length, m over m, of degree 5.
        length_m: Its length [m].
    """

    spline: BSpline
    length_m: float

    @classmethod
    def through(cls, points: ArrayLike) -> "Curve":
        """The curve through dense points of a smooth curve.

        Source: Berg Eqs. 3.1-3.2; arc length is the sum of the distances between the points (3.1.4), to
        which the spline's own length is added for the little that chords are short of.

        Args:
            points: In order of travel, shape (n, 3), m, n >= 6.

        Returns:
            The curve.

        Raises:
            SeamError: If points are too few, not finite or repeated.
        """
        array = _points(points, "points")
        require(len(array) > SPLINE_DEGREE, f"points: {len(array)} given, at least 6 needed", SeamError)
        s = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(array, axis=0), axis=1))))
        for _ in range(2):  # the second pass measures the first one's spline instead of chords
            spline = make_interp_spline(s, array, k=SPLINE_DEGREE)
            s = _lengths(spline, s)
        return cls(make_interp_spline(s, array, k=SPLINE_DEGREE), float(s[-1]))

    @classmethod
    def smoothed(cls, points: ArrayLike, spread_m: float) -> "Curve":
        """The Bezier-smoothed curve of a user's points; see ``bezier_smooth``.

        Args:
            points: In order of travel, shape (n, 3), m.
            spread_m: Standard deviation of the averaging at mid-length [m].

        Returns:
            The curve.
        """
        return cls.through(bezier_smooth(points, spread_m))

    def __call__(self, s_m: Array, order: int = 0) -> Array:
        """The curve or a derivative by arc length.

        Args:
            s_m: Arc lengths, shape (...), m.
            order: Of the derivative.

        Returns:
            Shape (..., 3); m, 1, 1/m, ...
        """
        return np.asarray(self.spline(s_m, nu=order))

    def tangent(self, s_m: Array) -> Array:
        """Unit direction of travel.

        Args:
            s_m: Arc lengths, shape (...), m.

        Returns:
            Shape (..., 3).
        """
        return normalise(self(s_m, 1))


def _lengths(spline: BSpline, s: Array) -> Array:
    """Arc length of a parametric curve at its parameters, by Gauss-Legendre quadrature of |spline'|."""
    nodes, weights = np.polynomial.legendre.leggauss(5)
    half = np.diff(s)[:, None] / 2
    speed = np.linalg.norm(spline((s[:-1, None] + s[1:, None]) / 2 + half * nodes, nu=1), axis=-1)
    return np.concatenate(([0.0], np.cumsum((half * speed) @ weights)))


@dataclass(frozen=True, eq=False)
class Edges:
    """The two edges of a bead.

    Attributes:
        left: To the left of travel, seen from the nozzle (x in the thesis).
        right: To the right (y in the thesis).
    """

    left: Curve
    right: Curve

    @classmethod
    def smoothed(cls, left: ArrayLike, right: ArrayLike, spread_m: float) -> "Edges":
        """Edges from a user's points.

        Args:
            left: Points of the left edge in order of travel, shape (n, 3), m.
            right: Of the right edge, shape (m, 3), m.
            spread_m: See ``bezier_smooth``.

        Returns:
            The edges.

        Raises:
            SeamError: See ``bezier_smooth``; or if the edges touch.
        """
        edges = cls(Curve.smoothed(left, spread_m), Curve.smoothed(right, spread_m))
        k = np.linspace(0.0, 1.0, 200)
        chord = edges.chord(k)
        width = np.linalg.norm(chord, axis=1)
        crossed = np.sum(chord[1:] * chord[:-1], axis=1) < 0.0  # between two samples
        width[:-1][crossed] = 0.0
        require(
            bool(width.min() > 1e-4),
            f"edges: only {width.min() * 1e3:.3g} mm apart at {k[width.argmin()] * 100:.0f} % of their "
            "length: they must stay at least 0.1 mm apart and run the same way",
            SeamError,
        )
        return edges

    def chord(self, share: Array) -> Array:
        """From the left to the right edge at equal shares of their lengths.

        Args:
            share: In [0, 1], shape (...).

        Returns:
            Shape (..., 3), m.
        """
        return self.right(share * self.right.length_m) - self.left(share * self.left.length_m)


def offset_polyline(points: ArrayLike, normal: ArrayLike, offset_m: float, *, closed: bool = False) -> Array:
    """A planar polyline moved sideways, with mitred corners.

    Args:
        points: In order of travel, shape (n, 3), m, in one plane.
        normal: Of the plane, towards the nozzle, shape (3,).
        offset_m: To the left of travel seen from the nozzle; negative to the right [m].
        closed: Whether the first and last point coincide and their legs meet in a corner or a straight.

    Returns:
        Shape (n, 3), m.

    Raises:
        SeamError: If the polyline turns back on itself.
    """
    polyline, up = _points(points, "points"), np.asarray(normal, dtype=np.float64)
    leg = normalise(np.diff(polyline, axis=0))
    first, last = (leg[-1:], leg[:1]) if closed else (leg[:1], leg[-1:])
    before, after = np.concatenate((first, leg)), np.concatenate((leg, last))
    cosine = 1.0 + np.sum(before * after, axis=1, keepdims=True)
    require(bool(np.all(cosine > 1e-3)), "points: the polyline turns back on itself", SeamError)
    return np.asarray(polyline + offset_m * cross(up, before + after) / cosine)
