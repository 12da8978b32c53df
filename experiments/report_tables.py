"""The rows of a result as tables to show: columns in words, numbers with their intervals."""

import math
from typing import Any, NamedTuple

Row = dict[str, Any]


class Cell(NamedTuple):
    """One place of a table.

    Attributes:
        text: As shown.
        value: The number behind it in full, None for text.
        interval: Its interval as shown, empty without one.
    """

    text: str
    value: float | None = None
    interval: str = ""


class Column(NamedTuple):
    """One column.

    Attributes:
        label: Heading.
        key: Key of the glossary, to explain it.
        numeric: Whether it is aligned to the right.
    """

    label: str
    key: str
    numeric: bool


class Table(NamedTuple):
    """A table ready to show.

    Attributes:
        caption: What it shows.
        columns: Its columns.
        rows: Cells by row.
        heads: How many leading columns name the row.
        open: Whether it is shown at once or on request.
    """

    caption: str
    columns: list[Column]
    rows: list[list[Cell]]
    heads: int
    open: bool = True


class Term(NamedTuple):
    """A quantity in the tables.

    Attributes:
        label: Heading of its column.
        text: What it means.
        digits: Digits after the point; None: four significant digits.
    """

    label: str
    text: str
    digits: int | None = None


GLOSSARY = {
    "trials": Term("trials", "Episodes in the row, each with its own seed.", 0),
    "reached_pct": Term(
        "reached %",
        "Episodes in which the nozzle passed the seam's end within 5 mm of the desired path, having visited "
        "at least 95 % of it within 5 mm. With Wilson's 95 % interval.",
        1,
    ),
    "collision_pct": Term(
        "collision %",
        "Episodes that ended with a contact of gun, arm or cameras with the part, the table or each other.",
        1,
    ),
    "timeout_pct": Term(
        "timeout %",
        "The rest: more than 25 mm off the path (lost), or three times the nominal time without an end. "
        "Reached, collision and timeout add up to 100 %.",
        1,
    ),
    "rmse_mm": Term(
        "RMSE mm",
        "Root mean square distance from the nozzle's mouth to the desired path, where the part is at that "
        "moment, from 10 mm of travel on, averaged over the episodes that reached. With a bootstrap 95 % "
        "interval.",
        4,
    ),
    "rmse_all_mm": Term("RMSE, all trials mm", "The same over all episodes, whatever their outcome.", 4),
    "rmse_whole_mm": Term("RMSE, whole run mm", "The same from the first step on, the approach included.", 3),
    "coverage_pct": Term("coverage %", "Share of the seam passed within 1 mm.", 1),
    "time_s": Term("time s", "Simulated time of the episodes that reached.", 2),
    "training_seed": Term("training seed", "Seed that the learned weights were trained with.", 0),
    "availability_pct": Term("frames with a line %", "Frames in which the method gave a line.", 1),
    "d_attr": Term(
        "distance px",
        "Attraction distance: from the nozzle's mouth to the seam line in the image, across the travel. The "
        "error against the true seam's tangent, root mean square.",
        2,
    ),
    "theta": Term("angle deg", "Angle of the seam line in the image; its error likewise.", 2),
    "d_tip": Term("distance mm", "The attraction distance in the frame of the nozzle.", 3),
    "theta_tip": Term("angle, tip frame deg", "The angle in the frame of the nozzle.", 2),
    "failed_pct": Term("failed %", "Frames without a line, or with one more than 3 px or 10 deg off.", 1),
    "offset_px": Term("offset px", "Distance of the line from the true one at the nozzle, median.", 3),
    "angle_deg": Term("angle deg", "Angle between the line and the true one, median.", 3),
    "line": Term(
        "line",
        "How the line is read. Raw: fitted to the edge pixels by RANSAC. Refined: through edges found to a "
        "fraction of a pixel, with a curve at the nozzle. Kalman: either, followed over time by a filter. "
        "Tracker: refined edges kept in the world as a memory of the seam; what the environments use.",
    ),
    "steps_to_goal": Term(
        "steps to goal", "Training steps until 90 % of the episodes reached with an RMSE of at most 1 mm.", 0
    ),
    "seed0": Term("first seed", "Seed of the first episode; the others count up from it.", 0),
}
_LABELS = {"workpiece": "part", "snr_db": "SNR dB", "level_db": "SNR level dB"}
_WORDS = {True: "yes", False: "no", None: "-"}
_CONTROL = (
    "reached_pct",
    "collision_pct",
    "timeout_pct",
    "rmse_mm",
    "rmse_all_mm",
    "rmse_whole_mm",
    "coverage_pct",
    "time_s",
)
# Beyond this many rows a table is split by its first column with few values.
_LONG, _FEW, _OPEN = 200, 12, 40


def is_number(value: object) -> bool:
    """Whether a value is a finite number.

    Args:
        value: From JSON.

    Returns:
        True for int and float, not for bool.
    """
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def number(value: float, digits: int | None) -> str:
    """A number for people.

    Args:
        value: The number.
        digits: After the point; None: four significant digits.

    Returns:
        Text.
    """
    if digits is not None:
        return f"{value:.{digits}f}"
    if isinstance(value, int):
        return str(value)
    if value != 0 and not 1e-4 <= abs(value) < 1e6:
        return f"{value:.2e}"
    return f"{value:.4g}" if abs(value) < 1e3 else f"{value:.0f}"


def interval_of(row: Row, key: str) -> tuple[float, float] | None:
    """The interval beside a number: ``rmse_mm_ci`` of ``rmse_mm``, ``reached_ci`` of ``reached_pct``.

    Args:
        row: Of a result.
        key: Of the number.

    Returns:
        Lower and upper end, None without one.
    """
    for name in (f"{key}_ci", f"{key.removesuffix('_pct')}_ci"):
        found = row.get(name)
        if isinstance(found, list | tuple) and len(found) == 2 and all(map(is_number, found)):
            return float(found[0]), float(found[1])
    return None


def label(key: str) -> str:
    """A column's heading.

    Args:
        key: Of the rows.

    Returns:
        The glossary's words, or the key with spaces and a unit sign.
    """
    if key in GLOSSARY:
        return GLOSSARY[key].label
    return _LABELS.get(key) or key.replace("_pct", " %").replace("_", " ")


def text_of(value: object) -> str:
    """A value that is no number.

    Args:
        value: From JSON.

    Returns:
        Text; the items of a dict or list separated by commas.
    """
    if isinstance(value, dict):
        return ", ".join(f"{k} {text_of(v)}" for k, v in value.items())
    if isinstance(value, list):
        return ", ".join(map(text_of, value))
    if value is None or isinstance(value, bool):
        return _WORDS[value]
    return number(value, None) if isinstance(value, int | float) else str(value)


def cell(row: Row, key: str, *, glossary_key: str | None = None) -> Cell:
    """One value with its interval.

    Args:
        row: Of a result.
        key: Of the value.
        glossary_key: Whose digits to show, by default the key's.

    Returns:
        The cell.
    """
    value = row.get(key)
    if value is None or not is_number(value):
        return Cell(text_of(value))
    term = GLOSSARY.get(glossary_key or key)
    digits = term.digits if term else None
    ends = interval_of(row, key)
    shown = "" if ends is None else f"[{number(ends[0], digits)}, {number(ends[1], digits)}]"
    return Cell(number(value, digits), value, shown)


def is_control(rows: list[Row]) -> bool:
    """Whether rows are those of a control table.

    Args:
        rows: Of a result.

    Returns:
        True if each names a method, a part and how many reached.
    """
    return bool(rows) and all({"method", "workpiece", "reached_pct"} <= row.keys() for row in rows)


def is_features(rows: list[Row]) -> bool:
    """Whether rows are those of a table of feature errors (Table 2).

    Args:
        rows: Of a result.

    Returns:
        True if each names view, feature and edge method.
    """
    return bool(rows) and all({"workpiece", "view", "feature", "edge", "rmse"} <= row.keys() for row in rows)


def control_keys(rows: list[Row]) -> list[str]:
    """The columns that tell rows of a control table apart, such as a disturbance and its severity.

    Args:
        rows: Of a control table.

    Returns:
        Keys, workpiece and method first.
    """
    numbers = {*_CONTROL, "trials", "seed0"}
    keys = [k for k in dict.fromkeys(k for row in rows for k in row) if not k.endswith("_ci")]
    extra = [k for k in keys if k not in {*numbers, "workpiece", "method"} and _varies(rows, k)]
    return ["workpiece", "method", *(k for k in extra if not _is_measure(k, rows))]


def _is_measure(key: str, rows: list[Row]) -> bool:
    return any(isinstance(row.get(key), float) for row in rows) and key != "severity"


def _varies(rows: list[Row], key: str) -> bool:
    return len({repr(row.get(key)) for row in rows}) > 1


def _table(
    caption: str, rows: list[Row], heads: list[str], keys: list[str], *, shown: bool | None = None
) -> Table:
    names = [*heads, *keys]
    numeric = [k not in heads and any(is_number(r.get(k)) for r in rows) for k in names]
    return Table(
        caption,
        [Column(label(k), k, n) for k, n in zip(names, numeric, strict=True)],
        [[cell(row, k) for k in names] for row in rows],
        len(heads),
        len(rows) <= _OPEN if shown is None else shown,
    )


def control_tables(rows: list[Row]) -> list[Table]:
    """A control table: a row for each part and method.

    Args:
        rows: Of the result.

    Returns:
        One table.
    """
    heads = control_keys(rows)
    present = [k for k in ("trials", *_CONTROL) if any(k in row for row in rows)]
    others = [
        k
        for k in dict.fromkeys(k for row in rows for k in row)
        if _is_measure(k, rows) and k not in (*present, *heads) and not k.endswith("_ci")
    ]
    order = {part: k for k, part in enumerate(dict.fromkeys(row["workpiece"] for row in rows))}
    by_part = sorted(rows, key=lambda row: order[row["workpiece"]])
    return [_table("Outcomes and errors by part and method", by_part, heads, [*present, *others])]


_READING = {
    ("raw", "none"): "raw",
    ("raw", "kalman"): "raw + Kalman",
    ("refined", "none"): "refined",
    ("refined", "kalman"): "refined + Kalman",
    ("refined", "memory"): "tracker",
}


def reading(row: Row) -> str:
    """How a method of Table 2 reads the line.

    Args:
        row: Of Table 2.

    Returns:
        Words.
    """
    line, tracker = "refined" if row.get("refined") else "raw", row.get("tracker")
    if tracker is None:
        tracker = "kalman" if row.get("kalman") else "none"
    return _READING.get((line, tracker), f"{line}, {tracker}")


def place(row: Row) -> str:
    """Where on a part a row of Table 2 was measured.

    Args:
        row: Of Table 2.

    Returns:
        The part, and the region if it is not the whole seam.
    """
    region = row.get("region", "all")
    return str(row["workpiece"]) if region == "all" else f"{row['workpiece']}, {region}s"


def feature_tables(rows: list[Row]) -> list[Table]:
    """Table 2: one table for each place, a row for each method, a column for each view and feature.

    Args:
        rows: Of the result.

    Returns:
        The tables, the first shown at once.
    """
    columns = list(dict.fromkeys((row["view"], row["feature"]) for row in rows))
    tables: list[Table] = []
    for where in dict.fromkeys(map(place, rows)):
        cells: dict[tuple[str, str], dict[tuple[str, str], Row]] = {}
        for row in rows:
            if place(row) == where:
                cells.setdefault((row["edge"], reading(row)), {})[row["view"], row["feature"]] = row
        body = []
        for names, found in cells.items():
            values = [cell(found[c], "rmse", glossary_key=c[1]) if c in found else Cell("-") for c in columns]
            lines = [r["availability_pct"] for r in found.values() if is_number(r.get("availability_pct"))]
            least = cell({"availability_pct": min(lines, default=None)}, "availability_pct")
            body.append([*(Cell(n) for n in names), *values, least])
        heads = [Column("edge method", "edge", False), Column("line", "line", False)]
        heads += [Column(f"{view} view, {label(f)}", f, True) for view, f in columns]
        heads.append(Column(label("availability_pct"), "availability_pct", True))
        tables.append(Table(f"Error of the seam line, {where}", heads, body, 2, not tables))
    return tables


def plain_tables(name: str, rows: list[Row]) -> list[Table]:
    """Any rows: split where they are many, constant columns told in the caption.

    Args:
        name: What they are; empty: the rows of the result.
        rows: Plain dicts.

    Returns:
        The tables.
    """
    keys = [k for k in dict.fromkeys(k for row in rows for k in row) if not _is_interval_key(k, rows)]
    splitter = "table" if "table" in keys and _varies(rows, "table") else None
    if splitter is None and len(rows) > _LONG:
        splitter = next((k for k in keys if 1 < len({repr(r.get(k)) for r in rows}) <= _FEW), None)
    if splitter is not None:
        groups: dict[str, list[Row]] = {}
        for row in rows:
            groups.setdefault(text_of(row.get(splitter)), []).append(row)
        prefix = "" if splitter == "table" else f"{label(splitter)} "
        return [
            table
            for value, group in groups.items()
            for table in plain_tables(
                ", ".join(p for p in (name, f"{prefix}{value}") if p),
                [{k: v for k, v in r.items() if k != splitter} for r in group],
            )
        ]
    fixed = [k for k in keys if len(rows) > 1 and not _varies(rows, k)]
    shown = [k for k in keys if k not in fixed]
    told = "; ".join(f"{label(k)} {cell(rows[0], k).text}" for k in fixed if rows[0].get(k) is not None)
    first = next((i for i, k in enumerate(shown) if any(is_number(r.get(k)) for r in rows)), len(shown))
    heads, caption = shown[: max(first, 1)], f"Rows: {name}" if name else "Rows"
    return [_table(f"{caption} ({told})" if told else caption, rows, heads, shown[len(heads) :])]


def _is_interval_key(key: str, rows: list[Row]) -> bool:
    return key.endswith("_ci") and any(base in row for row in rows for base in (key[:-3], f"{key[:-3]}_pct"))


def tables(document: dict[str, Any]) -> list[Table]:
    """All tables of a result: its rows, and any other list of rows but the trials.

    Args:
        document: As protocol.md describes it.

    Returns:
        The tables.
    """
    rows = document["rows"]
    if is_control(rows):
        out = control_tables(rows)
    elif is_features(rows):
        out = feature_tables(rows)
    else:
        out = plain_tables("", rows)
    for key, value in document.items():
        is_rows = isinstance(value, list) and value and all(isinstance(v, dict) for v in value)
        if is_rows and key not in ("rows", "trials"):
            out += plain_tables(key, value)
    return out
