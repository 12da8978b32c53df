"""Closes the thesis' loop: a geometric bead path refined on an evaluator, the gain shown in the reference.

    python -m experiments.bead_refine --out experiments/results --cell 2.0

For each case the optimal path of ``experiments.bead_paths`` is the first guess (Berg, Fig. 1.1). It is
refined twice by ``seal_gym.planning.bead_refine``: on an evaluator alone, and once more on the evaluator set
right by the reference's bead of the refined path. OpenFOAM lays all three. Writes the table as JSON, CSV and
Markdown and a picture for each case. Goes on where it was stopped; heights are kept in
<out>/bead_refine_fields.
"""

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments import bead_laydown, bead_reference, command, results
from experiments.bead_evaluators import EVALUATORS, evaluator, place_shares, scaled
from experiments.bead_laydown import INSET_M, SURFACES
from experiments.bead_refine_figures import draw
from experiments.laydown import resumed
from experiments.laydown_data import ARRAYS
from seal_gym.core.frames import Array
from seal_gym.planning import bead_cases
from seal_gym.planning.bead_config import BeadCfg
from seal_gym.planning.bead_refine import CHANNELS, RefineCfg, refine, shares
from seal_gym.sealant.laydown import foam

NAME = "bead_refine"
CASES = tuple(name for name in bead_cases.CASES if name not in SURFACES and bead_cases.get(name).feasible)
DEFAULT_CASES = ("zig_zag", "large_square", "half_circle")
PATHS = ("geometric", "refined", "refined twice")

Row = dict[str, Any]


@dataclass(frozen=True)
class Run:
    """One case to refine.

    Attributes:
        case: Name.
        evaluator: Of ``bead_evaluators.EVALUATORS``.
        cell_mm: Edge of the reference's cells.
        weights: The surrogate's file, if it is the evaluator.
    """

    case: str
    evaluator: str
    cell_mm: float
    weights: str | None = None


def unevenness(heights: Array, corner: NDArray[np.bool_]) -> Row:
    """How uneven a bead is.

    Args:
        heights: At both edges, shape (2, n), m.
        corner: Where the centre line has a corner, shape (n,).

    Returns:
        ``sd_pct``, standard deviation over both edges by their mean; ``range_pct``, largest less smallest by
        the mean; ``mean_mm``; ``difference_mm``, root mean square between the edges; ``corner_mm``, mean
        difference at the corners.
    """
    mean, off = float(heights.mean()), heights[0] - heights[1]
    return {
        "mean_mm": 1e3 * mean,
        "sd_pct": 100.0 * float(heights.std()) / mean,
        "range_pct": 100.0 * float(np.ptp(heights)) / mean,
        "difference_mm": 1e3 * float(np.sqrt(np.mean(off**2))),
        "corner_mm": 1e3 * float(np.abs(off[corner]).mean()),
    }


def work(run: Run) -> Row:
    """Refines one case and lays its paths in the reference.

    Args:
        run: Which.

    Returns:
        ``rows``, one a path; and under ``laydown_data.ARRAYS`` heights and corrections.
    """
    case, cfg = bead_cases.get(run.case), BeadCfg()
    theta = cfg.nozzle.fan_angle_rad
    edges = case.edges()
    strip = bead_laydown.strip_of(case, edges)
    at = bead_laydown.places(edges, strip)
    first = bead_reference.paths_of(case, edges, cfg)["ipopt"]
    evaluate = evaluator(run.evaluator, case, strip, at, theta, run.weights)
    share = place_shares(edges, first, at, theta)
    paths, asked = {PATHS[0]: first}, {PATHS[0]: evaluate([first])[0]}
    truth: dict[str, Array] = {}
    corrections, evaluations = {PATHS[0]: np.zeros((len(first.time_s), len(CHANNELS)))}, {PATHS[0]: 0}
    laid_rows: dict[str, Row] = {}
    now = evaluate
    for k, who in enumerate(PATHS):
        if k > 0:
            now = evaluate if k == 1 else scaled(evaluate, paths[PATHS[1]], truth[PATHS[1]])
            found = refine(first, now, share, RefineCfg())
            paths[who], asked[who] = found.path, found.after_m
            corrections[who], evaluations[who] = found.corrections, found.evaluations
        laid, laid_rows[who] = bead_reference.lay(case, edges, strip, paths[who], 1e-3 * run.cell_mm)
        heights = bead_laydown.edge_heights(strip, laid, at)
        truth[who] = np.stack((heights.left_m, heights.right_m))
    rows = []
    for who in PATHS:
        path = paths[who]
        row = {"path": who, "evaluations": evaluations[who], "duration_s": float(path.time_s[-1])}
        largest = np.abs(corrections[who]).max(axis=0)
        row |= {f"most_{name}": float(value) for name, value in zip(CHANNELS, largest, strict=True)}
        row |= {f"evaluator_{key}": value for key, value in unevenness(asked[who], at.corner).items()}
        row |= {f"reference_{key}": value for key, value in unevenness(truth[who], at.corner).items()}
        rows.append(row | laid_rows[who])
    arrays = {
        "along": at.along_m,
        "corner": at.corner,
        "truth": np.array([truth[who] for who in PATHS]),
        "asked": np.array([asked[who] for who in PATHS]),
        "corrections": np.array([corrections[who] for who in PATHS]),
        "share": shares(first),
    }
    return {"rows": rows, ARRAYS: arrays}


def title(evaluator_name: str) -> str:
    """What the files of an evaluator's results are called.

    Args:
        evaluator_name: Of ``bead_evaluators.EVALUATORS``.

    Returns:
        Their name; the default evaluator's have the experiment's own.
    """
    return NAME if evaluator_name == EVALUATORS[0] else f"{NAME}_{evaluator_name}"


def markdown(rows: list[Row], run: Run) -> str:
    """The table for people.

    Args:
        rows: One a case and path.
        run: Any of the runs, for evaluator and cells.

    Returns:
        Markdown.
    """
    number = results.number
    table = results.grid(
        [
            "case",
            "path",
            f"unevenness, {run.evaluator} %",
            "in the reference %",
            "gain",
            "largest - smallest %",
            "between edges mm",
            "at corners mm",
            "mean height mm",
            "time s",
            "most speed %",
            "shift mm",
            "offset mm",
            "tilt deg",
            "evaluations",
        ],
        [
            [
                row["case"],
                row["path"],
                number(row["evaluator_sd_pct"], 2),
                number(row["reference_sd_pct"], 2),
                f"{row['gain']:.2f} times" if row["path"] != PATHS[0] else "",
                number(row["reference_range_pct"], 1),
                number(row["reference_difference_mm"], 3),
                number(row["reference_corner_mm"], 3),
                number(row["reference_mean_mm"], 2),
                number(row["duration_s"], 3),
                number(100.0 * row["most_speed"], 1),
                number(1e3 * row["most_shift"], 2),
                number(1e3 * row["most_offset"], 2),
                number(float(np.rad2deg(row["most_tilt"])), 1),
                number(row["evaluations"], 0),
            ]
            for row in rows
        ],
    )
    evaluators = {
        "ballistic": "the jet flies with the tip's velocity added and stays where it lands",
        "fast": "the fast tier: straight rays on columns",
        "surrogate": "the cross-sections that a network predicts",
    }
    about = (
        f"Geometric: the optimal path of bead_paths.md. Refined: on the evaluator ({run.evaluator}: "
        f"{evaluators[run.evaluator]}); refined twice: on the evaluator times the ratio of the reference "
        f"to it along the refined path. Reference: OpenFOAM, cells of {run.cell_mm:g} mm. Unevenness: "
        f"standard deviation of the heights {1e3 * INSET_M:g} mm inside both edges by their mean, for "
        "refined paths on the evaluator they were refined on; gain: of the geometric path's unevenness in"
        " the reference over this one. Largest - smallest, by the mean; root mean square between the "
        "edges; mean difference at the corners: all in the reference. Corrections: the largest of each; "
        "evaluations: paths that the evaluator was asked about."
    )
    pictures = [
        f"![{name}]({title(run.evaluator)}_{name}.png)" for name in dict.fromkeys(row["case"] for row in rows)
    ]
    return "\n\n".join((table, about, *pictures))


def make(options: argparse.Namespace) -> str:
    """Does all of it.

    Args:
        options: With ``out``, ``case``, ``cell``, ``evaluator``, ``jobs``.

    Returns:
        The table.
    """
    weights = str(options.weights) if options.weights else None
    wanted = [Run(name, options.evaluator, options.cell, weights) for name in options.case or DEFAULT_CASES]
    folder = options.out / f"{NAME}_fields"
    folder.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    for run, found, new in resumed(wanted, work, options.out / f"{NAME}.trials.jsonl", options.jobs, "cases"):
        file = folder / f"{run.case}_{run.evaluator}_{run.cell_mm:g}.npz"
        if new:
            np.savez_compressed(file, **found[ARRAYS])
        base = found["rows"][0]["reference_sd_pct"]
        for row in found["rows"]:
            gain = base / row["reference_sd_pct"]
            rows.append(
                {"case": run.case, "evaluator": run.evaluator, "cell_mm": run.cell_mm, **row, "gain": gain}
            )
        with np.load(file) as stored:
            draw(
                options.out / f"{title(run.evaluator)}_{run.case}.png",
                bead_cases.get(run.case),
                PATHS,
                dict(stored),
            )
    text = markdown(rows, wanted[0])
    name = title(options.evaluator)
    results.write(options.out, name, rows, [], renderer="none", regime="static", text=text, module=NAME)
    return text


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Reads the command line.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        The options.
    """
    parser = argparse.ArgumentParser(
        prog=f"python -m experiments.{NAME}", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument(
        "--case",
        action="append",
        choices=CASES,
        help=f"may be repeated (default: {', '.join(DEFAULT_CASES)})",
    )
    parser.add_argument(
        "--evaluator",
        default=EVALUATORS[0],
        choices=EVALUATORS,
        help="that paths are refined on (default: %(default)s)",
    )
    parser.add_argument("--weights", type=Path, help="of the surrogate: NAME.safetensors")
    parser.add_argument("--cell", type=float, default=2.0, help="edge of a cell [mm] (default: %(default)s)")
    parser.add_argument("--jobs", type=int, default=1, help="cases at a time (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out") / NAME, help="folder (default: %(default)s)")
    options = command.checked(parser, arguments, jobs=1)
    if not 0.25 <= options.cell <= 4.0:
        parser.error(f"--cell {options.cell}: must be in [0.25, 4] mm")
    if (options.evaluator == "surrogate") != (options.weights is not None):
        parser.error("--evaluator surrogate needs --weights NAME.safetensors, no other does")
    return options


def main(arguments: list[str] | None = None) -> int:
    """Makes the table and the figures.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        Exit status, see ``command.run``.
    """
    options = parse(arguments)

    def do() -> str:
        foam.find("interFoam")
        return make(options)

    return command.run(do, options.out)


if __name__ == "__main__":
    sys.exit(main())
