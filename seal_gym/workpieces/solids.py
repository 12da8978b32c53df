"""Surfaces and collision solids swept along seams."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.frames import Array, cross, normalise, transform
from seal_gym.workpieces.surface import Surface

_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, kw_only=True, eq=False)
class Solid:
    """A convex body that gun and arm can hit.

    Attributes:
        kind: ``box`` (size = half extents), ``cylinder`` (size = radius, half height, 0) or ``hull`` (convex
            hull of ``points``).
        pose: ``T_part_solid``, shape (4, 4), m.
        size: Shape (3,), m; zeros for a hull.
        points: Shape (n, 3), m, in the solid's frame; empty for box and cylinder.
    """

    kind: Literal["box", "cylinder", "hull"]
    pose: Array
    size: Array
    points: Array


def _solid(kind: Literal["box", "cylinder"], position: Array, size: Array) -> Solid:
    return Solid(kind=kind, pose=transform(np.eye(3), position), size=size, points=np.empty((0, 3)))


def box(lower: tuple[float, float, float], upper: tuple[float, float, float]) -> Solid:
    """Axis-aligned box.

    Args:
        lower: Corner with the smallest coordinates [m].
        upper: Corner with the largest coordinates [m].

    Returns:
        The solid.
    """
    a, b = np.asarray(lower), np.asarray(upper)
    return _solid("box", (a + b) / 2, (b - a) / 2)


def cylinder(centre: tuple[float, float], radius: float, bottom: float, top: float) -> Solid:
    """Upright cylinder.

    Args:
        centre: Axis position x, y [m].
        radius: Radius [m].
        bottom: Lower end [m].
        top: Upper end [m].

    Returns:
        The solid.
    """
    position = np.array([*centre, (bottom + top) / 2])
    return _solid("cylinder", position, np.array([radius, (top - bottom) / 2, 0.0]))


def hull(points: Array) -> Solid:
    """Convex hull.

    Args:
        points: Shape (n, 3), m.

    Returns:
        The solid.
    """
    return Solid(kind="hull", pose=np.eye(4), size=np.zeros(3), points=points)


def _surface(triangles: Array, material: int) -> Surface:
    return Surface(triangles=triangles, material=np.full(len(triangles), material, np.int32))


def _strip(a: Array, b: Array) -> Array:
    """Triangles of the band between two curves of m points, outside seen with a on the left of b."""
    first = np.stack((a[:-1], b[:-1], b[1:]), axis=1)
    second = np.stack((a[:-1], b[1:], a[1:]), axis=1)
    triangles = np.concatenate((first, second))
    area = np.linalg.norm(cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    return np.asarray(triangles[area > 1e-14])


def _end_caps(rails: tuple[Array, Array, Array, Array], *, forward: bool) -> Array:
    """Triangles that close both ends of a swept section.

    Args:
        rails: Corners of the section along the sweep, each of shape (m, 3), m.
        forward: Whether they go round counter-clockwise seen from past the sweep's end.

    Returns:
        Shape (4, 3, 3), m.
    """
    caps = []
    for k, at_end in ((0, False), (-1, True)):
        quad = np.stack([rail[k] for rail in rails])
        quad = quad if at_end == forward else quad[::-1]
        caps += [quad[[0, 1, 2]], quad[[0, 2, 3]]]
    return np.stack(caps)


def rectangle(lower: tuple[float, float], upper: tuple[float, float], z: float, material: int) -> Surface:
    """Horizontal rectangle seen from above.

    Args:
        lower: Smallest x, y [m].
        upper: Largest x, y [m].
        z: Height [m].
        material: Index into ``MATERIALS``.

    Returns:
        Two triangles.
    """
    (x0, y0), (x1, y1) = lower, upper
    corners = np.array([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]])
    return _surface(corners[[[0, 1, 2], [0, 2, 3]]], material)


def plate(
    lower: tuple[float, float], upper: tuple[float, float], thickness: float, material: int
) -> tuple[Surface, Solid]:
    """A rectangular plate whose top is the plane z = 0.

    Args:
        lower: Smallest x, y [m].
        upper: Largest x, y [m].
        thickness: Downwards [m].
        material: Index into ``MATERIALS``.

    Returns:
        Its top and sides, and its solid.
    """
    return (
        Surface.join(rectangle(lower, upper, 0.0, material), rim(lower, upper, thickness, material)),
        box((*lower, -thickness), (*upper, 0.0)),
    )


def rim(lower: tuple[float, float], upper: tuple[float, float], thickness: float, material: int) -> Surface:
    """The sides of a plate: without them it would seem to float above its own shadow.

    Args:
        lower: Smallest x, y [m].
        upper: Largest x, y [m].
        thickness: From z = 0 downwards [m].
        material: Index into ``MATERIALS``.

    Returns:
        Eight triangles.
    """
    (x0, y0), (x1, y1) = lower, upper
    top = np.array([[x0, y0, 0.0], [x1, y0, 0.0], [x1, y1, 0.0], [x0, y1, 0.0], [x0, y0, 0.0]])
    return _surface(_strip(top, top - thickness * _UP), material)


def prism(footprint: Array, bottom: float, top: float, material: int) -> Surface:
    """Sides and top of an upright prism over a convex footprint.

    Args:
        footprint: Counter-clockwise corners, shape (n, 2), m.
        bottom: Lower end [m].
        top: Upper end [m].
        material: Index into ``MATERIALS``.

    Returns:
        The surface.
    """
    closed = np.concatenate((footprint, footprint[:1]))
    low = np.column_stack((closed, np.full(len(closed), bottom)))
    high = np.column_stack((closed, np.full(len(closed), top)))
    fan = np.stack((np.broadcast_to(high[0], high[2:-1].shape), high[1:-2], high[2:-1]), axis=1)
    return _surface(np.concatenate((_strip(high, low), fan)), material)


def arc_points(centre: tuple[float, float], radius: float, first: float, last: float, step: float) -> Array:
    """Points on a circular arc.

    Args:
        centre: Its centre x, y [m].
        radius: Its radius [m].
        first: First angle [rad].
        last: Last angle [rad].
        step: Largest angle between points [rad].

    Returns:
        Shape (n, 2), m.
    """
    angle = np.linspace(first, last, int(np.ceil(abs(last - first) / step - 1e-9)) + 1)
    return np.asarray(centre) + radius * np.column_stack((np.cos(angle), np.sin(angle)))


def simplify(curve: Array, tolerance: float) -> NDArray[np.intp]:
    """Indices of the fewest vertices that keep a curve within a tolerance (Douglas-Peucker).

    Args:
        curve: Shape (m, 3), m.
        tolerance: Largest departure [m].

    Returns:
        Increasing indices, the first and last among them.
    """
    keep, spans = {0, len(curve) - 1}, [(0, len(curve) - 1)]
    while spans:
        a, b = spans.pop()
        if b - a < 2:
            continue
        chord = curve[b] - curve[a]
        inner = curve[a + 1 : b] - curve[a]
        along = np.clip(inner @ chord / max(float(chord @ chord), 1e-18), 0.0, 1.0)
        distance = np.linalg.norm(inner - along[:, None] * chord, axis=1)
        if distance.max() > tolerance:
            middle = a + 1 + int(np.argmax(distance))
            keep.add(middle)
            spans += [(a, middle), (middle, b)]
    return np.array(sorted(keep), dtype=np.intp)


def sweep_wall(
    curve: Array, outward: Array, thickness: float, height: float, material: int
) -> tuple[Surface, list[Solid]]:
    """A wall whose face stands on a curve.

    Args:
        curve: Foot of the face in order of travel, shape (m, 3), m.
        outward: Horizontal unit normals of the face, towards the gun, shape (m, 3).
        thickness: Of the wall [m].
        height: Above the curve [m].
        material: Index into ``MATERIALS``.

    Returns:
        The surface and its convex pieces.
    """
    face_low, back_low = curve, curve - thickness * outward
    face_high, back_high = face_low + height * _UP, back_low + height * _UP
    back_foot = np.column_stack((back_low[:, :2], np.zeros(len(curve))))
    tangent = normalise(np.diff(curve, axis=0))
    right_hand = float(np.sum(cross(tangent, _UP) * outward[:-1])) > 0
    bands = [(face_high, face_low), (back_high, face_high), (back_foot, back_high)]
    triangles = np.concatenate([_strip(*(band if right_hand else band[::-1])) for band in bands])
    ends = _end_caps((face_low, face_high, back_high, back_foot), forward=not right_hand)
    pieces = []
    index = simplify(curve, 5e-5)
    for a, b in pairwise(index):
        corners = [face_low[[a, b]] * [1, 1, 0], face_high[[a, b]], back_foot[[a, b]], back_high[[a, b]]]
        pieces.append(hull(np.concatenate(corners)))
    return _surface(np.concatenate((triangles, ends)), material), pieces


def sweep_ledge(curve: Array, outward: Array, width: float, material: int) -> tuple[Surface, list[Solid]]:
    """A raised floor beside a curve that leaves the plate's plane, and its skirt down to the plate.

    Args:
        curve: Inner edge of the floor in order of travel, shape (m, 3), m, z >= 0.
        outward: Horizontal unit normals, from the curve over the floor, shape (m, 3).
        width: Of the floor [m].
        material: Index into ``MATERIALS``.

    Returns:
        The surface and its convex pieces.
    """
    inner, outer = curve, curve + width * outward
    outer_foot, inner_foot = outer * [1, 1, 0], inner * [1, 1, 0]
    tangent = normalise(np.diff(curve, axis=0))
    right_hand = float(np.sum(cross(tangent, _UP) * outward[:-1])) > 0
    bands = [(inner, outer), (outer, outer_foot)]
    triangles = np.concatenate([_strip(*(band if right_hand else band[::-1])) for band in bands])
    ends = _end_caps((inner_foot, inner, outer, outer_foot), forward=right_hand)
    triangles = np.concatenate((triangles, ends))
    index = simplify(curve, 5e-5)
    pieces = [
        hull(np.concatenate([rail[[a, b]] for rail in (inner, outer, inner_foot - 1e-3 * _UP, outer_foot)]))
        for a, b in pairwise(index)
    ]
    return _surface(triangles, material), pieces


def groove_plate(
    curve: Array, right: Array, half_width: float, depth: float, margin: float, materials: tuple[int, int]
) -> tuple[Surface, tuple[float, float], tuple[float, float]]:
    """A plate's top with a groove of rectangular section milled along a curve in its plane.

    Args:
        curve: Centre line at the plate's surface, shape (m, 3), m, z = 0.
        right: Horizontal unit normals, right of travel, shape (m, 3).
        half_width: Half the groove's width [m].
        depth: Of the groove [m].
        margin: Of the plate round the groove [m].
        materials: Of the plate's top and of the groove.

    Returns:
        The surface, and the plate's smallest and largest x, y [m].
    """
    from scipy.spatial import Delaunay  # takes 0.2 s to load: only for those who need it

    # Evenly spaced banks, closer together than the groove is wide: Delaunay then keeps them as edges.
    arc = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))))
    s = np.linspace(0.0, arc[-1], int(np.ceil(arc[-1] / (0.6 * half_width))) + 1)
    centre = np.column_stack([np.interp(s, arc, curve[:, k]) for k in range(3)])
    side = normalise(np.column_stack([np.interp(s, arc, right[:, k]) for k in range(3)]))
    closed = bool(np.linalg.norm(curve[-1] - curve[0]) < half_width)
    if closed:
        centre[-1], side[-1] = centre[0], side[0]
    left_bank, right_bank = centre - half_width * side, centre + half_width * side
    lower = tuple(float(v) for v in centre[:, :2].min(axis=0) - margin)
    upper = tuple(float(v) for v in centre[:, :2].max(axis=0) + margin)
    grid = np.stack(
        np.meshgrid(*(np.linspace(a, b, 9) for a, b in zip(lower, upper, strict=True))), axis=-1
    ).reshape(-1, 2)
    gap = np.min(np.linalg.norm(grid[:, None] - centre[None, ::5, :2], axis=-1), axis=1)
    grid = grid[gap > 4 * half_width]
    n = len(centre) - closed
    points = np.concatenate((left_bank[:n, :2], right_bank[:n, :2], grid))
    simplices = Delaunay(points).simplices
    first, second = (points[simplices[:, k]] - points[simplices[:, 0]] for k in (1, 2))
    turn = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    simplices = np.where(turn[:, None] > 0, simplices, simplices[:, ::-1])
    # Inside the groove: all three corners on the banks, not all on the same one, close along the arc.
    station = np.where(simplices < n, simplices, simplices - n)
    on_banks = np.all(simplices < 2 * n, axis=1)
    both = on_banks & np.any(simplices < n, axis=1) & np.any(simplices >= n, axis=1)
    apart = np.abs(station - np.roll(station, 1, axis=1))
    if closed:
        apart = np.minimum(apart, n - apart)
    inside = both & np.all(apart <= 3, axis=1)
    flat = np.column_stack((points, np.zeros(len(points))))
    top = flat[simplices[~inside]]
    down = depth * _UP
    channel = np.concatenate(
        (
            _strip(left_bank, left_bank - down),
            _strip(left_bank - down, right_bank - down),
            _strip(right_bank - down, right_bank),
        )
    )
    surface = Surface.join(_surface(top, materials[0]), _surface(channel, materials[1]))
    return surface, (lower[0], lower[1]), (upper[0], upper[1])
