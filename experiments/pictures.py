"""Plots and videos of a run."""

from pathlib import Path
from typing import Any

import cv2
import imageio.v2 as imageio
import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from seal_gym.envs.seal_env import SealEnv

mpl.use("Agg")  # no screen needed
import matplotlib.pyplot as plt  # the backend has to be chosen first

SPEED_UP = 5
_STRIP = 176
_GRID = (70, 74, 80)
_CURVE = (90, 200, 255)
_TEXT = (235, 235, 235)
_BACK = (28, 30, 34)
_BLUE, _RED, _GREY = "#1f5fa8", "#d1382c", "#8a8f98"


class Recorder:
    """Records a run: the tip's path in the part's frame, its error, and frames for a video.

    Attributes:
        time_s: Of each frame [s].
        tip_mm: Tip in the part's frame, one row a frame [mm].
        error_mm: Tip error of each frame [mm].
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
        self.desired_mm = np.empty((0, 3))

    def __call__(self, env: SealEnv, info: dict[str, Any]) -> None:
        """Takes one frame.

        Args:
            env: The environment.
            info: Of the last step.
        """
        core = env.core
        if not self.time_s:
            seam, stand_off = core.scene.workpiece.seam, core.cfg.cell.process.stand_off_m
            sealed = seam.at(np.linspace(0.0, seam.length, 2000))
            self.desired_mm = 1e3 * (sealed.position + stand_off * sealed.approach)
            self._nominal_s = seam.length / core.cfg.cell.process.speed_m_s
        part = core.arm.part_pose[0]
        self.time_s.append(core.seconds(0))
        self.tip_mm.append(1e3 * part[:3, :3].T @ (core.tip.pose[0, :3, 3] - part[:3, 3]))
        self.error_mm.append(info["tip_error_mm"])
        self.s_mm.append(1e3 * float(core.progress.s[0]))
        last = "episode_metrics" in info
        if self._video and (last or (len(self.time_s) - 1) % SPEED_UP == 0):
            picture = env.render()
            assert picture is not None
            self.frames.append(self._with_strip(picture))

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
        span = max(1.15 * self._nominal_s, self.time_s[-1])
        x = left + (right - left) * np.asarray(self.time_s) / span
        points = np.column_stack((x.round(), [row(e) for e in self.error_mm])).astype(np.int32)
        cv2.polylines(strip, [points], False, _CURVE, 2, cv2.LINE_AA)
        text = f"tip error {self.error_mm[-1]:.3f} mm    t = {self.time_s[-1]:.1f} s    {SPEED_UP}x real time"
        cv2.putText(strip, text, (left, _STRIP - 10), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _TEXT, 1, cv2.LINE_AA)
        return np.concatenate((picture, strip))

    def write_video(self, path: Path) -> None:
        """Writes the frames as an MP4 (H.264).

        Args:
            path: The file.
        """
        with imageio.get_writer(
            path, fps=30, codec="libx264", quality=7, macro_block_size=8, pixelformat="yuv420p"
        ) as writer:
            for frame in self.frames:
                writer.append_data(frame)  # type: ignore[attr-defined]  # imageio types the reader's base

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
        error.axhline(1.06, color=_GREY, ls="--", lw=1)
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
