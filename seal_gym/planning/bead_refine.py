"""Refines a bead path on an evaluator that says how high its bead stands at both edges (Berg, Fig. 1.1).

The geometric path is the first guess. Corrections of the speed, of the nozzle's place and of its direction
are cubic splines along the path; least squares makes the heights at the edges equal to a target. The
evaluator is a black box: derivatives are differences, of many knots at once, as a knot only changes the bead
near itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.interpolate import BSpline
from scipy.optimize import least_squares

from seal_gym.core.errors import ConfigError, is_number, require
from seal_gym.core.frames import Array, axis_angle
from seal_gym.planning.bead_geometry import BeadPath

_DEGREE = 3
# A knot's spline reaches 2 knots to either side, and its bead a little further.
_STRIDE = 8
_DIFFERENCE = 0.05  # of a correction's bound
CHANNELS = ("speed", "shift", "offset", "tilt", "spin")


class Evaluator(Protocol):
    """Says how high beads stand at both edges."""

    def __call__(self, paths: Sequence[BeadPath]) -> Array:
        """Heights of beads.

        Args:
            paths: The paths.

        Returns:
            At the same places of the edges for each, left then right: shape (len(paths), 2, n), m.
        """


@dataclass(frozen=True, kw_only=True)
class RefineCfg:
    """How a path may be corrected.

    Attributes:
        spacing_m: Of the knots along the nozzle's path, about [m].
        speed: Largest correction of the logarithm of the speed; 0 leaves it.
        shift_m: Of the nozzle's place along the tip's x [m].
        offset_m: Along the tip's z [m].
        tilt_rad: Turn about the tip's y [rad].
        spin_rad: Turn about the tip's z [rad].
        effort: Weight of the corrections, relative to their bounds, against relative errors of heights.
        iterations: Most evaluations of the residual.
    """

    spacing_m: float = 8e-3
    speed: float = 0.3
    shift_m: float = 2e-3
    offset_m: float = 4e-3
    tilt_rad: float = np.deg2rad(8.0)
    spin_rad: float = 0.0
    effort: float = 0.01
    iterations: int = 8

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for name, low, high in (
            ("spacing_m", 1e-3, 1.0),
            ("speed", 0.0, 1.0),
            ("shift_m", 0.0, 0.02),
            ("offset_m", 0.0, 0.05),
            ("tilt_rad", 0.0, 0.6),
            ("spin_rad", 0.0, 0.6),
            ("effort", 0.0, 10.0),
            ("iterations", 1, 1000),
        ):
            value = getattr(self, name)
            require(
                is_number(value) and low <= value <= high,
                f"RefineCfg.{name} = {value!r}: must be a number in [{low:g}, {high:g}]; check the unit",
                ConfigError,
            )
        require(
            bool(self.bounds.any()),
            "RefineCfg: every correction is bounded by 0: allow at least one",
            ConfigError,
        )

    @property
    def bounds(self) -> Array:
        """Of ``CHANNELS``, shape (5,)."""
        return np.array([self.speed, self.shift_m, self.offset_m, self.tilt_rad, self.spin_rad])


def basis(share: Array, knots: int) -> Array:
    """Uniform cubic splines.

    Args:
        share: In [0, 1], shape (n,).
        knots: How many splines, >= 4.

    Returns:
        Their values, which sum to 1, shape (n, knots).
    """
    inner = np.linspace(0.0, 1.0, knots - _DEGREE + 1)
    t = np.concatenate((np.zeros(_DEGREE), inner, np.ones(_DEGREE)))
    return np.asarray(BSpline.design_matrix(np.clip(share, 0.0, 1.0), t, _DEGREE).toarray())


def shares(path: BeadPath) -> Array:
    """How far along its way a nozzle is.

    Args:
        path: The path.

    Returns:
        Way over the whole way, at the path's times, shape (n,).
    """
    way = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(path.position_m, axis=0), axis=1))))
    return np.asarray(way / way[-1])


def corrected(path: BeadPath, corrections: Array) -> BeadPath:
    """A path with corrections.

    Args:
        path: The first guess.
        corrections: At its points, of ``CHANNELS``: logarithm of the speed, m, m, rad, rad; shape (n, 5).

    Returns:
        The path; its flow in time is not corrected, so that there is less sealant where it is faster.
    """
    speed, shift, offset, tilt, spin = corrections.T
    step = np.diff(path.time_s) * np.exp(-0.5 * (speed[1:] + speed[:-1]))
    x, z = path.rotation[..., 0], path.rotation[..., 2]
    turned = axis_angle(z, spin) @ axis_angle(path.rotation[..., 1], tilt) @ path.rotation
    return BeadPath(
        time_s=path.time_s[0] + np.concatenate(([0.0], np.cumsum(step))),
        position_m=path.position_m + shift[:, None] * x + offset[:, None] * z,
        rotation=turned,
        flow_m3_per_s=path.flow_m3_per_s,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Refined:
    """A refined path.

    Attributes:
        path: The path.
        corrections: At the first guess's points, shape (n, 5), see ``corrected``.
        before_m: The evaluator's heights of the first guess, shape (2, m).
        after_m: Of the path, shape (2, m).
        target_m: What they should be.
        evaluations: Paths that were evaluated.
    """

    path: BeadPath
    corrections: Array
    before_m: Array
    after_m: Array
    target_m: float
    evaluations: int


def refine(
    path: BeadPath,
    evaluate: Evaluator,
    place_share: Array,
    cfg: RefineCfg | None = None,
    target_m: float | None = None,
) -> Refined:
    """Corrects a path until its bead is as even as the evaluator and the bounds allow.

    Args:
        path: The first guess.
        evaluate: Gives heights at n places of both edges.
        place_share: Where along the nozzle's way (see ``shares``) each place is, shape (n,).
        cfg: What may be corrected; the default one if none is given.
        target_m: The height wanted [m]; the first guess's mean by default.

    Returns:
        The path.

    Raises:
        ConfigError: If the evaluator's heights do not fit the places or are not finite.
    """
    cfg = cfg or RefineCfg()
    along = shares(path)
    way = float(np.linalg.norm(np.diff(path.position_m, axis=0), axis=1).sum())
    count = max(round(way / cfg.spacing_m), _DEGREE + 1)
    splines, bounds = basis(along, count), cfg.bounds
    channels = np.flatnonzero(bounds)
    places = len(place_share)
    centre = np.array([np.average(along, weights=column) for column in splines.T])
    evaluations = 0

    def correction(values: Array) -> Array:
        out = np.zeros((len(along), len(CHANNELS)))
        out[:, channels] = splines @ (values.reshape(len(channels), count) * bounds[channels, None]).T
        return out

    def heights(batch: Sequence[Array]) -> Array:
        nonlocal evaluations
        evaluations += len(batch)
        found = evaluate([corrected(path, correction(values)) for values in batch])
        ok = found.shape == (len(batch), 2, places) and bool(np.isfinite(found).all())
        require(
            ok,
            f"evaluator: heights of shape {found.shape}: must be {(len(batch), 2, places)} and finite",
            ConfigError,
        )
        return found

    start = np.zeros(len(channels) * count)
    before = heights([start])[0]
    target = float(before.mean()) if target_m is None else target_m
    scale = 1.0 / (target * np.sqrt(2 * places))
    effort = cfg.effort / np.sqrt(start.size)

    def residual(values: Array) -> Array:
        return np.concatenate(((heights([values])[0].ravel() - target) * scale, effort * values))

    def jacobian(values: Array) -> Array:
        batch, groups = [values], []
        for c in range(len(channels)):
            for first in range(min(_STRIDE, count)):
                knots = np.arange(first, count, _STRIDE)
                # Towards the inside, so that no bound is passed.
                sign = np.where(values[c * count + knots] > 0.0, -1.0, 1.0)
                changed = values.copy()
                changed[c * count + knots] += _DIFFERENCE * sign
                batch.append(changed)
                groups.append((c * count, knots, sign))
        found = heights(batch)
        out = np.zeros((2, places, values.size))
        for (base, knots, sign), high in zip(groups, found[1:], strict=True):
            mine = np.argmin(np.abs(place_share[:, None] - centre[knots]), axis=1)
            slope = (high - found[0]) / (_DIFFERENCE * sign[mine]) * scale
            out[:, np.arange(places), base + knots[mine]] = slope
        return np.vstack((out.reshape(2 * places, -1), effort * np.eye(values.size)))

    solved = least_squares(residual, start, jacobian, bounds=(-1.0, 1.0), max_nfev=cfg.iterations)
    final = correction(solved.x)
    return Refined(
        path=corrected(path, final),
        corrections=final,
        before_m=before,
        after_m=heights([solved.x])[0],
        target_m=target,
        evaluations=evaluations,
    )
