"""Control tables: methods on parts, one trial a seed, in batches that are logged as they end.

What Tables 3 and 4 share; each says in a ``TableCfg`` what is its own. A table is NAME.json, .csv, .md,
NAME_paired.csv, NAME_paths.npz (the tip's path in the first trials of each cell) and figures.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import agents
from agents import engines
from agents.engines import Engine
from experiments import command, control_figures, control_report, methods, results, shapes, trials
from experiments.methods import METHODS, Weights
from experiments.trials import Row, Trial
from seal_gym.core.errors import SealGymError, require
from seal_gym.envs.config import PERCEPTIONS
from seal_gym.workpieces import catalogue

TRAINING_SEEDS = (0, 1, 2)
SHAPE_TRIALS = 25
PATHS = 5  # trials of a cell whose paths are kept and drawn


@dataclass(frozen=True, kw_only=True)
class TableCfg:
    """What one control table has of its own.

    Attributes:
        name: Of its files and its module.
        number: ``"Table N"``.
        title: What it is about.
        about: What a reader has to know before the numbers; Markdown.
        methods: Names of the policies, those of ``METHODS``.
        shapes: Names of the shapes that follow the nominal parts.
        regime: ``"static"`` or ``"dynamic"``.
        env: Keyword arguments of all its environments.
    """

    name: str
    number: str
    title: str
    about: str
    methods: tuple[str, ...]
    regime: str
    shapes: tuple[str, ...] = ()
    env: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Checks the names."""
        unknown = sorted({*self.methods} - {*METHODS} | {*self.shapes} - {*shapes.NAMES})
        require(
            not unknown,
            f"TableCfg of {self.name}: {unknown} unknown; methods are {sorted(METHODS)}, "
            f"shapes {list(shapes.NAMES)}",
        )
        require(
            self.regime in ("static", "dynamic"),
            f"TableCfg.regime = {self.regime!r}: must be 'static' or 'dynamic'",
        )


class Plan(NamedTuple):
    """What to run.

    Attributes:
        main: The shipped policies on the nominal parts.
        seeds: Every training seed on the nominal parts, the shipped ones among them.
        other: The shipped policies on the other shapes.
        weights: Of all learned policies.
    """

    main: list[Trial]
    seeds: list[Trial]
    other: list[Trial]
    weights: list[Weights]


def plan(table: TableCfg, options: argparse.Namespace) -> Plan:
    """The trials of a table.

    Args:
        table: The table.
        options: The command line.

    Returns:
        What to run.

    Raises:
        ConfigError: See ``methods.check_methods``.
    """
    names = list(dict.fromkeys(options.method or table.methods))
    weights = methods.check_methods(names, options.weights, options.training_seeds)
    env = {"perception": options.perception, "renderer": "raycast", **table.env}
    shipped = methods.shipped(names, weights)
    chosen = list(dict.fromkeys(options.workpiece or (*catalogue.NAMES, *table.shapes)))
    nominal, other = ([p for p in chosen if (p in catalogue.NAMES) is which] for which in (True, False))
    seeds = range(options.seed, options.seed + options.trials)
    shape_seeds = range(options.seed, options.seed + options.shape_trials)
    by_method = {
        m: sorted((w for w in weights if w.method == m), key=lambda w: w.training_seed) for m in names
    }
    return Plan(
        [t for m in names for p in nominal for t in methods.cell(m, p, seeds, env, shipped[m])],
        [
            t
            for m in names
            if len(by_method[m]) > 1
            for p in nominal
            for w in by_method[m]
            for t in methods.cell(m, p, seeds, env, w)
        ],
        [t for m in names for p in other for t in methods.cell(m, p, shape_seeds, env, shipped[m])],
        weights,
    )


def run(what: Plan, *, engine: Engine, log: Path) -> tuple[list[Row], list[Row], list[Row]]:
    """Runs the plan, each trial once.

    Args:
        what: The plan.
        engine: Where it runs.
        log: See ``trials.run_all``.

    Returns:
        Rows of ``main``, ``seeds`` and ``other``, with ``path_mm``.
    """
    groups = (what.main, what.seeds, what.other)
    wanted = {_identity(t): t for group in groups for t in group}
    rows = trials.run_all(wanted.values(), engine=engine, log=log, title="sealing", together=trials.TOGETHER)
    ran = dict(zip(wanted, rows, strict=True))
    main, seeds, other = ([ran[_identity(t)] for t in group] for group in groups)
    return main, seeds, other


def _identity(t: Trial) -> tuple[str, int | None, str, int]:
    return t.method, t.training_seed, t.workpiece, t.seed


def first_paths(rows: Sequence[Row]) -> dict[str, Any]:
    """The tip's paths in the first trials of each cell.

    Args:
        rows: Of trials, with ``path_mm``.

    Returns:
        By ``method/workpiece/seed``, shape (samples, 3), mm, float32.
    """
    out: dict[str, Any] = {}
    seen: dict[tuple[str, str], int] = {}
    for row in rows:
        cell = (row["method"], row["workpiece"])
        seen[cell] = seen.get(cell, 0) + 1
        if seen[cell] <= PATHS:
            out[control_figures.path_name(row)] = np.asarray(row["path_mm"], dtype=np.float32)
    return out


def write(
    table: TableCfg,
    what: Plan,
    ran: tuple[list[Row], list[Row], list[Row]],
    options: argparse.Namespace,
) -> str:
    """Writes the files.

    Args:
        table: The table.
        what: The plan.
        ran: From ``run``.
        options: The command line.

    Returns:
        The main table for people.
    """
    main, seeds, other = ran
    out: Path = options.out
    rows = control_report.summarise(main, seeds, other)
    spreads = control_report.spread(rows)
    pairs = control_report.paired([*main, *other])
    shipped = {(row["method"], row["training_seed"]) for row in main}
    seeds_alone = [row for row in seeds if (row["method"], row["training_seed"]) not in shipped]
    all_rows = [{k: v for k, v in row.items() if k != "path_mm"} for row in (*main, *seeds_alone, *other)]
    environments, light = trials.shared(all_rows)
    np.savez_compressed(out / f"{table.name}_paths.npz", **first_paths([*main, *other]))
    head = f"# {table.number}: {table.title}\n\n{table.about}"
    pictures = control_figures.names(table.name, rows)
    results.write(
        out,
        table.name,
        rows,
        light,
        renderer=renderer(options),
        regime=table.regime,
        text=control_report.markdown(head, rows, spreads, pairs, pictures),
        more={
            "paired": pairs,
            "spread": spreads,
            "policies": methods.record(what.weights),
            "environments": environments,
        },
    )
    if pairs:
        results.write_csv(out / f"{table.name}_paired.csv", pairs)
    redraw(table.name, out)
    return results.table(control_report.of_table(rows, "main") or rows)


def renderer(options: argparse.Namespace) -> str:
    """What drew the sensor images, as a table's JSON says it.

    Args:
        options: The command line.

    Returns:
        ``"raycast"``, or ``"none"`` by oracle features.
    """
    return "raycast" if options.perception == "vision" else "none"


def redraw(name: str, out: Path) -> None:
    """Draws the figures of a table from its files.

    Args:
        name: Of the table.
        out: Its folder.

    Raises:
        ConfigError: If there is no table.
    """
    file, paths = out / f"{name}.json", out / f"{name}_paths.npz"
    require(file.is_file() and paths.is_file(), f"{file} or {paths.name} not found: run the table first")
    with np.load(paths, allow_pickle=False) as arrays:
        control_figures.draw(out, json.loads(file.read_text(encoding="utf-8")), arrays)


def parse(table: TableCfg, arguments: list[str] | None = None) -> argparse.Namespace:
    """Reads the command line of a table.

    Args:
        table: The table.
        arguments: Without the program's name; the process's own by default.

    Returns:
        The options.
    """
    parser = argparse.ArgumentParser(
        prog=f"python -m experiments.{table.name}", description=f"{table.number}: {table.title}."
    )
    parser.add_argument(
        "--workpiece",
        action="append",
        choices=(*catalogue.NAMES, *table.shapes),
        help=f"a nominal part{' or a shape' if table.shapes else ''}; may be repeated (default: all)",
    )
    parser.add_argument("--trials", type=int, default=1, help="a nominal part (default: %(default)s)")
    if table.shapes:
        parser.add_argument(
            "--shape-trials", type=int, help=f"a shape (default: as --trials, at most {SHAPE_TRIALS})"
        )
    parser.add_argument(
        "--training-seeds",
        type=int,
        nargs="*",
        default=list(TRAINING_SEEDS),
        metavar="S",
        help="that get rows of their own beside the shipped one (default: 0 1 2)",
    )
    add_options(parser, table.name)
    options = command.checked(parser, arguments, trials=1, jobs=1, seed=0)
    if getattr(options, "shape_trials", None) is None:
        options.shape_trials = min(options.trials, SHAPE_TRIALS)
    if options.shape_trials < 1:
        parser.error(f"--shape-trials {options.shape_trials}: must be at least 1")
    return options


def add_options(parser: argparse.ArgumentParser, name: str) -> None:
    """Adds what all experiments on control take.

    Args:
        parser: To add to.
        name: Of the experiment.
    """
    parser.add_argument(
        "--method",
        action="append",
        choices=sorted({*METHODS, *agents.POLICIES}),
        help="may be repeated (default: all of the table)",
    )
    parser.add_argument("--seed", type=int, default=500_000, help="of the first trial (default: %(default)s)")
    parser.add_argument(
        "--weights", type=Path, default=agents.WEIGHTS, help="folder of the weights (default: the shipped)"
    )
    parser.add_argument("--perception", default=PERCEPTIONS[0], choices=PERCEPTIONS)
    parser.add_argument("--jobs", type=int, default=1, help="processes (default: %(default)s)")
    engines.add_options(parser)
    parser.add_argument("--out", type=Path, default=Path("out") / name, help="folder (default: %(default)s)")
    parser.add_argument("--redraw", action="store_true", help="draw the figures of a table in OUT again")


def main(table: TableCfg, arguments: list[str] | None = None) -> int:
    """Makes a table.

    Args:
        table: The table.
        arguments: Without the program's name; the process's own by default.

    Returns:
        Exit status: 0 if it ran to the end.
    """
    options = parse(table, arguments)
    try:
        if options.redraw:
            redraw(table.name, options.out)
            return 0
        what = plan(table, options)
        options.out.mkdir(parents=True, exist_ok=True)
        last = options.seed + max(options.trials, options.shape_trials) - 1
        results.log_run(table.name, table.number, last)
        engine = engines.of(options, trials.code)
        ran = run(what, engine=engine, log=options.out / f"{table.name}.trials.jsonl")
        text = write(table, what, ran, options)
    except SealGymError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    print(f"\n{text}\n\nwritten to {options.out}/")
    return 0
