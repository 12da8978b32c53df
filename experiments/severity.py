"""Reached and RMSE against the severity of every disturbance, one at a time, for every method.

    python -m experiments.severity --trials 25 --seed 1000000 --jobs 2 --out experiments/results

One nominal part and the shipped training seeds. Severity 0 is run once for all disturbances. Writes
severity.json, .csv, .md, a chart of each disturbance and one with all. Batches are logged as they end: the
same command goes on where it was stopped.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import NamedTuple

from agents import engines
from agents.engines import Engine
from experiments import (
    command,
    control_table,
    methods,
    results,
    severity_figures,
    severity_report,
    table4,
    trials,
)
from experiments.methods import Weights
from experiments.trials import Row, Trial
from seal_gym.core.errors import SealGymError, require
from seal_gym.workpieces import catalogue
from seal_gym.wrappers import NAMES, disturbance

NAME = "severity"
SEVERITIES = (0.0, 0.5, 1.0, 2.0, 4.0)
TRIALS = 25  # a point


class Point(NamedTuple):
    """Trials under one disturbance at one severity.

    Attributes:
        disturbance: Its name; None without any.
        severity: 0 without any.
        trials: Of all methods.
    """

    disturbance: str | None
    severity: float
    trials: list[Trial]


def plan(options: argparse.Namespace) -> tuple[list[Point], list[Weights]]:
    """The trials of the charts.

    Args:
        options: The command line.

    Returns:
        What to run, and the weights of the learned policies.

    Raises:
        ConfigError: See ``methods.check_methods``.
    """
    names = list(dict.fromkeys(options.method or table4.TABLE.methods))
    weights = methods.check_methods(names, options.weights, ())
    shipped = methods.shipped(names, weights)
    env = {"perception": options.perception, "renderer": "raycast"}
    seeds = range(options.seed, options.seed + options.trials)

    def point(name: str | None, severity: float) -> Point:
        acting = [] if name is None else [disturbance({"name": name, "severity": severity}).to_dict()]
        disturbed = {**env, "disturbances": acting}
        cells = (methods.cell(m, options.workpiece, seeds, disturbed, shipped[m]) for m in names)
        return Point(name, severity, [t for cell in cells for t in cell])

    chosen = list(dict.fromkeys(options.disturbance or NAMES))
    levels = sorted(set(options.severities))
    calm = [point(None, 0.0)] if 0.0 in levels else []
    return [*calm, *(point(name, s) for name in chosen for s in levels if s > 0)], weights


def run(points: list[Point], *, engine: Engine, log: Path) -> list[Row]:
    """Runs the plan.

    Args:
        points: The plan.
        engine: Where it runs.
        log: See ``trials.run_all``.

    Returns:
        One row a trial, with ``disturbance`` and ``severity``.
    """
    wanted = [t for p in points for t in p.trials]
    rows = trials.run_all(wanted, engine=engine, log=log, title="disturbed", together=trials.TOGETHER)
    under = [{"disturbance": p.disturbance, "severity": p.severity} for p in points for _ in p.trials]
    light = [{k: v for k, v in row.items() if k != "path_mm"} for row in rows]
    return [{**where, **row} for where, row in zip(under, light, strict=True)]


def write(ran: list[Row], weights: list[Weights], options: argparse.Namespace) -> str:
    """Writes the files.

    Args:
        ran: From ``run``.
        weights: Of the learned policies.
        options: The command line.

    Returns:
        The tables for people.
    """
    rows = severity_report.summarise(ran)
    environments, light = trials.shared(ran)
    results.write(
        options.out,
        NAME,
        rows,
        light,
        renderer=control_table.renderer(options),
        regime="one disturbance at a time",
        text=severity_report.markdown(rows, severity_figures.names(NAME, rows)),
        more={"policies": methods.record(weights), "environments": environments},
    )
    redraw(options.out)
    return severity_report.tables(rows, markdown=False)


def redraw(out: Path) -> None:
    """Draws the charts from the files.

    Args:
        out: Their folder.

    Raises:
        ConfigError: If there are none.
    """
    file = out / f"{NAME}.json"
    require(file.is_file(), f"{file} not found: run the experiment first")
    severity_figures.draw(out, json.loads(file.read_text(encoding="utf-8")))


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Reads the command line.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        The options.
    """
    parser = argparse.ArgumentParser(
        prog="python -m experiments.severity", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument(
        "--disturbance", action="append", choices=NAMES, help="may be repeated (default: all)"
    )
    parser.add_argument(
        "--severities",
        type=float,
        nargs="+",
        default=list(SEVERITIES),
        metavar="S",
        help="0 is off, 1 the default of the disturbance (default: 0 0.5 1 2 4)",
    )
    parser.add_argument(
        "--workpiece", default="cylinder", choices=catalogue.NAMES, help="(default: %(default)s)"
    )
    parser.add_argument("--trials", type=int, default=TRIALS, help="a point (default: %(default)s)")
    control_table.add_options(parser, NAME)
    return command.checked(parser, arguments, trials=1, jobs=1, seed=0)


def main(arguments: list[str] | None = None) -> int:
    """Makes the charts.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        Exit status: 0 if it ran to the end.
    """
    options = parse(arguments)
    try:
        if options.redraw:
            redraw(options.out)
            return 0
        points, weights = plan(options)
        options.out.mkdir(parents=True, exist_ok=True)
        results.log_run(NAME, "severity curves", options.seed + options.trials - 1)
        engine = engines.of(options, trials.code)
        ran = run(points, engine=engine, log=options.out / f"{NAME}.trials.jsonl")
        text = write(ran, weights, options)
    except SealGymError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    print(f"\n{text}\n\nwritten to {options.out}/")
    return 0


if __name__ == "__main__":
    sys.exit(main())
