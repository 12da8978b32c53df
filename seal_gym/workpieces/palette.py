"""Cable-harness palettes laid out at random: where cables, connectors, pegs, rivets and ties lie.

The palette of Carvajal and Martinez-Garcia (paper T, section IV) carries black cables, connectors, rivets,
nylon ties and target zones; ours also the pegs between which harness boards lead their cables. Frame: origin
in the middle of the board's top, x along the board, z up.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from seal_gym.core.errors import ConfigError, is_number, require
from seal_gym.core.frames import Array

BOARD_M = (0.36, 0.26, 0.02)
"""Length, width and thickness of the board."""
CABLE_RADIUS_M = 0.004
CONNECTOR_M = (0.026, 0.020)
"""Length and width of a connector; its height is drawn."""
RIVET_M = (0.004, 0.003)
"""Radius and height of a rivet."""
PEG_RADIUS_M = 0.004
HEAD_M = (0.012, 0.012, 0.006)
"""Length, width and height of a tie's head."""
TRAVEL_M = 0.006
"""Way of a tie's head from where it stands open to its seat on the cable."""
ZONE_M = 0.024
"""Side of the painted square round a target."""
MAX_TARGETS = 8
_SEAT_TOP_M = 2 * CABLE_RADIUS_M + HEAD_M[2]
_STEP_M = 0.012
_TRUNK_END_M = 0.142
_ROW_M = 0.105
_MAX_DRAWS = 200


def _is_pair(value: object) -> bool:
    return isinstance(value, list | tuple) and len(value) == 2 and all(map(is_number, value))


def _whole_range(name: str, value: tuple[int, int], low: int, high: int) -> None:
    require(
        _is_pair(value) and all(int(v) == v for v in value) and low <= value[0] <= value[1] <= high,
        f"LayoutCfg.{name} = {value!r}: must be (fewest, most), whole numbers within {low}..{high}",
    )


@dataclass(frozen=True, kw_only=True)
class LayoutCfg:
    """Ranges that a palette is drawn from.

    Attributes:
        targets: Number of ties to press home.
        seated: Number of ties that sit already and are not to be touched.
        branches: Number of cables that leave the trunk.
        rivets: Number of rivets.
        connector_height_m: Of each connector [m].
        pegs: Number of pegs beside the cables.
        peg_height_m: Of each peg [m].
        apart_m: Least distance between the middles of ties [m].
    """

    targets: tuple[int, int] = (4, MAX_TARGETS)
    seated: tuple[int, int] = (1, 3)
    branches: tuple[int, int] = (4, 6)
    rivets: tuple[int, int] = (8, 14)
    connector_height_m: tuple[float, float] = (0.020, 0.050)
    pegs: tuple[int, int] = (6, 12)
    peg_height_m: tuple[float, float] = (0.040, 0.070)
    apart_m: float = 0.045

    def __post_init__(self) -> None:
        """Checks the ranges."""
        _whole_range("targets", self.targets, 1, MAX_TARGETS)
        _whole_range("seated", self.seated, 0, 4)
        _whole_range("branches", self.branches, 2, 6)
        _whole_range("rivets", self.rivets, 0, 40)
        _whole_range("pegs", self.pegs, 0, 30)
        for name in ("connector_height_m", "peg_height_m"):
            value = getattr(self, name)
            require(
                _is_pair(value) and 0.005 <= value[0] <= value[1] <= 0.07,
                f"LayoutCfg.{name} = {value!r}: must be (lowest, highest), both within 0.005..0.07 m: "
                "the tool's pusher clears little more",
            )
        require(
            is_number(self.apart_m) and 0.02 <= self.apart_m <= 0.1,
            f"LayoutCfg.apart_m = {self.apart_m!r}: must be a number within 0.02..0.1 m",
        )


class Spot(NamedTuple):
    """Where something stands on the board.

    Attributes:
        x: [m].
        y: [m].
        yaw: Of its length against the board's [rad].
    """

    x: float
    y: float
    yaw: float


@dataclass(frozen=True, kw_only=True, eq=False)
class PaletteLayout:
    """What lies where, in the palette's frame.

    Attributes:
        cables: Centre lines, each of shape (n, 3), m.
        connectors: At the cables' ends.
        connector_height_m: Of each connector, shape (c,), m.
        pegs: Place and height of each, shape (p, 3), m.
        rivets: Shape (r, 2), m.
        targets: Ties to press home, over their cables.
        seated: Ties that sit.
    """

    cables: tuple[Array, ...]
    connectors: tuple[Spot, ...]
    connector_height_m: Array
    pegs: Array
    rivets: Array
    targets: tuple[Spot, ...]
    seated: tuple[Spot, ...]

    @property
    def target_m(self) -> Array:
        """Middle of the open ties' tops, shape (n, 3), m."""
        return np.array([[s.x, s.y, _SEAT_TOP_M + TRAVEL_M] for s in self.targets])


def _trunk(rng: np.random.Generator) -> Array:
    """The thick end of the harness: from side to side, slightly bent."""
    knots = np.linspace(-_TRUNK_END_M, _TRUNK_END_M, 5)
    y = rng.uniform(-0.02, 0.02) + rng.uniform(-0.012, 0.012, 5)
    x = np.linspace(knots[0], knots[-1], round(2 * _TRUNK_END_M / _STEP_M) + 1)
    return np.column_stack((x, CubicSpline(knots, y)(x), np.full(len(x), CABLE_RADIUS_M)))


def _branch(start: Array, end: Array) -> Array:
    """From the trunk along it, then straight up to a connector: a cubic Bezier curve, shape (n, 3), m."""
    side = np.sign(end[1] - start[1])
    along = np.sign(end[0] - start[0]) or 1.0
    control = np.array(
        (start, start + np.array([0.035 * along, 0.012 * side, 0.0]), end - [0.0, 0.045 * side, 0.0], end)
    )
    t = np.linspace(0.0, 1.0, 12)[:, None]
    weights = ((1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3)
    return np.asarray(sum(w * c for w, c in zip(weights, control, strict=True)))


def _cables(rng: np.random.Generator, cfg: LayoutCfg) -> tuple[list[Array], list[Spot]]:
    trunk = _trunk(rng)
    cables = [trunk]
    connectors = [
        Spot(x, y, np.pi / 2)
        for x, y, _ in (trunk[0] - np.array([0.01, 0, 0]), trunk[-1] + np.array([0.01, 0, 0]))
    ]
    count = int(rng.integers(cfg.branches[0], cfg.branches[1] + 1))
    first = float(rng.choice((-1.0, 1.0)))
    slots = np.linspace(-0.11, 0.11, count) if count > 1 else np.zeros(1)
    for k, slot in enumerate(slots):
        side = first if k % 2 == 0 else -first
        x = slot + rng.uniform(-0.01, 0.01)
        leave = x - rng.choice((-1.0, 1.0)) * rng.uniform(0.02, 0.035)
        start = trunk[int(np.argmin(np.abs(trunk[:, 0] - leave)))]
        end = np.array([x, side * (_ROW_M - CONNECTOR_M[1] / 2 + 0.004), CABLE_RADIUS_M])
        cables.append(_branch(start, end))
        connectors.append(Spot(x, side * _ROW_M, 0.0))
    return cables, connectors


def _on_cables(cables: list[Array]) -> list[Spot]:
    """Places where a tie could go: inner points of the cables, along them."""
    spots = []
    for number, cable in enumerate(cables):
        inner = range(2, len(cable) - 2) if number == 0 else range(4, len(cable) - 2)
        for i in inner:
            way = cable[i + 1] - cable[i - 1]
            spots.append(Spot(float(cable[i, 0]), float(cable[i, 1]), float(np.arctan2(way[1], way[0]))))
    return spots


def _apart(spot: Spot, others: list[Spot], least_m: float) -> bool:
    return all(np.hypot(spot.x - o.x, spot.y - o.y) >= least_m for o in others)


def _ties(
    rng: np.random.Generator, cables: list[Array], connectors: list[Spot], count: int, apart_m: float
) -> list[Spot]:
    """Up to ``count`` places for ties, apart from each other and from connectors."""
    chosen: list[Spot] = []
    spots = _on_cables(cables)
    for k in rng.permutation(len(spots)):
        if _apart(spots[k], chosen, apart_m) and _apart(spots[k], connectors, 0.03):
            chosen.append(spots[k])
        if len(chosen) == count:
            break
    return chosen


def _pegs(rng: np.random.Generator, cables: list[Array], spots: list[Spot], count: int) -> Array:
    """Pegs close beside cables, shape (count, 2), m; fewer where there is no room."""
    chosen: list[Array] = []
    lines = np.concatenate(cables)[:, :2]
    for _ in range(_MAX_DRAWS):
        if len(chosen) == count:
            break
        cable = cables[int(rng.integers(len(cables)))][:, :2]
        i = int(rng.integers(1, len(cable) - 1))
        along = cable[i + 1] - cable[i - 1]
        aside = np.array([-along[1], along[0]]) / np.linalg.norm(along)
        point = cable[i] + rng.choice((-1.0, 1.0)) * rng.uniform(0.010, 0.016) * aside
        clear = np.linalg.norm(lines - point, axis=1).min() >= 0.0095
        clear &= all(np.hypot(s.x - point[0], s.y - point[1]) >= 0.026 for s in spots)
        clear &= all(np.linalg.norm(point - other) >= 0.03 for other in chosen)
        if clear:
            chosen.append(point)
    return np.reshape(chosen, (-1, 2))


def _rivets(rng: np.random.Generator, cables: list[Array], spots: list[Spot], count: int) -> Array:
    """Rivets on free board, shape (count, 2), m; fewer where there is no room."""
    lines = np.concatenate(cables)[:, :2]
    chosen: list[Array] = []
    for _ in range(_MAX_DRAWS):
        if len(chosen) == count:
            break
        point = rng.uniform(-1.0, 1.0, 2) * (BOARD_M[0] / 2 - 0.012, BOARD_M[1] / 2 - 0.012)
        clear = np.linalg.norm(lines - point, axis=1).min() >= 0.016
        clear &= all(np.hypot(s.x - point[0], s.y - point[1]) >= 0.026 for s in spots)
        clear &= all(np.linalg.norm(point - other) >= 0.02 for other in chosen)
        if clear:
            chosen.append(point)
    return np.reshape(chosen, (-1, 2))


def draw_layout(rng: np.random.Generator, cfg: LayoutCfg | None = None) -> PaletteLayout:
    """Lays a palette out.

    Args:
        rng: Source of randomness.
        cfg: Ranges.

    Returns:
        The layout.

    Raises:
        ConfigError: If there is no room for the ties.
    """
    cfg = cfg or LayoutCfg()
    for _ in range(_MAX_DRAWS):
        cables, connectors = _cables(rng, cfg)
        wanted = int(rng.integers(cfg.targets[0], cfg.targets[1] + 1))
        sitting = int(rng.integers(cfg.seated[0], cfg.seated[1] + 1))
        ties = _ties(rng, cables, connectors, wanted + sitting, cfg.apart_m)
        if len(ties) < wanted + sitting:
            continue
        pegs = _pegs(rng, cables, [*ties, *connectors], int(rng.integers(cfg.pegs[0], cfg.pegs[1] + 1)))
        heights = rng.uniform(*cfg.peg_height_m, len(pegs))
        taken = [*ties, *connectors, *(Spot(x, y, 0.0) for x, y in pegs)]
        count = int(rng.integers(cfg.rivets[0], cfg.rivets[1] + 1))
        return PaletteLayout(
            cables=tuple(cables),
            connectors=tuple(connectors),
            connector_height_m=rng.uniform(*cfg.connector_height_m, len(connectors)),
            pegs=np.column_stack((pegs, heights)),
            rivets=_rivets(rng, cables, taken, count),
            targets=tuple(ties[:wanted]),
            seated=tuple(ties[wanted:]),
        )
    raise ConfigError(
        f"LayoutCfg: no room for {cfg.targets[1]} targets and {cfg.seated[1]} seated ties {cfg.apart_m} m "
        f"apart in {_MAX_DRAWS} draws: ask for fewer, or reduce apart_m"
    )
