"""What each edge method makes of the ROIs, and how accurate its lines are in noise and on photographs.

    python -m experiments.fig12 --out experiments/results --seed 500000

After Fig. 12 of Zhou et al.: panels of each part and view; the lines' accuracy against the signal-to-noise
ratio; the same on photographs that nobody here took, with seams of known place laid into them. Single frames
without memory: the tracker's figures are another table.
"""

import argparse
import sys
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from tqdm import tqdm

from experiments import edge_tables, photo_seams, tune_edges
from experiments.edge_tables import Log, Row
from experiments.seam_frames import (
    FAIL_DEG,
    FAIL_PX,
    FIRST_SEED,
    STAGES,
    VIEWS,
    LineErrors,
    SeamFrames,
    accuracy,
    check_seeds,
    draw,
    joined,
    lines_of,
    stage_errors,
    subset,
)
from seal_gym.core.errors import SealGymError
from seal_gym.core.frames import Array
from seal_gym.vision.baselines import DETECTORS
from seal_gym.vision.edges import EdgeDetector
from seal_gym.vision.seam_line import StripLine, find_lines
from seal_gym.workpieces.catalogue import NAMES

mpl.use("Agg")  # no screen needed
import matplotlib.pyplot as plt  # the backend has to be chosen first
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, NullFormatter

# Best at 2 dB by ``tune_edges``.
IN_NOISE: dict[str, Row] = {
    "canny": {"sigma_px": 1.0, "share": 0.03, "ratio": 0.8},
    "sobel": {"sigma_px": 0.0, "share": 0.16},
    "sobel_blurred": {"sigma_px": 0.7, "share": 0.05},
    "lsd": {
        "sigma_px": 1.0,
        "scale": 0.8,
        "sigma_scale": 1.0,
        "quant": 1.0,
        "angle_deg": 30.0,
        "density": 0.7,
        "refine": "standard",
        "min_length_px": 5.0,
    },
    "ours_tuned": {"weights": "a+b+c, more b", "alpha": 0.5, "length": 7, "tau": 0.55, "share": 0.05},
}

LEVELS_DB = tuple(range(20, -7, -2))
LABELS = {
    "canny": "Canny",
    "sobel": "Sobel",
    "sobel_blurred": "Sobel, blurred",
    "lsd": "LSD",
    "ours": "ours, as tracked",
    "ours_tuned": "ours, tuned",
}
SETS = {"run": "settings chosen as in a run", "2 dB": "settings chosen at 2 dB"}
_COLOURS = {
    "canny": "#1f77b4",
    "sobel": "#8c6d31",
    "sobel_blurred": "#e08214",
    "lsd": "#2ca02c",
    "ours": "#c51b7d",
    "ours_tuned": "#5e2ca5",
}
_MARKERS = {"canny": "s", "sobel": "v", "sobel_blurred": "^", "lsd": "D", "ours": "o", "ours_tuned": "P"}
_EDGE, _TRUE, _RAW, _REFINED = (1.0, 0.55, 0.0), "#00b400", "#0028ff", "#e00000"
_REFINED_PX = 30.0  # the local curve's reach on either side of the tip
_COLUMNS = {
    "offset_px": "offset at the tip [px]",
    "angle_deg": "angle [deg]",
    "failed_pct": "failed [%]",
}


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Reads the command line.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        The options.
    """
    parser = argparse.ArgumentParser(prog="python -m experiments.fig12", description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=FIRST_SEED, help="of the first frame")
    parser.add_argument("--frames", type=int, default=60, help="of each part at each SNR; of each photograph")
    parser.add_argument("--no-photos", action="store_true", help="leave out what needs scikit-image")
    parser.add_argument("--out", type=Path, default=Path("out/fig12"), help="folder (default: %(default)s)")
    options = parser.parse_args(arguments)
    if options.frames < 1:
        parser.error(f"--frames {options.frames}: must be at least 1")
    try:
        check_seeds(options.seed, max(options.frames, _PANEL_FRAMES))
    except SealGymError as error:
        parser.error(str(error))
    return options


def detector(name: str, chosen: str = "run") -> EdgeDetector:
    """A method with its settings.

    Args:
        name: One of ``LABELS``.
        chosen: One of ``SETS``: what the settings were chosen for.

    Returns:
        The detector; ``"ours"`` is the same in either.
    """
    if chosen == "run" or name == "ours":
        return DETECTORS[name]()
    return tune_edges.METHODS[name.removesuffix("_tuned")].make(IN_NOISE[name])


# -- panels -----------------------------------------------------------------------------------------------

_PANEL_FRAMES = 60


def panel_frame(part: str, seed: int) -> SeamFrames:
    """The frame that is shown: the seed's own, or on a part with corners the first at one.

    Args:
        part: Name of a nominal part.
        seed: The first seed.

    Returns:
        One frame.
    """
    frames = draw(part, _PANEL_FRAMES, seed)
    return subset(frames, np.array([int(np.argmax(frames.corner))]))


def _to_image(t: Array, o: Array, view: int, length: int) -> tuple[Array, Array]:
    """Points of a strip in the image, x and y."""
    return (o, length - t) if view == 0 else (t, o)


def _as_image(strip: NDArray[Any], view: int) -> NDArray[Any]:
    return strip[::-1] if view == 0 else strip.swapaxes(0, 1)


def _draw_lines(
    axes: Axes, truth: Array, found: StripLine, k: int, reference: Array, view: int, length: int
) -> None:
    """Draws the true line of a strip, RANSAC's and the refined one, as far as these were found."""
    refined = found.line[k, :2] if found.valid[k] else np.full(2, np.nan)
    lines: tuple[tuple[Array, float, Row], ...] = (
        (truth, 1e3, {"color": _TRUE, "lw": 2.2}),
        (found.raw[k], 1e3, {"color": _RAW, "lw": 1.3}),
        (refined, _REFINED_PX, {"color": _REFINED, "lw": 1.3, "ls": (0, (3, 2))}),
    )
    for line, reach, style in lines:
        t = np.array([max(reference[0] - reach, 0.0), min(reference[0] + reach, length)])
        axes.plot(*_to_image(t, line[0] + line[1] * (t - reference[0]), view, length), **style)


def _draw_method(axes: Axes, frames: SeamFrames, name: str, view: int) -> None:
    method = detector(name)
    strip, mask, reference = frames.strip[view], frames.views.mask[view], frames.views.reference[view]
    length, width = mask.shape
    edge = method(strip, mask).edge[0]
    overlay = np.zeros((length, width, 4))
    overlay[edge] = (*_EDGE, 1.0)
    overlay[mask] = (0.35, 0.35, 0.4, 0.75)
    image = _as_image(strip[0], view).mean(axis=2)
    size = (0, image.shape[1], image.shape[0], 0)
    axes.imshow(image, cmap="gray", vmin=0, vmax=255, extent=size, interpolation="nearest", alpha=0.55)
    axes.imshow(_as_image(overlay, view), extent=size, interpolation="nearest")
    found = find_lines(strip, mask, reference, method)
    _draw_lines(axes, frames.truth[0, view], found, 0, reference, view, length)
    e = stage_errors(found, frames.truth[:, view], reference[1])
    axes.set_xlabel("\n".join(f"{s}: {_error_text(e[s])}" for s in STAGES), fontsize=10)


def _error_text(e: LineErrors) -> str:
    """The errors of a single line."""
    if not np.isfinite(e.offset_px[0]):
        return "no line"
    return f"{abs(e.offset_px[0]):.2f} px, {abs(e.angle_deg[0]):.1f}°"


def panels(path: Path, seed: int, view: int) -> None:
    """Draws the panels of one view: original, grey, and each method's edges and lines.

    Args:
        path: The PNG file.
        seed: Of the frames.
        view: 0 front, 1 side.
    """
    titles = ["camera image", "grey", *LABELS.values()]
    # A row a part, or a column where the images are wide.
    size, shape = ((15.4, 13.4), (3, 8)) if view == 0 else ((14.2, 19.5), (8, 3))
    figure, grid = plt.subplots(*shape, figsize=size, constrained_layout=True)
    cells = grid if view == 0 else grid.T
    for row, part in zip(cells, NAMES, strict=True):
        frames = panel_frame(part, seed)
        where = "at a corner" if frames.corner[0] else "away from corners"
        head = f"{part}, {where}\nSNR {frames.images.snr_db[0, view]:.1f} dB, seed {frames.seed[0]}"
        image = _as_image(frames.strip[view][0], view)
        extent = (0, image.shape[1], image.shape[0], 0)
        row[0].imshow(image, extent=extent, interpolation="nearest")
        row[1].imshow(
            image.mean(axis=2), cmap="gray", vmin=0, vmax=255, extent=extent, interpolation="nearest"
        )
        for axes, name in zip(row[2:], LABELS, strict=True):
            _draw_method(axes, frames, name, view)
        for axes in row:
            axes.set(xlim=extent[:2], ylim=extent[2:], xticks=[], yticks=[])
        if view == 0:
            row[0].set_ylabel(head, fontsize=11)
        else:
            row[0].set_title(head, fontsize=12)
    for axes, title in zip(cells[0], titles, strict=True):
        if view == 0:
            axes.set_title(title, fontsize=12)
        else:
            axes.set_ylabel(title, fontsize=12)
    handles = [
        Patch(color=_EDGE, label="edge pixels"),
        Patch(color=(0.35, 0.35, 0.4), label="nozzle's mask"),
        Line2D([], [], color=_TRUE, lw=2.5, label="truth: the seam's tangent at the tip"),
        Line2D([], [], color=_RAW, lw=1.5, label="raw: RANSAC through the whole ROI"),
        Line2D([], [], color=_REFINED, lw=1.5, ls="--", label="refined: sub-pixel, near the tip"),
    ]
    columns = 5 if view == 0 else 3
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, fontsize=11)
    figure.suptitle(
        f"{VIEWS[view].capitalize()} view: edges and lines of single frames; the lines' errors at the tip",
        fontsize=13,
    )
    _save(figure, path, 90)


def _save(figure: Figure, path: Path, dpi: int) -> None:
    """Writes a figure without its transparency and packed as small as it will go: noise takes space."""
    buffer = BytesIO()
    figure.savefig(buffer, dpi=dpi)
    plt.close(figure)
    Image.open(buffer).convert("RGB").save(path, optimize=True)


# -- accuracy against the signal-to-noise ratio -----------------------------------------------------------


def snr_rows(part: str, level_db: float | None, frames: int, seed: int) -> list[Row]:
    """Errors of every method on one part at one signal-to-noise ratio, in a form to be pooled.

    Args:
        part: Name of a nominal part.
        level_db: The ratio; None for what a run has.
        frames: How many.
        seed: Of the first.

    Returns:
        One row for each set of settings, method, view and stage, with the errors of each frame.
    """
    seen = draw(part, frames, seed, snr_db=level_db)
    rows = []
    for chosen in SETS if level_db is not None else ("run",):
        for name in LABELS:
            for v, found in enumerate(lines_of(seen, detector(name, chosen))):
                for stage, e in stage_errors(found, seen.truth[:, v], seen.views.reference[v, 1]).items():
                    rows.append(
                        {"part": part, "chosen": chosen, "method": name, "stage": stage, "view": VIEWS[v]}
                        | {"snr_db": float(seen.images.snr_db[:, v].mean()), **_plain(e)}
                    )
    return rows


def _plain(e: LineErrors) -> Row:
    """Errors for the log, where JSON knows no infinity."""
    return {k: [round(float(x), 4) if np.isfinite(x) else None for x in v] for k, v in e._asdict().items()}


def _errors_of(row: Row) -> LineErrors:
    return LineErrors(*(np.array([np.inf if x is None else x for x in row[k]]) for k in LineErrors._fields))


def pooled(rows: list[Row], head: Row) -> list[Row]:
    """Table rows of each method and stage, pooled over the rest.

    Args:
        rows: With errors.
        head: First columns.

    Returns:
        The rows.
    """
    out = []
    for name in LABELS:
        for stage in STAGES:
            some = [_errors_of(r) for r in rows if r["method"] == name and r["stage"] == stage]
            out.append({**head, "method": name, "stage": stage, **accuracy(joined(some))})
    return out


def _number(row: Row, key: str) -> float:
    return np.nan if row[key] is None else float(row[key])


def snr_chart(path: Path, rows: list[Row], usual_db: float, settings: str) -> None:
    """Draws accuracy against the signal-to-noise ratio, all parts and views together.

    Args:
        path: The PNG file.
        rows: Table rows with part "all".
        usual_db: The ratio in a run.
        settings: What they were chosen for.
    """
    figure, grid = plt.subplots(2, 3, figsize=(13.0, 7.6), sharex=True, constrained_layout=True)
    for line, stage in zip(grid, STAGES, strict=True):
        for axes, (key, label) in zip(line, _COLUMNS.items(), strict=True):
            for name, title in LABELS.items():
                some = [r for r in rows if r["method"] == name and r["stage"] == stage]
                x, y = [r["snr_db"] for r in some], [_number(r, key) for r in some]
                wide = 2.2 if name.startswith("ours") else 1.2
                axes.plot(x, y, color=_COLOURS[name], marker=_MARKERS[name], ms=4.5, lw=wide, label=title)
            share = key == "failed_pct"
            if share:
                axes.set_ylim(-3, 103)
            else:
                axes.set_yscale("log")
                axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
                axes.yaxis.set_major_formatter("{x:g}")
                axes.yaxis.set_minor_formatter(NullFormatter())
            axes.set_xlim(max(LEVELS_DB) + 0.7, min(LEVELS_DB) - 0.7)
            axes.axvline(usual_db, color="#777777", ls=":", lw=1.2)
            axes.set_title(f"{stage}: {label if share else 'median ' + label}", fontsize=10)
            axes.grid(color="#dddddd", lw=0.6, which="both")
    for axes in grid[1]:
        axes.set_xlabel("SNR of the ROI [dB]; more noise to the right")
    handles, labels = grid[0, 0].get_legend_handles_labels()
    handles.append(Line2D([], [], color="#777777", ls=":", lw=1.2))
    labels.append(f"a run's mean, {usual_db:.1f} dB")
    figure.legend(handles, labels, loc="outside lower center", ncols=7, fontsize=10)
    figure.suptitle(
        f"Lines of single rendered frames, {settings}; three parts, both views ({rows[0]['frames']} lines a "
        "point).\nMedians count a missing line as infinitely far off; failed: none, or more than "
        f"{FAIL_PX:g} px or {FAIL_DEG:g}° off.",
        fontsize=11,
    )
    _save(figure, path, 85)


# -- photographs ------------------------------------------------------------------------------------------


def photo_rows(name: str, count: int, seed: int) -> list[Row]:
    """Errors of every method on seams laid into one photograph.

    Args:
        name: Of the photograph.
        count: How many seams.
        seed: Of the first.

    Returns:
        As ``snr_rows``.
    """
    seams = photo_seams.draw(name, count, seed)
    mask = np.zeros(seams.strip.shape[1:3], np.bool_)
    rows = []
    for method in LABELS:
        found = find_lines(seams.strip, mask, seams.reference, detector(method))
        for stage, e in stage_errors(found, seams.truth, seams.reference[1]).items():
            rows.append(
                {"photo": name, "method": method, "stage": stage}
                | {"snr_db": float(seams.snr_db.mean()), **_plain(e)}
            )
    return rows


def photo_chart(path: Path, rows: list[Row], count: int) -> None:
    """Draws accuracy on each photograph.

    Args:
        path: The PNG file.
        rows: Table rows of each photograph and of all.
        count: Seams in a photograph.
    """
    names = list(dict.fromkeys(r["part"] for r in rows))
    figure, grid = plt.subplots(2, 2, figsize=(13.0, 7.6), sharex=True, constrained_layout=True)
    for line, stage in zip(grid, STAGES, strict=True):
        for axes, key in zip(line, ("offset_px", "failed_pct"), strict=True):
            for k, (method, title) in enumerate(LABELS.items()):
                some = {r["part"]: r for r in rows if r["method"] == method and r["stage"] == stage}
                x = np.arange(len(names)) + 0.13 * (k - 2.5)
                axes.plot(
                    x,
                    [_number(some[n], key) for n in names],
                    color=_COLOURS[method],
                    marker=_MARKERS[method],
                    ls="",
                    ms=6,
                    label=title,
                )
            for k in range(1, len(names)):
                axes.axvline(k - 0.5, color="#e4e4e4", lw=1.0)
            axes.set(xlim=(-0.5, len(names) - 0.5), title=f"{stage}: {_COLUMNS[key]}")
            axes.set_ylim(bottom=0)
            axes.set_xticks(range(len(names)), names, rotation=35, ha="right")
            axes.grid(axis="y", color="#dddddd", lw=0.6)
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=6, fontsize=10)
    figure.suptitle(
        f"Seams laid into photographs of scikit-image, {count} each: median offset at the tip and share of\n"
        "failed lines; the named photograph is the plate, the wall is another drawn at random",
        fontsize=11,
    )
    _save(figure, path, 85)


def photo_examples(path: Path, seed: int) -> None:
    """Draws the first seams laid into each photograph, with our line.

    Args:
        path: The PNG file.
        seed: Of the seams.
    """
    shown = 2
    names = photo_seams.PHOTOS
    figure, grid = plt.subplots(shown, len(names), figsize=(15.5, 6.4), constrained_layout=True)
    for index, name in enumerate(names):
        column = list(grid[:, index])
        seams = photo_seams.draw(name, shown, seed)
        mask = np.zeros(seams.strip.shape[1:3], np.bool_)
        found = find_lines(seams.strip, mask, seams.reference, detector("ours"))
        column[0].set_title(name, fontsize=10)
        for k, axes in enumerate(column):
            size = (0, photo_seams.WIDTH, photo_seams.LENGTH, 0)
            axes.imshow(_as_image(seams.strip[k], 0), extent=size, interpolation="nearest")
            _draw_lines(axes, seams.truth[k], found, k, seams.reference, 0, photo_seams.LENGTH)
            axes.set(xlim=size[:2], ylim=size[2:], xticks=[], yticks=[])
    handles = [
        Line2D([], [], color=_TRUE, lw=2.5, label="truth"),
        Line2D([], [], color=_RAW, lw=1.5, label="ours, raw"),
        Line2D([], [], color=_REFINED, lw=1.5, ls="--", label="ours, refined"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=10)
    figure.suptitle("Seams laid into photographs of scikit-image: the first two of each", fontsize=12)
    _save(figure, path, 85)


# -- the command ------------------------------------------------------------------------------------------


def _page(options: argparse.Namespace, rows: list[Row], usual_db: float) -> str:
    columns = {
        "method": "method",
        "stage": "line",
        "frames": "lines",
        "offset_px": "median px",
        "angle_deg": "median deg",
        "failed_pct": "failed %",
        "failed_ci": "95 %",
    }
    some = [r for r in rows if r["table"] == "snr" and r["part"] == "all" and r["level_db"] in (8, 0, -6)]
    usual = [r for r in rows if r["table"] == "run"]
    photos = [r for r in rows if r["table"] == "photos" and r["part"].startswith("all")]
    parts = [
        "# Edge methods on single frames",
        f"{options.frames} frames of each part from seed {options.seed} on, two views each, no memory "
        "between frames. Every method has the same line stage and the settings of `tune_edges.md`; *ours* "
        "are those that the tracker uses, *ours_tuned* the best for these lines. Medians of the offset from "
        "the true line at the tip and of the angle over all frames, a missing line counting as "
        f"infinitely far off; failed: none, or more than {FAIL_PX:g} px or {FAIL_DEG:g} deg off. The SNR is "
        "the sensors' own: the variance of the noise-free ROI, nozzle included, over that of the noise.",
        f"## As in a run (SNR {usual_db:.1f} dB)",
        edge_tables.markdown(usual, {"part": "part", **columns}),
        "## Against the signal-to-noise ratio, three parts together",
        edge_tables.markdown(some, {"level_db": "SNR dB", "chosen": "settings chosen", **columns}),
        "All levels and each part by itself: `fig12.csv`.",
    ]
    if photos:
        parts += [
            "## Seams laid into photographs",
            f"{options.frames} seams in each of {len(photo_seams.PHOTOS)} photographs that come with "
            f"scikit-image ({', '.join(photo_seams.PHOTOS)}), steps of 25-60 grey levels before exposure, "
            "the camera's blur and noise on top. OpenCV's package brings no photographs.",
            edge_tables.markdown(photos, {"part": "photographs", "snr_db": "SNR dB", **columns}),
        ]
    return "\n\n".join(parts)


def _snr_table(options: argparse.Namespace, log: Log) -> tuple[list[Row], float]:
    out: list[Row] = []
    usual_db = 0.0
    for level in tqdm((None, *LEVELS_DB), desc="SNR levels", unit="level"):
        found: list[Row] = []
        for part in NAMES:
            key = {"part": part, "level": level, "n": options.frames, "seed": options.seed}
            found += log.get(key, partial(snr_rows, part, level, options.frames, options.seed))
        mean = float(np.mean([r["snr_db"] for r in found]))
        usual_db = mean if level is None else usual_db
        for chosen in dict.fromkeys(r["chosen"] for r in found):
            head = {"table": "run" if level is None else "snr", "level_db": level, "snr_db": mean}
            some = [r for r in found if r["chosen"] == chosen]
            for part in NAMES:
                rows = [r for r in some if r["part"] == part]
                out += pooled(rows, {**head, "chosen": chosen, "part": part})
            out += pooled(some, {**head, "chosen": chosen, "part": "all"})
    return out, usual_db


def _photo_table(options: argparse.Namespace, log: Log) -> list[Row]:
    found: dict[str, list[Row]] = {}
    for name in tqdm(photo_seams.PHOTOS, desc="photographs", unit="photo"):
        key = {"photo": name, "n": options.frames, "seed": options.seed}
        found[name] = log.get(key, partial(photo_rows, name, options.frames, options.seed))
    groups = {name: [name] for name in photo_seams.PHOTOS}
    groups |= {
        "all textures": list(photo_seams.TEXTURES),
        "all scenes": list(photo_seams.SCENES),
        "all": list(photo_seams.PHOTOS),
    }
    out = []
    for title, names in groups.items():
        rows = [r for name in names for r in found[name]]
        snr = float(np.mean([r["snr_db"] for r in rows]))
        out += pooled(
            rows, {"table": "photos", "level_db": None, "snr_db": snr, "chosen": "run", "part": title}
        )
    return out


def main(arguments: list[str] | None = None) -> int:
    """Makes the panels, charts and tables.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        Exit status: 0 if it ran to the end.
    """
    options = parse(arguments)
    out: Path = options.out
    out.mkdir(parents=True, exist_ok=True)
    log = Log(out / "fig12.trials.jsonl")
    try:
        photos = [] if options.no_photos else _photo_table(options, log)
    except SealGymError as error:
        sys.stderr.write(f"{error}, or use --no-photos\n")
        return 2
    rows, usual_db = _snr_table(options, log)
    for view, name in enumerate(VIEWS):
        panels(out / f"fig12_{name}.png", options.seed, view)
    for (chosen, settings), name in zip(SETS.items(), ("snr", "snr_in_noise"), strict=True):
        chart = [r for r in rows if r["table"] == "snr" and r["part"] == "all" and r["chosen"] == chosen]
        snr_chart(out / f"fig12_{name}.png", chart, usual_db, settings)
    if photos:
        photo_chart(out / "fig12_photos.png", photos, options.frames)
        photo_examples(out / "fig12_photo_examples.png", options.seed)
    rows += photos
    page = _page(options, rows, usual_db)
    document = {"seed0": options.seed, "frames": options.frames}
    edge_tables.write(out, "fig12", edge_tables.command_line(arguments), rows, document, page)
    sys.stdout.write(page + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
