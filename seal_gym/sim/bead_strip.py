"""The columns that a bead fills: rays along the nozzle's direction down to the part's triangles."""

from functools import lru_cache

import numpy as np

from seal_gym.core.frames import Array
from seal_gym.core.jit import kernel
from seal_gym.sealant.strip import Strip
from seal_gym.workpieces.workpiece import Workpiece

# Rays begin this far over the seam, along the columns, and end this far below it: a groove's bottom is seen,
# the far side of a thin plate is not.
_ABOVE_M, _BELOW_M = 18e-3, 8e-3


@kernel
def _hit(corner: Array, k: int, origin: Array, way: Array) -> float:
    """Length of a ray to a triangle (Moeller and Trumbore); infinite if it misses."""
    e1, e2, p, q, t = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for a in range(3):
        e1[a], e2[a] = corner[k, 1, a] - corner[k, 0, a], corner[k, 2, a] - corner[k, 0, a]
        t[a] = origin[a] - corner[k, 0, a]
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        p[a] = way[b] * e2[c] - way[c] * e2[b]
        q[a] = t[b] * e1[c] - t[c] * e1[b]
    det = e1[0] * p[0] + e1[1] * p[1] + e1[2] * p[2]
    if abs(det) < 1e-18:
        return np.inf
    u = (t[0] * p[0] + t[1] * p[1] + t[2] * p[2]) / det
    v = (way[0] * q[0] + way[1] * q[1] + way[2] * q[2]) / det
    slack = 1e-9  # rays through a shared edge hit one of the two
    if u < -slack or v < -slack or u + v > 1.0 + slack:
        return np.inf
    return float((e2[0] * q[0] + e2[1] * q[1] + e2[2] * q[2]) / det)


@kernel
def _probe(
    corner: Array,
    plane: Array,
    sphere: Array,
    point: Array,
    side: Array,
    column: Array,
    across: Array,
    above: float,
    below: float,
    height: Array,
    normal: Array,
) -> None:
    reach = max(abs(across[0]), abs(across[-1])) + above + below
    near = np.empty(len(corner), np.int64)
    origin, way = np.empty(3), np.empty(3)
    for k in range(len(point)):
        count = 0
        for n in range(len(corner)):
            gap = 0.0
            for a in range(3):
                gap += (sphere[n, a] - point[k, a]) ** 2
            if gap <= (reach + sphere[n, 3]) ** 2:
                near[count] = n
                count += 1
        for j in range(len(across)):
            for a in range(3):
                way[a] = -column[k, a]
                origin[a] = point[k, a] + across[j] * side[k, a] + above * column[k, a]
            best, which = above + below, -1
            for m in range(count):
                n = near[m]
                facing = plane[n, 0] * way[0] + plane[n, 1] * way[1] + plane[n, 2] * way[2]
                if facing >= 0.0:
                    continue
                length = _hit(corner, n, origin, way)
                if 0.0 <= length < best:
                    best, which = length, n
            if which >= 0:
                height[k, j] = above - best
                for a in range(3):
                    normal[k, j, a] = plane[which, a]


@lru_cache(maxsize=16)
def bead_strip(workpiece: Workpiece, spacing_m: float, half_width_m: float) -> Strip:
    """The columns over a workpiece's seam, its run-on past both ends included.

    Args:
        workpiece: The part.
        spacing_m: Between columns, along and across [m]; along it is rounded so that rows fit.
        half_width_m: How far to either side of the seam [m].

    Returns:
        The strip in the part's frame; the same object for the same arguments.
    """
    seam, surface = workpiece.seam, workpiece.surface
    first, last = float(seam.arc[0]), float(seam.arc[-1])
    arc = np.linspace(first, last, max(round((last - first) / spacing_m), 2) + 1)
    half = max(round(half_width_m / spacing_m), 1)
    across = spacing_m * np.arange(-half, half + 1, dtype=np.float64)
    line = seam.at(arc)
    side = np.cross(line.tangent, line.approach)
    triangles = np.ascontiguousarray(surface.triangles, dtype=np.float64)
    centre = 0.5 * (triangles.min(axis=1) + triangles.max(axis=1))
    radius = np.linalg.norm(triangles - centre[:, None], axis=2).max(axis=1)
    height = np.full((len(arc), len(across)), np.nan)
    normal = np.zeros((*height.shape, 3))
    _probe(
        triangles,
        np.ascontiguousarray(surface.normals),
        np.column_stack((centre, radius)),
        line.position,
        side,
        line.approach,
        across,
        _ABOVE_M,
        _BELOW_M,
        height,
        normal,
    )
    return Strip.of(arc, across, (line.position, line.tangent, line.approach), height, normal)
