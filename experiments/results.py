"""Rows with intervals, and the files every table is written to."""

import csv
import json
import shlex
import subprocess
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

import seal_gym
from agents.provenance import commit
from seal_gym.core.provenance import versions

_STACK = (
    "python",
    "seal-gym",
    "gymnasium",
    "mujoco",
    "numpy",
    "numba",
    "scipy",
    "opencv-python-headless",
    "filterpy",
    "scikit-image",
    "casadi",
    "toppra",
    "torch",
    "stable-baselines3",
)
_BOOTSTRAPS = 2000
FIRST_PUBLISHED_SEED = 1_000_000  # protocol.md: each run on these is logged
LOG = Path(__file__).resolve().parent / "results" / "LOG.md"
_LOG_HEAD = (
    "# Runs on the seeds of published tables\n\n"
    "Tuning and model choice use other seeds; these (1,000,000 on) are run once a release.\n\n"
    "| date | commit | command | tables |\n| --- | --- | --- | --- |\n"
)


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a rate.

    Args:
        successes: Count.
        trials: Count, >= 1.

    Returns:
        Lower and upper end [%].
    """
    interval = stats.binomtest(successes, trials).proportion_ci(confidence_level=0.95, method="wilson")
    return 100.0 * float(interval.low), 100.0 * float(interval.high)


def bootstrap(values: list[float]) -> tuple[float, float] | None:
    """Bootstrap 95 % interval of a mean (percentile method, fixed seed).

    Args:
        values: One a trial.

    Returns:
        Lower and upper end; None with fewer than two values.
    """
    if len(values) < 2:
        return None
    rng = np.random.default_rng(0)
    sample = np.asarray(values)
    means = sample[rng.integers(0, len(sample), (_BOOTSTRAPS, len(sample)))].mean(axis=1)
    low, high = np.percentile(means, (2.5, 97.5))
    return float(low), float(high)


def _mean(values: list[float]) -> float | None:
    return float(np.mean(values)) if values else None


def summarise(trials: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row for each method, training seed and workpiece, in order of first appearance.

    Args:
        trials: Rows of ``trials.run``.

    Returns:
        Rows as protocol.md names them.
    """
    cells: dict[tuple[str, str, int | None], list[dict[str, Any]]] = {}
    for trial in trials:
        cell_of = (trial["method"], trial["workpiece"], trial["training_seed"])
        cells.setdefault(cell_of, []).append(trial)
    rows = []
    for (method, part, training_seed), cell in cells.items():
        row: dict[str, Any] = {
            "method": method,
            "workpiece": part,
            "trials": len(cell),
            "seed0": min(t["seed"] for t in cell),
            "training_seed": training_seed,
        }
        for name in ("reached", "collision", "timeout"):
            count = sum(bool(t[name]) for t in cell)
            row[f"{name}_pct"] = 100.0 * count / len(cell)
            row[f"{name}_ci"] = wilson(count, len(cell))
        reached = [t for t in cell if t["reached"]]
        for key, source, chosen in (
            ("rmse_mm", "rmse_mm", reached),
            ("rmse_all_mm", "rmse_mm", cell),
            ("rmse_whole_mm", "rmse_whole_mm", reached),
            ("coverage_pct", "coverage_pct", reached),
            ("time_s", "time_s", reached),
        ):
            values = [t[source] for t in chosen if t[source] is not None]
            row[key] = _mean(values)
            if key in ("rmse_mm", "rmse_all_mm", "time_s"):
                row[f"{key}_ci"] = bootstrap(values)
        rows.append(row)
    return rows


def stack() -> dict[str, str]:
    """Versions of what decides a result.

    Returns:
        Version by package.
    """
    return versions(_STACK)


def dirty() -> bool:
    """Whether tracked files of the checkout differ from its commit.

    Returns:
        False outside a repository too.
    """
    root = Path(__file__).resolve().parents[1]
    run = subprocess.run(
        ["git", "-C", str(root), "status", "--porcelain", "--untracked-files=no"],
        capture_output=True,
        text=True,
        check=False,
    )
    return run.returncode == 0 and bool(run.stdout.strip())


def command(name: str) -> str:
    """The command line of this process.

    Args:
        name: Of the experiment.

    Returns:
        For a shell.
    """
    return shlex.join(["python", "-m", f"experiments.{name}", *sys.argv[1:]])


def log_run(name: str, tables: str, last_seed: int) -> None:
    """Notes a run on the seeds of published tables in ``LOG``; others it passes over.

    Args:
        name: Of the experiment.
        tables: That the run makes.
        last_seed: The largest of its seeds.
    """
    if last_seed < FIRST_PUBLISHED_SEED:
        return
    LOG.parent.mkdir(parents=True, exist_ok=True)
    text = LOG.read_text(encoding="utf-8") if LOG.exists() else _LOG_HEAD
    where = f"{commit() or 'no repository'}{' with changes' if dirty() else ''}"
    line = f"| {datetime.now(UTC):%Y-%m-%d %H:%M} UTC | {where} | `{command(name)}` | {tables} |\n"
    LOG.write_text(text + line, encoding="utf-8")


def write(
    out: Path,
    name: str,
    rows: list[dict[str, Any]],
    trials: list[dict[str, Any]],
    *,
    renderer: str,
    regime: str,
    text: str | None = None,
    more: Mapping[str, Any] | None = None,
    module: str | None = None,
) -> None:
    """Writes ``<name>.json``, ``.csv`` and ``.md``.

    Args:
        out: The folder.
        name: Of the table.
        rows: The table.
        trials: What it was made from.
        renderer: Of the sensor images, or ``"none"`` with oracle features.
        regime: ``"static"`` or ``"dynamic"``.
        text: Markdown for people; by default ``table`` of the rows, which are then a control table's.
        more: Further entries of the JSON, before the trials.
        module: Of the experiment, if it has another name than the table.
    """
    document = {
        "name": name,
        "version": seal_gym.__version__,
        "command": command(module or name),
        "git_commit": commit(),
        "stack": stack(),
        "renderer": renderer,
        "regime": regime,
        "rows": rows,
        **(more or {}),
        "trials": trials,
    }
    (out / f"{name}.json").write_text(document_text(document), encoding="utf-8")
    write_csv(out / f"{name}.csv", rows)
    (out / f"{name}.md").write_text((text or table(rows, markdown=True)) + "\n", encoding="utf-8")


def write_csv(path: Path, rows: list[dict[str, Any]]) -> None:
    """Writes rows with the columns of the first.

    Args:
        path: The file.
        rows: At least one.
    """
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def document_text(document: dict[str, Any]) -> str:
    """JSON with a line for each key, row and trial, so that changes can be read as a diff.

    Args:
        document: What to write.

    Returns:
        The text.
    """
    parts = []
    for key, value in document.items():
        if isinstance(value, list):
            lines = ",\n  ".join(json.dumps(item) for item in value)
            parts.append(f" {json.dumps(key)}: [\n  {lines}\n ]")
        else:
            parts.append(f" {json.dumps(key)}: {json.dumps(value)}")
    return "{\n" + ",\n".join(parts) + "\n}\n"


def number(value: float | None, digits: int) -> str:
    """A number for people.

    Args:
        value: The number.
        digits: After the point.

    Returns:
        Text, ``-`` for None.
    """
    return "-" if value is None else f"{value:.{digits}f}"


def with_interval(row: dict[str, Any], key: str, digits: int) -> str:
    """A number of a row with its interval.

    Args:
        row: From ``summarise``, or with entries named likewise.
        key: Of the number; its interval is ``<key>_ci``, without ``_pct``.
        digits: After the point.

    Returns:
        Text.
    """
    text = number(row[key], digits)
    interval = row[f"{key.removesuffix('_pct')}_ci"]
    return text if interval is None else f"{text} [{interval[0]:.{digits}f}, {interval[1]:.{digits}f}]"


def table(rows: list[dict[str, Any]], *, markdown: bool = False) -> str:
    """The control table for people.

    Args:
        rows: From ``summarise``.
        markdown: With Markdown's rules.

    Returns:
        Text.
    """
    seeds = any(row["training_seed"] is not None for row in rows)
    head = ["method", *(["training seed"] if seeds else []), "workpiece", "trials"]
    head += ["reached %", "collision %", "timeout %", "RMSE mm", "coverage %", "time s"]
    body = [
        [
            row["method"],
            *([number(row["training_seed"], 0)] if seeds else []),
            row["workpiece"],
            str(row["trials"]),
            with_interval(row, "reached_pct", 1),
            with_interval(row, "collision_pct", 1),
            with_interval(row, "timeout_pct", 1),
            with_interval(row, "rmse_mm", 4),
            number(row["coverage_pct"], 1),
            with_interval(row, "time_s", 2),
        ]
        for row in rows
    ]
    return grid(head, body, markdown=markdown)


def grid(head: list[str], body: list[list[str]], *, markdown: bool = True) -> str:
    """Cells in columns.

    Args:
        head: Titles of the columns.
        body: Rows of cells.
        markdown: With Markdown's rules.

    Returns:
        Text.
    """
    widths = [max(len(line[k]) for line in [head, *body]) for k in range(len(head))]
    rule = ["-" * w for w in widths]
    left, between, right = ("| ", " | ", " |") if markdown else ("", "  ", "")
    return "\n".join(
        left + between.join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)) + right
        for line in [head, rule, *body]
    )
