"""Ways over a palette: cubics from many starts against the straight line, RRT-Connect and up-across-down.

    python -m experiments.palette_paths --trials 20 --seed 500000 --jobs 2 --out experiments/results

On each palette the tool goes to a hover over each tie from a start beside the board, as low as 10 mm over it,
and from the hover over another tie. A way succeeds if arm and tool keep 2 mm from everything, looked at every
2 mm of the tip's way. Lengths are the tip's; times those of one tau-Jerk motion along the way within the
joints' and the tip's limits. RRT-Connect is OMPL's, in the joints, simplified and smoothed by it
(``pip install 'seal-gym[planning]'``); each palette has a process of its own, for OMPL's generator can be
seeded once in a process. Planning times are of the machine that ran it. Writes palette_paths.json, .csv, .md
and .png.
"""

import argparse
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from tqdm import tqdm

from agents.processes import pool
from experiments import command, palette_figures, results
from seal_gym.core.cell import load_cell
from seal_gym.core.errors import ConfigError
from seal_gym.core.frames import Array
from seal_gym.core.kinematics import JOINT_SPEED, tip_kinematics
from seal_gym.envs.palette_env import POSTURE, PaletteEnv
from seal_gym.planning import multi_path
from seal_gym.planning.multi_path import CubicWay
from seal_gym.planning.tau_jerk import unit_gap
from seal_gym.sim.palette_scene import BOARD_TOP_M
from seal_gym.sim.tool_check import ToolCheck

try:  # an extra: without it the other methods are compared all the same
    import ompl.base as ompl_base
    import ompl.geometric as ompl_geometric
    import ompl.util as ompl_util
except ImportError:
    ompl_base = ompl_geometric = ompl_util = None

NAME = "palette_paths"
UP = np.array([0.0, 0.0, 1.0])
HOVER_M = 0.008
SAFE_M = BOARD_TOP_M + 0.08  # above every peg
STARTS_LOW = np.array([0.15, -0.45, BOARD_TOP_M + 0.01])
STARTS_HIGH = np.array([0.40, -0.26, BOARD_TOP_M + 0.15])
MANY_STARTS = 8
_CHECK_M, _PLAN_M = 0.002, 0.003  # clearances: judged, and planned with
_STEP_M = 0.002
_KNOTS = 40
_SPEED_SHARE, _TIP_SPEED, _TIP_ACCEL = 0.5, 0.5, 2.0
_RRT_SECONDS, _RRT_RANGE, _RRT_STEP = 10.0, 0.3, 0.01
METHODS = ("straight line", "up, across, down", "multi-path", "multi-path, best start", "RRT-Connect")

Row = dict[str, Any]


class Problem(NamedTuple):
    """From where to where.

    Attributes:
        kind: ``"beside"`` or ``"tie"``: what the start is.
        starts: The first is the problem's, the others are for the method that may choose, shape (s, 3), m.
        goal: Shape (3,), m.
    """

    kind: str
    starts: Array
    goal: Array


class Found(NamedTuple):
    """What a method found.

    Attributes:
        q: Postures along the way, by legs from rest to rest, each of shape (m, 6), rad.
        inflections: Of the tip's curve; None where it is no cubic.
    """

    q: tuple[Array, ...]
    inflections: int | None = None


def duration_s(q: Array) -> float:
    """Time of one tau-Jerk motion along a way within the limits of joints and tip.

    With the way q(s) and the motion s(t / T) the speeds are q' s' / T and the accelerations
    (q'' s'^2 + q' s'') / T^2: T follows in closed form.

    Args:
        q: Postures, shape (m, 6), rad.

    Returns:
        [s].
    """
    tip = tip_kinematics(q, np.zeros_like(q)).pose[:, :3, 3]
    arc = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(tip, axis=0), axis=1))))
    if arc[-1] < 1e-9:
        return 0.0
    keep = np.concatenate(([True], np.diff(arc) > 1e-9))
    share = arc[keep] / arc[-1]
    time_s = np.linspace(0.0, 1.0, 400)
    gap = unit_gap(time_s, 0.25)
    s, ds, dds = 1.0 - gap.position, -gap.velocity, -gap.acceleration
    asked = [0.0]
    accel = np.full(6, load_cell().limits.joint_rad_s2)
    for values, speed, acceleration in (
        (q[keep], _SPEED_SHARE * JOINT_SPEED, accel),
        (tip[keep], _TIP_SPEED, _TIP_ACCEL),
    ):
        knots = np.linspace(0.0, 1.0, min(_KNOTS, len(share)))
        way = CubicSpline(knots, np.column_stack([np.interp(knots, share, v) for v in values.T]))
        first = way(s, 1) * ds[:, None]
        second = way(s, 2) * ds[:, None] ** 2 + way(s, 1) * dds[:, None]
        if np.ndim(speed):
            asked += [
                float(np.max(np.abs(first) / speed)),
                float(np.sqrt(np.max(np.abs(second) / acceleration))),
            ]
        else:
            asked += [
                float(np.linalg.norm(first, axis=1).max() / speed),
                float(np.sqrt(np.linalg.norm(second, axis=1).max() / acceleration)),
            ]
    return max(asked)


def _line(check: ToolCheck, a: Array, b: Array) -> Array:
    count = max(int(np.ceil(np.linalg.norm(b - a) / _STEP_M)) + 1, 2)
    return check.postures(np.linspace(a, b, count))


def straight_line(check: ToolCheck, problem: Problem) -> Found | None:
    """The tip on a line, whatever is there."""
    return Found((_line(check, problem.starts[0], problem.goal),), 0)


def up_across_down(check: ToolCheck, problem: Problem) -> Found | None:
    """As the scripted policy goes, with a rest at each corner."""
    start, goal = problem.starts[0], problem.goal
    safe = max(SAFE_M, float(start[2]))
    corners = [start, np.array([*start[:2], safe]), np.array([*goal[:2], safe]), goal]
    legs = [(a, b) for a, b in pairwise(corners) if np.linalg.norm(b - a) > 1e-6]
    return Found(tuple(_line(check, a, b) for a, b in legs))


def _of(check: ToolCheck, way: CubicWay | None) -> Found | None:
    if way is None:
        return None
    count = max(int(np.ceil(way.length_m / _STEP_M)) + 1, 2)
    return Found((check.postures(way.equidistant(count)),), way.inflections)


def one_start(check: ToolCheck, problem: Problem) -> Found | None:
    """Cubics from the problem's start."""
    return _of(check, multi_path.choose(multi_path.ways(problem.starts[0], problem.goal, check.free, UP)))


def many_starts(check: ToolCheck, problem: Problem) -> Found | None:
    """Cubics from all starts: the best of all is taken, as in the paper's Fig. 7."""
    found = [way for s in problem.starts for way in multi_path.ways(s, problem.goal, check.free, UP)]
    return _of(check, multi_path.choose(found))


def rrt_connect(check: ToolCheck, problem: Problem) -> Found | None:
    """OMPL's RRT-Connect between the postures of start and goal."""
    if ompl_base is None:
        raise ConfigError("RRT-Connect needs OMPL: pip install 'seal-gym[planning]'")
    ends = check.postures(np.stack((problem.starts[0], problem.goal)))
    space, bounds = ompl_base.RealVectorStateSpace(6), ompl_base.RealVectorBounds(6)
    for k in range(6):
        bounds.setLow(k, float(ends[:, k].min() - 1.0))
        bounds.setHigh(k, float(ends[:, k].max() + 1.0))
    space.setBounds(bounds)
    setup = ompl_geometric.SimpleSetup(space)
    setup.setStateValidityChecker(
        lambda state: bool(check.free_postures(np.array([[state[k] for k in range(6)]]))[0])
    )
    information = setup.getSpaceInformation()
    information.setStateValidityCheckingResolution(_RRT_STEP / space.getMaximumExtent())
    planner = ompl_geometric.RRTConnect(information)
    planner.setRange(_RRT_RANGE)
    setup.setPlanner(planner)
    states = [space.allocState() for _ in ends]
    for state, q in zip(states, ends, strict=True):
        for k in range(6):
            state[k] = float(q[k])
    setup.setStartAndGoalStates(*states)
    setup.solve(_RRT_SECONDS)
    if not setup.haveExactSolutionPath():
        return None
    path = setup.getSolutionPath()
    setup.getPathSimplifier().simplifyMax(path)  # until nothing improves: no clock decides
    corners = np.array([[state[k] for k in range(6)] for state in path.getStates()])
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    arc = np.concatenate(([0.0], np.cumsum(lengths)))
    fine = np.linspace(0.0, arc[-1], max(int(np.ceil(arc[-1] / _RRT_STEP)) + 1, 2))
    whole = np.column_stack([np.interp(fine, arc, c) for c in corners.T])
    legs = tuple(whole[(fine >= a - 1e-9) & (fine <= b + 1e-9)] for a, b in pairwise(arc) if b > a)
    legs = tuple(leg for leg in legs if len(leg) > 1)
    # Straight in the joints from corner to corner: at rest there, unless going on is faster.
    through = duration_s(whole) < sum(duration_s(leg) for leg in legs)
    return Found((whole,) if through else legs)


Method = Callable[[ToolCheck, Problem], Found | None]
_PLANNERS: dict[str, Method] = dict(
    zip(METHODS, (straight_line, up_across_down, one_start, many_starts, rrt_connect), strict=True)
)


def problems(env: PaletteEnv, check: ToolCheck, rng: np.random.Generator) -> list[Problem]:
    """Two ways to each tie: from beside the board, and from another tie.

    Args:
        env: After ``reset``.
        check: For starts that are free.
        rng: Draws the starts.

    Returns:
        The problems.
    """
    hover = env.target_m + np.array([0.0, 0.0, HOVER_M])
    out = []
    for k, goal in enumerate(hover):
        starts: list[Array] = []
        while len(starts) < MANY_STARTS:
            point = rng.uniform(STARTS_LOW, STARTS_HIGH)
            if check.free(point[None])[0]:
                starts.append(point)
        out.append(Problem("beside", np.array(starts), goal))
        out.append(Problem("tie", np.delete(hover, k, axis=0), goal))
    return out


def measure(method: str, plan: ToolCheck, judge: ToolCheck, problem: Problem) -> Row:
    """A method on a problem.

    Args:
        method: One of ``METHODS``.
        plan: Where it may go, with some room to spare.
        judge: Where it must not be.
        problem: From where to where.

    Returns:
        Success, length [mm], time [s], inflections and planning time [ms].
    """
    start = time.perf_counter()
    found = _PLANNERS[method](plan, problem)
    planning_ms = 1e3 * (time.perf_counter() - start)
    row: Row = {"method": method, "start": problem.kind, "planning_ms": planning_ms}
    if found is None:
        return row | {
            "found": False,
            "success": False,
            "length_mm": None,
            "time_s": None,
            "inflections": None,
        }
    legs = [leg for leg in found.q if np.isfinite(leg).all()]
    success = len(legs) == len(found.q) and all(judge.free_postures(leg).all() for leg in legs)
    tips = [tip_kinematics(leg, np.zeros_like(leg)).pose[:, :3, 3] for leg in legs]
    length = sum(float(np.linalg.norm(np.diff(tip, axis=0), axis=1).sum()) for tip in tips)
    return row | {
        "found": True,
        "success": bool(success),
        "length_mm": 1e3 * length,
        "time_s": sum(duration_s(leg) for leg in legs),
        "inflections": found.inflections,
    }


def run(seed: int) -> list[Row]:
    """All methods on one palette.

    Args:
        seed: Of the palette.

    Returns:
        A row for each problem and method.
    """
    env = PaletteEnv(perception="oracle")
    env.reset(seed=seed)
    plan = ToolCheck(env.scene, env.part_pose, POSTURE, _PLAN_M)
    judge = ToolCheck(env.scene, env.part_pose, POSTURE, _CHECK_M)
    if ompl_util is not None:
        ompl_util.setLogLevel(ompl_util.LogLevel.LOG_NONE)
        ompl_util.RNG.setSeed(seed + 1)  # 0 would mean the clock
    rng, rows = np.random.default_rng(seed), []
    for number, problem in enumerate(problems(env, plan, rng)):
        for method in METHODS:
            if method == "RRT-Connect" and ompl_base is None:
                continue
            rows.append({"seed": seed, "problem": number, **measure(method, plan, judge, problem)})
    return rows


def summarise(rows: list[Row]) -> list[Row]:
    """A row for each method and kind of start.

    Lengths and times are compared on the problems that all methods but the line and the free choice of the
    start solve.

    Args:
        rows: From ``run``.

    Returns:
        Success with Wilson's interval, means with bootstrap intervals.
    """
    judged = {"up, across, down", "multi-path", "RRT-Connect"}
    failed = {(r["seed"], r["problem"]) for r in rows if r["method"] in judged and not r["success"]}
    out = []
    for kind in ("beside", "tie"):
        for method in METHODS:
            mine = [r for r in rows if r["method"] == method and r["start"] == kind]
            if not mine:
                continue
            good = [r for r in mine if r["success"]]
            common = [r for r in good if (r["seed"], r["problem"]) not in failed]
            row: Row = {"start": kind, "method": method, "problems": len(mine)}
            row["success_pct"] = 100.0 * len(good) / len(mine)
            row["success_ci"] = results.wilson(len(good), len(mine))
            row["compared"] = len(common)
            for key in ("length_mm", "time_s"):
                values = [r[key] for r in common]
                row[key] = float(np.mean(values)) if values else None
                row[f"{key}_ci"] = results.bootstrap(values)
            bends = [r["inflections"] for r in common if r["inflections"] is not None]
            row["inflections"] = float(np.mean(bends)) if bends else None
            row["planning_ms"] = float(np.median([r["planning_ms"] for r in mine]))
            out.append(row)
    return out


def markdown(rows: list[Row]) -> str:
    """The table.

    Args:
        rows: From ``summarise``.

    Returns:
        Markdown.
    """
    head = ["start", "method", "problems", "success %", "compared", "length mm", "time s", "inflections"]
    body = [
        [
            r["start"],
            r["method"],
            str(r["problems"]),
            results.with_interval(r, "success_pct", 1),
            str(r["compared"]),
            results.with_interval(r, "length_mm", 0),
            results.with_interval(r, "time_s", 2),
            results.number(r["inflections"], 2),
            f"{r['planning_ms']:.0f}",
        ]
        for r in rows
    ]
    return (
        "Success: arm and tool keep 2 mm from everything. Lengths and times: of the successful ways, on the "
        "problems that up-across-down, multi-path and RRT-Connect all solve. The best start is that of "
        "the least cost among all ways from 8 starts beside the board, or from every other tie.\n\n"
        f"{results.grid([*head, 'planning ms (median)'], body)}"
    )


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Reads the command line.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        The options.
    """
    parser = argparse.ArgumentParser(
        prog="python -m experiments.palette_paths", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--trials", type=int, default=20, help="palettes (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=500_000, help="of the first (default: %(default)s)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out") / NAME, help="folder (default: %(default)s)")
    return command.checked(parser, arguments, trials=1, jobs=1, seed=0)


def main(arguments: list[str] | None = None) -> int:
    """Makes the table and the figure.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        Exit status: 0 if it ran to the end.
    """
    options = parse(arguments)

    def do() -> str:
        seeds = list(range(options.seed, options.seed + options.trials))
        if ompl_util is None:
            sys.stderr.write("no RRT-Connect: OMPL is not installed (pip install 'seal-gym[planning]')\n")
        with pool(options.jobs, tasks_each=1) as workers:
            found = tqdm(workers.map(run, seeds), total=len(seeds), desc="palettes")
            rows = [row for palette in found for row in palette]
        table = summarise(rows)
        text = markdown(table)
        palette_figures.ways(options.out / f"{NAME}.png", options.seed)
        results.write(options.out, NAME, table, rows, renderer="none", regime="static", text=text)
        return text

    return command.run(do, options.out)


if __name__ == "__main__":
    sys.exit(main())
