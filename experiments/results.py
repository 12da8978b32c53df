"""Rows with intervals, and the files every table is written to."""

import csv
import json
import shlex
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

import seal_gym

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
    "torch",
    "stable-baselines3",
)
_BOOTSTRAPS = 2000


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
    """One row for each method and workpiece, in order of first appearance.

    Args:
        trials: Rows of ``trials.run``.

    Returns:
        Rows as protocol.md names them.
    """
    cells: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for trial in trials:
        cells.setdefault((trial["method"], trial["workpiece"]), []).append(trial)
    rows = []
    for (method, part), cell in cells.items():
        row: dict[str, Any] = {
            "method": method,
            "workpiece": part,
            "trials": len(cell),
            "seed0": min(t["seed"] for t in cell),
            "training_seed": cell[0]["training_seed"],
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
    found = {"python": sys.version.split()[0]}
    for name in _STACK[1:]:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def commit() -> str | None:
    """Hash of the checkout's commit.

    Returns:
        The hash, None outside a repository.
    """
    root = Path(__file__).resolve().parents[1]
    run = subprocess.run(
        ["git", "-C", str(root), "rev-parse", "HEAD"], capture_output=True, text=True, check=False
    )
    return run.stdout.strip() if run.returncode == 0 else None


def write(
    out: Path,
    name: str,
    rows: list[dict[str, Any]],
    trials: list[dict[str, Any]],
    *,
    renderer: str,
    regime: str,
    text: str | None = None,
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
    """
    arguments = [a for a in sys.argv[1:]]
    document = {
        "name": name,
        "version": seal_gym.__version__,
        "command": shlex.join(["python", "-m", f"experiments.{name}", *arguments]),
        "git_commit": commit(),
        "stack": stack(),
        "renderer": renderer,
        "regime": regime,
        "rows": rows,
        "trials": trials,
    }
    (out / f"{name}.json").write_text(document_text(document), encoding="utf-8")
    with (out / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    (out / f"{name}.md").write_text((text or table(rows, markdown=True)) + "\n", encoding="utf-8")


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


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _with_interval(row: dict[str, Any], key: str, digits: int) -> str:
    text = _number(row[key], digits)
    interval = row[f"{key.removesuffix('_pct')}_ci" if key.endswith("_pct") else f"{key}_ci"]
    return text if interval is None else f"{text} [{interval[0]:.{digits}f}, {interval[1]:.{digits}f}]"


def table(rows: list[dict[str, Any]], *, markdown: bool = False) -> str:
    """The control table for people.

    Args:
        rows: From ``summarise``.
        markdown: With Markdown's rules.

    Returns:
        Text.
    """
    head = [
        "method",
        "workpiece",
        "trials",
        "reached %",
        "collision %",
        "timeout %",
        "RMSE mm",
        "coverage %",
        "time s",
    ]
    body = [
        [
            row["method"],
            row["workpiece"],
            str(row["trials"]),
            _with_interval(row, "reached_pct", 1),
            _with_interval(row, "collision_pct", 1),
            _with_interval(row, "timeout_pct", 1),
            _with_interval(row, "rmse_mm", 4),
            _number(row["coverage_pct"], 1),
            _with_interval(row, "time_s", 2),
        ]
        for row in rows
    ]
    widths = [max(len(line[k]) for line in [head, *body]) for k in range(len(head))]
    rule = ["-" * w for w in widths]
    left, between, right = ("| ", " | ", " |") if markdown else ("", "  ", "")
    return "\n".join(
        left + between.join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)) + right
        for line in [head, rule, *body]
    )
