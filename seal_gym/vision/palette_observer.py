"""The Hopfield observer of a palette of cables: a colour and depth picture in, elements and faults out.

Carvajal and Martinez-Garcia, section IV: layer 1 names each pixel by its thresholded colour, layer 2 judges.
The exact layer 1 answers with one unit or none, so that layer 2's fault rows can never come up for a single
pixel; here layer 2 judges areas of one colour by the votes of their pixels, which disagree in noise, half
shadow and dull light.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.cell import OverheadCfg
from seal_gym.core.errors import is_number, require
from seal_gym.core.frames import Array
from seal_gym.vision import hopfield, palette_segments
from seal_gym.vision.hopfield import HopfieldNetwork
from seal_gym.vision.palette_regions import (
    NamedPixels,
    PalettePlan,
    PaletteReport,
    RegionCfg,
    report_on,
)
from seal_gym.vision.palette_segments import (
    CODES,
    PALETTE_CODE,
    RIVET_CODE,
    AreaCfg,
    Bytes,
    Levels,
    Mask,
    PaletteClass,
)

# Layer 2's answers with one unit, in the order of its units (Table II: cable, connector, target).
_NAMES = (PaletteClass.CABLE, PaletteClass.CONNECTOR, PaletteClass.TARGET)


@dataclass(frozen=True, kw_only=True)
class PaletteObserverCfg:
    """Parameters of the observer.

    Attributes:
        levels: Thresholds of red, green and blue [grey levels]; None takes Otsu's from each picture.
        vote: A unit of layer 1 counts as active in an area if this share of its pixels activates it.
        areas: How the picture is divided.
        regions: How areas are gathered into regions.
    """

    levels: Levels | None = None
    vote: float = 0.25
    areas: AreaCfg = field(default_factory=AreaCfg)
    regions: RegionCfg = field(default_factory=RegionCfg)

    def __post_init__(self) -> None:
        """Checks the ranges."""
        if self.levels is not None:
            palette_segments.check_levels(self.levels)
        require(
            is_number(self.vote) and 0.0 < self.vote <= 0.5,
            f"PaletteObserverCfg.vote = {self.vote!r}: must be within (0, 0.5]; above, no two units conflict",
        )


def check_picture(rgb: Bytes, depth_m: Array, camera: OverheadCfg, inside: Mask | None) -> None:
    """Checks a colour and depth picture against its camera.

    Args:
        rgb: Should be of uint8, shape (H, W, 3).
        depth_m: Should be of floats, shape (H, W).
        camera: The camera, of frame (W, H).
        inside: Should be of bool, shape (H, W), with a pixel set; or None.

    Raises:
        ConfigError: If it does not fit.
    """
    palette_segments.check_rgb(rgb)
    shape = rgb.shape[:2]
    frame = tuple(int(n) for n in camera.frame_px)
    require(
        frame == (shape[1], shape[0]),
        f"rgb: {shape[1]} x {shape[0]} pixels, but the camera's frame_px is {frame}: give the camera of this "
        "picture",
    )
    require(
        np.shape(depth_m) == shape and np.issubdtype(np.asarray(depth_m).dtype, np.floating),
        f"depth_m: must be floats in m, shape {shape}, not {np.asarray(depth_m).dtype}, shape "
        f"{np.shape(depth_m)}",
    )
    if inside is not None:
        require(
            np.shape(inside) == shape and np.asarray(inside).dtype == np.bool_ and bool(np.any(inside)),
            f"inside: must be bool, shape {shape}, with a pixel set",
        )


def verdicts(histogram: NDArray[np.int64], network: HopfieldNetwork, vote: float) -> tuple[Bytes, Mask]:
    """Layer 2's judgement of areas.

    One unit names the area, if the pixels that activate it in layer 1 outnumber those that activate none; all
    three (other objects) leave its name to the commonest code, of which only rivets and board have one; any
    other answer is a conflict.

    Args:
        histogram: Pixels of each code in each area, shape (n, 8), no row empty.
        network: The network.
        vote: See ``PaletteObserverCfg``.

    Returns:
        Class of each area, of ``PaletteClass``, and whether its pixels conflict, both of shape (n,).
    """
    active = network.first.answers() == 1
    total = histogram.sum(axis=1)
    share = histogram @ active / total[:, None]
    silent = histogram @ ~active.any(axis=1) / total
    answer = network.second.settle((share >= vote).astype(np.int8)) == 1
    units = answer.sum(axis=1)
    other = np.full(CODES, PaletteClass.UNKNOWN, dtype=np.uint8)
    other[RIVET_CODE], other[PALETTE_CODE] = PaletteClass.RIVET, PaletteClass.PALETTE
    named = np.array(_NAMES, dtype=np.uint8)[answer.argmax(axis=1)]
    conflict = ~((units == 3) | ((units == 1) & (silent < 0.5)))
    classes = np.where(units == 3, other[histogram.argmax(axis=1)], named)
    return np.where(conflict, np.uint8(PaletteClass.UNKNOWN), classes).astype(np.uint8), conflict


def name_pixels(
    rgb: Bytes, network: HopfieldNetwork, cfg: PaletteObserverCfg, inside: Mask | None = None
) -> NamedPixels:
    """Names the areas of a picture.

    Args:
        rgb: Shape (H, W, 3).
        network: The network.
        cfg: Parameters.
        inside: The palette's pixels, shape (H, W); all by default.

    Returns:
        Names by pixel; ``PALETTE`` outside.
    """
    levels = cfg.levels or palette_segments.otsu_levels(rgb, inside)
    code = palette_segments.codes(rgb, levels)
    area, core = palette_segments.areas(rgb, cfg.areas)
    votes = area[core].astype(np.int64) * CODES + code[core]
    histogram = np.bincount(votes, minlength=CODES * (int(area.max()) + 1)).reshape(-1, CODES)
    of_area, conflict = verdicts(histogram, network, cfg.vote)
    classes, disagree = of_area[area], conflict[area]
    if inside is not None:
        classes[~inside], disagree[~inside] = PaletteClass.PALETTE, False
    return NamedPixels(classes=classes, conflict=disagree)


_DEFAULT = PaletteObserverCfg()


def observe(
    rgb: Bytes,
    depth_m: Array,
    camera: OverheadCfg,
    *,
    network: HopfieldNetwork | None = None,
    cfg: PaletteObserverCfg = _DEFAULT,
    inside: Mask | None = None,
    plan: PalettePlan | None = None,
) -> PaletteReport:
    """Finds the elements of a palette in the world, and its faults.

    Cables are black, connectors blue, rivets green, target zones red, board and ties white or light grey; a
    target zone is a convex mark under the cable that stands out on both sides of it and of its tie.

    Args:
        rgb: Shape (H, W, 3), 8 bit.
        depth_m: Along the optical axis, not along the ray, shape (H, W), m; 0 or not finite where unknown.
        camera: The camera, whose ``frame_px`` is (W, H).
        network: Both layers; the exact ones by default.
        cfg: Parameters.
        inside: The palette's pixels, shape (H, W): without it, a dark table around the board is a cable.
        plan: What should lie where; with it, wrong and absent elements are faults.

    Returns:
        The report.

    Raises:
        ConfigError: If picture, depth, camera or mask do not fit one another, or no pixel has a depth.
    """
    check_picture(rgb, depth_m, camera, inside)
    rgb = np.ascontiguousarray(rgb)  # OpenCV takes no flipped views
    named = name_pixels(rgb, network or hopfield.exact(), cfg, inside)
    return report_on(named, rgb, np.asarray(depth_m, dtype=np.float64), camera, cfg.regions, plan)
