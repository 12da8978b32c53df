"""Rows of control tables: intervals, the spread of training seeds, paired differences; and their Markdown."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from scipy import stats

from experiments import results, shapes
from experiments.methods import BASE, METHODS
from seal_gym.core.errors import SealGymError, require

Row = dict[str, Any]


def summarise(main: Sequence[Row], seeds: Sequence[Row], other: Sequence[Row]) -> list[Row]:
    """The rows of the three tables, one below the other.

    Args:
        main: Trials of the shipped policies on the nominal parts.
        seeds: Trials of every training seed on the nominal parts, the shipped ones' among them.
        other: Trials of the shipped policies on the other shapes.

    Returns:
        Rows as protocol.md names them; ``table`` is ``main``, ``training_seeds`` or ``generalisation``.
    """
    tables = {"main": main, "training_seeds": seeds, "generalisation": other}
    return [
        {"table": name, **row} for name, trials in tables.items() for row in results.summarise(list(trials))
    ]


def of_table(rows: Iterable[Row], name: str) -> list[Row]:
    """The rows of one table.

    Args:
        rows: From ``summarise``.
        name: Of the table.

    Returns:
        Its rows.
    """
    return [row for row in rows if row["table"] == name]


def spread(rows: Sequence[Row]) -> list[Row]:
    """How far the training seeds lie apart, beside the interval over the shipped seed's trials.

    Args:
        rows: From ``summarise``.

    Returns:
        For each method and workpiece of the training seeds' table: smallest, largest and standard deviation
        (of the sample) of the seeds' means; None where fewer than two seeds have one.
    """
    shipped = {(r["method"], r["workpiece"]): r for r in of_table(rows, "main")}
    cells: dict[tuple[str, str], list[Row]] = {}
    for row in of_table(rows, "training_seeds"):
        cells.setdefault((row["method"], row["workpiece"]), []).append(row)
    out = []
    for (method, part), cell in cells.items():
        ours = shipped[method, part]
        line: Row = {
            "method": method,
            "workpiece": part,
            "training_seeds": [r["training_seed"] for r in cell],
            "shipped": ours["training_seed"],
        }
        for key, interval in (("reached_pct", "reached_ci"), ("rmse_mm", "rmse_mm_ci")):
            values = [r[key] for r in cell if r[key] is not None]
            enough = len(values) > 1
            line |= {
                key: ours[key],
                interval: ours[interval],
                f"{key}_min": min(values) if enough else None,
                f"{key}_max": max(values) if enough else None,
                f"{key}_sd": float(np.std(values, ddof=1)) if enough else None,
            }
        out.append(line)
    return out


def mcnemar(only_first: int, only_second: int) -> float:
    """Exact two-sided McNemar test: is it chance which of two methods succeeds where one alone does?

    Args:
        only_first: Pairs in which the first alone succeeded.
        only_second: Pairs in which the second alone did.

    Returns:
        The p value; 1 if they never differ.
    """
    n = only_first + only_second
    return float(stats.binomtest(only_first, n, 0.5).pvalue) if n else 1.0


def paired(trials: Sequence[Row], base: str = BASE) -> list[Row]:
    """Differences of each method from one of them on the same seeds.

    Args:
        trials: Of one training seed a method.
        base: The method to compare with.

    Returns:
        One row for each other method and workpiece, differences are the method's less ``base``'s: of the
        reached share [points] with bootstrap interval and McNemar's exact test; of ``rmse_mm`` over the
        seeds on which both reached, with bootstrap interval. Empty without ``base``.

    Raises:
        SealGymError: If two methods were not run on the same seeds.
    """
    cells: dict[tuple[str, str], dict[int, Row]] = {}
    for t in trials:
        cells.setdefault((t["method"], t["workpiece"]), {})[t["seed"]] = t
    out = []
    for (method, part), mine in cells.items():
        theirs = cells.get((base, part))
        if method == base or theirs is None:
            continue
        require(set(mine) == set(theirs), f"{method} and {base} differ in seeds on {part}", SealGymError)
        pairs = [(mine[seed], theirs[seed]) for seed in sorted(mine)]
        both = [(a, b) for a, b in pairs if a["reached"] and b["reached"]]
        only = [sum(a["reached"] > b["reached"] for a, b in way) for way in (pairs, [p[::-1] for p in pairs])]
        reached = [100.0 * (float(a["reached"]) - float(b["reached"])) for a, b in pairs]
        rmse = [a["rmse_mm"] - b["rmse_mm"] for a, b in both]
        out.append(
            {
                "method": method,
                "against": base,
                "workpiece": part,
                "pairs": len(pairs),
                "reached_diff_pct": float(np.mean(reached)),
                "reached_diff_ci": results.bootstrap(reached),
                "only_method": only[0],
                "only_against": only[1],
                "mcnemar_p": mcnemar(*only),
                "both_reached": len(both),
                "rmse_diff_mm": float(np.mean(rmse)) if rmse else None,
                "rmse_diff_mm_ci": results.bootstrap(rmse),
            }
        )
    return out


# -- for people -------------------------------------------------------------------------------------------


def markdown(
    head: str, rows: Sequence[Row], spreads: Sequence[Row], pairs: Sequence[Row], pictures: Sequence[str]
) -> str:
    """The table for people.

    Args:
        head: Its title and what it is about.
        rows: From ``summarise``.
        spreads: From ``spread``.
        pairs: From ``paired``.
        pictures: Files beside the table.

    Returns:
        Markdown.
    """
    methods = list(dict.fromkeys(row["method"] for row in rows))
    parts = [head]
    parts.append("\n".join(f"- `{m}`: {METHODS[m]}" for m in methods if m in METHODS))
    parts.append(
        "In brackets 95 % intervals over the trials: Wilson's for the rates, bootstrap for the others. RMSE "
        "and time are over the trials that reached the end. Every method sees the same trial seeds."
    )
    main, seeds, other = (of_table(rows, name) for name in ("main", "training_seeds", "generalisation"))
    if main:
        parts += ["## Nominal parts, the shipped training seed", results.table(main, markdown=True)]
    if seeds:
        parts += ["## Every training seed", results.table(seeds, markdown=True)]
    if spreads:
        parts += [
            "## Spread between the training seeds",
            "Beside the shipped seed's mean and its interval over the trials: the smallest and the largest "
            "of the seeds' means, and their standard deviation.",
            _spread_table(spreads),
        ]
    nominal = {row["workpiece"] for row in main}
    for title, chosen in (
        ("nominal parts", [p for p in pairs if p["workpiece"] in nominal]),
        ("other shapes", [p for p in pairs if p["workpiece"] not in nominal]),
    ):
        if chosen:
            parts += [
                f"## Paired differences from `{chosen[0]['against']}`, {title}",
                "The method's less the other's, on the same seeds; p is McNemar's exact test of the reached "
                "share; RMSE over the seeds on which both reached the end.",
                _paired_table(chosen),
            ]
    if other:
        parts += [
            "## Generalisation: seams of other shape",
            "Trials that reached the end, of all; below, their mean RMSE in mm. Intervals: see the CSV file.",
            _shape_table(other),
        ]
    if pictures:
        parts += ["## Figures", "\n\n".join(f"![{name}]({name})" for name in pictures)]
    return "\n\n".join(part for part in parts if part)


def _range(line: Row, key: str, digits: int) -> str:
    if line[f"{key}_sd"] is None:
        return "-"
    low, high = (results.number(line[f"{key}_{end}"], digits) for end in ("min", "max"))
    return f"{low}..{high}, sd {results.number(line[f'{key}_sd'], digits)}"


def _spread_table(lines: Sequence[Row]) -> str:
    head = ["method", "workpiece", "seeds", "reached %", "between seeds", "RMSE mm", "between seeds"]
    body = [
        [
            line["method"],
            line["workpiece"],
            ", ".join(map(str, line["training_seeds"])),
            results.with_interval(line, "reached_pct", 1),
            _range(line, "reached_pct", 1),
            results.with_interval(line, "rmse_mm", 4),
            _range(line, "rmse_mm", 4),
        ]
        for line in lines
    ]
    return results.grid(head, body)


def _signed(row: Row, key: str, digits: int) -> str:
    """A difference with its interval, the sign always shown."""
    value, interval = row[key], row[f"{key.removesuffix('_pct')}_ci"]
    if value is None:
        return "-"
    text = f"{value:+.{digits}f}"
    return text if interval is None else f"{text} [{interval[0]:+.{digits}f}, {interval[1]:+.{digits}f}]"


def _paired_table(rows: Sequence[Row]) -> str:
    head = ["method", "workpiece", "pairs", "reached, points", "only it / only the other", "p"]
    head += ["both reached", "RMSE, mm"]
    body = [
        [
            row["method"],
            row["workpiece"],
            str(row["pairs"]),
            _signed(row, "reached_diff_pct", 1),
            f"{row['only_method']} / {row['only_against']}",
            f"{row['mcnemar_p']:.2g}",
            str(row["both_reached"]),
            _signed(row, "rmse_diff_mm", 4),
        ]
        for row in rows
    ]
    return results.grid(head, body)


def _shape_table(rows: Sequence[Row]) -> str:
    methods = list(dict.fromkeys(row["method"] for row in rows))
    cells = {(row["method"], row["workpiece"]): row for row in rows}
    body = []
    for shape in dict.fromkeys(row["workpiece"] for row in rows):
        here = [cells[m, shape] for m in methods]
        reached = [f"{round(r['trials'] * r['reached_pct'] / 100)} of {r['trials']}" for r in here]
        body.append([shapes.TITLES[shape], *reached])
        body.append(["", *(results.number(r["rmse_mm"], 4) for r in here)])
    return results.grid(["shape", *methods], body)
