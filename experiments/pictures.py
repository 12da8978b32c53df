"""Plots and videos of a run."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from agents.video import open_video
from seal_gym.core.frames import Array
from seal_gym.envs.seal_env import SealEnv
from seal_gym.workpieces.surface import Surface

mpl.use("Agg")  # no screen needed
import matplotlib.pyplot as plt  # the backend has to be chosen first
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import LogNorm

SPEED_UP = 5
_STRIP = 176
_GRID = (70, 74, 80)
_CURVE = (90, 200, 255)
_TEXT = (235, 235, 235)
_BACK = (28, 30, 34)
_BLUE, _RED, _GREY = "#1f5fa8", "#d1382c", "#8a8f98"
_CLEARANCE_MM = 1.06  # of the mouth to wall and plate
_ERROR_MM = (0.01, 3.0)  # range of the colours
_SETTLE_MM = 10.0  # protocol.md: errors count from here
_SHOWN_POSES = 5


class Recorder:
    """Records a run: the tip's path in the part's frame, its error, and frames for a video.

    On the ways from home and back there are pictures only.

    Attributes:
        time_s: Of each frame, since the gun was in its hover [s].
        tip_mm: Tip in the part's frame, one row a frame [mm].
        error_mm: Tip error of each frame [mm].
        s_mm: Arc length of the seam's point nearest the tip in each frame [mm].
        part_pose: ``T_base_part`` of each frame, shape (4, 4), m.
        frames: Pictures, if asked for.
    """

    def __init__(self, *, video: bool) -> None:
        """Starts empty.

        Args:
            video: Whether to take pictures: every ``SPEED_UP``-th frame.
        """
        self._video = video
        self.time_s: list[float] = []
        self.tip_mm: list[NDArray[np.float64]] = []
        self.error_mm: list[float] = []
        self.frames: list[NDArray[np.uint8]] = []
        self.s_mm: list[float] = []
        self.part_pose: list[Array] = []
        self.desired_mm = np.empty((0, 3))
        self._seen, self._ended, self._start_s = 0, False, 0.0

    def __call__(self, env: SealEnv, info: dict[str, Any]) -> None:
        """Takes one frame.

        Args:
            env: The environment.
            info: Of the last step.
        """
        core = env.core
        if self._seen == 0:
            seam, stand_off = core.scene.workpiece.seam, core.cfg.cell.process.stand_off_m
            sealed = seam.at(np.linspace(0.0, seam.length, 2000))
            self.desired_mm = 1e3 * (sealed.position + stand_off * sealed.approach)
            self._nominal_s = seam.length / core.cfg.cell.process.speed_m_s
        last = "episode_metrics" in info and not self._ended
        if not (self._ended or info.get("under_way")):
            self._record(env, info)
        if self._video and (last or self._seen % SPEED_UP == 0):
            picture = env.render()
            assert picture is not None
            self.frames.append(self._with_strip(picture))
        self._seen += 1
        self._ended = self._ended or last

    def _record(self, env: SealEnv, info: dict[str, Any]) -> None:
        core = env.core
        part = core.arm.part_pose[0].copy()
        self.part_pose.append(part)
        if not self.time_s:
            self._start_s = core.seconds(0)
        self.time_s.append(core.seconds(0) - self._start_s)
        self.tip_mm.append(1e3 * part[:3, :3].T @ (core.tip.pose[0, :3, 3] - part[:3, 3]))
        self.error_mm.append(info["tip_error_mm"])
        self.s_mm.append(1e3 * float(core.progress.s[0]))

    def _with_strip(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The picture with the tip error so far on a logarithmic scale below it."""
        width = picture.shape[1]
        strip = np.full((_STRIP, width, 3), _BACK, np.uint8)
        left, right, top, bottom = 84, width - 24, 22, _STRIP - 34

        def row(error: float) -> int:
            level = (np.log10(min(max(error, 1e-3), 30.0)) + 3.0) / (np.log10(30.0) + 3.0)
            return round(float(bottom - level * (bottom - top)))

        for error, label in ((1e-3, "0.001"), (1e-2, "0.01"), (0.1, "0.1"), (1.0, "1"), (10.0, "10 mm")):
            cv2.line(strip, (left, row(error)), (right, row(error)), _GRID, 1)
            cv2.putText(
                strip, label, (12, row(error) + 5), cv2.FONT_HERSHEY_SIMPLEX, 0.45, _TEXT, 1, cv2.LINE_AA
            )
        if self.time_s:
            span = max(1.15 * self._nominal_s, self.time_s[-1])
            x = left + (right - left) * np.asarray(self.time_s) / span
            points = np.column_stack((x.round(), [row(e) for e in self.error_mm])).astype(np.int32)
            cv2.polylines(strip, [points], False, _CURVE, 2, cv2.LINE_AA)
            text = f"tip error {self.error_mm[-1]:.3f} mm    t = {self.time_s[-1]:.1f} s"
        if self._ended or not self.time_s:
            text = "back home" if self._ended else "from home to the seam"
        text += f"    {SPEED_UP}x real time"
        cv2.putText(strip, text, (left, _STRIP - 10), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _TEXT, 1, cv2.LINE_AA)
        return np.concatenate((picture, strip))

    def write_video(self, path: Path) -> None:
        """Writes the frames as an MP4 (H.264).

        Args:
            path: The file.
        """
        with open_video(path) as writer:
            for frame in self.frames:
                writer.append_data(frame)

    def plot(self, path: Path, title: str) -> None:
        """Plots path against seam from top and side, and the error along the seam.

        Args:
            path: The PNG file.
            title: Above the plots.
        """
        tip, desired = np.asarray(self.tip_mm), self.desired_mm
        sealing = np.asarray(self.s_mm) >= 0
        figure, (top, side, error) = plt.subplots(
            3, 1, figsize=(8.2, 11.5), height_ratios=(2.2, 1, 1), constrained_layout=True
        )
        top.plot(*desired[:, :2].T, color=_BLUE, lw=4, alpha=0.45, label="desired path (seam + stand-off)")
        top.plot(*tip[:, :2].T, color=_RED, lw=1.2, label="tip")
        top.plot(*tip[0, :2], "o", color=_RED, ms=6, label="start")
        top.plot(*tip[-1, :2], "s", color=_RED, ms=6, label="end")
        top.set(xlabel="x of the part [mm]", ylabel="y of the part [mm]", title=f"{title}: from the top")
        top.set_aspect("equal", adjustable="datalim")
        top.legend(loc="best", fontsize=9)

        arc = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(desired, axis=0), axis=1))))
        arc *= (self.s_mm[-1] if self.s_mm[-1] > 0 else arc[-1]) / arc[-1] if arc[-1] > 0 else 1.0
        side.plot(arc, desired[:, 2], color=_BLUE, lw=4, alpha=0.45, label="desired")
        side.plot(self.s_mm, tip[:, 2], color=_RED, lw=1.2, label="tip")
        side.set(xlabel="along the seam [mm]", ylabel="z of the part [mm]", title="from the side")
        side.legend(loc="best", fontsize=9)

        error.semilogy(
            np.asarray(self.s_mm)[sealing], np.maximum(np.asarray(self.error_mm)[sealing], 1e-4), color=_RED
        )
        error.axhline(_CLEARANCE_MM, color=_GREY, ls="--", lw=1)
        error.text(
            0.995,
            1.06,
            "nozzle clearance 1.06 mm",
            color=_GREY,
            fontsize=8,
            ha="right",
            va="bottom",
            transform=error.get_yaxis_transform(),
        )
        error.set(xlabel="along the seam [mm]", ylabel="tip error [mm]", title="tip error")
        for axes in (top, side, error):
            axes.grid(color="#dddddd", lw=0.6)
        figure.savefig(path, dpi=110)
        plt.close(figure)


def _draw_part(axes: Any, surface: Surface, pose: Array, alpha: float = 1.0) -> None:
    """The faces that are seen from above, plate light and wall dark."""
    up = surface.normals[:, 2] > 0.5
    order = np.argsort(surface.triangles[up, :, 2].max(axis=1), kind="stable")
    corners = 1e3 * (surface.triangles[up][order] @ pose[:3, :3].T + pose[:3, 3])
    shades = np.array(["#dfe3e8", "#a9b2bd"])[np.minimum(surface.material[up][order], 1)]
    edges = shades.tolist() if alpha == 1.0 else "none"  # overlapping edges would show the triangles
    style = {"facecolors": shades.tolist(), "edgecolors": edges, "alpha": alpha, "zorder": 0}
    axes.add_collection(PolyCollection(list(corners[:, :, :2]), **style))


def _coloured(axes: Any, points: Array, values: Array, norm: Any, width: float) -> LineCollection:
    """A path coloured by a value at each point."""
    pieces = np.stack((points[:-1, :2], points[1:, :2]), axis=1)
    path = LineCollection(list(pieces), cmap="turbo", norm=norm, linewidths=width, capstyle="round", zorder=3)
    path.set_array(values[1:])
    axes.add_collection(path)
    return path


def plot_on_part(path: Path, title: str, surface: Surface, run: Recorder) -> None:
    """Draws the tip error on the part, as Zhou et al., Fig. 14: the tip's path in the moving part's frame.

    Args:
        path: The PNG file.
        title: Above the plots.
        surface: The part.
        run: A recorded run.
    """
    tip, error, time = np.asarray(run.tip_mm), np.asarray(run.error_mm), np.asarray(run.time_s)
    poses = np.asarray(run.part_pose)
    sealing = np.asarray(run.s_mm) >= _SETTLE_MM
    first = int(np.argmax(sealing)) if sealing.any() else len(tip) - 1
    figure = plt.figure(figsize=(13.0, 8.6), constrained_layout=True)
    figure.suptitle(title, fontsize=13)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.35, 1.0), height_ratios=(1.5, 1.0))
    on_part, cell, course = (
        figure.add_subplot(grid[0:2, 0]),
        figure.add_subplot(grid[0, 1]),
        figure.add_subplot(grid[1, 1]),
    )

    _draw_part(on_part, surface, np.eye(4))
    on_part.plot(
        *tip[: first + 1, :2].T, color=_GREY, lw=1.2, ls=":", label="approach, not counted", zorder=2
    )
    norm = LogNorm(*_ERROR_MM, clip=True)
    line = _coloured(on_part, tip[first:], error[first:], norm, 6.0)
    on_part.plot(*tip[0, :2], "o", color=_GREY, ms=6, label="start", zorder=4)
    on_part.plot(*tip[-1, :2], "s", color="black", ms=6, label="end", zorder=4)
    rms = np.sqrt(np.mean(error[first:] ** 2))
    on_part.set(
        title=f"the tip's path on the part: RMS error {rms:.3f} mm, largest {error[first:].max():.3f} mm",
        xlabel="x of the part [mm]",
        ylabel="y of the part [mm]",
    )
    bar = figure.colorbar(line, ax=on_part, location="bottom", shrink=0.8, aspect=35, pad=0.02)
    bar.set_label("tip error [mm]; line: the nozzle's clearance to wall and plate, 1.06 mm")
    bar.ax.axvline(_CLEARANCE_MM, color="black", lw=1.2)
    bar.set_ticks([0.01, 0.1, 1.0], labels=["0.01 or less", "0.1", "1"])
    on_part.legend(loc="upper right", fontsize=9)

    for k, share in enumerate(np.linspace(0.0, 1.0, _SHOWN_POSES)):
        _draw_part(cell, surface, poses[round(share * (len(poses) - 1))], alpha=0.15 + 0.1 * k)
    ends = (tip[..., None, :] @ np.swapaxes(poses[:, :3, :3], 1, 2))[:, 0] + 1e3 * poses[:, :3, 3]
    cell.plot(*ends[:, :2].T, color=_RED, lw=1.5, label="tip")
    cell.plot(*(1e3 * poses[:, :2, 3].T), color=_BLUE, lw=1.5, label="the part's origin")
    yaw = np.rad2deg(np.unwrap(np.arctan2(poses[:, 1, 0], poses[:, 0, 0])))
    shift = 1e3 * np.linalg.norm(poses[:, :2, 3] - poses[0, :2, 3], axis=1).max()
    turned = np.abs(yaw - yaw[0]).max()
    cell.set(
        title=f"in the cell: the part moves by up to {shift:.0f} mm and {turned:.0f} deg",
        xlabel="x of the robot's base [mm]",
        ylabel="y [mm]",
    )
    cell.legend(loc="best", fontsize=9)
    for axes in (on_part, cell):
        axes.set_aspect("equal", adjustable="datalim")
        axes.autoscale_view()

    course.semilogy(time[first:], np.maximum(error[first:], 1e-3), color=_RED, lw=1.2)
    course.axhline(_CLEARANCE_MM, color=_GREY, ls="--", lw=1)
    course.set(title="tip error and the part's speed", xlabel="time [s]", ylabel="tip error [mm]")
    course.yaxis.label.set_color(_RED)
    speed = np.linalg.norm(np.diff(1e3 * poses[:, :3, 3], axis=0), axis=1) / np.diff(time)
    beside = course.twinx()
    beside.plot(time[1:], speed, color=_BLUE, lw=1.0, alpha=0.8)
    beside.set_ylabel("speed of the part's origin [mm/s]", color=_BLUE)
    beside.set_ylim(bottom=0.0)
    course.grid(color="#dddddd", lw=0.6)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def draw_frames(path: Path, title: str, run: Recorder, shown: Sequence[int], captions: Sequence[str]) -> None:
    """Pictures of a run side by side, as Zhou et al., Fig. 15.

    Args:
        path: The PNG file.
        title: Above them.
        run: A run recorded with pictures.
        shown: Indices of frames; of each the picture taken last before it.
        captions: One a frame.
    """
    across = min(3, len(shown))
    down = -(-len(shown) // across)
    figure, grid = plt.subplots(
        down, across, figsize=(5.6 * across, 4.2 * down + 0.5), squeeze=False, constrained_layout=True
    )
    figure.suptitle(title, fontsize=13)
    for axes in grid.flat:
        axes.axis("off")
    for axes, k, caption in zip(grid.flat, shown, captions, strict=False):
        last = k == len(run.time_s) - 1
        axes.imshow(run.frames[-1 if last else k // SPEED_UP])
        axes.set_title(caption, fontsize=9)
    figure.savefig(path, dpi=110)
    plt.close(figure)


@dataclass(frozen=True, kw_only=True, eq=False)
class FeatureTrace:
    """The features of a run of T frames beside the truth; two columns are front and side view.

    Attributes:
        arc_mm: Arc length of the seam's point nearest the tip, shape (T,), mm.
        true_d_mm: Attraction distances from the true geometry, shape (T, 2), mm.
        seen_d_mm: As perception gave them, shape (T, 2), mm.
        true_theta_deg: Seam angles from the true geometry, shape (T, 2), deg.
        seen_theta_deg: As perception gave them, shape (T, 2), deg.
        error_px: Error of the attraction distance in the image, shape (T, 2), px.
        valid: Whether the view showed the seam, shape (T, 2).
        tip_error_mm: Distance from the tip to the desired path, shape (T,), mm.
        snr_db: Signal-to-noise ratio of the images, shape (T, 2), dB.
        corners_mm: Arc-length intervals of the seam's corners, shape (k, 2), mm.
    """

    arc_mm: Array
    true_d_mm: Array
    seen_d_mm: Array
    true_theta_deg: Array
    seen_theta_deg: Array
    error_px: Array
    valid: NDArray[np.bool_]
    tip_error_mm: Array
    snr_db: Array
    corners_mm: Array

    @property
    def sealing(self) -> NDArray[np.bool_]:
        """Frames from 10 mm of travel on, as protocol.md counts errors, shape (T,)."""
        return np.asarray(self.arc_mm >= 10.0)

    @property
    def d_error_mm(self) -> Array:
        """Error of the attraction distances, shape (T, 2), mm."""
        return self.seen_d_mm - self.true_d_mm

    @property
    def theta_error_deg(self) -> Array:
        """Error of the seam angles, shape (T, 2), deg."""
        return self.seen_theta_deg - self.true_theta_deg


def plot_features(
    path: Path, title: str, run: FeatureTrace, rois: Sequence[NDArray[np.uint8]], worst_mm: float
) -> None:
    """Plots a run's features, true and estimated, their errors and the tip's, and what the cameras saw.

    Args:
        path: The PNG file.
        title: Above the plots.
        run: The run's numbers.
        rois: Both ROIs with their marks where the error was largest.
        worst_mm: Arc length of that frame [mm].
    """
    figure = plt.figure(figsize=(13.0, 15.0), constrained_layout=True)
    figure.suptitle(title, fontsize=13)
    grid = figure.add_gridspec(6, 2, height_ratios=(1, 0.8, 1, 0.8, 1.1, 1.9))
    rows = (
        ("d [mm]", run.true_d_mm, run.seen_d_mm, run.d_error_mm),
        ("theta [deg]", run.true_theta_deg, run.seen_theta_deg, run.theta_error_deg),
    )
    for v, view in enumerate(("front view", "side view")):
        for k, (label, true, seen, error) in enumerate(rows):
            values, errors = (figure.add_subplot(grid[2 * k + i, v]) for i in (0, 1))
            shown = np.where(run.valid[:, v], seen[:, v], np.nan)
            values.plot(run.arc_mm, true[:, v], color=_GREY, lw=3.0, alpha=0.7, label="true")
            values.plot(run.arc_mm, shown, color=_BLUE, lw=0.9, label="estimated")
            values.set(title=f"{view}: {label}", ylabel=label)
            _limit(values, run.sealing, true[:, v], seen[:, v])
            wrong = np.where(run.valid[:, v], error[:, v], np.nan)
            errors.plot(run.arc_mm, wrong, color=_RED, lw=0.9)
            used = error[run.sealing & run.valid[:, v], v]
            rms = np.sqrt(np.mean(used**2)) if len(used) else np.nan
            errors.set(ylabel=f"error {label.split()[1]}", title=f"error, RMS {rms:.3f} {label.split()[1]}")
            errors.axhline(0.0, color=_GREY, lw=0.6)
            _limit(errors, run.sealing, error[:, v])
            for axes in (values, errors):
                _along(axes, run)
            if v == k == 0:
                values.legend(loc="best", fontsize=9)
    tip = figure.add_subplot(grid[4, :])
    tip.semilogy(run.arc_mm, np.maximum(run.tip_error_mm, 1e-4), color=_RED, lw=1.0)
    tip.axvline(worst_mm, color=_BLUE, lw=1.0, ls=":")
    tip.set(title="tip error [mm]; dotted: where the pictures below were taken", ylabel="tip error [mm]")
    tip.set_xlabel(
        "along the seam [mm]; shaded: corners; errors count from 10 mm on (the approach is cut off)"
    )
    _along(tip, run)
    for v, (view, picture) in enumerate(zip(("front", "side"), rois, strict=True)):
        axes = figure.add_subplot(grid[5, v])
        axes.imshow(picture)
        axes.set_title(f"{view} view at {worst_mm:.0f} mm, the largest error of d")
        axes.axis("off")
    figure.savefig(path, dpi=90)
    plt.close(figure)


def _along(axes: Any, run: FeatureTrace) -> None:
    """The common axis: arc length, the corners shaded."""
    for first, last in run.corners_mm:
        axes.axvspan(first, last, color="#f2d9a0", alpha=0.7, lw=0)
    axes.set_xlim(min(0.0, float(run.arc_mm.max()) - 1.0), float(run.arc_mm.max()))
    axes.grid(color="#dddddd", lw=0.6)


def _limit(axes: Any, sealing: NDArray[np.bool_], *curves: Array) -> None:
    """Limits the ordinate to what counts: the approach is a hundred times larger."""
    values = np.concatenate([c[sealing] for c in curves])
    if len(values):
        reach = max(1.15 * float(np.abs(values).max()), 1e-3)
        axes.set_ylim(-reach, reach)
