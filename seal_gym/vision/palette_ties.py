"""The Hopfield observer as an eye of the palette environment: where ties stand over their target zones."""

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from seal_gym.core.cell import OverheadCfg
from seal_gym.core.errors import is_number, require
from seal_gym.vision import hopfield
from seal_gym.vision.hopfield import HopfieldNetwork
from seal_gym.vision.palette_observer import PaletteObserverCfg, observe
from seal_gym.vision.palette_regions import PaletteReport, RegionCfg
from seal_gym.vision.palette_seen import Depth, Regions, deproject
from seal_gym.vision.palette_segments import Mask, PaletteClass

_MEDIAN_PX, _OPEN_PX = 5, 5


def _cfg() -> PaletteObserverCfg:
    """Zones may be crossed by two cables where one branches off: wider gaps than one cable's."""
    return PaletteObserverCfg(regions=RegionCfg(target_bridge_m=0.016))


@dataclass(frozen=True, kw_only=True, eq=False)
class TieObserver:
    """Finds the ties that stand open, with ``palette_observer.observe``.

    Attributes:
        floor_m: What is lower than this in the world frame is not the palette [m].
        network: Both layers of the Hopfield network.
        cfg: Parameters of the observer.
    """

    floor_m: float
    network: HopfieldNetwork = field(default_factory=hopfield.exact)
    cfg: PaletteObserverCfg = field(default_factory=_cfg)

    def __post_init__(self) -> None:
        """Checks the floor."""
        require(
            is_number(self.floor_m) and -10.0 <= self.floor_m <= 10.0,
            f"TieObserver.floor_m = {self.floor_m!r}: must be a number within -10..10 m, world frame",
        )

    def report(self, rgb: NDArray[np.uint8], depth_m: Depth, camera: OverheadCfg) -> PaletteReport:
        """Everything that is seen on the palette.

        Args:
            rgb: Shape (H, W, 3).
            depth_m: Along the optical axis, NaN where there is none, shape (H, W), m.
            camera: Which took it.

        Returns:
            Elements and faults.
        """
        require(bool(np.isfinite(depth_m).any()), "depth_m: no pixel has a depth: nothing can be seen")
        inside = above(depth_m, camera, self.floor_m)
        require(
            bool(inside.any()),
            f"depth_m: nothing is above floor_m = {self.floor_m} m: lower it, or mend the gaps in depth_m",
        )
        depth = np.asarray(depth_m, dtype=np.float64)
        return observe(rgb, depth, camera, network=self.network, cfg=self.cfg, inside=inside)

    def __call__(self, rgb: NDArray[np.uint8], depth_m: Depth, camera: OverheadCfg) -> Regions:
        """Where to press.

        Args:
            rgb: Shape (H, W, 3).
            depth_m: Along the optical axis, NaN where there is none, shape (H, W), m.
            camera: Which took it.

        Returns:
            Middles of the tops of the ties in target zones; those without a depth are left out.
        """
        seen = self.report(rgb, depth_m, camera)
        points = seen.positions_m[seen.of(PaletteClass.TIE)]
        points = points[np.isfinite(points).all(axis=1)]
        return Regions(points, ("tie",) * len(points))


def above(depth_m: Depth, camera: OverheadCfg, floor_m: float) -> Mask:
    """Pixels that show something above a height.

    Args:
        depth_m: Along the optical axis, NaN where there is none, shape (H, W), m.
        camera: Which took it.
        floor_m: The height, world frame [m].

    Returns:
        Shape (H, W); without lone pixels.
    """
    filled = np.nan_to_num(depth_m, nan=0.0).astype(np.float32)
    steady = np.asarray(cv2.medianBlur(filled, _MEDIAN_PX), dtype=np.float64)
    rows, columns = np.indices(steady.shape)
    points = deproject(np.stack((columns + 0.5, rows + 0.5), axis=-1), steady, camera)
    higher = ((points[..., 2] > floor_m) & (steady > 0.0)).astype(np.uint8)
    kernel = np.ones((_OPEN_PX, _OPEN_PX), np.uint8)
    return np.asarray(cv2.morphologyEx(higher, cv2.MORPH_OPEN, kernel) > 0)
