"""Single frames of seams with their truth, and how far a method's lines are from it.

The frames are what the cameras see in a run: the tip within a millimetre and a few degrees of its path, all
along the seam, under the whole sensor realism. Frame ``seed`` is the same in every experiment.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments import results
from seal_gym.core.cell import load_cell
from seal_gym.core.errors import require
from seal_gym.core.frames import Array, axis_angle, tip_rotation, transform
from seal_gym.sim.look import Look, LookCfg
from seal_gym.sim.raycast import Images, Raycaster
from seal_gym.sim.scene import cached_scene
from seal_gym.vision.edges import EdgeDetector
from seal_gym.vision.features import SeamLines, ViewGeometry, oracle_lines
from seal_gym.vision.seam_line import LineCfg, StripLine, dilated, find_lines, strips
from seal_gym.workpieces import catalogue
from seal_gym.workpieces.seam import Seam, nearest_on_path

Bytes = NDArray[np.uint8]
Bools = NDArray[np.bool_]

VIEWS = ("front", "side")
STAGES = ("raw", "refined")
FIRST_SEED, LAST_SEED = 500_000, 999_999
CORNER_M = 15e-3  # protocol.md: within this of a corner
_WINDOW_M = 10e-3  # as the environment's progress
FAIL_PX, FAIL_DEG = 3.0, 10.0
_AXES = np.eye(3)


@dataclass(frozen=True, kw_only=True)
class FrameCfg:
    """Where the tip is, about its path.

    Attributes:
        offset_m: Largest displacement across the path, along x and z of the tip [m].
        turned_rad: Largest rotation about x and z of the tip [rad].
        lean_rad: Largest rotation about y [rad].
        look: Light, exposure, noise and texture.
    """

    offset_m: float = 1e-3
    turned_rad: float = float(np.deg2rad(3.0))
    lean_rad: float = float(np.deg2rad(2.0))
    look: LookCfg = LookCfg()  # noqa: RUF009  # frozen


class Views(NamedTuple):
    """What both views have in common in all frames, as strips (see ``seam_line``).

    Attributes:
        mask: Where the nozzle is, each of shape (length, width).
        reference: t and o of the point one stand-off before the nozzle mouth, shape (2, 2), px.
    """

    mask: tuple[Bools, Bools]
    reference: Array


class SeamFrames(NamedTuple):
    """N frames of a part.

    Attributes:
        part: Its name.
        seed: Of each frame, shape (N,).
        s_m: Arc length of the seam's point nearest the tip, shape (N,), m.
        corner: Whether that is within 15 mm of a corner, shape (N,).
        images: What the sensors gave.
        strip: The same as strips, front and side, each of shape (N, length, width, 3).
        truth: p and q of the seam's tangent in either strip, shape (N, 2, 2), px.
        views: Masks and references.
    """

    part: str
    seed: NDArray[np.int64]
    s_m: Array
    corner: Bools
    images: Images
    strip: tuple[Bytes, Bytes]
    truth: Array
    views: Views


def check_seeds(seed: int, count: int) -> None:
    """Refuses seeds that are not for validation: published tables have seeds of their own.

    Args:
        seed: The first.
        count: How many.
    """
    require(
        count >= 1 and seed >= FIRST_SEED and seed + count - 1 <= LAST_SEED,
        f"seeds {seed}..{seed + count - 1}: must be within {FIRST_SEED}..{LAST_SEED} (validation)",
    )


def _pose(seam: Seam, s_m: float, stand_off_m: float, rng: np.random.Generator, cfg: FrameCfg) -> Array:
    """``T_part_tip`` about the path at an arc length."""
    point = seam.at(s_m)
    x, z = rng.uniform(-cfg.offset_m, cfg.offset_m, 2)
    about_x, about_z = rng.uniform(-cfg.turned_rad, cfg.turned_rad, 2)
    about_y = rng.uniform(-cfg.lean_rad, cfg.lean_rad)
    path = transform(
        tip_rotation(point.tangent, point.approach), point.position + stand_off_m * point.approach
    )
    turn = np.eye(3)
    for axis, angle in zip(_AXES, (about_x, about_y, about_z), strict=True):
        turn = turn @ axis_angle(axis, angle)
    return np.asarray(path @ transform(turn, np.array([x, 0.0, z])))


def _strip_lines(lines: SeamLines, views: ViewGeometry, reference: Array) -> Array:
    """Lines of the images as p and q of the strips, shape (N, 2, 2)."""
    out = np.empty((len(lines.point), 2, 2))
    for v in range(2):
        (x, y), (u, w) = lines.point[:, v].T, lines.direction[:, v].T
        t, o, dt, do = (views.size[0, 1] - y, x, -w, u) if v == 0 else (x, y, u, w)
        out[:, v, 1] = do / dt
        out[:, v, 0] = o + out[:, v, 1] * (reference[v, 0] - t)
    return out


def _images(caster: Raycaster, pose: Array, look: Look, snr_db: float | None) -> Images:
    part, frame = np.tile(np.eye(4), (len(pose), 1, 1)), np.zeros(len(pose), np.uint64)
    if snr_db is None:
        return caster.render(pose, part, look, frame)
    out = []
    for v in range(2):
        sigma = look.noise_sigma.copy()
        # The exposure leaves room for the noise, so the noise-free picture changes with it, a little.
        for _ in range(8):
            seen = caster.render(pose, part, look._replace(noise_sigma=sigma), frame)
            sigma = sigma * 10.0 ** ((seen.snr_db[:, v] - snr_db) / 20.0)
        out.append(seen)
    snr = np.column_stack([seen.snr_db[:, v] for v, seen in enumerate(out)])
    return Images(out[0].front, out[1].side, snr)


def draw(
    part: str, count: int, seed: int = FIRST_SEED, cfg: FrameCfg | None = None, snr_db: float | None = None
) -> SeamFrames:
    """Draws frames; that of a seed does not depend on how many are drawn.

    Args:
        part: Name of a nominal part.
        count: How many.
        seed: Of the first; each has the next.
        cfg: Where the tip is, and the look.
        snr_db: If given, the noise is scaled until the sensor's own signal-to-noise ratio, that of the whole
            ROI with the nozzle in it, is this in either view.

    Returns:
        The frames.
    """
    check_seeds(seed, count)
    cfg, cell, piece = cfg or FrameCfg(), load_cell(), catalogue.get(part)
    seam, stand_off = piece.seam, cell.process.stand_off_m
    caster = Raycaster(piece.surface, cell, cached_scene(piece, cell).tool)
    geometry = ViewGeometry.of(cell)
    path = seam.tip_path(stand_off)
    look, pose, s = Look.empty(count), np.empty((count, 4, 4)), np.empty(count)
    for k in range(count):
        rng = np.random.default_rng(seed + k)
        drawn = float(rng.uniform(0.0, seam.length))
        pose[k] = _pose(seam, drawn, stand_off, rng, cfg)
        look.draw(k, rng, cfg.look)
        window = (drawn - _WINDOW_M, drawn + _WINDOW_M)
        _, s[k] = nearest_on_path(path, seam.arc, pose[k, :3, 3], *window)
    at = seam.at(s)
    ref = geometry.reference
    views = Views(
        dilated(caster.nozzle_alpha), np.array([[geometry.size[0, 1] - ref[0, 1], ref[0, 0]], ref[1]])
    )
    lines = oracle_lines(at.position, at.tangent, pose, geometry)
    require(bool(lines.valid.all()), f"{part}: a frame does not show the seam; reduce FrameCfg.offset_m")
    images = _images(caster, pose, look, snr_db)
    corner = np.zeros(count, np.bool_)
    for first, last in seam.corners:
        corner |= (s > first - CORNER_M) & (s < last + CORNER_M)
    return SeamFrames(
        part=part,
        seed=seed + np.arange(count),
        s_m=s,
        corner=corner,
        images=images,
        strip=strips(images.front, images.side),
        truth=_strip_lines(lines, geometry, views.reference),
        views=views,
    )


def subset(frames: SeamFrames, keep: NDArray[Any]) -> SeamFrames:
    """Some of the frames.

    Args:
        frames: The frames.
        keep: Indices, or True for those to keep.

    Returns:
        These.
    """
    images = Images(*(x[keep] for x in frames.images))
    return frames._replace(
        seed=frames.seed[keep],
        s_m=frames.s_m[keep],
        corner=frames.corner[keep],
        images=images,
        strip=(frames.strip[0][keep], frames.strip[1][keep]),
        truth=frames.truth[keep],
    )


def lines_of(frames: SeamFrames, detector: EdgeDetector, cfg: LineCfg | None = None) -> list[StripLine]:
    """A method's lines in both views, each frame by itself.

    Args:
        frames: The frames.
        detector: Finds the edges.
        cfg: The line stage.

    Returns:
        Front and side.
    """
    return [
        find_lines(frames.strip[v], frames.views.mask[v], frames.views.reference[v], detector, cfg)
        for v in range(2)
    ]


class LineErrors(NamedTuple):
    """How far lines are from the truth, infinitely where there is none.

    Attributes:
        offset_px: Of the attraction distance d_attr (formulas.md, section 2), signed, shape (N,), px.
        angle_deg: Of the angle, signed, shape (N,), deg.
    """

    offset_px: Array
    angle_deg: Array


def errors(line: Array, truth: Array, o_ref: float) -> LineErrors:
    """Errors of lines against the truth.

    Args:
        line: p and q, NaN without a line, shape (N, 2), px.
        truth: Likewise.
        o_ref: The reference's o [px].

    Returns:
        The errors.
    """

    def features(x: Array) -> Array:
        p, q = x[:, 0], x[:, 1]
        return np.stack(((p - o_ref) / (1.0 + q * q), np.rad2deg(np.arctan(q))))

    off, turn = features(line) - features(truth)
    lost = ~np.isfinite(off)
    return LineErrors(np.where(lost, np.inf, off), np.where(lost, np.inf, turn))


def stage_errors(found: StripLine, truth: Array, o_ref: float) -> dict[str, LineErrors]:
    """Errors before and after the refinement.

    Args:
        found: Lines.
        truth: p and q, shape (N, 2), px.
        o_ref: The reference's o [px].

    Returns:
        For ``"raw"`` and ``"refined"``.
    """
    refined = np.where(found.valid[:, None], found.line[:, :2], np.nan)
    return {"raw": errors(found.raw, truth, o_ref), "refined": errors(refined, truth, o_ref)}


def joined(parts: Sequence[LineErrors]) -> LineErrors:
    """Errors one after the other.

    Args:
        parts: Errors.

    Returns:
        All.
    """
    return LineErrors(*(np.concatenate(x) for x in zip(*parts, strict=True)))


def failed(e: LineErrors) -> Bools:
    """Lines that are missing, or more than ``FAIL_PX`` or ``FAIL_DEG`` off.

    Args:
        e: Errors.

    Returns:
        Shape (N,).
    """
    return (np.abs(e.offset_px) > FAIL_PX) | (np.abs(e.angle_deg) > FAIL_DEG)


def loss(e: LineErrors) -> float:
    """Mean of offset and angle errors, each over what counts as failed and at most 1.

    Args:
        e: Errors.

    Returns:
        0 (no error) to 1 (all failed).
    """
    off = np.minimum(np.abs(e.offset_px) / FAIL_PX, 1.0)
    return float(0.5 * np.mean(off + np.minimum(np.abs(e.angle_deg) / FAIL_DEG, 1.0)))


def accuracy(e: LineErrors) -> dict[str, Any]:
    """Figures for a table; medians over all frames, a missing line counting as infinitely far off.

    Args:
        e: Errors, at least one.

    Returns:
        Columns; a median is None where most have no line.
    """
    count, n = int(failed(e).sum()), len(e.offset_px)
    off, turn = (float(np.median(np.abs(x))) for x in e)
    return {
        "frames": n,
        "offset_px": off if np.isfinite(off) else None,
        "angle_deg": turn if np.isfinite(turn) else None,
        "failed_pct": 100.0 * count / n,
        "failed_ci": results.wilson(count, n),
        "loss": loss(e),
    }
