"""Lines of the two strips and tangents in the tip frame: rays, projections, triangulation."""

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.frames import Array
from seal_gym.core.jit import kernel
from seal_gym.vision.features import MIN_SEEN_PX, ViewGeometry, length_inside

Bools = NDArray[np.bool_]


@kernel
def to_strip(p: Array, view: int, g: ViewGeometry, out: Array) -> bool:
    """Image of a point of the tip frame as t, o of the strip; False if it is behind the camera."""
    x = y = z = 0.0
    for k in range(3):
        d = p[k] - g.position[view, k]
        x += g.rotation[view, k, 0] * d
        y += g.rotation[view, k, 1] * d
        z += g.rotation[view, k, 2] * d
    if z < 1e-3:
        return False
    u, v = g.centre[view, 0] + g.focal[view] * x / z, g.centre[view, 1] + g.focal[view] * y / z
    if view == 0:
        out[0], out[1] = g.size[0, 1] - v, u
    else:
        out[0], out[1] = u, v
    return True


@kernel
def strip_ray(t: float, o: float, view: int, g: ViewGeometry, out: Array) -> None:
    """Ray of a strip's point in the tip frame."""
    u, v = (o, g.size[0, 1] - t) if view == 0 else (t, o)
    x, y = (u - g.centre[view, 0]) / g.focal[view], (v - g.centre[view, 1]) / g.focal[view]
    for k in range(3):
        out[k] = g.rotation[view, k, 0] * x + g.rotation[view, k, 1] * y + g.rotation[view, k, 2]


@kernel
def strip_slope(p: Array, d: Array, view: int, g: ViewGeometry, line: Array) -> bool:
    """The t and o of a point and do/dt of a direction there (line: t, o, q)."""
    a, b = np.empty(2), np.empty(2)
    ahead = np.empty(3)
    for k in range(3):
        ahead[k] = p[k] + 1e-6 * d[k]
    if not (to_strip(p, view, g, a) and to_strip(ahead, view, g, b)):
        return False
    if b[0] - a[0] < 1e-5:  # less than 0.01 px a mm of travel
        return False
    line[0], line[1], line[2] = a[0], a[1], (b[1] - a[1]) / (b[0] - a[0])
    return True


@kernel
def project_tangent(
    i: int, v: int, p: Array, d: Array, g: ViewGeometry, point: Array, direction: Array, valid: Bools
) -> None:
    """Projects the tangent (tip frame) into a view."""
    pc, dc = np.zeros(3), np.zeros(3)
    for r in range(3):
        for k in range(3):
            pc[r] += g.rotation[v, k, r] * (p[k] - g.position[v, k])
            dc[r] += g.rotation[v, k, r] * d[k]
    if pc[2] < 1e-3:
        valid[i, v] = False
        return
    x, y = pc[0] / pc[2], pc[1] / pc[2]
    point[i, v, 0], point[i, v, 1] = g.centre[v, 0] + g.focal[v] * x, g.centre[v, 1] + g.focal[v] * y
    direction[i, v, 0], direction[i, v, 1] = dc[0] - x * dc[2], dc[1] - y * dc[2]
    valid[i, v] = length_inside(point[i, v], direction[i, v], g.size[v]) >= MIN_SEEN_PX


@kernel
def normalise(v: Array) -> None:
    """Brings a vector to unit length, in place."""
    size = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    for k in range(3):
        v[k] /= size


@kernel
def nearest_point(p: Array, d: Array) -> None:
    """Moves a tangent's point to the one nearest the tip, the origin."""
    along = p[0] * d[0] + p[1] * d[1] + p[2] * d[2]
    for k in range(3):
        p[k] -= along * d[k]


@kernel
def plate_axes(d: Array, plate: tuple[float, float, float], n: Array, m: Array) -> None:
    """Normal n of the plate's plane through a tangent d, and its m across, both in the tip frame."""
    n[0], n[1], n[2] = plate
    along = n[0] * d[0] + n[1] * d[1] + n[2] * d[2]
    for k in range(3):
        n[k] -= along * d[k]
    normalise(n)
    m[0] = d[1] * n[2] - d[2] * n[1]
    m[1] = d[2] * n[0] - d[0] * n[2]
    m[2] = d[0] * n[1] - d[1] * n[0]


@kernel
def triangulate(lines: Array, ref: Array, g: ViewGeometry, p: Array, d: Array) -> bool:
    """The tangent (tip frame) whose images the two views' lines are."""
    normal, offset = np.empty((2, 3)), np.zeros(2)
    a, b = np.empty(3), np.empty(3)
    for v in range(2):
        # Two rays span the plane.
        strip_ray(ref[v, 0], lines[v, 0], v, g, a)
        strip_ray(ref[v, 0] + 10.0, lines[v, 0] + 10.0 * lines[v, 1], v, g, b)
        normal[v, 0] = a[1] * b[2] - a[2] * b[1]
        normal[v, 1] = a[2] * b[0] - a[0] * b[2]
        normal[v, 2] = a[0] * b[1] - a[1] * b[0]
        for k in range(3):
            offset[v] += normal[v, k] * g.position[v, k]
    d[0] = normal[0, 1] * normal[1, 2] - normal[0, 2] * normal[1, 1]
    d[1] = normal[0, 2] * normal[1, 0] - normal[0, 0] * normal[1, 2]
    d[2] = normal[0, 0] * normal[1, 1] - normal[0, 1] * normal[1, 0]
    size = np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    if abs(d[1]) < 0.3 * size:
        return False
    p[0] = (normal[0, 2] * offset[1] - normal[1, 2] * offset[0]) / d[1]
    p[1] = 0.0
    p[2] = (normal[1, 0] * offset[0] - normal[0, 0] * offset[1]) / d[1]
    way = 1.0 if d[1] > 0.0 else -1.0
    for k in range(3):
        d[k] *= way / size
    return bool(abs(p[0]) < 0.03 and abs(p[2]) < 0.04)
