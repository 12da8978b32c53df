"""Regions of a palette of cables from its named pixels: centroids, metric positions, ties and faults."""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from seal_gym.core.cell import OverheadCfg
from seal_gym.core.errors import is_number, require
from seal_gym.core.frames import Array
from seal_gym.vision.palette_seen import deproject
from seal_gym.vision.palette_segments import Bytes, Mask, PaletteClass

_PLANE_PX = 12  # fewer pixels give no plane, their median depth does
_REFITS, _OUTLIER, _LEAST_RESIDUAL = 2, 3.0, 1e-4
# Pixels this near to a region's outline are shared by it and its surroundings, whose colours are taken from
# farther off; they have to differ by so much [grey levels].
_OUTLINE_PX, _LEAST_DIFFERENCE = 2, 30.0


class Fault(StrEnum):
    """What may be wrong with a palette, or with what is seen of it."""

    CONFLICT = "conflict"
    """The pixels of an area disagree: layer 2 answers a fault, or no name has the majority."""
    UNKNOWN_PATTERN = "unknown pattern"
    """An area of a colour that no element has."""
    MISSING_TIE = "missing tie"
    """A target zone without a tie."""
    WRONG_CLASS = "wrong class"
    """Another element than the plan's at its place."""
    ABSENT = "absent"
    """Nothing at a place where the plan has an element."""
    NO_DEPTH = "no depth"
    """A region none of whose pixels has a depth: no metric position."""


@dataclass(frozen=True, kw_only=True)
class RegionCfg:
    """How pixels are gathered into regions.

    Attributes:
        least_mm2: Smaller regions are dropped [mm2].
        cable_bridge_m: Gaps up to this in a cable are a tie across it: wider than a tie, narrower than the
            way between two cables [m].
        target_bridge_m: Gaps up to this in a target zone are a cable across it [m].
        tie_least_mm2: White of this area inside a target zone is a tie [mm2].
        rim_px: White this near to a zone's rim is the board's [px].
    """

    least_mm2: float = 15.0
    cable_bridge_m: float = 0.009
    target_bridge_m: float = 0.013
    tie_least_mm2: float = 15.0
    rim_px: int = 2

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for name, low, high in (
            ("least_mm2", 0.0, 1e4),
            ("cable_bridge_m", 0.0, 0.1),
            ("target_bridge_m", 0.0, 0.1),
            ("tie_least_mm2", 0.0, 1e4),
            ("rim_px", 0, 50),
        ):
            value = getattr(self, name)
            require(
                is_number(value) and low <= value <= high,
                f"RegionCfg.{name} = {value!r}: must be within {low:g}..{high:g}",
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class PalettePlan:
    """What should lie where.

    Attributes:
        classes: Shape (m,), of ``PaletteClass``.
        positions_m: In the world frame, shape (m, 3), m.
        tolerance_m: A region this near, across the world's z, is at the place [m].
    """

    classes: NDArray[np.int8]
    positions_m: Array
    tolerance_m: float = 0.01

    def __post_init__(self) -> None:
        """Checks shapes and ranges."""
        count = np.size(self.classes)
        known = [int(c) for c in PaletteClass]
        require(
            np.shape(self.classes) == (count,) and bool(np.isin(self.classes, known).all()),
            f"PalettePlan.classes: must be numbers of PaletteClass {known}, shape (m,)",
        )
        require(
            np.shape(self.positions_m) == (count, 3) and bool(np.isfinite(self.positions_m).all()),
            f"PalettePlan.positions_m: must be finite, shape ({count}, 3), not {np.shape(self.positions_m)}",
        )
        require(
            is_number(self.tolerance_m) and 0.0 < self.tolerance_m <= 0.1,
            f"PalettePlan.tolerance_m = {self.tolerance_m!r}: must be within (0, 0.1]; check the unit",
        )


@dataclass(frozen=True, kw_only=True)
class PaletteFault:
    """One fault.

    Attributes:
        kind: What is wrong.
        region: Index of the region it is about; None where there is none.
        message: For people; names the place.
    """

    kind: Fault
    region: int | None
    message: str


@dataclass(frozen=True, kw_only=True, eq=False)
class PaletteReport:
    """What the observer sees.

    Attributes:
        classes: Of each region, shape (n,), of ``PaletteClass``; never ``PALETTE``.
        centroids_px: Shape (n, 2), px, (0, 0) the picture's upper left corner. A target zone's is of its
            convex hull, which cable and tie cover in part.
        positions_m: The centroids on the surface seen there, in the world frame, shape (n, 3), m; NaN without
            depth.
        areas_px: Shape (n,), px; a target zone's of its hull.
        areas_mm2: As seen face on, shape (n,), mm2; NaN without depth.
        labels: Region of each pixel plus 1, 0 for none, shape (H, W).
        faults: In the order of the regions.
    """

    classes: NDArray[np.int8]
    centroids_px: Array
    positions_m: Array
    areas_px: Array
    areas_mm2: Array
    labels: NDArray[np.int32]
    faults: tuple[PaletteFault, ...]

    def __len__(self) -> int:
        return len(self.classes)

    def of(self, kind: PaletteClass) -> NDArray[np.intp]:
        """Regions of a class.

        Args:
            kind: The class.

        Returns:
            Their indices.
        """
        return np.flatnonzero(self.classes == kind)

    @property
    def open_targets_m(self) -> Array:
        """Where ties are missing, in the world frame, shape (k, 3), m: the robot's goals."""
        missing = [f.region for f in self.faults if f.kind is Fault.MISSING_TIE]
        return self.positions_m[np.array(missing, dtype=np.intp)]

    def __str__(self) -> str:
        counts = [f"{len(self.of(kind))} {kind.name.lower()}" for kind in PaletteClass if len(self.of(kind))]
        head = ", ".join(counts) or "nothing"
        return "\n".join([f"seen: {head}; {len(self.faults)} faults", *(f.message for f in self.faults)])


@dataclass(frozen=True, kw_only=True, eq=False)
class NamedPixels:
    """A picture's pixels as a classifier names them.

    Attributes:
        classes: Of ``PaletteClass``, shape (H, W).
        conflict: Where pixels named ``UNKNOWN`` are so because they disagree, shape (H, W).
    """

    classes: Bytes
    conflict: Mask


@dataclass(frozen=True, kw_only=True, eq=False)
class _Region:
    kind: PaletteClass
    whole: Mask  # with what is covered
    seen: Mask
    fault: Fault | None = None


def _disc(diameter_px: float) -> NDArray[np.uint8]:
    size = 2 * int(np.ceil(diameter_px / 2)) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), dtype=np.uint8)


def _pieces(mask: Mask, bridge_px: float, least_px: float) -> Iterator[Mask]:
    """Connected parts of a mask, gaps bridged, without the specks."""
    bytes_ = mask.astype(np.uint8)
    count, label, stats, _ = cv2.connectedComponentsWithStats(bytes_, connectivity=8)
    keep = stats[:, cv2.CC_STAT_AREA] >= max(0.25 * least_px, 4.0)
    keep[0] = False
    bytes_ = keep[label].astype(np.uint8)
    if bridge_px > 0.0:
        kernel = _disc(bridge_px)
        pad = len(kernel)
        padded = cv2.copyMakeBorder(bytes_, pad, pad, pad, pad, cv2.BORDER_CONSTANT, value=0)
        closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, kernel)[pad:-pad, pad:-pad]
    else:
        closed = bytes_
    count, label = cv2.connectedComponents(closed, connectivity=8)
    label[bytes_ == 0] = 0
    sizes = np.bincount(label.ravel(), minlength=count)
    for k in range(1, count):
        if sizes[k] >= least_px:
            yield np.asarray(label == k)


def _hull(mask: Mask) -> Mask:
    rows, columns = np.nonzero(mask)
    hull = cv2.convexHull(np.stack((columns, rows), axis=1).astype(np.int32))
    out = np.zeros(mask.shape, dtype=np.uint8)
    cv2.fillConvexPoly(out, hull, 1)
    return np.asarray(out.astype(np.bool_) | mask)


def _tie(zone: Mask, white: Mask, least_px: float, rim_px: int) -> Mask | None:
    """The largest white area inside a target zone; None if it is small."""
    inside = cv2.erode(zone.astype(np.uint8), _square(rim_px), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    ties = list(_pieces((inside > 0) & white, 0.0, least_px))
    if not ties:
        return None
    # The rim hides the ends of a tie that reaches across it: all white of the zone that hangs together.
    largest = max(ties, key=np.count_nonzero)
    _, label = cv2.connectedComponents((zone & white).astype(np.uint8), connectivity=4)
    row, column = (int(v[0]) for v in np.nonzero(largest))
    return np.asarray(label == label[row, column])


def _gather(named: NamedPixels, scale_m: float, cfg: RegionCfg) -> Iterator[_Region]:
    """Regions of a picture; ``scale_m`` is a pixel's width on the palette [m]."""
    least_px = cfg.least_mm2 * 1e-6 / scale_m**2
    tie_px = max(cfg.tie_least_mm2 * 1e-6 / scale_m**2, 1.0)
    white = named.classes == PaletteClass.PALETTE
    bridges = {PaletteClass.CABLE: cfg.cable_bridge_m}
    for kind in (PaletteClass.CABLE, PaletteClass.CONNECTOR, PaletteClass.RIVET):
        for mask in _pieces(named.classes == kind, bridges.get(kind, 0.0) / scale_m, least_px):
            yield _Region(kind=kind, whole=mask, seen=mask)
    target = named.classes == PaletteClass.TARGET
    for mask in _pieces(target, cfg.target_bridge_m / scale_m, least_px):
        zone = _hull(mask)
        tie = _tie(zone, white, tie_px, cfg.rim_px)
        fault = Fault.MISSING_TIE if tie is None else None
        yield _Region(kind=PaletteClass.TARGET, whole=zone, seen=mask, fault=fault)
        if tie is not None:
            yield _Region(kind=PaletteClass.TIE, whole=tie, seen=tie)
    unknown = named.classes == PaletteClass.UNKNOWN
    for fault, where in (
        (Fault.CONFLICT, unknown & named.conflict),
        (Fault.UNKNOWN_PATTERN, unknown & ~named.conflict),
    ):
        for mask in _pieces(where, 0.0, least_px):
            yield _Region(kind=PaletteClass.UNKNOWN, whole=mask, seen=mask, fault=fault)


def _square(radius_px: int) -> NDArray[np.uint8]:
    return np.ones((2 * radius_px + 1, 2 * radius_px + 1), dtype=np.uint8)


def _nearest_colour(where: Mask, colour: Array, pixels: Mask) -> Array:
    index = ndimage.distance_transform_edt(~where, return_distances=False, return_indices=True)
    return np.asarray(colour[tuple(index)][pixels])


def coverage(mask: Mask, rgb: Bytes) -> Array:
    """What share of each pixel a region covers, from how the colours mix along its outline.

    Args:
        mask: The region to about a pixel, shape (H, W).
        rgb: Shape (H, W, 3).

    Returns:
        0..1, shape (H, W); 0 or 1 where the region is too thin or too like its surroundings to tell.
    """
    share = mask.astype(np.float64)
    whole = mask.astype(np.uint8)
    inner, outer = cv2.erode(whole, _square(_OUTLINE_PX)), cv2.dilate(whole, _square(_OUTLINE_PX))
    within = cv2.erode(whole, _square(_OUTLINE_PX + 1)) > 0
    without = cv2.dilate(whole, _square(_OUTLINE_PX + 1)) == 0
    outline = (outer > 0) & (inner == 0)
    if not (within.any() and without.any()):
        return share
    steady = cv2.medianBlur(rgb, 5).astype(np.float64)
    ours = _nearest_colour(within, steady, outline)
    across = ours - (theirs := _nearest_colour(without, steady, outline))
    square = (across**2).sum(axis=1)
    mixed = ((rgb[outline] - theirs) * across).sum(axis=1) / np.maximum(square, 1.0)
    told = square >= _LEAST_DIFFERENCE**2
    share[outline] = np.where(told, np.clip(mixed, 0.0, 1.0), share[outline])
    return share


def _centroid(mask: Mask, rgb: Bytes) -> tuple[Array, float]:
    """Centroid and area of a region to a fraction of a pixel [px]."""
    rows, columns = np.nonzero(mask)
    margin = _OUTLINE_PX + 3
    top, left = max(int(rows.min()) - margin, 0), max(int(columns.min()) - margin, 0)
    crop = np.s_[top : int(rows.max()) + margin + 1, left : int(columns.max()) + margin + 1]
    share = coverage(mask[crop], rgb[crop])
    area = float(share.sum())
    x = share.sum(axis=0) @ (np.arange(share.shape[1]) + left + 0.5) / area
    y = share.sum(axis=1) @ (np.arange(share.shape[0]) + top + 0.5) / area
    return np.array([x, y]), area


def depth_at(point_px: Array, mask: Mask, depth_m: Array) -> float:
    """Depth of a plane through the pixels of a region, at a point of the picture.

    The inverse of a plane's depth is linear in pixel coordinates; pixels off the plane, as at an edge, are
    left out.

    Args:
        point_px: Shape (2,), px.
        mask: The region, shape (H, W).
        depth_m: Along the optical axis, shape (H, W), m; 0 or not finite where unknown.

    Returns:
        Depth [m]; NaN if no pixel has one.
    """
    rows, columns = np.nonzero(mask & np.isfinite(depth_m) & (depth_m > 0.0))
    if len(rows) == 0:
        return float("nan")
    z = depth_m[rows, columns]
    middle = float(np.median(z))
    if len(rows) < _PLANE_PX:
        return middle
    A = np.stack((columns + 0.5 - point_px[0], rows + 0.5 - point_px[1], np.ones(len(rows))), axis=1)
    w = middle / z
    kept = np.abs(w - 1.0) <= 0.25
    coefficients = np.array([0.0, 0.0, 1.0])
    for _ in range(1 + _REFITS):
        coefficients = np.linalg.lstsq(A[kept], w[kept], rcond=None)[0]
        residual = np.abs(w - A @ coefficients)
        kept = residual <= max(_OUTLIER * 1.4826 * float(np.median(residual)), _LEAST_RESIDUAL)
    level = float(coefficients[2])
    return middle / level if 0.5 < level < 2.0 else middle


def _place(position: Array, centroid: Array) -> str:
    if np.isfinite(position).all():
        x, y, z = np.round(1e3 * position, 1) + 0.0  # no minus zero
        return f"at ({x:.1f}, {y:.1f}, {z:.1f}) mm"
    return f"at pixel ({centroid[0]:.1f}, {centroid[1]:.1f})"


def _against_plan(report: PaletteReport, plan: PalettePlan) -> Iterator[PaletteFault]:
    """Places of the plan where something else lies, or nothing."""
    for number, place in zip(plan.classes, plan.positions_m, strict=True):
        away = np.hypot(*(report.positions_m[:, :2] - place[:2]).T)
        near = np.flatnonzero(away <= plan.tolerance_m)  # NaN is not near
        if number in report.classes[near]:
            continue
        wanted = PaletteClass(number).name.lower()
        where = _place(place, np.zeros(2))
        if len(near) == 0:
            yield PaletteFault(kind=Fault.ABSENT, region=None, message=f"absent: no {wanted} {where}")
            continue
        nearest = int(near[np.argmin(away[near])])
        seen = PaletteClass(report.classes[nearest]).name.lower()
        yield PaletteFault(
            kind=Fault.WRONG_CLASS,
            region=nearest,
            message=f"wrong class: {seen} instead of {wanted} {where}",
        )


_WORDS = {
    Fault.CONFLICT: "conflict: the pixels of an area disagree",
    Fault.UNKNOWN_PATTERN: "unknown pattern: an area of no element's colour",
    Fault.MISSING_TIE: "missing tie: target zone without one",
    Fault.NO_DEPTH: "no depth: no metric position of a region",
}


def report_on(
    named: NamedPixels,
    rgb: Bytes,
    depth_m: Array,
    camera: OverheadCfg,
    cfg: RegionCfg,
    plan: PalettePlan | None = None,
) -> PaletteReport:
    """Gathers named pixels into regions.

    Args:
        named: The pixels.
        rgb: The picture they were named in, shape (H, W, 3).
        depth_m: Along the optical axis, shape (H, W), m; 0 or not finite where unknown.
        camera: The camera.
        cfg: Parameters.
        plan: What should lie where, if known.

    Returns:
        The report.

    Raises:
        ConfigError: If no pixel has a depth.
    """
    known = depth_m[np.isfinite(depth_m) & (depth_m > 0.0)]
    require(known.size > 0, "depth_m: no pixel has a depth; must be > 0 m, along the optical axis, somewhere")
    regions = list(_gather(named, float(np.median(known)) / camera.focal_px, cfg))
    labels = np.zeros(named.classes.shape, dtype=np.int32)
    n = len(regions)
    centroids, positions, areas_px, areas_mm2 = np.empty((n, 2)), np.empty((n, 3)), np.empty(n), np.empty(n)
    faults: list[PaletteFault] = []
    for k, region in enumerate(regions):
        labels[region.seen] = k + 1
        centroids[k], areas_px[k] = _centroid(region.whole, rgb)
        depth = depth_at(centroids[k], region.seen, depth_m)
        positions[k] = deproject(centroids[k], depth, camera)
        areas_mm2[k] = areas_px[k] * (1e3 * depth / camera.focal_px) ** 2
        found = [region.fault] if region.fault else []
        found += [] if np.isfinite(depth) else [Fault.NO_DEPTH]
        for fault in found:
            message = f"{_WORDS[fault]} {_place(positions[k], centroids[k])}"
            faults.append(PaletteFault(kind=fault, region=k, message=message))
    report = PaletteReport(
        classes=np.array([r.kind for r in regions], dtype=np.int8),
        centroids_px=centroids,
        positions_m=positions,
        areas_px=areas_px,
        areas_mm2=areas_mm2,
        labels=labels,
        faults=tuple(faults),
    )
    if plan is None:
        return report
    return PaletteReport(**{**vars(report), "faults": (*faults, *_against_plan(report, plan))})
