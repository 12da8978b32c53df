"""A run as a Rerun recording: images and marks, features over time, the gun and its leaves in 3D."""

from collections.abc import Sequence
from datetime import timedelta
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from seal_gym.core.frames import Array, quat_from_matrix
from seal_gym.rmp import TipRmp
from seal_gym.sim.scene import Scene
from seal_gym.vision import overlay
from seal_gym.workpieces.surface import MATERIALS

if TYPE_CHECKING:
    from experiments.inspect import Frame

VIEWS = ("front", "side")
KINDS = ("translation", "rotation")
_MM, _DEG = 1e3, float(np.rad2deg(1.0))
# Lengths in the 3D view: the nozzle's mouth has a radius of 1.5 mm.
ACCEL_S2 = 0.08  # m for 1 m/s^2
ANGULAR_M_S2 = 0.002  # m for 1 rad/s^2
METRIC_M = 0.010  # half axis for an eigenvalue of 1
_THINNEST_M = 3e-4
_EYE_M = (0.018, -0.027, 0.015)  # in the tip frame: from behind the nozzle on its free side
_EYE_DISTANCE_M = 0.36
_PATH_STEP_M = 5e-4
_TRUE_RGB, _SEEN_RGB = (150, 150, 150), (40, 130, 255)
_TRUE_LINE_RGB = (0, 158, 115)
_SEAM_RGB, _PATH_RGB = (255, 255, 255), (255, 115, 25)
_LEAF_RGB = {
    "attraction_front": (230, 159, 0),
    "heading_front": (240, 228, 66),
    "attraction_side": (86, 180, 233),
    "heading_side": (0, 114, 178),
    "forward_speed": (0, 158, 115),
    "policy": (255, 255, 255),
    "damping": (204, 121, 167),
    "regularisation": (150, 150, 150),
    "lean": (213, 94, 0),
}
ABOUT = f"""# One run, frame by frame

Scrub the timeline below; `time` is in seconds of the simulation, `frame` counts camera frames.

**front, side**: the regions of interest, pixel by pixel.

- orange dots: the edge pixels RANSAC chose from
- broad green line: the true seam's tangent
- blue line: RANSAC's, from this frame alone
- thin white line: the tracked one
- yellow point: one stand-off before the nozzle mouth
- magenta point: the attraction point, its foot on the tracked line

**cell**: part, nozzle, true seam (white), desired tip path (grey), the tip's path so far (orange), estimated
tangent (blue).

**translation, rotation**: the leaves at the tip, in the tip frame (x red, right of travel; y green, along it;
z blue, back along the nozzle). Colours as in the plots.

- An arrow is the acceleration a leaf wants: {_MM * ACCEL_S2:.0f} mm for 1 m/s^2, {_MM * ANGULAR_M_S2:.0f} mm
  for 1 rad/s^2 about the arrow.
- An ellipsoid is its metric, long where the leaf insists: half axes of {_MM * METRIC_M:.0f} mm times the root
  of each eigenvalue of the 3x3 block.
- `attraction_front` to `forward_speed` are the expert's leaves; `policy` is the action that was resolved;
  `damping`, `regularisation` and `lean` are the fixed leaves beside it. Joint limits and leaves of yours act
  elsewhere and are not drawn.

**plots**: features true and estimated, the tip's error, what each leaf asks for.
"""


def missing() -> str | None:
    """Whether recordings can be written.

    Returns:
        None, or what to install.
    """
    if find_spec("rerun") is None:
        return "rerun-sdk is not installed: pip install 'seal-gym[viz]' (or pip install rerun-sdk)"
    return None


def ellipsoid(block: Array) -> tuple[Array, Array]:
    """The ellipsoid that stands for a metric: long where it is large.

    Args:
        block: Symmetric, positive semi-definite, shape (3, 3).

    Returns:
        Half axes, shape (3,), m, and the orientation as a unit quaternion (x, y, z, w).
    """
    values, axes = np.linalg.eigh(block)
    if np.linalg.det(axes) < 0.0:
        axes = axes * [1.0, 1.0, -1.0]
    half = np.maximum(METRIC_M * np.sqrt(np.maximum(values, 0.0)), _THINNEST_M)
    return half, np.roll(quat_from_matrix(axes), -1)


class Writer:
    """Writes frames as they come; ``close`` ends the file.

    Args:
        path: The .rrd file.
        name: Of the recording.
        scene: The run's part, cell and nozzle.

    Attributes:
        about: What the viewer shows as text.
    """

    about = ABOUT

    def __init__(self, path: Path, name: str, scene: Scene) -> None:
        self._rr: Any = import_module("rerun")
        batches = self._rr.ChunkBatcherConfig()
        batches.flush_tick = timedelta(seconds=5)  # small batches would double the file
        self._stream = self._rr.RecordingStream("seal_gym_inspect", recording_id=name, batcher_config=batches)
        self._stream.save(path, default_blueprint=self._layout(scene))
        self._leaf_names: set[str] = set()
        self._times: list[float] = []
        self._scalars: dict[str, list[float]] = {}
        self._accels: dict[str, tuple[list[int], list[float]]] = {}
        self._path: list[Array] = []
        self._part: Array | None = None
        self._static(scene)

    def _layout(self, scene: Scene) -> Any:
        """How the viewer opens."""
        return blueprint(scene, _plots())

    # -- what does not change ---------------------------------------------------------------------------

    def _static(self, scene: Scene) -> None:
        rr, part = self._rr, scene.workpiece
        self._fixed("about", rr.TextDocument(self.about, media_type=rr.MediaType.MARKDOWN))
        self._fixed("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        rgb = np.array([m.rgb for m in MATERIALS])[part.surface.material]
        self._mesh("world/part/surface", part.surface.triangles, np.round(255 * rgb).astype(np.uint8))
        self._mesh(
            "world/tip/nozzle", scene.tool, np.tile(np.array([230, 190, 60], np.uint8), (len(scene.tool), 1))
        )
        self._fixed("world/tip", rr.TransformAxes3D(axis_length=0.015))
        seam = part.seam
        inside = (seam.arc >= 0.0) & (seam.arc <= seam.length)
        desired = seam.tip_path(scene.cell.process.stand_off_m)
        for entity, curve, colour in (
            ("seam", seam.position, _SEAM_RGB),
            ("desired_path", desired, _TRUE_RGB),
        ):
            strip = rr.LineStrips3D([curve[inside]], colors=[colour], radii=[5e-4])
            self._fixed(f"world/part/{entity}", strip)
        for view, camera in zip(VIEWS, scene.cell.cameras, strict=True):
            stand_off = camera.project(np.array([0.0, 0.0, -scene.cell.process.stand_off_m]))
            self._fixed(
                f"{view}/stand_off",
                rr.Points2D([stand_off], colors=[overlay.STAND_OFF_RGB], radii=[1.4], draw_order=30.0),
            )

    def _fixed(self, entity: str, what: Any) -> None:
        self._stream.log(entity, what, static=True)

    def _mesh(self, entity: str, triangles: Array, rgb: NDArray[np.uint8]) -> None:
        points = triangles.reshape(-1, 3)
        edge = triangles[:, 1:] - triangles[:, :1]
        normal = np.cross(edge[:, 0], edge[:, 1])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        mesh = self._rr.Mesh3D(
            vertex_positions=points,
            triangle_indices=np.arange(len(points)).reshape(-1, 3),
            vertex_normals=normal.repeat(3, axis=0),
            vertex_colors=rgb.repeat(3, axis=0),
        )
        self._fixed(entity, mesh)

    # -- what does --------------------------------------------------------------------------------------

    def add(self, k: int, frame: "Frame", *, full: bool) -> None:
        """Writes a frame.

        Args:
            k: Its number.
            frame: What there is to see.
            full: With images, marks and leaves, which take most of the room.
        """
        self._stream.set_time("frame", sequence=k)
        self._stream.set_time("time", duration=frame.time_s)
        self._times.append(frame.time_s)
        self._poses(frame)
        self._numbers(frame)
        for name, leaf in frame.leaves.items():
            self._accel(k, name, leaf)
        if not full:
            return
        for v, view in enumerate(VIEWS):
            self._view(view, frame.images[v], frame.marks[v], frame.true_marks[v])
        self._path_so_far()
        for name, leaf in frame.leaves.items():
            self._leaf(name, leaf)

    def _poses(self, frame: "Frame") -> None:
        rr, part, tip = self._rr, frame.part_pose, frame.tip_pose
        if self._part is None or not np.array_equal(part, self._part):
            self._part = part
            self._stream.log("world/part", rr.Transform3D(translation=part[:3, 3], mat3x3=part[:3, :3]))
        self._stream.log("world/tip", rr.Transform3D(translation=tip[:3, 3], mat3x3=tip[:3, :3]))
        mouth = part[:3, :3].T @ (tip[:3, 3] - part[:3, 3])
        if not self._path or np.linalg.norm(mouth - self._path[-1]) >= _PATH_STEP_M:
            self._path.append(mouth)
        tangent = []
        if frame.seen.valid[0].all():
            reach = 0.01 * frame.seen.direction[0]
            tangent = [np.stack((frame.seen.point_m[0] - reach, frame.seen.point_m[0] + reach))]
        self._stream.log(
            "world/tip/estimated_tangent", rr.LineStrips3D(tangent, colors=[_SEEN_RGB], radii=[4e-4])
        )

    def _path_so_far(self) -> None:
        strip = self._rr.LineStrips3D([np.array(self._path)], colors=[_PATH_RGB], radii=[5e-4])
        self._stream.log("world/part/tip_path", strip)

    def _numbers(self, frame: "Frame") -> None:
        values = {
            "tip/error_mm": _MM * frame.tip_error_m,
            "tip/arc_mm": _MM * frame.arc_m,
        }
        for v, view in enumerate(VIEWS):
            for source, f in (("true", frame.true), ("estimated", frame.seen)):
                values[f"features/d_{view}_mm/{source}"] = _MM * float(f.d_m[0, v])
                values[f"features/theta_{view}_deg/{source}"] = _DEG * float(f.theta_rad[0, v])
            values[f"quality/valid_{view}"] = float(frame.seen.valid[0, v])
            values[f"quality/snr_{view}_db"] = float(frame.snr_db[v])
        for entity, value in values.items():
            self._scalars.setdefault(entity, []).append(value)

    def _accel(self, k: int, name: str, leaf: TipRmp) -> None:
        for kind, unit, part in (("translation", "m_s2", slice(0, 3)), ("rotation", "rad_s2", slice(3, 6))):
            if not leaf.metric[0, part, part].any():
                continue
            frames, values = self._accels.setdefault(f"accel/{kind}_{unit}/{name}", ([], []))
            frames.append(k)
            values.append(float(np.linalg.norm(leaf.accel[0, part])))

    def _view(
        self, view: str, image: NDArray[np.uint8], seen: overlay.ViewMarks, true: overlay.ViewMarks
    ) -> None:
        rr = self._rr
        # Lossless: the edge stage reads single grey levels.
        png = cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))[1].tobytes()
        self._stream.log(f"{view}/image", rr.EncodedImage(contents=png, media_type="image/png"))
        self._stream.log(
            f"{view}/candidates",
            rr.Points2D(seen.candidates, colors=[overlay.CANDIDATE_RGB], radii=[0.28], draw_order=10.0),
        )
        for name, ends, rgb, radius, order in (
            ("true", true.line, _TRUE_LINE_RGB, 0.7, 11.0),
            ("ransac", seen.ransac, overlay.RANSAC_RGB, 0.45, 12.0),
            ("tracked", seen.line, overlay.LINE_RGB, 0.2, 13.0),
        ):
            strips = [] if ends is None else [ends]
            strip = rr.LineStrips2D(strips, colors=[rgb], radii=[radius], draw_order=order)
            self._stream.log(f"{view}/{name}", strip)
        foot = [] if seen.attraction is None else [seen.attraction]
        self._stream.log(
            f"{view}/attraction",
            rr.Points2D(foot, colors=[overlay.ATTRACTION_RGB], radii=[0.9], draw_order=31.0),
        )

    def _leaf(self, name: str, leaf: TipRmp) -> None:
        rr, colour = self._rr, _LEAF_RGB.get(name, (255, 255, 255))
        for kind, part, scale in (
            ("translation", slice(0, 3), ACCEL_S2),
            ("rotation", slice(3, 6), ANGULAR_M_S2),
        ):
            block = leaf.metric[0, part, part]
            entity = f"world/tip/{kind}/{name}"
            if not block.any() and entity not in self._leaf_names:
                continue  # the leaf does not act here
            self._leaf_names.add(entity)
            self._arrow(f"{entity}/accel", scale * leaf.accel[0, part], colour)
            half, quaternion = ellipsoid(block)
            self._stream.log(
                f"{entity}/metric",
                rr.Ellipsoids3D(
                    half_sizes=[half],
                    quaternions=[rr.Quaternion(xyzw=quaternion)],
                    colors=[colour],
                    line_radii=[1e-4],
                    fill_mode="MajorWireframe",
                    labels=[name],
                    show_labels=False,
                ),
            )

    def _arrow(self, entity: str, vector: Array, colour: tuple[int, int, int]) -> None:
        arrow = self._rr.Arrows3D(vectors=[vector], colors=[colour], radii=[3e-4])
        self._stream.log(entity, arrow)

    # -- the end ----------------------------------------------------------------------------------------

    def close(self) -> None:
        """Writes the time series and ends the file."""
        rr = self._rr
        everyone = list(range(len(self._times)))
        series = {entity: (everyone, values) for entity, values in self._scalars.items()}
        for entity, (frames, values) in {**series, **self._accels}.items():
            times = [
                rr.TimeColumn("frame", sequence=frames),
                rr.TimeColumn("time", duration=[self._times[k] for k in frames]),
            ]
            leaf = entity.rsplit("/", 1)[-1]
            fixed = {"true": _TRUE_RGB, "estimated": _SEEN_RGB, **_LEAF_RGB}.get(leaf)
            style = rr.SeriesLines(colors=None if fixed is None else [fixed], names=[leaf], widths=[1.5])
            self._fixed(entity, style)
            self._stream.send_columns(entity, indexes=times, columns=rr.Scalars.columns(scalars=values))
        self._stream.flush()
        self._stream.disconnect()


def blueprint(scene: Scene, plots: Sequence[Any]) -> Any:
    """How the viewer opens: the ROIs left, the cell and the leaves in the middle, the plots right.

    Args:
        scene: The run's part, cell and nozzle.
        plots: Views for the right column.

    Returns:
        A ``rerun.blueprint.Blueprint``.
    """
    b = import_module("rerun.blueprint")
    rois = b.Vertical(
        b.Spatial2DView(origin="front", name="front"),
        b.Spatial2DView(origin="side", name="side"),
        b.TextDocumentView(origin="about", name="about"),
        row_shares=[2.0, 1.0, 1.2],
    )
    leaves = [
        b.Spatial3DView(
            origin="world/tip",
            contents=["+ $origin", f"+ $origin/{kind}/**"],
            name=f"leaves: {kind}",
            eye_controls=b.EyeControls3D(
                position=_EYE_M, look_target=(0.0, 0.0, 0.0), eye_up=(0.0, 0.0, 1.0)
            ),
            line_grid=False,
        )
        for kind in KINDS
    ]
    cell = b.Spatial3DView(
        origin="world",
        contents=["+ $origin/**", *(f"- $origin/tip/{kind}/**" for kind in KINDS)],
        name="cell",
        eye_controls=_eye(scene, b),
        line_grid=False,
    )
    return b.Blueprint(
        b.Horizontal(
            rois,
            b.Vertical(cell, b.Horizontal(*leaves), row_shares=[1.3, 1.0]),
            b.Vertical(*plots),
            column_shares=[1.0, 1.5, 1.3],
        ),
        b.TimePanel(state="collapsed", timeline="time"),
        b.SelectionPanel(state="collapsed"),
        b.BlueprintPanel(state="collapsed"),
    )


def _plots() -> list[Any]:
    """Features, the tip's error, the leaves and the images' quality over time."""
    b = import_module("rerun.blueprint")
    plots = [
        b.TimeSeriesView(
            origin=f"features/{name}_{view}_{unit}",
            name=f"{name} {view} [{unit}]",
            axis_y=b.ScalarAxis(range=(-reach, reach)),
        )
        # The approach, ten times larger, is cut off: zoom out to see it.
        for name, unit, reach in (("d", "mm", 0.5), ("theta", "deg", 6.0))
        for view in VIEWS
    ]
    plots.append(
        b.TimeSeriesView(origin="tip/error_mm", name="tip error [mm]", axis_y=b.ScalarAxis(range=(0.0, 0.5)))
    )
    plots.append(
        b.Tabs(
            b.TimeSeriesView(
                origin="accel/translation_m_s2", name="leaves [m/s^2]", axis_y=b.ScalarAxis(range=(0.0, 0.15))
            ),
            b.TimeSeriesView(
                origin="accel/rotation_rad_s2",
                name="leaves [rad/s^2]",
                axis_y=b.ScalarAxis(range=(0.0, 10.0)),
            ),
            b.TimeSeriesView(origin="quality", name="valid, SNR [dB]"),
        )
    )
    return plots


def _eye(scene: Scene, blueprint: Any) -> Any:
    """Looks at the seam from the side that the nozzle leans to."""
    seam, pose = scene.workpiece.seam, scene.workpiece.pose
    middle = pose[:3, :3] @ seam.position.mean(axis=0) + pose[:3, 3]
    away = pose[:3, :3] @ seam.approach.mean(axis=0)
    away[2] = max(away[2], 0.3)
    return blueprint.EyeControls3D(
        position=middle + _EYE_DISTANCE_M * away / np.linalg.norm(away),
        look_target=middle,
        eye_up=(0.0, 0.0, 1.0),
    )
