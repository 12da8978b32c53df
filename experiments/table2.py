"""Table 2: how well each way of reading the images sees the seam, with and without a Kalman filter.

    python -m experiments.table2 --trials 20 --out out/table2

The expert steers on oracle features, so that every method reads the same images: 10 s of each trial, at a
place of the seam drawn from the seed. The trackers see the second before it too: no run begins in the middle
of a seam. Truth is the seam's tangent at its point nearest the tip, projected into each view.

Writes table2.json, .csv, .md and .png, and a file with every frame of each trial in ``frames/``.
"""

import argparse
import sys
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents import engines
from experiments import command, results, trials
from experiments.table2_report import FEATURES, REGIONS, Method, markdown, plot, summarise
from seal_gym.core.cell import load_cell
from seal_gym.core.errors import SealGymError
from seal_gym.core.frames import Array
from seal_gym.envs.seal_env import SealEnv
from seal_gym.estimation.line_kalman import LineKalman, LineKalmanCfg
from seal_gym.vision.baselines import DETECTORS
from seal_gym.vision.endpoints import end_points, image_lines, strip_references
from seal_gym.vision.features import MIN_SEEN_PX, RoiFeatures, SeamLines, ViewGeometry, update_features
from seal_gym.vision.perception import Perception
from seal_gym.vision.seam_line import dilated, find_lines, strips
from seal_gym.workpieces import catalogue

Bools = NDArray[np.bool_]

_ANGLES = np.array([unit == "deg" for _, unit in FEATURES])
CORNER_M = 15e-3  # arc this near a corner belongs to it
SETTLED_M = 10e-3  # the approach from the hover is not measured
WARM_UP_M = 10e-3
_END_M = 2e-3
# Edge methods that the tracker with a memory is run on.
MEMORY = tuple(DETECTORS)
# Chosen on validation seeds with our edges; the best for each edge method is within a few per cent of this.
KALMAN = {"raw": LineKalmanCfg(), "refined": LineKalmanCfg(q=8.0)}


@dataclass(frozen=True, kw_only=True)
class Ride(trials.Trial):
    """A trial of which a part is measured.

    Attributes:
        seconds: Length of that part [s].
    """

    seconds: float = 10.0

    def spec(self) -> dict[str, Any]:
        """Enough to rebuild it.

        Returns:
            The trial's, with the measured part.
        """
        return {**super().spec(), "seconds": self.seconds, "from_s_m": self.start_m}

    @property
    def start_m(self) -> float:
        """Arc length from which it is measured [m], drawn from the seed."""
        reach = load_cell().process.speed_m_s * self.seconds
        last = catalogue.get(self.workpiece).seam.length - reach - _END_M
        return float(np.random.default_rng([self.seed, 2]).uniform(SETTLED_M, max(last, SETTLED_M)))


METHODS = [
    Method(edge, tracker, refined)
    for edge in DETECTORS
    for tracker, refined in (
        ("none", False),
        ("kalman", False),
        ("none", True),
        ("kalman", True),
        ("memory", True),
    )
    if tracker != "memory" or edge in MEMORY
]


class Film(NamedTuple):
    """What the cameras saw in F frames.

    Attributes:
        front: Shape (F, height, width, 3).
        side: Shape (F, height, width, 3).
        tip: ``T_world_tip``, shape (F, 4, 4), m.
        truth: The oracle's lines, rows are frames.
        s_m: Arc length of the seam's point nearest the tip, shape (F,), m.
        measured: Frames that count, shape (F,); those before are the trackers' warm-up.
        nozzle: Its coverage of each pixel, front and side.
    """

    front: NDArray[np.uint8]
    side: NDArray[np.uint8]
    tip: Array
    truth: SeamLines
    s_m: Array
    measured: Bools
    nozzle: tuple[Array, Array]


class Camera:
    """Films a trial from the warm-up to the last frame that counts."""

    def __init__(self, ride: Ride) -> None:
        """Waits for the gun.

        Args:
            ride: Which part of the trial to film.
        """
        self._ride = ride
        self._start, self._left = ride.start_m, round(ride.seconds * load_cell().timing.frame_rate_hz)
        self._frames: list[tuple[Any, ...]] = []
        self._nozzle: tuple[Array, Array] | None = None

    def __call__(self, env: SealEnv, info: dict[str, Any]) -> None:
        """Takes one frame.

        Args:
            env: The environment.
            info: Of the last step.
        """
        del info
        core = env.core
        s = float(core.progress.s[0])
        if self._left == 0 or s < self._start - WARM_UP_M:
            return
        # A frame that counts is followed by others that do, though the gun may draw back a little.
        counts = s >= self._start or (bool(self._frames) and self._frames[-1][-1])
        self._left -= counts
        self._nozzle = core.sensors.nozzle
        images = core.sensors.images(core.tip.pose, core.arm, core.frames)
        lines = core.lines
        self._frames.append(
            (
                images.front[0].copy(),
                images.side[0].copy(),
                core.tip.pose[0].copy(),
                lines.point[0].copy(),
                lines.direction[0].copy(),
                lines.valid[0].copy(),
                s,
                counts,
            )
        )

    def film(self) -> Film:
        """The frames taken.

        Returns:
            In order.

        Raises:
            SealGymError: If none counts.
        """
        if self._nozzle is None or not self._frames[-1][-1]:
            raise SealGymError(
                f"{self._ride.part}, seed {self._ride.seed}: the run ended before {1e3 * self._start:.0f} mm"
            )
        front, side, tip, point, direction, valid, s, counts = (
            np.array(c) for c in zip(*self._frames, strict=True)
        )
        return Film(front, side, tip, SeamLines(point, direction, valid), s, counts, self._nozzle)


# -- from images to features ------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def _views() -> ViewGeometry:
    return ViewGeometry.of(load_cell())


def features_of(lines: SeamLines) -> Array:
    """The features of each frame.

    Args:
        lines: Lines of F frames.

    Returns:
        By view and ``FEATURES``, NaN without a line, shape (F, 2, 4).
    """
    views, n = _views(), len(lines.point)
    # The same for all: a line that does not show in the ROI is none.
    seen = lines.valid & (end_points(lines, views.size).length >= MIN_SEEN_PX)
    f = RoiFeatures.zeros(n)
    update_features(f, SeamLines(lines.point, lines.direction, seen), views)
    both = f.valid[:, :1] & f.valid[:, 1:]
    columns = (
        np.where(seen, f.d_px, np.nan),
        np.where(seen, np.degrees(f.theta_px_rad), np.nan),
        np.where(both, 1e3 * f.d_m, np.nan),
        np.where(both, np.degrees(f.theta_rad), np.nan),
    )
    return np.stack(columns, axis=-1)


def error_of(found: Array, truth: Array) -> Array:
    """Errors of features.

    Args:
        found: Shape (F, 2, 4).
        truth: Likewise.

    Returns:
        Differences, those of angles within +-90 deg: a line has no sense.
    """
    error = found - truth
    return np.where(_ANGLES, np.mod(error + 90.0, 180.0) - 90.0, error)


def lines_by_frame(film: Film, edge: str) -> dict[str, tuple[Array, Bools]]:
    """The line in each image by itself.

    Args:
        film: The images.
        edge: Name of the edge method.

    Returns:
        For ``raw`` and ``refined``: p and q, shape (F, 2, 2), and whether there is a line, shape (F, 2).
    """
    masks, references = dilated(film.nozzle), strip_references(_views())
    found = [
        find_lines(images, mask, reference, DETECTORS[edge]())
        for images, mask, reference in zip(strips(film.front, film.side), masks, references, strict=True)
    ]
    raw = np.stack([f.raw for f in found], axis=1)
    refined = np.stack([f.line[:, :2] for f in found], axis=1)
    return {
        "raw": (raw, np.isfinite(raw[..., 0])),
        "refined": (refined, np.stack([f.valid for f in found], axis=1)),
    }


def _filtered(line: Array, valid: Bools, cfg: LineKalmanCfg) -> tuple[Array, Bools]:
    kalman = LineKalman(1, load_cell().timing.frame_s, cfg)
    out = [kalman.update(line[k : k + 1], valid[k : k + 1]) for k in range(len(line))]
    return np.concatenate([o.line for o in out]), np.concatenate([o.valid for o in out])


def _remembered(film: Film, edge: str) -> SeamLines:
    eyes = Perception(1, _views(), film.nozzle, load_cell().timing.frame_s, detector=DETECTORS[edge]())
    out = [
        eyes.update(film.front[k : k + 1], film.side[k : k + 1], film.tip[k : k + 1])
        for k in range(len(film.front))
    ]
    return SeamLines(*(np.concatenate(columns) for columns in zip(*out, strict=True)))


def read(film: Film, methods: list[Method]) -> dict[str, Array]:
    """Every method's features of every frame.

    Args:
        film: What the cameras saw.
        methods: The methods.

    Returns:
        By the method's name, shape (F, 2, 4).
    """
    by_frame = {edge: lines_by_frame(film, edge) for edge in dict.fromkeys(m.edge for m in methods)}
    out = {}
    for method in methods:
        kind = "refined" if method.refined else "raw"
        line, valid = by_frame[method.edge][kind]
        if method.tracker == "memory":
            lines = _remembered(film, method.edge)
        else:
            if method.tracker == "kalman":
                line, valid = _filtered(line, valid, KALMAN[kind])
            lines = image_lines(line, valid, _views())
        out[method.name] = features_of(lines)
    return out


# -- trials -----------------------------------------------------------------------------------------------


def _corner(ride: Ride, s_m: Array) -> Bools:
    corners = catalogue.get(ride.workpiece).seam.corners
    near = (s_m[:, None] >= corners[:, 0] - CORNER_M) & (s_m[:, None] <= corners[:, 1] + CORNER_M)
    return np.asarray(near.any(axis=1))


def run(ride: trials.Trial, frames: Path) -> dict[str, Any]:
    """Runs a trial, lets every method read its images and writes what each saw, frame by frame.

    Args:
        ride: What to run.
        frames: Folder of the frames' files: ``s_m``, ``corner``, ``truth`` and what each method found, NaN
            without a line, shape (frames, 2, 4): front and side, and ``FEATURES``.

    Returns:
        The trial's row; for each method and region the sums of squared errors and the frames with a line, by
        view and feature.
    """
    assert isinstance(ride, Ride)
    camera = Camera(ride)
    row = trials.run(ride, camera)
    film = camera.film()
    counts = film.measured
    truth = features_of(film.truth)[counts]
    # The figures are those of the numbers in the file, which need no more digits than these.
    found = {name: values[counts].astype(np.float32) for name, values in read(film, METHODS).items()}
    corner = _corner(ride, film.s_m[counts])
    np.savez_compressed(
        frames / f"{ride.part}-{ride.seed}.npz",
        s_m=film.s_m[counts],
        corner=corner,
        truth=truth,
        **found,  # type: ignore[arg-type]  # numpy's stub takes the keywords for allow_pickle
    )
    sums: dict[str, Any] = {}
    for region, chosen in zip(REGIONS, (~corner, corner), strict=True):
        for name, values in found.items():
            error = error_of(values.astype(np.float64), truth)[chosen]
            sums.setdefault(name, {})[region] = {
                "squared": np.nansum(error**2, axis=0).tolist(),
                "lines": np.isfinite(error).sum(axis=0).tolist(),
                "frames": np.isfinite(truth[chosen]).sum(axis=0).tolist(),
            }
    return {**row, "frames": int(counts.sum()), "sums": sums}


# -- the command -----------------------------------------------------------------------------------------


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Reads the command line.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        The options.
    """
    parser = argparse.ArgumentParser(
        prog="python -m experiments.table2", description=__doc__.splitlines()[0].removeprefix("Table 2: ")
    )
    parser.add_argument(
        "--workpiece",
        action="append",
        choices=catalogue.NAMES,
        help="may be repeated (default: all three)",
    )
    parser.add_argument("--seed", type=int, default=500_000, help="of the first trial (default: %(default)s)")
    parser.add_argument("--trials", type=int, default=1, help="a part (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=10.0, help="measured of each (default: %(default)s)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out/table2"), help="folder (default: %(default)s)")
    options = command.checked(parser, arguments, trials=1, jobs=1, seed=0)
    if not 0.1 <= options.seconds <= 20.0:
        parser.error(f"--seconds {options.seconds}: must be within 0.1..20: the seams take 22 s and more")
    return options


def main(arguments: list[str] | None = None) -> int:
    """Makes the table.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        Exit status: 0 if it ran to the end.
    """
    options = parse(arguments)
    frames = options.out / "frames"
    frames.mkdir(parents=True, exist_ok=True)
    wanted = [
        Ride(
            method="rmp_expert",
            workpiece=part,
            seed=options.seed + k,
            env={"perception": "oracle"},
            seconds=options.seconds,
        )
        for part in dict.fromkeys(options.workpiece or catalogue.NAMES)
        for k in range(options.trials)
    ]
    try:
        rows = trials.run_all(
            wanted,
            engine=engines.local(options.jobs),
            log=options.out / "table2.trials.jsonl",
            title="filming",
            work=partial(run, frames=frames),
        )
    except SealGymError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    table = summarise(rows, METHODS)
    light = [{k: v for k, v in row.items() if k != "sums"} for row in rows]
    text = markdown(table)
    results.write(options.out, "table2", table, light, renderer="raycast", regime="static", text=text)
    plot(table, options.out / "table2.png")
    sys.stdout.write(f"\n{text}\n\nwritten to {options.out}/\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
