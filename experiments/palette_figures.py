"""Figures of palettes: the ways of a run, its jerk, what the observer saw, and multi-path planning."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from seal_gym.core.frames import Array
from seal_gym.envs.palette_config import PaletteCfg
from seal_gym.envs.palette_env import POSTURE, PaletteEnv
from seal_gym.planning import multi_path
from seal_gym.planning.multi_path import CubicWay
from seal_gym.sim.palette_scene import BOARD_TOP_M
from seal_gym.sim.rgbd import Picture
from seal_gym.sim.tool_check import ToolCheck
from seal_gym.vision.palette_segments import PaletteClass
from seal_gym.vision.palette_ties import TieObserver
from seal_gym.workpieces.palette import (
    BOARD_M,
    CABLE_RADIUS_M,
    CONNECTOR_M,
    PEG_RADIUS_M,
    RIVET_M,
    ZONE_M,
    Spot,
)

mpl.use("Agg")  # no screen needed
import matplotlib.pyplot as plt  # the backend has to be chosen first
from matplotlib.colors import to_rgba
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon

_MM = 1e3
_BLUE, _RED, _GREY, _ORANGE = "#1f5fa8", "#d1382c", "#8a8f98", "#e8883a"
_CONNECTOR, _PEG, _RIVET, _BOARD = "#5468c8", "#8a8f98", "#3f9d54", "#efeeea"
_SHOWN_STARTS = 8
_NAMED = {
    PaletteClass.PALETTE: "#f7f7f5",
    PaletteClass.CABLE: "#303030",
    PaletteClass.CONNECTOR: _CONNECTOR,
    PaletteClass.RIVET: _RIVET,
    PaletteClass.TARGET: _RED,
    PaletteClass.TIE: "#f2c14e",
    PaletteClass.UNKNOWN: "#b04fc0",
}


class Trace(NamedTuple):
    """A run of the policy.

    Attributes:
        time_s: Of each frame, shape (m,), s.
        tip_m: Measured, shape (m, 3), m.
        command_m: Commanded, shape (m, 3), m.
        home_s: When ties came home, s.
        force_n: Of the pad on a tie, shape (m,), N.
    """

    time_s: Array
    tip_m: Array
    command_m: Array
    home_s: list[float]
    force_n: Array


def _corners(spot: Spot, size: tuple[float, float], pose: Array) -> Array:
    """Of a rectangle on the board, in the world [mm]."""
    half = 0.5 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * size
    c, s = np.cos(spot.yaw), np.sin(spot.yaw)
    local = half @ np.array([[c, s], [-s, c]]) + [spot.x, spot.y]
    return np.asarray(_MM * (local @ pose[:2, :2].T + pose[:2, 3]))


def draw_palette(axes: Any, env: PaletteEnv) -> None:
    """The palette from above, the world's x and y in mm.

    Args:
        axes: To draw on.
        env: After ``reset``.
    """
    layout, pose = env.scene.layout, env.part_pose

    def world(points: Array) -> Array:
        return np.asarray(_MM * (points[..., :2] @ pose[:2, :2].T + pose[:2, 3]))

    def patch(shape: Any) -> None:
        axes.add_patch(shape)

    patch(Polygon(_corners(Spot(0, 0, 0), BOARD_M[:2], pose), facecolor=_BOARD, edgecolor=_GREY, lw=0.8))
    for spot in layout.targets:
        patch(Polygon(_corners(spot, (ZONE_M, ZONE_M), pose), facecolor="#f3b8b2", edgecolor=_RED, lw=0.8))
    for line in layout.cables:
        centre = world(line)
        along = np.diff(centre, axis=0)
        normal = np.column_stack((-along[:, 1], along[:, 0])) / np.linalg.norm(along, axis=1)[:, None]
        normal = np.concatenate((normal, normal[-1:])) * _MM * CABLE_RADIUS_M
        patch(Polygon(np.concatenate((centre + normal, (centre - normal)[::-1])), facecolor="#3a3a3a", lw=0))
    for spot in layout.connectors:
        patch(Polygon(_corners(spot, CONNECTOR_M, pose), facecolor=_CONNECTOR, lw=0))
    for point in world(layout.pegs):
        patch(Circle(point, _MM * PEG_RADIUS_M, facecolor=_PEG, edgecolor="black", lw=0.5))
    for point in world(layout.rivets):
        patch(Circle(point, _MM * RIVET_M[0], facecolor=_RIVET, lw=0))
    axes.set_aspect("equal")
    axes.set_xlabel("x [mm]")
    axes.set_ylabel("y [mm]")


def _bare(axes: Any) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25, lw=0.6)


def jerk(path: Path, trace: Trace, seed: int) -> None:
    """Jerk of the commanded tip and force on the ties over time.

    Args:
        path: The PNG.
        trace: The run.
        seed: Of the palette.
    """
    dt = trace.time_s[1] - trace.time_s[0]
    values = np.linalg.norm(np.diff(trace.command_m, n=3, axis=0), axis=1) / dt**3
    figure, (top, bottom) = plt.subplots(2, 1, figsize=(10, 5.2), sharex=True, layout="constrained")
    top.plot(trace.time_s[3:], values, color=_BLUE, lw=1.0)
    top.set_ylabel("jerk of the\ncommanded tip [m/s³]")
    bottom.plot(trace.time_s, trace.force_n, color=_ORANGE, lw=1.0)
    bottom.axhline(15.0, color=_GREY, lw=0.9, ls="--")
    bottom.annotate("15 N: enough", (0.0, 15.0), textcoords="offset points", xytext=(0, 4), color="#555")
    bottom.set_ylabel("force of the pad\non a tie [N]")
    bottom.set_xlabel("time [s]")
    for axes in (top, bottom):
        _bare(axes)
        for k, at in enumerate(trace.home_s):
            axes.axvline(at, color=_RED, lw=0.8, alpha=0.6, label="tie home" if k == 0 else None)
    top.set_ylim(0.0, 1.25 * values.max())
    top.legend(loc="upper right", frameon=True)
    top.set_title(f"Palette {seed}: tau-Jerk motions from tie to tie")
    figure.savefig(path, dpi=120)
    plt.close(figure)


def paths(path: Path, env: PaletteEnv, trace: Trace, seed: int) -> None:
    """The tip's way from above and in space.

    Args:
        path: The PNG.
        env: After the run.
        trace: The run.
        seed: Of the palette.
    """
    figure = plt.figure(figsize=(12, 5.6), layout="constrained")
    top = figure.add_subplot(1, 2, 1)
    draw_palette(top, env)
    tip = _MM * trace.tip_m
    top.plot(tip[:, 0], tip[:, 1], color=_BLUE, lw=1.4)
    top.plot(*tip[0, :2], "o", color=_BLUE, ms=7)
    top.annotate("start", (tip[0, 0], tip[0, 1]), textcoords="offset points", xytext=(8, -3))
    frames = [int(np.argmin(np.abs(trace.time_s - t))) for t in trace.home_s]
    for number, k in enumerate(frames, 1):
        top.annotate(
            str(number),
            (tip[k, 0], tip[k, 1]),
            ha="center",
            va="center",
            fontsize=9,
            fontweight="bold",
            bbox={"boxstyle": "circle,pad=0.2", "fc": "white", "ec": _RED, "lw": 1.0},
        )
    top.set_title("from above; numbers: order of the ties")
    space = figure.add_subplot(1, 2, 2, projection="3d")
    space.plot(*tip.T, color=_BLUE, lw=1.3)
    space.scatter(*tip[frames].T, color=_RED, s=25)
    board = _corners(Spot(0, 0, 0), BOARD_M[:2], env.part_pose)
    board = np.column_stack((board, np.full(4, _MM * env.part_pose[2, 3])))
    space.plot(*np.concatenate((board, board[:1])).T, color=_GREY, lw=1.0)
    for x, y, height in env.scene.layout.pegs:
        foot = _MM * (env.part_pose[:3, :3] @ [x, y, 0.0] + env.part_pose[:3, 3])
        space.plot([foot[0]] * 2, [foot[1]] * 2, [foot[2], foot[2] + _MM * height], color=_PEG, lw=3)
    space.set_xlabel("x [mm]")
    space.set_ylabel("y [mm]", labelpad=12)
    space.set_zlabel("z [mm]")
    space.set_box_aspect((1.0, 1.2, 0.6))
    space.view_init(elev=28, azim=-50)
    space.set_title("in space; red: ties pressed home, grey: board and pegs")
    figure.suptitle(f"Palette {seed}: way of the tool's tip")
    figure.savefig(path, dpi=120)
    plt.close(figure)


def _to_pixel(env: PaletteEnv, points: Array) -> Array:
    camera = env.cfg.camera
    local = (points - camera.pose[:3, 3]) @ camera.pose[:3, :3]
    width, height = camera.frame_px
    return np.asarray(camera.focal_px * local[:, :2] / local[:, 2:] + [width / 2, height / 2])


def _named(picture: Picture, env: PaletteEnv) -> NDArray[Any]:
    """The observer's regions in the colours of ``_NAMED``, shape (H, W, 4)."""
    observer = env.cfg.observer if isinstance(env.cfg.observer, TieObserver) else PaletteCfg().observer
    assert isinstance(observer, TieObserver)
    report = observer.report(picture.rgb, picture.depth_m, env.cfg.camera)
    of_region = np.append(np.int8(PaletteClass.PALETTE), report.classes)
    colours = np.array([to_rgba(_NAMED[kind]) for kind in PaletteClass])
    return np.asarray(colours[of_region[report.labels]])


def segmentation(path: Path, environments: Sequence[PaletteEnv], seeds: Sequence[int]) -> None:
    """What the camera saw, what the Hopfield observer made of it, and where the targets are.

    Args:
        path: The PNG.
        environments: After ``reset``, with vision.
        seeds: Of the palettes.
    """
    count = len(environments)
    figure, grid = plt.subplots(count, 3, figsize=(10.5, 4.2 * count), layout="constrained", squeeze=False)
    for row, env, seed in zip(grid, environments, seeds, strict=True):
        picture = env.picture
        depth: NDArray[Any] = _MM * picture.depth_m
        row[0].imshow(picture.rgb)
        row[1].imshow(_named(picture, env))
        shown = row[2].imshow(depth, cmap="viridis", vmin=790, vmax=880)
        figure.colorbar(shown, ax=row[2], label="depth [mm]", shrink=0.8)
        for axes in row[:2]:
            axes.plot(*_to_pixel(env, env.target_m).T, "+", color=_ORANGE, ms=7, mew=1.5)
            axes.plot(*_to_pixel(env, env.place_m).T, "o", mfc="none", color="#00a0c0", ms=13, mew=1.6)
        row[0].set_ylabel(f"palette {seed}", fontsize=12)
    for axes, title in zip(
        grid[0], ("picture", "areas named by the Hopfield observer", "depth (white: none)"), strict=True
    ):
        axes.set_title(title)
    for axes in grid.ravel():
        axes.set_xticks([])
        axes.set_yticks([])
    marks = [
        Line2D([], [], ls="", marker="+", color=_ORANGE, ms=11, mew=2, label="true target"),
        Line2D(
            [], [], ls="", marker="o", mfc="none", color="#00a0c0", ms=12, mew=1.6, label="target as seen"
        ),
    ]
    marks += [
        Line2D([], [], ls="", marker="s", color=colour, ms=10, label=kind.name.lower())
        for kind, colour in _NAMED.items()
        if kind is not PaletteClass.PALETTE
    ]
    figure.legend(handles=marks, loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def ways(path: Path, seed: int) -> None:
    """Multi-path planning to one tie, after the paper's Fig. 7.

    Args:
        path: The PNG.
        seed: Of the palette and of the starts.
    """
    env, rng = PaletteEnv(perception="oracle"), np.random.default_rng(seed)
    env.reset(seed=seed)
    check = ToolCheck(env.scene, env.part_pose, POSTURE)
    # The tie that is hardest to reach from the starts' side.
    goal = env.target_m[np.argmax(env.target_m[:, 1])] + [0.0, 0.0, 0.008]
    starts: list[Array] = []
    while len(starts) < _SHOWN_STARTS:
        point = rng.uniform((0.15, -0.45, BOARD_TOP_M + 0.01), (0.55, -0.26, BOARD_TOP_M + 0.06))
        if check.free(point[None])[0]:
            starts.append(point)
    up = np.array([0.0, 0.0, 1.0])
    found = [(s, multi_path.ways(s, goal, check.free, up)) for s in starts]
    per_start = [multi_path.choose(candidates) for _, candidates in found]
    best = multi_path.choose([way for way in per_start if way is not None])
    figure, (above, side, local) = plt.subplots(1, 3, figsize=(16, 5.4), layout="constrained")
    draw_palette(above, env)
    for (start, candidates), chosen in zip(found, per_start, strict=True):
        above.plot(*(_MM * start[:2]), "o", color="black", ms=4)
        for way in candidates:
            _draw_way(above, side, way, color=_GREY, lw=0.7)
        if chosen is not None and chosen is not best:
            _draw_way(above, side, chosen, color=_BLUE, lw=1.6)
    if best is not None:
        _draw_way(above, side, best, color=_RED, lw=2.6)
        _draw_local(local, best)
    side.axhspan(0, 70, color=_PEG, alpha=0.12, lw=0)
    side.annotate("height of pegs", (0.02, 73), xycoords=("axes fraction", "data"), color="#555", fontsize=9)
    side.set_xlabel("distance left to the tie [mm]")
    side.set_ylabel("height over the board [mm]")
    side.invert_xaxis()
    side.set_title("from the side")
    _bare(side)
    lines = [
        Line2D([], [], color=_GREY, lw=0.9, label="free ways"),
        Line2D([], [], color=_BLUE, lw=1.8, label="best from each start"),
        Line2D([], [], color=_RED, lw=2.6, label="best of all"),
    ]
    figure.legend(handles=lines, loc="outside lower center", ncols=3, frameon=False)
    above.set_title("from above")
    figure.suptitle(f"Palette {seed}: cubic ways from {_SHOWN_STARTS} starts to one tie")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _draw_way(above: Any, side: Any, way: CubicWay, **style: Any) -> None:
    points = _MM * way.equidistant(120)
    above.plot(points[:, 0], points[:, 1], **style)
    left = np.linalg.norm(points[:, :2] - points[-1, :2], axis=1)
    side.plot(left, points[:, 2] - _MM * BOARD_TOP_M, **style)


def _draw_local(axes: Any, way: CubicWay) -> None:
    """Both cubics of a way in its own frame, extrema and inflections marked."""
    x = way.along(300)
    # Where both are the same the broken line lets the other one through.
    curves = ((way.y, "y(x), aside", _BLUE, "-"), (way.z, "z(x), up", _RED, (0, (4, 3))))
    for cubic, label, colour, dashes in curves:
        axes.plot(_MM * x, _MM * cubic(x), color=colour, lw=2.2, ls=dashes, label=label)
        extreme = multi_path.extrema(cubic)
        axes.plot(_MM * extreme.x, _MM * extreme.y, "^", color=colour, ms=9)
        bend = multi_path.inflections(cubic)
        axes.plot(_MM * bend, _MM * cubic(bend), "o", mfc="white", color=colour, ms=9, mew=1.8)
    axes.plot([], [], "^", color="black", ms=8, label="extremum")
    axes.plot([], [], "o", mfc="white", color="black", ms=8, mew=1.8, label="inflection")
    axes.set_xlabel("x along the line to the goal [mm]")
    axes.set_ylabel("off the line [mm]")
    axes.set_title(
        f"best of all in its own frame: {_MM * way.length_m:.0f} mm, {way.inflections} inflection(s)"
    )
    axes.legend(fontsize=9)
    _bare(axes)
