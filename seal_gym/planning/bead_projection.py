"""The bead a nozzle lays along the borders of its fan, by following its rays to the surface.

This knows nothing of how a path was made: it takes any timed path, so that the optimal, the naive and a
robot's own path are measured alike. The surface is the band that the lines across the bead sweep, at equal
shares of the edges' lengths, and its tangent plane beyond the edges.
"""

from dataclasses import dataclass

import numpy as np

from seal_gym.core.frames import Array, cross, normalise
from seal_gym.planning.bead_curves import Curve, Edges
from seal_gym.planning.bead_geometry import BeadPath

_GRID = 1500
_CORRECTIONS = 12
_FAN_STEP_RAD = 1e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class Footprint:
    """Where the fan's borders meet the surface and what they leave there.

    Attributes:
        left_m: Hits of the left border, shape (n, 3), m.
        right_m: Of the right border, shape (n, 3), m.
        left_height_m: g, shape (n,), m; infinite where the border stands still.
        right_height_m: h, shape (n,), m.
        left_miss_m: Distance of the hits from the left edge, shape (n,), m.
        right_miss_m: From the right edge, shape (n,), m.
    """

    left_m: Array
    right_m: Array
    left_height_m: Array
    right_height_m: Array
    left_miss_m: Array
    right_miss_m: Array

    @property
    def spread(self) -> float:
        """Largest less smallest height over both borders, relative to their mean."""
        return height_spread(np.concatenate((self.left_height_m, self.right_height_m)))


def height_spread(heights: Array) -> float:
    """How uneven heights are.

    Args:
        heights: Shape (n,), m.

    Returns:
        (largest - smallest) / mean; infinite if a height is.
    """
    if not np.all(np.isfinite(heights)):
        return float("inf")
    return float((heights.max() - heights.min()) / heights.mean())


def footprint(path: BeadPath, edges: Edges, fan_angle_rad: float) -> Footprint:
    """Follows the fan's borders to the surface and measures the heights they leave.

    The flow spreads evenly over the fan's angle phi. While the volume dV leaves the nozzle, the sliver d phi
    sweeps the area |dq/dphi x dq/dV| dphi dV of the surface at its hit q, so that the height is
    1 / (theta |dq/dphi x dq/dV|). Both derivatives are central differences of ray-surface hits. Volume in
    place of time makes the measure indifferent to a slow-down that the flow follows.

    Source: the idea of Berg Eqs. 3.19-3.23, without its closed forms.

    Args:
        path: In the edges' frame.
        edges: The edges.
        fan_angle_rad: theta [rad].

    Returns:
        One entry a time of the path.
    """
    flow = path.flow_m3_per_s
    volume = np.concatenate(([0.0], np.cumsum((flow[1:] + flow[:-1]) / 2.0 * np.diff(path.time_s))))
    half = fan_angle_rad / 2.0
    out: list[tuple[Array, Array, Array]] = []
    for edge, inner, side in ((edges.left, edges.right, -1.0), (edges.right, edges.left, 1.0)):
        before, hit, after = (
            _hits(path, edge, inner, side * (half + turn)) for turn in (-_FAN_STEP_RAD, 0.0, _FAN_STEP_RAD)
        )
        along = np.gradient(hit, volume, axis=0, edge_order=2)
        across = (after - before) / (2.0 * _FAN_STEP_RAD)
        with np.errstate(divide="ignore"):
            height = 1.0 / (fan_angle_rad * np.linalg.norm(cross(across, along), axis=-1))
        out.append((hit, height, _distance(hit, edge)))
    (left, g, left_miss), (right, h, right_miss) = out
    return Footprint(
        left_m=left,
        right_m=right,
        left_height_m=g,
        right_height_m=h,
        left_miss_m=left_miss,
        right_miss_m=right_miss,
    )


def _hits(path: BeadPath, edge: Curve, other: Curve, angle_rad: float) -> Array:
    """Where the rays at an angle to the nozzle's axis meet the surface near an edge, shape (n, 3)."""
    x, z = path.rotation[..., 0], path.rotation[..., 2]
    ray = np.sin(angle_rad) * x - np.cos(angle_rad) * z
    share = _nearest_to_rays(path.position_m, ray, edge)
    for _ in range(_CORRECTIONS):
        # The surface's tangent plane at this share; the right one if the hit is straight across from there.
        foot, tangent = edge(share * edge.length_m), edge.tangent(share * edge.length_m)
        chord = normalise(other(share * other.length_m) - foot)
        normal = cross(tangent, chord)
        reach = np.sum((foot - path.position_m) * normal, -1) / np.sum(ray * normal, -1)
        hit = path.position_m + reach[:, None] * ray
        aside = np.sum((hit - foot) * cross(chord, normal), -1) / np.sum(normal**2, -1)
        share = np.clip(share + aside / edge.length_m, 0.0, 1.0)
    return np.asarray(hit)


def _nearest_to_rays(position: Array, ray: Array, edge: Curve) -> Array:
    """Shares of an edge's length where it comes nearest to rays, shape (n,)."""
    grid = np.linspace(0.0, 1.0, _GRID + 1)
    points = edge(grid * edge.length_m)
    share = np.empty(len(position))
    for k, (p, d) in enumerate(zip(position, ray, strict=True)):
        to = points - p
        reach = np.maximum(to @ d, 0.0)
        share[k] = grid[np.argmin(np.sum((to - reach[:, None] * d) ** 2, axis=1))]
    return share


def _distance(points: Array, edge: Curve) -> Array:
    """Distances of points from an edge, shape (n,), m."""
    grid = np.linspace(0.0, edge.length_m, _GRID + 1)
    vertices = edge(grid)
    s = np.array([grid[np.argmin(np.sum((vertices - p) ** 2, axis=1))] for p in points])
    for _ in range(3):  # along the tangent to where it is straight across
        s = np.clip(s + np.sum((points - edge(s)) * edge.tangent(s), axis=1), 0.0, edge.length_m)
    return np.asarray(np.linalg.norm(points - edge(s), axis=1))
