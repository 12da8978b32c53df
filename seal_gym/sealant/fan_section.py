"""The fast tier's cross-section: what a fan leaves in its own plane, from the inputs of the surrogate alone.

The sheet stands in the tip's xz plane and moves with the tip: whatever the jet's speed, fluid comes down in
that plane, where its ray meets the surface. The fan's flow is even over its angle, so that a strip of the
surface between two rays gets its share of the flow, spread over the area that the strip is swept across: seen
along the nozzle, a column's thickness is flow share / (column width times the sheet's speed across itself).
The sealant stays where it lands. What a simulation adds to this is what a surrogate has to learn.

``fan_sections`` knows one station. It takes the tip to go on as it does there, and so knows nothing of the
bead's ends, of a speed that has just changed, or of places that the fan comes back to where it turns.
``swept_thickness_m`` follows the fan along the path: velocities and arc lengths tell where the stations
before and after stand, and what they lay near a window's plane is summed up in it.
"""

import math

import numpy as np
from scipy.spatial.transform import Rotation

from seal_gym.core.errors import ConfigError, is_number, require
from seal_gym.core.frames import Array
from seal_gym.core.jit import kernel
from seal_gym.sealant.laydown.config import THESIS_FLOW_M3S
from seal_gym.sealant.laydown.sections import BELOW_M, PIXEL_M, RAYS, ROWS

FAN_ANGLE_RAD = math.radians(40.0)
_MIDDLE = RAYS // 2
_RAYS_X = (np.arange(RAYS) - _MIDDLE) * PIXEL_M
_COLUMNS_X = 0.5 * (_RAYS_X[1:] + _RAYS_X[:-1])
_LOWER = np.arange(ROWS) * PIXEL_M
# Where the tip turns about a point of the sheet, the sheet stands still there: a fluid would flow away.
_SLOWEST_MPS = 0.05
# Half the length over which what lands is averaged along the bead. The reference, too, cannot hold steps
# along the bead: of 1 to 8 mm, 6 gave the largest intersection over union with it on the training paths.
SLAB_M = 6e-3
_REACH_M = 25e-3  # along the path, as far as stations are looked for that lay in a window's plane
_PER_STATION = 2
_LEAST_AHEAD = 0.2  # of the unit vector along the way, across the sheet: a fan that slides along itself


def check(name: str, values: Array, columns: int, rows: int | None = None) -> Array:
    """Refuses an input that cannot be one of a station's.

    Args:
        name: Named in the error.
        values: What is checked.
        columns: How many there must be.
        rows: Likewise; any number by default.

    Returns:
        The values as floats, shape (n, columns).

    Raises:
        ConfigError: If the shape is another or a value is not finite.
    """
    array = np.asarray(values, dtype=float)
    wanted = f"({'n' if rows is None else rows}, {columns})"
    fits = array.ndim == 2 and array.shape[1] == columns and rows in (None, len(array))
    require(fits, f"{name} has shape {array.shape}: must be {wanted}", ConfigError)
    require(bool(np.isfinite(array).all()), f"{name}: must be finite", ConfigError)
    return array


def surface_m(heights_m: Array) -> Array:
    """The substrate in the window of a cross-section.

    Args:
        heights_m: Along 41 rays, shape (n, 41) [m].

    Returns:
        Its height over the window's lower edge in the middle of each column, shape (n, 40) [m].
    """
    middle = 0.5 * (heights_m[:, 1:] + heights_m[:, :-1])
    return np.asarray(heights_m[:, _MIDDLE, None] - middle + BELOW_M)


def filled(tops_m: Array) -> Array:
    """How much of each pixel is below a height.

    Args:
        tops_m: Over the window's lower edge, column by column, shape (n, 40) [m].

    Returns:
        Shares in [0, 1], shape (n, 20, 40), rows up.
    """
    return np.asarray(np.clip((tops_m[:, None] - _LOWER[:, None]) / PIXEL_M, 0.0, 1.0))


def sweep_mps(linear_mps: Array, angular_radps: Array, x_m: Array, heights_m: Array) -> Array:
    """How fast the sheet moves across itself, where it meets the surface.

    Args:
        linear_mps: Of the tip, in its frame, shape (n, 3) [m/s].
        angular_radps: Likewise, shape (n, 3) [rad/s].
        x_m: Places across, shape (k,) [m].
        heights_m: How far below the tip's x axis the surface is there, shape (n, k) [m].

    Returns:
        The y component of v + omega x r, shape (n, k) [m/s].
    """
    turn = angular_radps[:, 2:3] * x_m + angular_radps[:, 0:1] * heights_m
    return np.asarray(linear_mps[:, 1:2] + turn)


def ideal_area_m2(
    linear_mps: Array, angular_radps: Array, heights_m: Array, flow_m3s: float = THESIS_FLOW_M3S
) -> Array:
    """Flow over speed: what a cut in the fan's plane must hold where nothing flows along the bead.

    Args:
        linear_mps: Of the tip, in its frame, shape (n, 3) [m/s].
        angular_radps: Likewise, shape (n, 3) [rad/s].
        heights_m: Along 41 rays, shape (n, 41) [m].
        flow_m3s: Of sealant [m3/s].

    Returns:
        With the speed where the nozzle points at, shape (n,) [m2].
    """
    speed = sweep_mps(linear_mps, angular_radps, np.zeros(1), heights_m[:, _MIDDLE : _MIDDLE + 1])[:, 0]
    return np.asarray(flow_m3s / np.maximum(np.abs(speed), _SLOWEST_MPS))


def thickness_m(
    linear_mps: Array,
    angular_radps: Array,
    heights_m: Array,
    flow_m3s: float = THESIS_FLOW_M3S,
    fan_angle_rad: float = FAN_ANGLE_RAD,
) -> Array:
    """What lands in each column of the window.

    Args:
        linear_mps: Of the tip, in its frame, shape (n, 3) [m/s].
        angular_radps: Likewise, shape (n, 3) [rad/s].
        heights_m: Along -z from points 1 mm apart on the tip's x axis to the surface, shape (n, 41) [m].
        flow_m3s: Of sealant [m3/s].
        fan_angle_rad: Over which the flow is even [rad].

    Returns:
        Thickness along the nozzle, shape (n, 40) [m]. Its sum times 1 mm is flow / speed, if the tip does not
        turn and the fan ends within the window.

    Raises:
        ConfigError: If a shape or a number is out of range.
    """
    heights = check("heights_m", heights_m, RAYS)
    linear = check("linear_mps", linear_mps, 3, len(heights))
    angular = check("angular_radps", angular_radps, 3, len(heights))
    require(bool((heights > 0).all()), f"heights_m: smallest {heights.min():g}: must be positive")
    require(is_number(flow_m3s) and flow_m3s >= 0, f"flow_m3s = {flow_m3s!r}: must be a number >= 0")
    require(
        is_number(fan_angle_rad) and 0.01 <= fan_angle_rad <= 2.8,
        f"fan_angle_rad = {fan_angle_rad!r}: must be in [0.01, 2.8] rad; check the unit",
    )
    share = _shares(heights, fan_angle_rad)
    speed = sweep_mps(linear, angular, _COLUMNS_X, 0.5 * (heights[:, 1:] + heights[:, :-1]))
    return np.asarray(flow_m3s * share / (PIXEL_M * np.maximum(np.abs(speed), _SLOWEST_MPS)))


def _shares(heights: Array, fan_angle_rad: float) -> Array:
    """Share of the flow that lands in each column, shape (n, 40)."""
    seen = np.arctan2(_RAYS_X, heights)
    # from the middle outwards, nothing lands behind what is in the way: the angles may only grow
    right = np.maximum.accumulate(seen[:, _MIDDLE:], 1)
    left = np.minimum.accumulate(seen[:, _MIDDLE::-1], 1)[:, ::-1]
    edges = np.concatenate((left[:, :-1], right), 1).clip(-0.5 * fan_angle_rad, 0.5 * fan_angle_rad)
    return np.asarray(np.diff(edges, axis=1) / fan_angle_rad)


def fan_sections(
    linear_mps: Array,
    angular_radps: Array,
    heights_m: Array,
    flow_m3s: float = THESIS_FLOW_M3S,
    fan_angle_rad: float = FAN_ANGLE_RAD,
) -> Array:
    """The fast tier's cross-sections: what lands, piled up on the surface.

    Args:
        linear_mps: Of the tip, in its frame, shape (n, 3) [m/s].
        angular_radps: Likewise, shape (n, 3) [rad/s].
        heights_m: Along 41 rays, as ``laydown.sections.Stations`` has them, shape (n, 41) [m].
        flow_m3s: Of sealant [m3/s].
        fan_angle_rad: Over which the flow is even [rad].

    Returns:
        Shares of sealant in [0, 1], shape (n, 20, 40), as ``laydown.sections.cut`` gives them.

    Raises:
        ConfigError: If a shape or a number is out of range.
    """
    thick = thickness_m(linear_mps, angular_radps, heights_m, flow_m3s, fan_angle_rad)
    foot = surface_m(np.asarray(heights_m, dtype=float))
    return filled(foot + thick) - filled(foot)


def poses(arcs_m: Array, linear_mps: Array, angular_radps: Array) -> tuple[Array, Array, Array]:
    """Where stations stand, as their velocities tell.

    Args:
        arcs_m: Along the tip's path, shape (n,), n >= 2 [m].
        linear_mps: To the next station, in the tip's frame, shape (n, 3) [m/s].
        angular_radps: Likewise, shape (n, 3) [rad/s].

    Returns:
        Times from each station to the next (n,) [s], positions (n + 1, 3) [m] and orientations
        (n + 1, 3, 3) in the first one's frame. The last station is as far from its next as from the one
        before.
    """
    steps = np.append(np.diff(arcs_m), arcs_m[-1] - arcs_m[-2])
    dt = steps / np.maximum(np.linalg.norm(linear_mps, axis=1), 1e-6)
    turns = Rotation.from_rotvec(angular_radps * dt[:, None]).as_matrix()
    rotations, positions = np.empty((len(dt) + 1, 3, 3)), np.zeros((len(dt) + 1, 3))
    rotations[0] = np.eye(3)
    for k, turn in enumerate(turns):
        rotations[k + 1] = rotations[k] @ turn
        positions[k + 1] = positions[k] + rotations[k] @ linear_mps[k] * dt[k]
    return dt, positions, rotations


@kernel
def _sweep(
    mouths: Array,
    turns: Array,
    travel: Array,
    arcs: Array,
    amounts: Array,
    drops: Array,
    planes: Array,
    slab: float,
) -> Array:
    """Thickness in planes along the travel of each station: hits of the fan, weighted by a triangle."""
    n, columns = amounts.shape
    out = np.zeros((n, len(planes), columns))
    hit = np.empty(3)
    for j in range(n):
        for s in range(_PER_STATION):
            when = (s + 0.5) / _PER_STATION
            for k in range(columns):
                if amounts[j, k] <= 0.0:
                    continue
                x, z = (k + 0.5 - 0.5 * columns) * PIXEL_M, -drops[j, k]
                for a in range(3):
                    here = mouths[j, a] + turns[j, a, 0] * x + turns[j, a, 2] * z
                    there = mouths[j + 1, a] + turns[j + 1, a, 0] * x + turns[j + 1, a, 2] * z
                    hit[a] = here + when * (there - here)
                for i in range(n):
                    if abs(arcs[i] - arcs[j]) > _REACH_M:
                        continue
                    across, along = 0.0, 0.0
                    for a in range(3):
                        off = hit[a] - mouths[i, a]
                        across += turns[i, a, 0] * off
                        along += turns[i, a, 1] * off
                    along /= travel[i, 1]
                    place = (across - along * travel[i, 0]) / PIXEL_M + 0.5 * columns - 0.5
                    column = int(np.floor(place))
                    right = place - column
                    for p in range(len(planes)):
                        weight = 1.0 - abs(along - planes[p]) / slab
                        if weight <= 0.0:
                            continue
                        thick = weight * amounts[j, k] / (slab * travel[i, 1] * _PER_STATION * PIXEL_M)
                        if 0 <= column < columns:
                            out[i, p, column] += thick * (1.0 - right)
                        if 0 <= column + 1 < columns:
                            out[i, p, column + 1] += thick * right
    return out


def _travel(linear: Array, angular: Array, heights: Array) -> Array:
    """Unit x and y of the way of the place that the nozzle points at, seen along the nozzle, shape (n, 2)."""
    reach = heights[:, _MIDDLE]
    way = np.stack((linear[:, 0] - angular[:, 1] * reach, linear[:, 1] + angular[:, 0] * reach), -1)
    unit = way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
    unit[:, 1] = np.maximum(unit[:, 1], _LEAST_AHEAD)
    return np.asarray(unit / np.linalg.norm(unit, axis=1, keepdims=True))


def swept_thickness_m(
    arcs_m: Array,
    linear_mps: Array,
    angular_radps: Array,
    heights_m: Array,
    planes_m: tuple[float, ...] = (0.0,),
    flow_m3s: float = THESIS_FLOW_M3S,
    fan_angle_rad: float = FAN_ANGLE_RAD,
) -> Array:
    """What the fan lands along a path in each station's window, and in planes before and behind it.

    Args:
        arcs_m: Along the tip's path, rising, shape (n,), n >= 2 [m].
        linear_mps: To the next station, in the tip's frame, shape (n, 3) [m/s].
        angular_radps: Likewise, shape (n, 3) [rad/s].
        heights_m: Along 41 rays, shape (n, 41) [m].
        planes_m: Where the planes are that what lies before and behind is seen in, along the way of the place
            that the nozzle points at, m of them [m].
        flow_m3s: Of sealant [m3/s].
        fan_angle_rad: Over which the flow is even [rad].

    Returns:
        Thickness along the window's nozzle, a mean over ``SLAB_M`` before and behind each plane with weights
        that fall linearly, moved into the window along that way: shape (n, m, 40) [m].

    Raises:
        ConfigError: If a shape or a number is out of range.
    """
    heights = check("heights_m", heights_m, RAYS)
    linear = check("linear_mps", linear_mps, 3, len(heights))
    angular = check("angular_radps", angular_radps, 3, len(heights))
    arcs = check("arcs_m", np.asarray(arcs_m, dtype=float)[:, None], 1, len(heights))[:, 0]
    require(
        len(arcs) >= 2 and bool((np.diff(arcs) > 0).all()),
        f"arcs_m: {len(arcs)} stations: must be at least 2, and rise from station to station",
    )
    require(bool((heights > 0).all()), f"heights_m: smallest {heights.min():g}: must be positive")
    dt, positions, rotations = poses(arcs, linear, angular)
    amounts = flow_m3s * dt[:, None] * _shares(heights, fan_angle_rad)
    drops = 0.5 * (heights[:, 1:] + heights[:, :-1])
    travel = _travel(linear, angular, heights)
    return np.asarray(_sweep(positions, rotations, travel, arcs, amounts, drops, np.array(planes_m), SLAB_M))
