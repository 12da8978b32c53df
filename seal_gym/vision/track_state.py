"""What the tracker is told, what it remembers and where it works."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import require
from seal_gym.core.frames import Array
from seal_gym.core.jit import kernel
from seal_gym.vision.edges import EdgeCfg
from seal_gym.vision.groove import NO_GROOVE, GrooveCfg
from seal_gym.vision.seam_line import LineCfg

Bools = NDArray[np.bool_]

MIN_ROWS = 8  # with an edge, for a view to count as seen
_MM, _DEG = 1e-3, float(np.deg2rad(1.0))
_PLANE = 0.3  # share of the drift of a fillet's floor that a groove's plane has: it never climbs


@dataclass(frozen=True, kw_only=True)
class PerceptionCfg:
    """Parameters of the tracker.

    Attributes:
        edges: The edge stage.
        line: The line stage.
        coast_s: A lost view is believed for this long [s].
        search_s: After this long the seam is looked for anew [s].
        level_change: A view whose grey levels beside the line are this far from the usual, on the wall's and
            on the plate's side, is not believed.
        level_step: Nor is one where they change by more from one frame to the next.
        level_gain: Share of a frame in the usual levels.
        memory_s: Age at which a remembered edge is dropped [s]; while neither gun nor part move none ages.
        ahead_px: How far ahead the front view's edge is remembered [px].
        sigma_m: Width of the fit around the tip [m].
        bend: Standard deviation of the curve's quadratic coefficient [1/m].
        step_m: Standard deviation of the seam's place against the frame before [m].
        step_rad: Of its heading [rad].
        clip_m: Residuals beyond this weigh less [m].
        jump_m: New edges this far beside the memory's are not the seam's [m].
        row_sigma_m: Standard deviation of a row's edge at a step of one grey level [m].
        side_px: How far ahead and behind the side view is looked at [px].
        height_q_m: Drift of the plane's height from frame to frame [m].
        pitch_q_rad: Drift of its pitch [rad].
        gate: Measurements this many standard deviations off are not believed.
        follow_gain: Share of the new edges' drift against the memory by which the memory follows.
        velocity_gain: Share of that drift added to the part's velocity a frame.
        along_gain: Share of the drift along the seam, which bends show, that both take.
    """

    edges: EdgeCfg = field(default_factory=EdgeCfg)
    line: LineCfg = field(default_factory=LineCfg)
    coast_s: float = 0.3
    search_s: float = 1.0
    level_change: tuple[float, float] = (40.0, 12.0)
    level_step: tuple[float, float] = (7.0, 6.0)
    level_gain: float = 0.15
    memory_s: float = 0.7
    ahead_px: float = 26.0
    sigma_m: float = 2.0 * _MM
    bend: float = 80.0
    step_m: float = 0.3 * _MM
    step_rad: float = 5.0 * _DEG
    clip_m: float = 0.15 * _MM
    jump_m: float = 0.8 * _MM
    row_sigma_m: float = 3.0 * _MM
    side_px: float = 18.0
    height_q_m: float = 0.01 * _MM
    pitch_q_rad: float = 0.3 * _DEG
    gate: float = 5.0
    follow_gain: float = 0.4
    velocity_gain: float = 0.1
    along_gain: float = 1.0

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for name in ("coast_s", "search_s", "level_gain",
                     "memory_s", "ahead_px", "sigma_m", "bend", "step_m", "step_rad", "clip_m",
                     "jump_m", "row_sigma_m", "side_px", "height_q_m", "pitch_q_rad", "gate", "follow_gain",
                     "velocity_gain", "along_gain"):  # fmt: skip
            value = getattr(self, name)
            require(0.0 < value < np.inf, f"PerceptionCfg.{name} = {value!r}: must be finite and > 0")
        for name in ("level_change", "level_step"):
            pair = getattr(self, name)
            require(
                isinstance(pair, tuple) and len(pair) == 2 and all(0.0 < v < np.inf for v in pair),
                f"PerceptionCfg.{name} = {pair!r}: must be two finite numbers > 0, wall and plate",
            )


class TrackNumbers(NamedTuple):
    """``PerceptionCfg``'s numbers as the kernels take them, times in frames; plate and groove."""

    memory: float
    ahead_px: float
    sigma_m: float
    bend: float
    step_m: float
    step_rad: float
    clip_m: float
    jump_m: float
    row_sigma_m: float
    side_px: float
    height_q_m: float
    pitch_q_rad: float
    gate: float
    coast: float
    search: float
    level_change: tuple[float, float]
    level_step: tuple[float, float]
    level_gain: float
    follow_gain: float
    velocity_gain: float
    along_gain: float
    plate: tuple[float, float, float]
    groove: tuple[float, float, float]
    lays: bool  # whether the gun lays sealant, which hides the seam beside the tip

    @classmethod
    def of(
        cls, cfg: PerceptionCfg, frame_s: float, plate: Array, groove: GrooveCfg | None, lays: bool = False
    ) -> "TrackNumbers":
        """Takes the numbers from a configuration.

        Args:
            cfg: The configuration.
            frame_s: Duration of a frame [s].
            plate: Normal of the plate in the tip frame, shape (3,).
            groove: The seam's section; None if the seam is an edge.
            lays: Whether the gun lays sealant.

        Returns:
            The numbers.
        """
        pairs = ("level_change", "level_step")
        names = [n for n in cls._fields if hasattr(cfg, n) and n not in pairs]
        same = {name: float(getattr(cfg, name)) for name in names}
        if groove:
            same["height_q_m"] *= _PLANE
            same["pitch_q_rad"] *= _PLANE
        x, y, z = (float(v) for v in plate)
        return cls(
            **same,
            level_change=(float(cfg.level_change[0]), float(cfg.level_change[1])),
            level_step=(float(cfg.level_step[0]), float(cfg.level_step[1])),
            memory=float(max(round(cfg.memory_s / frame_s), 1)),
            coast=cfg.coast_s / frame_s + 1e-9,
            search=cfg.search_s / frame_s + 1e-9,
            plate=(x, y, z),
            groove=groove.numbers if groove else NO_GROOVE,
            lays=lays,
        )


class TrackState(NamedTuple):
    """What is remembered of N simulations."""

    point: Array  # the tangent's point nearest the tip, world, (N, 3), m
    direction: Array  # its direction of travel, world, (N, 3)
    variance: Array  # of the plane's height and pitch, (N, 2)
    tip: Array  # where the tip was in the frame before, world, (N, 3), m
    gone: Array  # the tip's travel over the part since the last page, (N,), m
    carried: Array  # the part's motion since then, world, (N, 3), m
    tracking: Bools  # (N,)
    missed: NDArray[np.int64]  # frames without the seam, (N, 2)
    clock: NDArray[np.int64]  # pages of the memory, one for each step of travel or motion, (N,)
    level: Array  # usual grey levels beside the line, views by sides, -1 before the first, (N, 2, 2)
    last: Array  # those of the frame before, -1 likewise
    steady: NDArray[np.int64]  # frames since they jumped, (N, 2)
    velocity: Array  # of the part across the seam, world, (N, 3), m a frame
    eye: Array  # remembered rays: optical centre, world, (N, K, 3), m
    ray: Array  # direction, (N, K, 3)
    weight: Array  # (N, K)
    stamp: NDArray[np.int64]  # page of each, -1 for none, (N, K)
    head: NDArray[np.int64]  # where the next ray goes, (N,)
    page: NDArray[np.int64]  # where the last page begins, (N,)


class EdgeMaps(NamedTuple):
    """What another edge method found in N simulations' strips; without one, arrays of no rows."""

    edge: tuple[Bools, Bools]  # (N, length, width) of each view
    intensity: tuple[Array, Array]
    vector: tuple[Array, Array]  # across and along the strip, (N, length, width, 2)


OWN_EDGES = EdgeMaps(
    edge=(np.zeros((0, 1, 1), np.bool_),) * 2,
    intensity=(np.zeros((0, 1, 1)),) * 2,
    vector=(np.zeros((0, 1, 1, 2)),) * 2,
)


class Scratch(NamedTuple):
    """Work space of one frame."""

    grey: NDArray[np.int64]
    padded: Array
    work: Array
    bins: NDArray[np.int64]
    ex: Array
    ey: Array
    magnitude: Array
    orientation: Array
    intensity: Array
    edge: Bools
    profile: Array
    points: Array
    columns: Array
    fit: Array

    @classmethod
    def of(cls, length: int, width: int, pad: int, rays: int) -> "Scratch":
        """Allocates.

        Args:
            length: Of a strip [px].
            width: Of a strip [px].
            pad: Pixels that the edge masks reach beyond their centres.
            rays: Size of the memory.

        Returns:
            Room for one thread.
        """
        shape = (length, width)
        return cls(
            grey=np.empty(shape, np.int64),
            padded=np.empty((length + 2 * pad, width + 2 * pad)),
            work=np.empty(shape),
            bins=np.empty(512, np.int64),
            ex=np.empty(shape),
            ey=np.empty(shape),
            magnitude=np.empty(shape),
            orientation=np.empty(shape),
            intensity=np.empty(shape),
            edge=np.empty(shape, np.bool_),
            profile=np.empty(64),
            points=np.empty((2 * length, 3)),
            columns=np.empty((3, 2 * length)),
            fit=np.empty((4, rays)),
        )


@kernel
def forget(i: int, state: TrackState) -> None:
    """Gives one simulation's track up."""
    state.tracking[i] = False
    state.clock[i] = 0
    state.gone[i] = np.inf  # the first frame begins a page
    state.missed[i, 0] = state.missed[i, 1] = 0
    for a in range(3):
        state.velocity[i, a] = 0.0
    for k in range(state.stamp.shape[1]):
        state.stamp[i, k] = -1
    for v in range(2):
        for k in range(2):
            state.level[i, v, k] = state.last[i, v, k] = -1.0
