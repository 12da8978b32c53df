"""The eight cases that bead paths are tried on (Berg 3.1.4, Fig. 3.6).

The thesis shows them without sizes; those here are our own, of the size of its plots.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from seal_gym.core.errors import SeamError
from seal_gym.core.frames import Array
from seal_gym.planning.bead_curves import Edges, offset_polyline

_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, kw_only=True, eq=False)
class BeadCase:
    """Two edges to be sealed in a given time.

    Attributes:
        name: Of the case.
        title: For people.
        left: Points of the left edge in order of travel, shape (n, 3), m, in the part's frame (z up).
        right: Points of the right edge, shape (n, 3), m.
        spread_m: Of the Bezier smoothing, see ``bead_curves.bezier_smooth`` [m].
        duration_s: t_f, which sets the bead's height [s].
        feasible: Whether a path within the default limits exists.
        gap_m: Width of a gap in the substrate under the bead's centre line [m]; 0 for none.
    """

    name: str
    title: str
    left: Array
    right: Array
    spread_m: float
    duration_s: float
    feasible: bool = True
    gap_m: float = 0.0

    def edges(self) -> Edges:
        """The smooth edges.

        Returns:
            By arc length.
        """
        return Edges.smoothed(self.left, self.right, self.spread_m)


def _planar(centre: ArrayLike, half_width_m: float, *, closed: bool = False) -> tuple[Array, Array]:
    """Both edges beside a centre line in the xy plane, given by x and y."""
    xy = np.asarray(centre, dtype=np.float64)
    points = np.column_stack((xy, np.zeros(len(xy))))
    return (
        offset_polyline(points, _UP, half_width_m, closed=closed),
        offset_polyline(points, _UP, -half_width_m, closed=closed),
    )


def _upright(profile: ArrayLike, half_width_m: float) -> tuple[Array, Array]:
    """Both edges beside a centre line in the xz plane, given by x and z."""
    xz = np.asarray(profile, dtype=np.float64)
    centre = np.column_stack((xz[:, 0], np.zeros(len(xz)), xz[:, 1]))
    aside = np.array([0.0, half_width_m, 0.0])
    return centre + aside, centre - aside


def _varying_width() -> BeadCase:
    x = np.linspace(0.0, 0.4, 401)
    half = (0.012 + 0.018 * np.sin(np.pi * x / 0.4) ** 2) / 2
    zero = np.zeros_like(x)
    return BeadCase(
        name="varying_width",
        title="varying width",
        left=np.column_stack((x, half, zero)),
        right=np.column_stack((x, -half, zero)),
        spread_m=5e-3,
        duration_s=1.0,
    )


def _zig_zag() -> BeadCase:
    left, right = _planar([(0, 0), (0.08, 0.04), (0.16, 0), (0.24, 0.04), (0.32, 0)], 7.5e-3)
    return BeadCase(name="zig_zag", title="zig-zag", left=left, right=right, spread_m=12e-3, duration_s=1.2)


def _square(side_m: float) -> list[tuple[float, float]]:
    """A square from the middle of a side, counter-clockwise."""
    half = side_m / 2
    return [(0, -half), (half, -half), (half, half), (-half, half), (-half, -half), (0, -half)]


def _large_square() -> BeadCase:
    left, right = _planar(_square(0.2), 7.5e-3, closed=True)
    return BeadCase(
        name="large_square", title="large square", left=left, right=right, spread_m=8e-3, duration_s=2.6
    )


def _small_square() -> BeadCase:
    # The sharper its corners the shorter its outer edge against the inner one: up to a spread of 3 mm there
    # still is a path, with the tilt at its limit nearly all the way round.
    left, right = _planar(_square(0.05), 10e-3, closed=True)
    return BeadCase(
        name="small_square",
        title="small square",
        left=left,
        right=right,
        spread_m=8e-3,
        duration_s=0.7,
        feasible=False,
    )


def _half_circle() -> BeadCase:
    radius, leg = 0.06, 0.05
    angle = np.linspace(0.0, np.pi, 181)
    arc = np.column_stack((radius * np.sin(angle), -radius * np.cos(angle)))
    steps = np.linspace(-leg, 0.0, 26)[:-1]
    first = np.column_stack((steps, np.full_like(steps, -radius)))
    last = np.column_stack((steps[::-1], np.full_like(steps, radius)))
    left, right = _planar(np.concatenate((first, arc, last)), 7.5e-3)
    return BeadCase(
        name="half_circle",
        title="half circle over a gap",
        left=left,
        right=right,
        spread_m=5e-3,
        duration_s=1.2,
        gap_m=2e-3,
    )


def _corner_seam() -> BeadCase:
    ends = np.array([0.0, 0.3])
    return BeadCase(
        name="corner_seam",
        title="seam in a corner",
        left=np.column_stack((ends, [0.0, 0.0], [0.01, 0.01])),
        right=np.column_stack((ends, [-0.01, -0.01], [0.0, 0.0])),
        spread_m=5e-3,
        duration_s=1.0,
    )


def _over_corner() -> BeadCase:
    left, right = _upright([(0, 0), (0.12, 0), (0.12, -0.12)], 10e-3)
    return BeadCase(
        name="over_corner", title="over a corner", left=left, right=right, spread_m=8e-3, duration_s=1.0
    )


def _stairs() -> BeadCase:
    tread, riser = 0.06, 0.04
    profile = [(0.0, 0.0)]
    for _ in range(3):
        x, z = profile[-1]
        profile += [(x + tread, z), (x + tread, z + riser)]
    profile.append((profile[-1][0] + tread, profile[-1][1]))
    left, right = _upright(profile, 10e-3)
    return BeadCase(name="stairs", title="stairs", left=left, right=right, spread_m=8e-3, duration_s=1.5)


_CASES: dict[str, Callable[[], BeadCase]] = {
    "varying_width": _varying_width,
    "zig_zag": _zig_zag,
    "large_square": _large_square,
    "small_square": _small_square,
    "half_circle": _half_circle,
    "corner_seam": _corner_seam,
    "over_corner": _over_corner,
    "stairs": _stairs,
}
CASES = tuple(_CASES)


@lru_cache(maxsize=len(CASES))
def get(name: str) -> BeadCase:
    """A case by name.

    Args:
        name: One of ``CASES``.

    Returns:
        The case.

    Raises:
        SeamError: If there is none of that name.
    """
    if name not in _CASES:
        raise SeamError(f"bead case {name!r}: unknown; the cases are {', '.join(CASES)}")
    return _CASES[name]()
