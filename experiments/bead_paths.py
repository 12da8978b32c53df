"""Nozzle paths for beads: the thesis' eight cases solved, measured, and timed for the UR5.

    python -m experiments.bead_paths --out out/bead_paths

For each case (Berg, Fig. 3.6): the optimal path by IPOPT and by SLSQP on N = 60 as the thesis has it, the
naive path it is compared with, and the optimal one as the UR5 executes it. Heights are those of
``bead_projection.footprint``: rays along the fan's borders are followed to the surface. Writes the table as
JSON, CSV and Markdown, and for each case a figure of the path and one of the parameters the thesis plots
(its Figs. 4.1-4.8).
"""

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from experiments import bead_figures, command, results
from seal_gym.core.frames import Array
from seal_gym.planning import bead_cases, bead_projection, robot_path
from seal_gym.planning.bead_cases import BeadCase
from seal_gym.planning.bead_config import BeadCfg, PlanningError
from seal_gym.planning.bead_curves import Edges
from seal_gym.planning.bead_geometry import BeadPath
from seal_gym.planning.bead_path import FINER, naive_path, quantities, timed_path
from seal_gym.planning.bead_projection import Footprint
from seal_gym.planning.bead_slsqp import solve_slsqp
from seal_gym.planning.bead_solver import BeadSolution, Infeasibility, solve
from seal_gym.planning.bead_symbols import load_casadi

NAME = "bead_paths"
SLSQP_INTERVALS = 60

Row = dict[str, Any]


def clocked(work: Callable[[], Any]) -> tuple[Any, float, float]:
    """Does something and times it.

    Args:
        work: What to do.

    Returns:
        What came of it, CPU time of this process and wall time [s].
    """
    cpu, wall = time.process_time(), time.perf_counter()
    found = work()
    return found, time.process_time() - cpu, time.perf_counter() - wall


def measured(path: BeadPath, edges: Edges, cfg: BeadCfg) -> tuple[Footprint, Row]:
    """What a path lays.

    Args:
        path: In the edges' frame.
        edges: The edges.
        cfg: For the fan.

    Returns:
        Where its fan meets the surface, and in numbers: spread of the heights of both borders, their smallest
        and largest, and the largest distance of a border from its edge.
    """
    found = bead_projection.footprint(path, edges, cfg.nozzle.fan_angle_rad)
    heights = np.concatenate((found.left_height_m, found.right_height_m))
    return found, {
        "spread_pct": 100.0 * found.spread,
        "height_mean_mm": 1e3 * float(heights.mean()),
        "height_min_mm": 1e3 * float(heights.min()),
        "height_max_mm": 1e3 * float(heights.max()),
        "miss_mm": 1e3 * float(max(found.left_miss_m.max(), found.right_miss_m.max())),
    }


def prefixed(prefix: str, row: Row) -> Row:
    """A row with other names.

    Args:
        prefix: To put before each.
        row: The row.

    Returns:
        The new row.
    """
    return {f"{prefix}_{key}": value for key, value in row.items()}


def by_slsqp(edges: Edges, case: BeadCase, cfg: BeadCfg) -> Row:
    """The thesis' formulation on a case.

    Args:
        edges: Of the case.
        case: The case.
        cfg: Limits and weights.

    Returns:
        Its columns.
    """

    def attempt() -> BeadSolution | str:
        try:
            return solve_slsqp(edges, case.duration_s, cfg, SLSQP_INTERVALS)
        except PlanningError as error:
            return str(error)

    found, cpu, wall = clocked(attempt)
    row: Row = {"slsqp_cpu_s": cpu, "slsqp_wall_s": wall, "slsqp_cost": None, "slsqp_spread_pct": None}
    if isinstance(found, BeadSolution):
        path = timed_path(edges, found.nodes.finer(FINER), cfg)
        row |= {"slsqp_cost": found.cost, "slsqp_spread_pct": measured(path, edges, cfg)[1]["spread_pct"]}
    return row | {"slsqp_word": found if isinstance(found, str) else "solved"}


_NO_PATH: Row = {
    f"{who}_{key}": None
    for who in ("ipopt", "robot")
    for key in ("spread_pct", "height_mean_mm", "height_min_mm", "height_max_mm", "miss_mm")
} | {
    "ipopt_cost": None,
    "intervals": None,
    "closed_form_spread_pct": None,
    "max_tilt_deg": None,
    "max_drag_deg": None,
    "min_distance_mm": None,
    "max_distance_mm": None,
    "slow_down": None,
    "robot_time_s": None,
    "part_pose": None,
}


def work(case: BeadCase, cfg: BeadCfg, out: Path) -> Row:
    """All of one case.

    Args:
        case: The case.
        cfg: Limits and weights.
        out: Folder of the figures.

    Returns:
        A row of the table.
    """
    edges = case.edges()
    found, cpu, wall = clocked(lambda: solve(edges, case.duration_s, cfg))
    naive = naive_path(edges, case.duration_s, cfg, FINER * 240 + 1)
    naive_print, naive_row = measured(naive, edges, cfg)
    solved = isinstance(found, BeadSolution)
    row: Row = {
        "case": case.name,
        "result": "solved" if solved else ("infeasible, proven" if found.proven else "infeasible"),
        "planned_s": case.duration_s,
        "left_mm": 1e3 * edges.left.length_m,
        "right_mm": 1e3 * edges.right.length_m,
        "ipopt_cpu_s": cpu,
        "ipopt_wall_s": wall,
        **_NO_PATH,
        **prefixed("naive", naive_row),
        "reason": "",
    }
    row |= by_slsqp(edges, case, cfg)
    if isinstance(found, Infeasibility):
        bead_figures.draw_paths(out / f"{NAME}_{case.name}.png", case, edges, naive, naive_print, None, None)
        return row | {"reason": str(found)}
    fine = found.nodes.finer(FINER)
    path, values = timed_path(edges, fine, cfg), quantities(edges, fine, cfg)
    foot, ipopt_row = measured(path, edges, cfg)
    knots = timed_path(edges, found.nodes, cfg)
    pose = robot_path.place(knots)
    robot = robot_path.robot_path(knots, pose)
    robot_print, robot_row = measured(robot.path, edges, cfg)
    closed_form = bead_projection.height_spread(np.concatenate((values.g_m, values.h_m)))
    row |= prefixed("ipopt", ipopt_row) | prefixed("robot", robot_row)
    row |= {
        "ipopt_cost": found.cost,
        "intervals": len(found.nodes.time_s) - 1,
        "closed_form_spread_pct": 100.0 * closed_form,
        "max_tilt_deg": _peak_deg(values.tilt_rad),
        "max_drag_deg": _peak_deg(fine.drag_rad),
        "min_distance_mm": 1e3 * float(min(values.b_m.min(), values.c_m.min())),
        "max_distance_mm": 1e3 * float(max(values.b_m.max(), values.c_m.max())),
        "slow_down": robot.slow_down,
        "robot_time_s": float(robot.path.time_s[-1]),
        "part_pose": pose.round(6).tolist(),
    }
    bead_figures.draw_paths(out / f"{NAME}_{case.name}.png", case, edges, naive, naive_print, path, foot)
    bead_figures.draw_parameters(
        out / f"{NAME}_{case.name}_parameters.png", case, values, cfg, naive, naive_print, robot, robot_print
    )
    return row


def _peak_deg(angle: Array) -> float:
    return float(np.rad2deg(np.abs(angle).max()))


def markdown(rows: list[Row]) -> str:
    """The table for people.

    Args:
        rows: Of ``work``.

    Returns:
        Markdown.
    """
    number = results.number
    first = results.grid(
        [
            "case",
            "result",
            "IPOPT CPU s (wall)",
            "intervals",
            "cost",
            "height spread %",
            "as executed by the UR5 %",
            "slow-down",
            "naive heights mm",
            "naive miss mm",
            "SLSQP CPU s",
            "SLSQP cost",
            "SLSQP spread %",
        ],
        [
            [
                r["case"],
                r["result"],
                f"{r['ipopt_cpu_s']:.2f} ({r['ipopt_wall_s']:.2f})",
                number(r["intervals"], 0),
                number(r["ipopt_cost"], 3),
                number(r["ipopt_spread_pct"], 3),
                number(r["robot_spread_pct"], 3),
                number(r["slow_down"], 2),
                f"{r['naive_height_min_mm']:.2f} to {r['naive_height_max_mm']:.2f}",
                number(r["naive_miss_mm"], 2),
                number(r["slsqp_cpu_s"], 2),
                number(r["slsqp_cost"], 3),
                number(r["slsqp_spread_pct"], 2),
            ]
            for r in rows
        ],
    )
    notes = [f"- {r['case']}: {r['reason']}" for r in rows if r["reason"]]
    notes += [
        f"- {r['case']}, SLSQP: {r['slsqp_word']}" for r in rows if r["slsqp_word"] not in ("", "solved")
    ]
    text = (
        "Height spread: (largest - smallest) / mean of the heights along both borders of the fan, on a grid "
        f"{FINER} times finer than the solver's, from rays followed to the surface, not from the constraint. "
        "As executed: the same measure on the forward kinematics of the time-scaled joint path with the "
        "scaled flow, from rest to rest; slow-down: its time over the planned one. Naive: its smallest and "
        "largest height by the same measure, and the largest distance of its fan's borders from the "
        f"edges they should meet. SLSQP: N = {SLSQP_INTERVALS} steps in time, nothing holds between them. "
        "CPU time of one core, curves and CasADi loaded."
    )
    return "\n\n".join((first, text, "\n".join(notes))).rstrip()


def make(options: argparse.Namespace) -> str:
    """Writes the files.

    Args:
        options: The command line.

    Returns:
        The table for people.
    """
    from tqdm import tqdm

    load_casadi()
    cfg = BeadCfg()
    names = list(dict.fromkeys(options.case or bead_cases.CASES))
    rows = [work(bead_cases.get(name), cfg, options.out) for name in tqdm(names, desc="cases", unit="case")]
    text = markdown(rows)
    pictures = [f"![{r['case']}]({NAME}_{r['case']}.png)" for r in rows]
    results.write(
        options.out,
        NAME,
        rows,
        [],
        renderer="none",
        regime="static",
        text="\n\n".join((text, *pictures)),
    )
    return text


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Reads the command line.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        The options.
    """
    parser = argparse.ArgumentParser(
        prog=f"python -m experiments.{NAME}", description=__doc__.splitlines()[0]
    )
    parser.add_argument(
        "--case", action="append", choices=bead_cases.CASES, help="may be repeated (default: all)"
    )
    parser.add_argument("--out", type=Path, default=Path("out") / NAME, help="folder (default: %(default)s)")
    return command.checked(parser, arguments)


def main(arguments: list[str] | None = None) -> int:
    """Makes the table and the figures.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        Exit status: 0 if it ran to the end.
    """
    options = parse(arguments)
    return command.run(lambda: make(options), options.out)


if __name__ == "__main__":
    sys.exit(main())
