"""Rows of the severity curves, and their tables."""

from collections.abc import Sequence
from typing import Any

from experiments import results
from seal_gym.wrappers import disturbance

Row = dict[str, Any]
_AT_ONE = {
    "MovingWorkpiece": "the part moves up to {amplitude_mm:g} mm, {speed_mm_s:g} mm/s, {yaw_deg:g} deg, "
    "{yaw_rate_deg_s:g} deg/s",
    "MovingObstacle": "a ball of {radius_mm:g} mm radius is in the gun's way for {stay_s:g} s",
    "Lighting": "light level {level:.0%}, contrast {contrast:.0%}, moving shadow {shadow:.0%}, lamp turns",
    "CameraNoise": "grey noise of {sigma:g} of 255 on top of the sensor's own",
    "CameraDropout": "{share:.0%} of the frames are {lost}",
    "CameraLatency": "images come late by {frames:g} frame of 1/30 s",
    "ExternalPush": "pushes of {force_n:g} N on the {on}, one in about {pause_s:g} s",
    "HandEyeError": "camera bracket off by {shift_mm:g} mm and {turn_deg:g} deg",
    "ActuationDelay": "commands come late by {frames:g} frame of 1/30 s",
}


def at_one(name: str) -> str:
    """What a disturbance does at severity 1.

    Args:
        name: Of the disturbance.

    Returns:
        A few words with the numbers of its default configuration.
    """
    return _AT_ONE[name].format(**disturbance(name).to_dict())


def summarise(trials: Sequence[Row]) -> list[Row]:
    """One row for each disturbance, severity and method.

    Args:
        trials: With ``disturbance`` and ``severity``; those without a disturbance are severity 0 of all.

    Returns:
        Rows as protocol.md names them, with ``disturbance`` and ``severity``; of one disturbance below each
        other, by severity.
    """
    calm = [t for t in trials if t["disturbance"] is None]
    names = dict.fromkeys(t["disturbance"] for t in trials if t["disturbance"] is not None)
    rows: list[Row] = []
    for name in names or [None]:
        mine = calm + [t for t in trials if name is not None and t["disturbance"] == name]
        for severity in sorted({t["severity"] for t in mine}):
            cells = results.summarise([t for t in mine if t["severity"] == severity])
            rows += [{"disturbance": name, "severity": severity, **cell} for cell in cells]
    return rows


# -- for people -------------------------------------------------------------------------------------------


def markdown(rows: Sequence[Row], pictures: Sequence[str]) -> str:
    """The tables for people.

    Args:
        rows: From ``summarise``.
        pictures: Files beside them.

    Returns:
        Markdown.
    """
    parts = [
        "# Growing disturbances",
        f"One disturbance at a time on the {rows[0]['workpiece']} part, {rows[0]['trials']} trials a point. "
        "Severity 0 is off and the same trials for all, 1 the disturbance's default; amplitudes and speeds "
        "grow in proportion. Each cell has the share of trials that reached the end and the mean RMSE of "
        "those that did; intervals: see the CSV file. What acts on light, images or the cameras' bracket "
        "does not touch `adaptive`, which has a laser instead.",
        tables(rows, markdown=True),
        "## Figures",
        "\n\n".join(f"![{name}]({name})" for name in pictures),
    ]
    return "\n\n".join(parts)


def tables(rows: Sequence[Row], *, markdown: bool) -> str:
    """One table a disturbance: a line a method, a column a severity.

    Args:
        rows: From ``summarise``.
        markdown: With Markdown's rules.

    Returns:
        Text.
    """
    out = []
    for name in dict.fromkeys(row["disturbance"] for row in rows):
        mine = [row for row in rows if row["disturbance"] == name]
        cells = {(row["method"], row["severity"]): row for row in mine}
        levels = sorted({row["severity"] for row in mine})
        body = [
            [m, *(_cell(cells[m, level]) for level in levels)]
            for m in dict.fromkeys(row["method"] for row in mine)
        ]
        title = "no disturbance" if name is None else f"{name} (1: {at_one(name)})"
        grid = results.grid(["method", *(f"{level:g}" for level in levels)], body, markdown=markdown)
        out.append(f"{'## ' if markdown else ''}{title}\n\n{grid}")
    return "\n\n".join(out)


def _cell(row: Row) -> str:
    rmse = "-" if row["rmse_mm"] is None else f"{row['rmse_mm']:.3f} mm"
    return f"{row['reached_pct']:.0f} %, {rmse}"
