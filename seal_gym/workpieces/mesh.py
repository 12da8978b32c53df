"""Parts from mesh files: triangles, and convex pieces that collide exactly where the triangles are."""

from collections import defaultdict, deque
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import SeamError, is_number, require
from seal_gym.core.frames import Array, cross, normalise
from seal_gym.workpieces.seam import MAX_COORDINATE_M
from seal_gym.workpieces.solids import Solid, hull

# Every triangle becomes a part of some convex piece, and the pieces are looked at in each physics step.
MAX_TRIANGLES = 20_000
# How far a piece may depart from the triangles: what single precision leaves of a part of a metre, and
# far below the clearance of 1 mm the nozzle has.
_TOLERANCE_M = 2e-5
_WELD_M = 1e-6
_SMALLEST_AREA_M2 = 1e-12
# A flat piece is given a back of this depth, inside the part; the shallower where it is thin.
_DEPTHS_M = (5e-4, 1e-4)


def read_mesh(path: Path, scale: float) -> Array:
    """Triangles of an STL or OBJ file.

    Args:
        path: The file.
        scale: Metres per unit of the file.

    Returns:
        Shape (n, 3, 3), m, in the file's frame. A closed mesh that is inside out is turned.

    Raises:
        SeamError: If there is no such file, its type is another, it holds no usable mesh, too many
            triangles or the scale is not a positive number.
    """
    require(
        path.is_file(), f"mesh file {str(path)!r} not found: give the path of an STL or OBJ file", SeamError
    )
    require(
        path.suffix.lower() in (".stl", ".obj"),
        f"mesh file {path.name!r} has the type {path.suffix!r}: must be .stl or .obj",
        SeamError,
    )
    require(
        is_number(scale) and scale > 0,
        f"scale = {scale!r}: must be a number > 0, metres per unit of the file (0.001 for millimetres)",
        SeamError,
    )
    import trimesh  # only for parts from files

    try:
        triangles = scale * np.array(trimesh.load_mesh(path, process=False).triangles, dtype=np.float64)
    except Exception as error:
        # Its parsers raise whatever a broken file makes them stumble over.
        raise SeamError(f"mesh file {path.name!r} cannot be used: {error}; export it anew") from error
    require(
        triangles.ndim == 3 and len(triangles) > 0 and bool(np.isfinite(triangles).all()),
        f"mesh file {path.name!r} cannot be used: no triangles, or one that is not finite; export it anew",
        SeamError,
    )
    extent = np.ptp(triangles.reshape(-1, 3), axis=0).max()
    require(
        bool(extent <= MAX_COORDINATE_M),
        f"mesh file {path.name!r} is {extent:.3g} m across: at most {MAX_COORDINATE_M:g} m; check the units "
        f"(scale = {scale:g}, 0.001 for millimetres)",
        SeamError,
    )
    require(
        len(triangles) <= MAX_TRIANGLES,
        f"mesh file {path.name!r} has {len(triangles)} triangles: at most {MAX_TRIANGLES}; export it coarser",
        SeamError,
    )
    topology = _Topology.of(triangles)
    if topology.closed and np.sum(triangles[:, 0] * cross(triangles[:, 1], triangles[:, 2])) < 0:
        return triangles[:, ::-1]
    return triangles


def convex_pieces(triangles: Array) -> list[Solid]:
    """Convex pieces that together have the surface of a mesh, concave or not.

    Each piece is the hull of neighbouring triangles of which none looks at another, grown as far as no
    other triangle reaches into it: nothing of a closed mesh's outside is then within a piece. Of an open
    mesh, which has no inside, only coplanar triangles are joined.

    Args:
        triangles: Counter-clockwise seen from outside, shape (n, 3, 3), m.

    Returns:
        The pieces, within 0.02 mm of the triangles on their outside.
    """
    shape = _Topology.of(triangles)
    free = shape.area > _SMALLEST_AREA_M2
    pieces = []
    # Where the last piece had to be cut back, the next will hardly be larger: do not look far in vain.
    limit = len(triangles)
    # Large faces first: they make the largest pieces.
    for seed in np.argsort(-shape.area, kind="stable"):
        if not free[seed]:
            continue
        members = _grow(shape, int(seed), free, limit)
        limit = 2 * limit if len(members) == limit else limit
        while (points := _piece(shape, members)) is None:
            members = members[: len(members) // 2]
            limit = 2 * len(members)
        free[members] = False
        pieces.append(hull(points))
    return pieces


@dataclass(frozen=True, kw_only=True, eq=False)
class _Topology:
    """Triangles with what is needed to join them.

    Attributes:
        triangles: Shape (n, 3, 3), m.
        normal: Shape (n, 3).
        offset: Distance of each plane from the origin, shape (n,), m.
        area: Shape (n,), m^2.
        neighbours: Indices of the triangles that share an edge, one list a triangle.
        closed: Whether every edge has as many triangles on one side as on the other.
    """

    triangles: Array
    normal: Array
    offset: Array
    area: Array
    neighbours: list[list[int]]
    closed: bool

    @classmethod
    def of(cls, triangles: Array) -> Self:
        """Joins triangles at the edges they share."""
        keys = np.round(triangles.reshape(-1, 3) / _WELD_M).astype(np.int64)
        vertex = np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1, 3)
        sides: dict[tuple[int, int], list[int]] = defaultdict(list)
        for k, (a, b, c) in enumerate(vertex.tolist()):
            for edge in ((a, b), (b, c), (c, a)):
                sides[edge].append(k)
        neighbours: list[list[int]] = [[] for _ in triangles]
        for (a, b), here in sides.items():
            for k in here:
                neighbours[k] += sides.get((b, a), [])
        closed = all(len(here) == len(sides.get((b, a), ())) for (a, b), here in sides.items() if a != b)
        normal = cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        twice = np.linalg.norm(normal, axis=1, keepdims=True)
        normal = np.divide(normal, twice, out=np.zeros_like(normal), where=twice > 0)
        return cls(
            triangles=triangles,
            normal=normal,
            offset=np.sum(normal * triangles[:, 0], axis=1),
            area=twice[:, 0] / 2,
            neighbours=neighbours,
            closed=closed,
        )


def _grow(shape: _Topology, seed: int, free: NDArray[np.bool_], limit: int) -> NDArray[np.intp]:
    """Free triangles connected to a seed, nearest first, each behind the planes of all the others."""
    members, seen, queue = [seed], {seed}, deque(shape.neighbours[seed])
    while queue and len(members) < limit:
        k = queue.popleft()
        if k in seen or not free[k]:
            continue
        seen.add(k)
        heights = shape.triangles[members].reshape(-1, 3) @ shape.normal[k] - shape.offset[k]
        if heights.max() > _TOLERANCE_M or (not shape.closed and heights.min() < -_TOLERANCE_M):
            continue
        above = shape.normal[members] @ shape.triangles[k].T - shape.offset[members, None]
        if above.max() > _TOLERANCE_M:
            continue
        members.append(k)
        queue.extend(shape.neighbours[k])
    return np.array(members, dtype=np.intp)


def _piece(shape: _Topology, members: NDArray[np.intp]) -> Array | None:
    """Points of the hull of some triangles, with a back if they are flat; None if it holds too much."""
    points = np.unique(shape.triangles[members].reshape(-1, 3), axis=0)
    weight = shape.area[members, None]
    mean = np.sum(weight * shape.normal[members], axis=0)
    facing = float(np.linalg.norm(mean) / weight.sum())
    single = len(members) == 1
    if facing > 0.5 and np.ptp(points @ normalise(mean)) < _DEPTHS_M[0]:
        centre = np.sum(weight * shape.triangles[members].mean(axis=1), axis=0) / weight.sum()
        backs = [np.concatenate((points, [centre - depth * normalise(mean)])) for depth in _DEPTHS_M]
    else:
        backs = [points]
    for candidate in backs:
        if _fits(shape, members, candidate):
            return candidate
    return backs[-1] if single else None


def _fits(shape: _Topology, members: NDArray[np.intp], points: Array) -> bool:
    """Whether no other triangle reaches into the hull of the points (or, of an open mesh, the area fits)."""
    from scipy.spatial import ConvexHull, QhullError  # takes 0.2 s to load: only for those who need it

    try:
        body = ConvexHull(points)
    except QhullError:
        return False
    faces = body.equations
    if not shape.closed and len(members) > 1:
        front = faces[:, :3] @ shape.normal[members[0]] > 0.99
        corners = points[body.simplices[front]]
        outline = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        gap = np.linalg.norm(outline, axis=1).sum() / 2 - shape.area[members].sum()
        return bool(gap < _TOLERANCE_M * np.sqrt(shape.area[members].sum()))
    other = np.ones(len(shape.area), np.bool_)
    other[members] = False
    low, high = points.min(axis=0) + _TOLERANCE_M, points.max(axis=0) - _TOLERANCE_M
    t = shape.triangles
    other &= np.all((t.max(axis=1) > low) & (t.min(axis=1) < high), axis=1)
    near = np.flatnonzero(other)
    if not len(near):
        return True
    # Separating planes: a face of the hull, or the triangle's own. (Pairs that only a third plane parts
    # count as touching: that costs a piece more, never a wrong one.)
    distance = (t[near].reshape(-1, 3) @ faces[:, :3].T + faces[:, 3]).reshape(len(near), 3, -1)
    outside = (distance.min(axis=1) > -_TOLERANCE_M).any(axis=1)
    height = points @ shape.normal[near].T - shape.offset[near]
    beside = (height.max(axis=0) < _TOLERANCE_M) | (height.min(axis=0) > -_TOLERANCE_M)
    return bool(np.all(outside | beside))
