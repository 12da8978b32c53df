"""Dot plots with intervals, laid out for inline SVG; the page's template draws them."""

import math
from typing import Any, NamedTuple

from experiments import report_tables as rt
from experiments.report_tables import Row

# In units of the drawing, which the page shows at 1 px or less each: readable on a phone.
WIDTH = 360
_LEFT, _RIGHT = 132, 64
_ROW, _HEADING, _GAP, _TOP, _BOTTOM = 19, 20, 6, 6, 36
_LOG_FROM = 30.0  # ratio of largest to smallest value
_MOST_ROWS = 60
_COLOURS = 6
_NAME = 18  # characters that fit beside the plot


class Dot(NamedTuple):
    """A value to plot.

    Attributes:
        label: Of its row.
        value: Where the dot is.
        interval: Lower and upper end, None without one.
        text: Shown at the right.
        colour: Index of its colour.
    """

    label: str
    value: float
    interval: tuple[float, float] | None
    text: str
    colour: int


class Group(NamedTuple):
    """Dots under a common heading.

    Attributes:
        heading: Its words, empty for none.
        dots: From top to bottom.
    """

    heading: str
    dots: list[Dot]


class Mark(NamedTuple):
    """A dot with its interval, placed.

    Attributes:
        x: Of the dot.
        y: Of the row.
        low: Lower end of the interval, ``x`` without one.
        high: Upper end.
        label: At the left.
        text: At the right.
        title: Shown on hover.
        colour: Index of the colour.
    """

    x: float
    y: float
    low: float
    high: float
    label: str
    text: str
    title: str
    colour: int


class Chart(NamedTuple):
    """A dot plot, placed.

    Attributes:
        title: What it shows.
        height: In units, of ``WIDTH`` wide.
        left: Where the axis begins.
        right: Where it ends.
        bottom: Where it lies.
        ticks: Place and text of each grid line.
        headings: Place and text of each group's heading.
        marks: The dots.
        axis: Words under the axis.
        summary: The numbers in words, for those who cannot see it.
    """

    title: str
    height: float
    left: float
    right: float
    bottom: float
    ticks: list[tuple[float, str]]
    headings: list[tuple[float, str]]
    marks: list[Mark]
    axis: str
    summary: str


class Axis(NamedTuple):
    """Values to places.

    Attributes:
        low: Value at the left end.
        high: Value at the right end.
        log: Whether decades are equally long.
        ticks: Values with a grid line.
    """

    low: float
    high: float
    log: bool
    ticks: list[float]

    def place(self, value: float) -> float:
        """Where a value is drawn.

        Args:
            value: Clipped to the axis.

        Returns:
            Place between ``_LEFT`` and ``WIDTH - _RIGHT``.
        """
        value = min(max(value, self.low), self.high)
        if self.log:
            share = math.log(value / self.low) / math.log(self.high / self.low)
        else:
            share = (value - self.low) / (self.high - self.low)
        return _LEFT + share * (WIDTH - _LEFT - _RIGHT)


def axis(values: list[float], *, percent: bool = False) -> Axis:
    """An axis that holds all values, with round grid lines.

    Args:
        values: All that is drawn, not negative.
        percent: Up to 100, from 0 or from where the values begin.

    Returns:
        The axis: by decades if the values span more than a factor of 30.
    """
    if percent:
        low = max(start for start in (0.0, 50.0, 80.0, 90.0) if start <= min(values, default=0.0))
        return Axis(low, 100.0, False, [low + k * (100.0 - low) / 4 for k in range(0, 5, 2 if low else 1)])
    positive = [v for v in values if v > 0]
    if positive and max(positive) / min(positive) > _LOG_FROM:
        first = math.floor(math.log10(min(positive)))
        last = math.ceil(math.log10(max(positive)))
        step = -(-(last - first) // 4)
        last = first + step * -(-(last - first) // step)
        return Axis(10.0**first, 10.0**last, True, [10.0**k for k in range(first, last + 1, step)])
    top = max(values, default=0.0) or 1.0
    size = 10.0 ** math.floor(math.log10(top / 4))
    step_size = next(s * size for s in (1.0, 2.0, 2.5, 5.0, 10.0) if s * size * 4 >= top * (1 - 1e-12))
    count = math.ceil(top / step_size - 1e-9)
    return Axis(0.0, count * step_size, False, [k * step_size for k in range(count + 1)])


def dot_plot(title: str, groups: list[Group], unit: str) -> Chart:
    """Places a dot plot.

    Args:
        title: What it shows.
        groups: The values, each >= 0.
        unit: Of the axis; ``%`` gives one that ends at 100.

    Returns:
        The chart.
    """
    dots = [dot for group in groups for dot in group.dots]
    scale = axis([v for d in dots for v in (d.value, *(d.interval or ()))], percent=unit == "%")
    y, headings, marks, said = float(_TOP), [], [], []
    for group in groups:
        if group.heading:
            y += _HEADING
            headings.append((y - 6, group.heading))
        for dot in group.dots:
            low, high = dot.interval or (dot.value, dot.value)
            name = ", ".join(n for n in (group.heading, dot.label) if n)
            ends = f", 95 % interval {low:.4g} to {high:.4g}" if dot.interval else ""
            said.append(f"{name}: {dot.text} {unit}{ends}")
            marks.append(
                Mark(
                    scale.place(dot.value), y + _ROW / 2, scale.place(low), scale.place(high),
                    dot.label if len(dot.label) <= _NAME else dot.label[: _NAME - 1] + "…",
                    dot.text, said[-1], dot.colour % _COLOURS,
                )
            )  # fmt: skip
            y += _ROW
        y += _GAP
    return Chart(
        title,
        y + _BOTTOM,
        _LEFT,
        WIDTH - _RIGHT,
        y,
        [(scale.place(t), f"{t:g}") for t in scale.ticks],
        headings,
        marks,
        unit + (", each grid line a power of ten" if scale.log else ""),
        "; ".join(said),
    )


def _dot(row: Row, key: str, name: str, colour: int, glossary_key: str | None = None) -> Dot | None:
    shown = rt.cell(row, key, glossary_key=glossary_key)
    if shown.value is None or shown.value < 0:
        return None
    return Dot(name, shown.value, rt.interval_of(row, key), shown.text, colour)


def _plot(title: str, unit: str, found: list[tuple[str, Dot | None]]) -> list[Chart]:
    groups: dict[str, list[Dot]] = {}
    for heading, dot in found:
        if dot is not None:
            groups.setdefault(heading, []).append(dot)
    if not groups or len(found) > _MOST_ROWS:
        return []
    return [dot_plot(title, [Group(h, dots) for h, dots in groups.items()], unit)]


def control_charts(rows: list[Row]) -> list[Chart]:
    """Reached and RMSE of a control table.

    Args:
        rows: Of the result.

    Returns:
        None beyond 60 rows, which are no longer readable.
    """
    heads = rt.control_keys(rows)[1:]
    alone = len({repr([row.get(k) for k in heads]) for row in rows}) == 1
    methods = list(dict.fromkeys(row["method"] for row in rows))
    order = {part: k for k, part in enumerate(dict.fromkeys(row["workpiece"] for row in rows))}
    charts = []
    for key, title, unit in (
        ("reached_pct", "Reached", "%"),
        ("rmse_mm", "RMSE of the trials that reached", "mm"),
        ("time_s", "Time of the trials that reached", "s"),
    ):
        found = []
        for row in sorted(rows, key=lambda r: order[r["workpiece"]]):
            name = row["workpiece"] if alone else _name(row, heads)
            colour = 0 if alone else methods.index(row["method"])
            found.append(("" if alone else row["workpiece"], _dot(row, key, name, colour)))
        charts += _plot(title, unit, found)
    return charts


def _name(row: Row, heads: list[str]) -> str:
    return ", ".join(rt.text_of(row.get(k)) for k in heads if row.get(k) is not None)


def feature_charts(rows: list[Row]) -> list[Chart]:
    """Error of the first edge method of Table 2 in the image, read in each way.

    Args:
        rows: Of the result.

    Returns:
        A chart for each view and feature.
    """
    edge = rows[0]["edge"]
    own = [row for row in rows if row["edge"] == edge and row["feature"] in ("d_attr", "theta")]
    split = {row["workpiece"] for row in own if row.get("region", "all") != "all"}
    own = [row for row in own if row["workpiece"] not in split or row["region"] != "all"]
    ways = list(dict.fromkeys(map(rt.reading, own)))
    words = {"d_attr": "distance", "theta": "angle"}
    charts = []
    for view, feature in dict.fromkeys((row["view"], row["feature"]) for row in own):
        cell = [row for row in own if (row["view"], row["feature"]) == (view, feature)]
        found = [
            (rt.place(r), _dot(r, "rmse", rt.reading(r), ways.index(rt.reading(r)), feature)) for r in cell
        ]
        unit = cell[0]["unit"]
        charts += _plot(f"{view.capitalize()} view, {words[feature]}: RMSE [{unit}]", unit, found)
    return charts


def charts(document: dict[str, Any]) -> list[Chart]:
    """The charts of a result.

    Args:
        document: As protocol.md describes it.

    Returns:
        Dot plots of control tables and feature errors; none of other tables.
    """
    rows = document["rows"]
    if rt.is_control(rows):
        return control_charts(rows)
    return feature_charts(rows) if rt.is_features(rows) else []
