"""Markers as cameras see them: pictures of a flat print without OpenGL, and labels in a MuJoCo scene."""

from dataclasses import dataclass, replace

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from seal_gym.core.cell import CameraCfg, MarkerCfg, OverheadCfg
from seal_gym.core.errors import SeamError, is_number, require
from seal_gym.core.frames import Array, quat_from_matrix, transform
from seal_gym.vision.calibration import Board
from seal_gym.vision.part_pose import PartMarker
from seal_gym.workpieces.workpiece import Workpiece

Grey = NDArray[np.uint8]
# A label's corners (times half its size), counter-clockwise from the lower left, and its texture's.
_QUAD = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
_QUAD_UV = np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]])
# Resolution of the prints.
_SQUARE_PX, _BIT_PX = 96, 48
# Above the plate, so that the two do not flicker through each other.
_PAPER_M = 1e-4
# Reflectance of white paper; more, and the lamps of the scene drive it into the sensor's limit.
_PAPER_GREY = 0.7
# How places are searched: grid, how flat the plate has to be, and how far from what stands on it.
_STEP_M, _FLAT_M, _CLEAR_M = 2.5e-3, 1e-5, 5e-3


@dataclass(frozen=True, kw_only=True)
class ShotCfg:
    """How a picture of a print is taken.

    Attributes:
        black: Grey level of the print's black, of 255.
        white: Grey level of the print's white.
        surround: Grey level of everything else.
        blur_px: Standard deviation of the lens's and motion's blur [px].
        noise_sigma: Standard deviation of the sensor noise, of 255.
        supersample: Samples a pixel, along each side.
    """

    black: float = 40.0
    white: float = 215.0
    surround: float = 120.0
    blur_px: float = 0.7
    noise_sigma: float = 8.0
    supersample: int = 4

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for name, high in (("black", 255.0), ("white", 255.0), ("surround", 255.0), ("noise_sigma", 128.0)):
            value = getattr(self, name)
            require(
                is_number(value) and 0 <= value <= high,
                f"ShotCfg.{name} = {value!r}: must be within 0..{high:g}",
            )
        require(
            is_number(self.blur_px) and 0 <= self.blur_px <= 10,
            f"ShotCfg.blur_px = {self.blur_px!r}: must be within 0..10",
        )
        require(
            self.supersample in range(1, 17),
            f"ShotCfg.supersample = {self.supersample!r}: must be a whole number in 1..16",
        )


def shoot(
    picture: Grey,
    size_m: tuple[float, float],
    T_camera_print: Array,
    matrix: Array,
    frame_px: tuple[int, int],
    rng: np.random.Generator,
    cfg: ShotCfg,
    hidden_by: Array | None = None,
) -> Grey:
    """A pinhole camera's picture of a flat print, in even light.

    Args:
        picture: The print, grey, shape (h, w): black 0, white 255.
        size_m: The print's width and height [m].
        T_camera_print: The print's frame: origin at its upper left corner, x right, y down; shape (4, 4), m.
        matrix: Intrinsic matrix for continuous pixel coordinates, (0, 0) the first pixel's corner; (3, 3).
        frame_px: Width and height of the picture to take [px].
        rng: Source of the noise.
        cfg: Light, blur and noise.
        hidden_by: Triangles in the camera's frame that stand before the print, shape (n, 3, 3), m; black.

    Returns:
        Shape (height, width).
    """
    width, height = frame_px
    flat = matrix @ np.column_stack((T_camera_print[:3, :2], T_camera_print[:3, 3]))
    flat = flat @ np.diag([size_m[0] / picture.shape[1], size_m[1] / picture.shape[0], 1.0])
    image = np.full((height, width), cfg.surround)
    rows, columns = _window(flat, picture, frame_px, hidden_by is not None, 4 * cfg.blur_px)
    # Supersampled pixels of the window.
    k = cfg.supersample
    fine = np.diag([k, k, 1.0]) @ np.array([[1, 0, -columns.start], [0, 1, -rows.start], [0, 0, 1.0]])
    canvas = np.full(
        (k * (rows.stop - rows.start), k * (columns.stop - columns.start)), cfg.surround, np.float32
    )
    levels = cfg.black + (cfg.white - cfg.black) / 255.0 * picture.astype(np.float32)
    # Our coordinates are continuous; OpenCV's count from pixel centres, half a pixel less.
    shift = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
    to_canvas = np.linalg.inv(shift) @ fine @ flat @ shift
    cv2.warpPerspective(
        levels, to_canvas, canvas.shape[::-1], canvas, cv2.INTER_LINEAR, cv2.BORDER_TRANSPARENT
    )
    if hidden_by is not None:
        _cover(canvas, hidden_by, fine @ matrix)
    if cfg.blur_px > 0:
        cv2.GaussianBlur(canvas, (0, 0), k * cfg.blur_px, canvas)
    blocks = np.asarray(canvas, np.float64).reshape(canvas.shape[0] // k, k, canvas.shape[1] // k, k)
    image[rows, columns] = blocks.mean(axis=(1, 3))
    image += rng.normal(0.0, cfg.noise_sigma, image.shape)
    return np.asarray(np.clip(np.rint(image), 0, 255), dtype=np.uint8)


def _window(
    flat: Array, picture: Grey, frame_px: tuple[int, int], everything: bool, margin_px: float
) -> tuple[slice, slice]:
    """Rows and columns of the frame in which the print lies: all of them, if there is more to draw."""
    width, height = frame_px
    h, w = picture.shape
    corners = np.array([[0, 0, 1], [w, 0, 1], [w, h, 1], [0, h, 1]]) @ flat.T
    if everything or (corners[:, 2] <= 0).any():
        return slice(0, height), slice(0, width)
    pixels = corners[:, :2] / corners[:, 2:]
    low, high = pixels.min(axis=0) - margin_px - 2, pixels.max(axis=0) + margin_px + 2
    # At least one pixel, so that a print out of sight needs no case of its own.
    x0, y0 = (int(v) for v in np.clip(low, 0, [width - 1, height - 1]))
    x1, y1 = (int(v) for v in np.clip(np.ceil(high), [x0 + 1, y0 + 1], [width, height]))
    return slice(y0, y1), slice(x0, x1)


def _cover(canvas: NDArray[np.float32], triangles: Array, matrix: Array) -> None:
    """Fills the images of triangles with black."""
    p = triangles @ matrix.T
    before = (p[..., 2] > 1e-3).all(axis=1)
    # Sixteenths of a pixel, counted from pixel centres.
    corners = np.rint((p[before, :, :2] / p[before, :, 2:] - 0.5) * 16).astype(np.int32)
    for triangle in corners:
        cv2.fillConvexPoly(canvas, triangle, 0.0, lineType=cv2.LINE_8, shift=4)


def shoot_board(
    board: Board,
    T_world_board: Array,
    camera: CameraCfg,
    T_world_tip: Array,
    tool: Array,
    rng: np.random.Generator,
    cfg: ShotCfg,
) -> Grey:
    """A sensor camera's picture of a calibration board, the nozzle before it.

    Args:
        board: The board.
        T_world_board: Its place, shape (4, 4), m.
        camera: The camera; its ROI is the picture (``CameraCfg.window`` gives the whole frame).
        T_world_tip: The tip's pose, shape (4, 4), m.
        tool: Triangles of the nozzle in the tip frame (``Scene.tool``), shape (n, 3, 3), m.
        rng: Source of the noise.
        cfg: Light, blur and noise.

    Returns:
        Shape (height, width).
    """
    T_camera_tip = np.linalg.inv(transform(camera.rotation, camera.position_m))
    matrix = np.diag([camera.focal_px, camera.focal_px, 1.0])
    matrix[:2, 2] = camera.centre_px
    return shoot(
        board.picture(_SQUARE_PX),
        board.size_m,
        T_camera_tip @ np.linalg.inv(T_world_tip) @ T_world_board,
        matrix,
        camera.roi_px,
        rng,
        cfg,
        tool @ T_camera_tip[:3, :3].T + T_camera_tip[:3, 3],
    )


def shoot_marker(
    marker: PartMarker, T_world_part: Array, camera: OverheadCfg, rng: np.random.Generator, cfg: ShotCfg
) -> Grey:
    """The overhead camera's picture of a part's AR code, nothing before it.

    Args:
        marker: The code.
        T_world_part: The part's pose, shape (4, 4), m.
        camera: The camera.
        rng: Source of the noise.
        cfg: Light, blur and noise.

    Returns:
        Shape (height, width).
    """
    half = marker.label_m / 2
    # From the middle, y up and z out of the label, to its upper left corner, y down and z into it.
    T_marker_print = transform(np.diag([1.0, -1.0, -1.0]), np.array([-half, half, 0.0]))
    return shoot(
        marker.picture(_BIT_PX),
        (marker.label_m, marker.label_m),
        np.linalg.inv(camera.pose) @ T_world_part @ marker.T_part_marker @ T_marker_print,
        camera.matrix,
        camera.frame_px,
        rng,
        cfg,
    )


def part_marker(workpiece: Workpiece, cfg: MarkerCfg) -> PartMarker:
    """The AR code of a part.

    Args:
        workpiece: The part.
        cfg: Number and size.

    Returns:
        The code, in its place.

    Raises:
        SeamError: If the part has no room for it.
    """
    size_m = cfg.size_mm * 1e-3
    unplaced = PartMarker(id=int(cfg.id), size_m=size_m, T_part_marker=np.eye(4))
    return replace(unplaced, T_part_marker=marker_place(workpiece, unplaced.label_m))


def marker_place(workpiece: Workpiece, label_m: float) -> Array:
    """A place for a label on a part's plate: as far from the seam as can be, clear of all that stands there.

    Of equally good places it takes the one farthest from the seam's start, where the gun waits.

    Args:
        workpiece: The part; its plate's top is the plane z = 0.
        label_m: Side of the label [m].

    Returns:
        ``T_part_marker``: the label's middle, turned as the part is, shape (4, 4), m.

    Raises:
        SeamError: If no place on the plate is large enough.
    """
    triangles = workpiece.surface.triangles
    low, high = triangles.reshape(-1, 3).min(axis=0)[:2], triangles.reshape(-1, 3).max(axis=0)[:2]
    axes = [np.arange(a + _STEP_M / 2, b, _STEP_M) for a, b in zip(low, high, strict=True)]
    x, y = np.meshgrid(*axes, indexing="ij")
    cells = np.column_stack((x.ravel(), y.ravel()))
    bare = (np.abs(_height(cells, triangles)) < _FLAT_M).reshape(x.shape).astype(np.uint8)
    reach = int(np.ceil((label_m / 2 + _CLEAR_M) / _STEP_M))
    window = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    room = np.asarray(cv2.erode(bare, window, borderType=cv2.BORDER_CONSTANT, borderValue=0))
    seam = workpiece.seam
    # With its run-on: a groove may be narrower than the grid.
    whole = seam.at(np.linspace(seam.arc[0], seam.arc[-1], 400)).position[:, :2]
    away = np.linalg.norm(cells[:, None] - whole, axis=-1).min(axis=1)
    free = (room.ravel() > 0) & (away > label_m / np.sqrt(2) + _CLEAR_M)
    require(
        bool(free.any()),
        f"workpiece {workpiece.name!r} has no place for a label of {label_m * 1e3:.0f} mm: make the code "
        "smaller ([marker] size_mm in the cell file) or the plate larger",
        SeamError,
    )
    free_cells = cells[free]
    sealed = seam.at(np.linspace(0.0, seam.length, 200)).position[:, :2]
    apart = np.linalg.norm(free_cells[:, None] - sealed, axis=-1)
    # Whole millimetres, so that places alike by symmetry are alike.
    best = np.lexsort((apart[:, 0], np.round(apart.min(axis=1), 3)))[-1]
    return transform(np.eye(3), np.array([*free_cells[best], _PAPER_M]))


def _height(points: Array, triangles: Array) -> Array:
    """Height of the surface seen from above, -inf where there is none, shape (n,), m."""
    out = np.full(len(points), -np.inf)
    for a, b, c in triangles:
        u, v = b - a, c - a
        area = u[0] * v[1] - u[1] * v[0]
        if abs(area) < 1e-12:
            continue  # stands upright
        d = points - a[:2]
        s = (d[:, 0] * v[1] - d[:, 1] * v[0]) / area
        t = (u[0] * d[:, 1] - u[1] * d[:, 0]) / area
        inside = (s >= 0) & (t >= 0) & (s + t <= 1)
        out[inside] = np.maximum(out[inside], a[2] + s[inside] * u[2] + t[inside] * v[2])
    return out


def add_label(
    spec: mujoco.MjSpec,
    body: mujoco.MjsBody,
    name: str,
    picture: Grey,
    size_m: tuple[float, float],
    T_body_label: Array,
    group: int,
) -> None:
    """Glues a print to a body of a MuJoCo model: to be seen, not to be felt.

    Args:
        spec: The model.
        body: What it is glued to.
        name: Of geom, mesh, material and texture.
        picture: The print, grey, shape (h, w).
        size_m: Width and height [m].
        T_body_label: The label's middle, x right and y up in its picture, z out of it, shape (4, 4), m.
        group: Geom group.
    """
    texture = spec.add_texture(
        name=name,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        width=picture.shape[1],
        height=picture.shape[0],
        nchannel=3,
    )
    texture.data = np.repeat(picture[..., None], 3, axis=-1).tobytes()
    look = spec.add_material(name=name, rgba=[_PAPER_GREY] * 3 + [1.0], specular=0.0, shininess=0.0)
    look.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    half = np.array(size_m) / 2
    mesh = spec.add_mesh(name=name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    mesh.uservert = (_QUAD * [*half, 0.0]).astype(np.float32).ravel()
    mesh.usertexcoord = _QUAD_UV.astype(np.float32).ravel()
    mesh.userface = mesh.userfacetexcoord = np.array([0, 1, 2, 0, 2, 3], np.int32)
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=name,
        material=name,
        pos=T_body_label[:3, 3],
        quat=quat_from_matrix(T_body_label[:3, :3]),
        group=group,
        contype=0,
        conaffinity=0,
        density=0.0,
    )
