"""Calibration: the sensor cameras from pictures of a board, the part's pose from its AR code.

    python -m experiments.calibrate --seed 500000 --out out/calibrate

Writes true, found and error of each camera's values, the calibrated cell file, the error of the part's pose,
and a picture of what the cameras saw.
"""

from experiments import backend

_GL = backend.choose()

import argparse  # the backend has to be chosen before mujoco is imported
import json
import shlex
import sys
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from tqdm import tqdm

import seal_gym
from experiments import command, results
from seal_gym.core.cell import CameraCfg, load_cell, with_cameras
from seal_gym.core.errors import RenderError, SealGymError
from seal_gym.core.frames import Array, transform, yaw_pose
from seal_gym.core.paths import asset
from seal_gym.planning import ik
from seal_gym.sim.arm import ArmBatch
from seal_gym.sim.markers import ShotCfg, shoot_board, shoot_marker
from seal_gym.sim.reach import check_reach
from seal_gym.sim.scene import GROUP_COLLISION, Scene, build_scene, cached_scene
from seal_gym.tasks.progress import SealTaskCfg
from seal_gym.vision.calibration import Board, BoardCorners, Calibration, SolveCfg, calibrate
from seal_gym.vision.part_pose import PartMarker, level_part_pose, part_pose
from seal_gym.workpieces import catalogue

mpl.use("Agg")  # no screen needed
import matplotlib.pyplot as plt
from matplotlib.patches import Polygon, Rectangle

Grey = NDArray[np.uint8]
# The board's middle, on a block as high as a part's plate; the board faces up, its x away from the robot.
_BOARD_M = (0.45, 0.0, -0.05)
# The views: mouth above the board, beside its middle, gun turned from upright.
_HEIGHT_M, _SIDEWAYS_M, _TILT_DEG = (0.012, 0.06), 0.015, 30.0
# How wrong a real arm's own poses are; a UR5 repeats to 0.1 mm.
_ARM_ERROR_MM, _ARM_ERROR_DEG = SolveCfg().tip_mm, SolveCfg().tip_deg
_EXACT = SolveCfg(tip_mm=1e-3, tip_deg=1e-3)
# Zhou et al.'s moving part goes this far on top of the displacement at the start (protocol.md).
_MOVES_M, _MOVES_RAD = 0.02, np.deg2rad(10.0)
_BLUE, _RED, _GREEN = "#1f5fa8", "#d1382c", "#2ca02c"


class Sight(NamedTuple):
    """What one camera saw in a calibration.

    Attributes:
        camera: The true camera, its ROI the whole frame.
        images: Its pictures; empty where only the result is kept.
        corners: The corners found in each.
    """

    camera: CameraCfg
    images: list[Grey]
    corners: list[BoardCorners]


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Reads the command line.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        The options.
    """
    parser = argparse.ArgumentParser(
        prog="python -m experiments.calibrate", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--views", type=int, default=24, help="pictures of the board (default: %(default)s)")
    parser.add_argument("--trials", type=int, default=10, help="calibrations (default: %(default)s)")
    parser.add_argument(
        "--parts", type=int, default=50, help="poses a part and regime (default: %(default)s)"
    )
    parser.add_argument(
        "--gl-parts", type=int, default=20, help="of them, in MuJoCo's picture too (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=500_000, help="of the first trial (default: %(default)s)")
    parser.add_argument(
        "--out", type=Path, default=Path("out/calibrate"), help="folder (default: %(default)s)"
    )
    return command.checked(parser, arguments, views=5, trials=1, parts=1, gl_parts=0, seed=0)


# -- the sensor cameras -------------------------------------------------------------------------------------


def board_pose(board: Board) -> Array:
    """Where the board is.

    Args:
        board: The board.

    Returns:
        ``T_world_board``, shape (4, 4), m.
    """
    corner = np.array([-board.size_m[0] / 2, board.size_m[1] / 2, 0.0])
    return transform(np.diag([1.0, -1.0, -1.0]), np.array(_BOARD_M) + corner)


def tip_poses(n: int, rng: np.random.Generator) -> Array:
    """Poses from which both cameras see the board, and which the arm reaches.

    Args:
        n: How many.
        rng: Source of the draws.

    Returns:
        ``T_world_tip``, shape (n, 4, 4), m.
    """
    out: list[Array] = []
    while len(out) < n:
        angles = [rng.uniform(-180.0, 180.0), *rng.uniform(-_TILT_DEG, _TILT_DEG, 2)]
        shift = [*rng.uniform(-_SIDEWAYS_M, _SIDEWAYS_M, 2), rng.uniform(*_HEIGHT_M)]
        pose = transform(
            Rotation.from_euler("zxy", angles, degrees=True).as_matrix(), np.add(_BOARD_M, shift)
        )
        if np.isfinite(ik.solve(pose)).all(axis=-1).any():
            out.append(pose)
    return np.stack(out)


def look(board: Board, tips: Array, camera: CameraCfg, tool: Array, rng: np.random.Generator) -> Sight:
    """Takes one camera's pictures of the board.

    Args:
        board: The board.
        tips: ``T_world_tip``, shape (n, 4, 4), m.
        camera: The true camera, its ROI the whole frame.
        tool: Triangles of the nozzle in the tip frame, shape (m, 3, 3), m.
        rng: Source of the noise.

    Returns:
        The pictures and the corners in them.
    """
    where = board_pose(board)
    images = [shoot_board(board, where, camera, tip, tool, rng, ShotCfg()) for tip in tips]
    return Sight(camera, images, [board.find(image) for image in images])


def as_measured(tips: Array, rng: np.random.Generator) -> Array:
    """Tip poses as an arm that is not quite calibrated reports them.

    Args:
        tips: True ``T_world_tip``, shape (n, 4, 4), m.
        rng: Source of the errors.

    Returns:
        Shape (n, 4, 4), m.
    """
    turn = Rotation.from_rotvec(rng.normal(0.0, np.deg2rad(_ARM_ERROR_DEG), (len(tips), 3)))
    return np.asarray(
        tips @ transform(turn.as_matrix(), rng.normal(0.0, 1e-3 * _ARM_ERROR_MM, (len(tips), 3)))
    )


def values(camera: CameraCfg) -> dict[str, tuple[str, Array]]:
    """A camera's calibrated values.

    Args:
        camera: The camera, its ROI as in the cell file.

    Returns:
        Unit and numbers by name.
    """
    return {
        "focal length": ("px", np.array([camera.focal_px])),
        "principal point": ("px", camera.centre_px),
        "nozzle mouth": ("px", np.array(camera.tip_px)),
        "position": ("mm", np.array(camera.position_mm)),
        "optical axis": ("-", camera.rotation[:, 2]),
    }


def errors(found: CameraCfg, true: CameraCfg) -> dict[str, float]:
    """What the calibration is judged by.

    Args:
        found: The calibrated camera, its ROI as in the cell file.
        true: The cell's.

    Returns:
        Errors, named with their units.
    """
    turn = Rotation.from_matrix(found.rotation.T @ true.rotation)
    return {
        "focal_pct": 100.0 * abs(found.focal_px / true.focal_px - 1.0),
        "tip_px": float(np.linalg.norm(np.subtract(found.tip_px, true.tip_px))),
        "position_mm": float(np.linalg.norm(np.subtract(found.position_mm, true.position_mm))),
        "rotation_deg": float(np.rad2deg(turn.magnitude())),
    }


class Trial(NamedTuple):
    """One calibration of both cameras.

    Attributes:
        sights: What each camera saw.
        found: By the arm's error (``"exact"`` or ``"arm"``), a calibration for each camera.
    """

    sights: list[Sight]
    found: dict[str, list[Calibration]]


def calibrate_once(seed: int, views: int) -> Trial:
    """Calibrates both cameras.

    Args:
        seed: Of all draws.
        views: Pictures of the board.

    Returns:
        What was seen and found.
    """
    cell, rng = load_cell(), np.random.default_rng(seed)
    board, tool = Board.of(cell.calibration), cached_scene(catalogue.get("flat"), cell).tool
    tips = tip_poses(views, rng)
    wide = [camera.window(cell.calibration.frame_px) for camera in cell.cameras]
    sights = [look(board, tips, camera, tool, rng) for camera in wide]
    reported = {"exact": (tips, _EXACT), "arm": (as_measured(tips, rng), SolveCfg())}
    found = {
        name: [calibrate(s.camera.name, s.camera.roi_px, poses, s.corners, cfg) for s in sights]
        for name, (poses, cfg) in reported.items()
    }
    return Trial(sights, found)


def camera_rows(trials: list[Trial]) -> list[dict[str, Any]]:
    """A row for each camera and error of the arm: root mean square and largest errors.

    Args:
        trials: The calibrations.

    Returns:
        The rows.
    """
    rows = []
    for v, camera in enumerate(load_cell().cameras):
        for arm in ("exact", "arm"):
            found = [t.found[arm][v] for t in trials]
            each = [errors(f.camera.window(camera.roi_px), camera) for f in found]
            row: dict[str, Any] = {"camera": camera.name, "tip_poses": arm, "trials": len(trials)}
            row["views"] = found[0].views
            row["corners"] = round(float(np.mean([len(f.errors_px) for f in found])))
            distance = np.concatenate([np.linalg.norm(f.errors_px, axis=1) for f in found])
            row["residual_px_median"] = float(np.median(distance))
            for name in each[0]:
                sample = np.array([e[name] for e in each])
                row[f"{name}_rms"] = float(np.sqrt((sample**2).mean()))
                row[f"{name}_max"] = float(sample.max())
            rows.append(row)
    return rows


# -- the part's pose ----------------------------------------------------------------------------------------


class Overhead:
    """The camera above the cell, in MuJoCo's picture of the scene."""

    def __init__(self, scene: Scene, start_q: Array) -> None:
        """Opens the renderer.

        Args:
            scene: A scene with the AR code.
            start_q: Where the arm waits, shape (6,), rad.

        Raises:
            RenderError: If no OpenGL context can be made here.
        """
        from seal_gym.sim.gl import offscreen  # needs OpenGL: only when asked for

        width, height = scene.cell.overhead.frame_px
        self._renderer = offscreen(scene.model, height, width)
        self._arm, self._q = ArmBatch(scene, 1), start_q
        self._option = mujoco.MjvOption()
        self._option.geomgroup[GROUP_COLLISION] = 0
        self._option.sitegroup[:] = 0

    def __call__(self, part: Array, rng: np.random.Generator) -> NDArray[np.uint8]:
        """Takes a picture.

        Args:
            part: ``T_world_part``, shape (4, 4), m.
            rng: Source of the sensor noise.

        Returns:
            RGB, shape (height, width, 3).
        """
        self._arm.reset(0, self._q, part)
        self._renderer.update_scene(self._arm.data(0), camera="overhead", scene_option=self._option)
        picture = self._renderer.render() + rng.normal(0.0, ShotCfg().noise_sigma, (*self._size, 1))
        return np.asarray(np.clip(np.rint(picture), 0, 255), dtype=np.uint8)

    @property
    def _size(self) -> tuple[int, int]:
        return (self._renderer.height, self._renderer.width)

    def close(self) -> None:
        """Closes the renderer."""
        self._renderer.close()


def displaced(nominal: Array, regime: str, rng: np.random.Generator) -> Array:
    """A part's pose within the regime's range.

    Args:
        nominal: ``T_world_part``, shape (4, 4), m.
        regime: ``"static"`` or ``"dynamic"``.
        rng: Source of the draws.

    Returns:
        Shape (4, 4), m.
    """
    task = SealTaskCfg()
    moves = regime == "dynamic"
    shift = rng.uniform(-1, 1, 2) * task.part_shift_m + moves * rng.uniform(-1, 1, 2) * _MOVES_M
    yaw = rng.uniform(-1, 1) * task.part_yaw_rad + moves * rng.uniform(-1, 1) * _MOVES_RAD
    return np.asarray(nominal @ yaw_pose(shift[0], shift[1], 0.0, yaw))


def pose_errors(image: NDArray[np.uint8], scene: Scene, part: Array) -> dict[str, float] | None:
    """Reads the part's pose from a picture and compares it with the true one.

    Args:
        image: Of the overhead camera.
        scene: A scene with the AR code.
        part: True ``T_world_part``, shape (4, 4), m.

    Returns:
        Errors of the part's origin and yaw; None where the code is not seen.
    """
    marker = scene.marker
    assert marker is not None
    corners = marker.find(image)
    if corners is None:
        return None
    out = {}
    for name, seen in (
        ("level", level_part_pose(corners, marker, scene.cell.overhead, float(part[2, 3]))),
        ("free", part_pose(corners, marker, scene.cell.overhead)),
    ):
        off = np.linalg.inv(part) @ seen.T_world_part
        out[f"{name}_mm"] = float(1e3 * np.linalg.norm(off[:3, 3]))
        out[f"{name}_yaw_deg"] = float(np.rad2deg(np.arctan2(off[1, 0], off[0, 0])))
    return out


def part_rows(options: argparse.Namespace) -> tuple[list[dict[str, Any]], NDArray[np.uint8]]:
    """A row for each part, regime and renderer.

    Args:
        options: The command line.

    Returns:
        The rows, and a picture of the overhead camera.
    """
    rows: list[dict[str, Any]] = []
    shown: NDArray[np.uint8] | None = None
    for name in catalogue.NAMES:
        scene = build_scene(catalogue.get(name), load_cell(), marked=True)
        assert scene.marker is not None
        task = SealTaskCfg()
        reach = check_reach(scene, task.part_shift_m, task.part_yaw_rad)
        overhead = None
        if _GL != "disabled" and options.gl_parts:
            try:
                overhead = Overhead(scene, reach.start_q)
            except RenderError as error:
                sys.stderr.write(f"no pictures by MuJoCo: {error}\n")
        for regime in ("static", "dynamic"):
            rng = np.random.default_rng(options.seed)
            poses = [displaced(reach.part_pose, regime, rng) for _ in range(options.parts)]
            seen = []
            for pose in tqdm(poses, desc=f"{name}, {regime}", unit="pose"):
                image = shoot_marker(scene.marker, pose, scene.cell.overhead, rng, ShotCfg())
                seen.append(pose_errors(image, scene, pose))
                shown = image if shown is None else shown
            rows.append(_part_row(name, regime, "software", seen))
            if overhead is None:
                continue
            seen = []
            for pose in tqdm(poses[: options.gl_parts], desc=f"{name}, {regime}, MuJoCo", unit="pose"):
                shown = overhead(pose, rng)
                seen.append(pose_errors(shown, scene, pose))
            rows.append(_part_row(name, regime, "gl", seen))
        if overhead is not None:
            overhead.close()
    assert shown is not None
    return rows, shown


def _part_row(part: str, regime: str, renderer: str, seen: list[dict[str, float] | None]) -> dict[str, Any]:
    found = [s for s in seen if s is not None]
    row: dict[str, Any] = {"workpiece": part, "regime": regime, "renderer": renderer, "trials": len(seen)}
    row["seen_pct"] = 100.0 * len(found) / len(seen)
    for name in ("level_mm", "level_yaw_deg", "free_mm", "free_yaw_deg"):
        sample = np.array([s[name] for s in found])
        row[f"{name}_rms"] = float(np.sqrt((sample**2).mean())) if found else None
        row[f"{name}_max"] = float(np.abs(sample).max()) if found else None
    return row


# -- output -------------------------------------------------------------------------------------------------


def _markdown(head: list[str], body: list[list[str]]) -> str:
    widths = [max(len(line[k]) for line in [head, *body]) for k in range(len(head))]
    lines = [head, ["-" * w for w in widths], *body]
    return "\n".join(
        f"| {' | '.join(c.ljust(w) for c, w in zip(line, widths, strict=True))} |" for line in lines
    )


def values_table(trial: Trial) -> str:
    """True, found and error of each value of both cameras, of one calibration.

    Args:
        trial: The calibration.

    Returns:
        Markdown.
    """
    body = []
    for v, true in enumerate(load_cell().cameras):
        found = values(trial.found["exact"][v].camera.window(true.roi_px))
        for name, (unit, numbers) in values(true).items():
            sets = (numbers, found[name][1], found[name][1] - numbers)
            body.append([true.name, name, unit, *(", ".join(f"{x:.4f}" for x in s) for s in sets)])
    return _markdown(["camera", "value", "unit", "true", "found", "error"], body)


def _pair(row: dict[str, Any], name: str, digits: int) -> str:
    values = (row[f"{name}_rms"], row[f"{name}_max"])
    return " / ".join("-" if v is None else f"{v:.{digits}f}" for v in values)


def report(trials: list[Trial], cameras: list[dict[str, Any]], parts: list[dict[str, Any]]) -> str:
    """The tables for people.

    Args:
        trials: The calibrations; the first one's values are shown.
        cameras: From ``camera_rows``.
        parts: From ``part_rows``.

    Returns:
        Markdown.
    """
    head = ["camera", "tip poses", "trials", "views", "focal length %", "nozzle mouth px", "position mm"]
    body = [
        [
            row["camera"],
            "exact" if row["tip_poses"] == "exact" else f"{_ARM_ERROR_MM} mm, {_ARM_ERROR_DEG} deg off",
            str(row["trials"]),
            str(row["views"]),
            _pair(row, "focal_pct", 3),
            _pair(row, "tip_px", 3),
            _pair(row, "position_mm", 3),
            _pair(row, "rotation_deg", 4),
        ]
        for row in cameras
    ]
    part_head = ["workpiece", "regime", "renderer", "poses", "seen %", "position mm", "yaw deg"]
    part_body = [
        [
            row["workpiece"],
            row["regime"],
            row["renderer"],
            str(row["trials"]),
            f"{row['seen_pct']:.0f}",
            _pair(row, "level_mm", 3),
            _pair(row, "level_yaw_deg", 4),
            _pair(row, "free_mm", 2),
        ]
        for row in parts
    ]
    return "\n\n".join(
        (
            "# Calibration",
            "One calibration of each sensor camera from pictures of a ChArUco board. Pixels count from the "
            "corner of the ROI, mount and optical axis are in the tip frame.",
            values_table(trials[0]),
            "Errors of all calibrations, root mean square / largest.",
            _markdown([*head, "rotation deg"], body),
            "The part's pose from its AR code in the overhead camera's picture: error of the part's origin "
            "and yaw, root mean square / largest, for a part known to lie flat at the plate's height; in the "
            "last column with all six freedoms open. software: the code alone; gl: MuJoCo's picture of the "
            "cell with arm and shadows. Static: +-20 mm, +-15 deg; dynamic: +-40 mm, +-25 deg.",
            _markdown([*part_head, "position mm (6 freedoms)"], part_body),
        )
    )


def picture(path: Path, trial: Trial, overhead: NDArray[np.uint8]) -> None:
    """Draws what the cameras saw.

    Args:
        path: The PNG file.
        trial: A calibration.
        overhead: A picture of the overhead camera.
    """
    cell = load_cell()
    figure, axes = plt.subplots(2, 3, figsize=(15.5, 9), constrained_layout=True)
    for v, (sight, camera) in enumerate(zip(trial.sights, cell.cameras, strict=True)):
        for k in range(2):
            panel = axes[v, k]
            panel.imshow(sight.images[k], cmap="gray", vmin=0, vmax=255, extent=(0, *sight.camera.roi_px, 0))
            found = sight.corners[k].pixels
            panel.plot(*found.T, "+", color=_GREEN, ms=6, label=f"{len(found)} corners found")
            corner = np.subtract(sight.camera.tip_px, camera.tip_px)
            panel.add_patch(
                Rectangle(tuple(corner), *camera.roi_px, fill=False, ec=_BLUE, lw=1.5, label="ROI")
            )
            panel.plot(*sight.camera.tip_px, "x", color=_RED, ms=8, label="nozzle mouth")
            panel.set_title(f"{camera.name} camera, view {k + 1} of {len(sight.images)}")
            panel.legend(loc="lower left", fontsize=8)
    panel = axes[0, 2]
    for sight, calibration, colour in zip(trial.sights, trial.found["exact"], (_BLUE, _RED), strict=True):
        distance = np.linalg.norm(calibration.errors_px, axis=1)
        label = f"{sight.camera.name}: {len(distance)} corners, median {np.median(distance):.3f} px"
        panel.hist(
            np.minimum(distance, 0.5), bins=np.linspace(0, 0.5, 51), histtype="step", ec=colour, label=label
        )
    panel.set(xlabel="corner found to corner predicted [px]; 0.5: 0.5 or more", ylabel="corners")
    panel.set_title("what is left after the fit")
    panel.legend(fontsize=8)
    height, width = overhead.shape[:2]
    axes[1, 2].imshow(overhead, cmap="gray", vmin=0, vmax=255, extent=(0, width, height, 0))
    axes[1, 2].set_title("overhead camera: the AR code on the part")
    marker = PartMarker(id=cell.marker.id, size_m=1e-3 * cell.marker.size_mm, T_part_marker=np.eye(4))
    corners = marker.find(overhead)
    if corners is not None:
        axes[1, 2].add_patch(Polygon(corners, fill=False, ec=_RED, lw=2, label="AR code as found"))
        axes[1, 2].legend(loc="lower left", fontsize=8)
    for panel in (*axes[:, 0], *axes[:, 1], axes[1, 2]):
        panel.set(xticks=[], yticks=[])
    figure.savefig(path, dpi=90)
    plt.close(figure)


def write(
    out: Path, trial: Trial, cameras: list[dict[str, Any]], parts: list[dict[str, Any]], text: str
) -> None:
    """Writes ``calibrate.json``, ``calibrate.md`` and the calibrated cell file.

    Args:
        out: The folder.
        trial: The calibration whose values are shown.
        cameras: From ``camera_rows``.
        parts: From ``part_rows``.
        text: From ``report``.
    """
    pairs = zip(trial.found["exact"], load_cell().cameras, strict=True)
    found = [f.camera.window(true.roi_px) for f, true in pairs]
    document = {
        "name": "calibrate",
        "version": seal_gym.__version__,
        "command": shlex.join(["python", "-m", "experiments.calibrate", *sys.argv[1:]]),
        "stack": results.stack(),
        "rows": cameras,
        "parts": parts,
        "values": {
            true.name: {
                name: {"unit": unit, "true": numbers.tolist(), "found": values(camera)[name][1].tolist()}
                for name, (unit, numbers) in values(true).items()
            }
            for true, camera in zip(load_cell().cameras, found, strict=True)
        },
    }
    (out / "calibrate.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    (out / "calibrate.md").write_text(text + "\n", encoding="utf-8")
    old = asset("ur5_sealgun", "cell.toml").read_text(encoding="utf-8")
    (out / "calibrate.cell.toml").write_text(with_cameras(old, found), encoding="utf-8")


def main(arguments: list[str] | None = None) -> int:
    """Runs the calibration.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        Exit status: 0 if it ran to the end.
    """
    options = parse(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    try:
        seeds = range(options.seed, options.seed + options.trials)
        trials: list[Trial] = []
        for seed in tqdm(seeds, desc="calibrating", unit="run"):
            trial = calibrate_once(seed, options.views)
            # One trial's pictures are enough to show.
            sights = [s._replace(images=[]) for s in trial.sights] if trials else trial.sights
            trials.append(trial._replace(sights=sights))
        cameras = camera_rows(trials)
        parts, shown = part_rows(options)
    except SealGymError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    text = report(trials, cameras, parts)
    write(options.out, trials[0], cameras, parts, text)
    picture(options.out / "calibrate.png", trials[0], shown)
    sys.stdout.write(f"\n{text}\n\nwritten to {options.out}/\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
