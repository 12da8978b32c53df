"""Figures of the palette observer."""

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

from experiments import palette_methods, palette_pictures
from experiments.palette_pictures import CAMERA, COLOURS, LightCfg
from seal_gym.vision import hopfield, palette_segments
from seal_gym.vision.hopfield import INPUTS, TABLE_1, TABLE_2
from seal_gym.vision.palette_observer import PaletteObserverCfg, name_pixels
from seal_gym.vision.palette_regions import Fault, RegionCfg, report_on
from seal_gym.vision.palette_segments import Bytes, PaletteClass

mpl.use("Agg")  # no screen needed
import matplotlib.pyplot as plt  # the backend has to be chosen first
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Rectangle

Row = dict[str, Any]

_POINTS = 250  # of each class in the scatter
_STAGES = (
    ("even light", LightCfg(noise=4.0)),
    ("level 0.55, slope 0.6, noise 16", LightCfg(level=0.55, slope=0.6, noise=16.0)),
)
_STYLES = {
    "Hopfield, exact": ("#1f5fa8", "-", "o"),
    "Hopfield, exact, fixed thresholds": ("#1f5fa8", "--", "o"),
    "Hopfield, Hebb as printed": ("#8a8f98", "-", "s"),
    "Hopfield, Hebb, best reading": ("#8a8f98", "--", "s"),
    "thresholds + components": ("#d1382c", "-", "^"),
    "thresholds + components, fixed": ("#d1382c", "--", "^"),
    "k-NN": ("#2a8f3c", "-", "D"),
    "k-NN, many lights": ("#2a8f3c", "--", "D"),
}
_UNITS = {
    "level": "light level",
    "contrast": "contrast",
    "slope": "slope of the light across the picture",
    "noise": "noise, standard deviation of 255",
}


def _colour(kind: PaletteClass) -> Any:
    return np.array(COLOURS[kind]) / 255.0


def _scatter(axes: Any, seed: int) -> None:
    rng = np.random.default_rng(seed)
    # A layout with a stranger in it, whichever comes first.
    while True:
        elements = palette_pictures.layout(rng)
        if any(e.kind == PaletteClass.UNKNOWN for e in elements):
            break
    palette = palette_pictures.draw(elements, rng)
    rgb = palette_pictures.photograph(palette, LightCfg(noise=8.0), rng)
    for kind in PaletteClass:
        pixels = rgb[palette.labels == kind]
        shown = pixels[rng.choice(len(pixels), min(_POINTS, len(pixels)), replace=False)]
        label = "stranger" if kind == PaletteClass.UNKNOWN else kind.name.lower()
        edge = "#777777" if kind in (PaletteClass.TIE, PaletteClass.PALETTE) else "none"
        axes.scatter(*shown.T, s=14, color=_colour(kind), edgecolors=edge, linewidths=0.3, label=label)
    levels = palette_segments.otsu_levels(rgb)
    square = np.array([[0, 0], [255, 0], [255, 255], [0, 255], [0, 0]], dtype=np.float64)
    for axis, level in enumerate(levels):
        axes.plot(*np.insert(square, axis, level, axis=1).T, color="#444444", lw=1.0)
    axes.set(xlabel="red", ylabel="green", zlabel="blue", xlim=(0, 255), ylim=(0, 255), zlim=(0, 255))
    axes.view_init(elev=22, azim=-58)
    axes.set_box_aspect(None, zoom=0.85)
    axes.set_title(f"pixels in RGB space, thresholds {levels}", fontsize=11)
    axes.legend(fontsize=9, loc="upper left", bbox_to_anchor=(-0.16, 0.98))


def _answers(axes: Any, title: str, network: hopfield.HopfieldNetwork, first: bool) -> None:
    groups = ((network.first, TABLE_1, "layer 1"), (network.second, TABLE_2, "layer 2"))
    for group, (layer, table, name) in enumerate(groups):
        answers, good = layer.answers(), hopfield.recalled(layer, table)
        axes.text(3.6 * group + 1.0, -1.15, f"{name}: {good.sum()} of 8", ha="center", fontsize=9)
        for row in range(len(INPUTS)):
            for unit in range(3):
                right = answers[row, unit] == table[row, unit]
                face = "#cfe6d2" if right else "#f0b4ae"
                corner = (3.6 * group + unit - 0.5, row - 0.5)
                axes.add_patch(Rectangle(corner, 1, 1, facecolor=face, edgecolor="white", lw=1.5))
                sign = "+" if answers[row, unit] > 0 else "-"
                axes.text(3.6 * group + unit, row, sign, ha="center", va="center", fontsize=11)
        for unit, letter in enumerate("abc"):
            axes.text(
                3.6 * group + unit, -0.62, letter, ha="center", va="center", fontsize=9, color="#555555"
            )
    axes.set(xlim=(-0.6, 6.2), ylim=(7.6, -1.6), xticks=[], yticks=range(8) if first else [])
    if first:
        axes.set_yticklabels(["".join(map(str, x)) for x in INPUTS], family="monospace")
        axes.set_ylabel("input")
    axes.set_title(title, fontsize=11)
    for spine in axes.spines.values():
        spine.set_visible(False)


def responses(path: Path, seed: int) -> None:
    """Fig. 4: pixels in the space of colours, and what the networks answer to all inputs.

    Args:
        path: The PNG file.
        seed: Of the palette.
    """
    figure = plt.figure(figsize=(13.5, 5.4), layout=ConstrainedLayoutEngine(rect=(0, 0.05, 1, 0.95)))
    grid = figure.add_gridspec(1, 4, width_ratios=(1.75, 1, 1, 1))
    _scatter(figure.add_subplot(grid[0], projection="3d"), seed)
    networks = (
        ("exact", hopfield.exact()),
        ("Hebb as printed", hopfield.printed()),
        ("Hebb, best reading", hopfield.best_hebbian()),
    )
    for k, (title, network) in enumerate(networks):
        _answers(figure.add_subplot(grid[k + 1]), title, network, k == 0)
    figure.text(
        0.70, 0.02, "green: as the paper's table, red: not; row by row, + is 1 and - is -1", ha="center"
    )
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _painted(classes: Bytes) -> Bytes:
    table = np.array([COLOURS[k] for k in PaletteClass], dtype=np.uint8)
    table[PaletteClass.UNKNOWN] = (200, 60, 220)
    return np.asarray(table[classes], dtype=np.uint8)


def stages(path: Path, seed: int) -> None:
    """Fig. 6: from the picture to regions and faults, in good light and in bad.

    Args:
        path: The PNG file.
        seed: Of the palette.
    """
    figure, grid = plt.subplots(2, 4, figsize=(16.5, 7.1), constrained_layout=True)
    rng = np.random.default_rng(seed)
    palette = palette_pictures.draw(palette_pictures.layout(rng), rng)
    cfg = PaletteObserverCfg()
    codes = np.array([[255 * (c >> 2 & 1), 255 * (c >> 1 & 1), 255 * (c & 1)] for c in range(8)], np.uint8)
    for row, (title, light) in enumerate(_STAGES):
        rgb = palette_pictures.photograph(palette, light, rng)
        code = palette_segments.codes(rgb, palette_segments.otsu_levels(rgb))
        area, _ = palette_segments.areas(rgb, cfg.areas)
        named = name_pixels(rgb, hopfield.exact(), cfg)
        report = report_on(named, rgb, palette.depth_m, CAMERA, RegionCfg())
        shuffled = np.random.default_rng(1).uniform(60, 255, (int(area.max()) + 1, 3)).astype(np.uint8)
        pictures = (rgb, codes[code], shuffled[area], _painted(named.classes))
        names = (
            f"{title}",
            "thresholded channels x1 x2 x3",
            f"{int(area.max()) + 1} areas of one colour",
            f"judged by layer 2: {len(report)} regions, {len(report.faults)} faults",
        )
        for axes, picture, name in zip(grid[row], pictures, names, strict=True):
            axes.imshow(picture)
            axes.set_title(name, fontsize=11)
            axes.set(xticks=[], yticks=[])
        last = grid[row, -1]
        last.plot(*report.centroids_px.T, "+", color="black", ms=9, mew=2.6)
        last.plot(*report.centroids_px.T, "+", color="white", ms=7, mew=1.2, label="centroid")
        marks = {Fault.MISSING_TIE: ("#ff9d00", "missing tie"), None: ("black", "conflict or unknown")}
        for kind, (colour, label) in marks.items():
            regions = [f.region for f in report.faults if (f.kind is Fault.MISSING_TIE) == (kind is not None)]
            shown = report.centroids_px[np.array(regions, dtype=np.intp)]
            last.plot(*shown.T, "o", mfc="none", mec=colour, ms=21, mew=2.4, label=label)
        last.set(xlim=(0, rgb.shape[1]), ylim=(rgb.shape[0], 0))
    grid[1, -1].legend(
        loc="upper center", bbox_to_anchor=(0.5, -0.02), ncols=3, fontsize=9, facecolor="#bbbbbb"
    )
    figure.savefig(path, dpi=100)
    plt.close(figure)


def accuracy(path: Path, rows: list[Row], sweeps: dict[str, list[tuple[float, str]]]) -> None:
    """Recall and precision of each method over light, contrast, slope and noise.

    Args:
        path: The PNG file.
        rows: Of all classes together.
        sweeps: Values and their lights by name.
    """
    found = {(r["light"], r["method"]): r for r in rows}
    figure, grid = plt.subplots(2, 4, figsize=(15.0, 7.2), sharey=True, constrained_layout=True)
    for column, (name, values) in enumerate(sweeps.items()):
        for row, key in enumerate(("recall_pct", "precision_pct")):
            axes = grid[row, column]
            for method in palette_methods.NAMES:
                colour, line, mark = _STYLES[method]
                y = [found[light, method][key] for _, light in values]
                x = [value for value, _ in values]
                shown = [np.nan if v is None else v for v in y]
                # Triangles are large and hollow: most of them lie on the observer's points.
                size = {"ms": 9.0, "mfc": "none"} if mark == "^" else {"ms": 4.5}
                axes.plot(x, shown, line, marker=mark, color=colour, label=method, **size)
            axes.grid(color="#dddddd", lw=0.6)
            axes.set(ylim=(-3, 103), xlabel=_UNITS[name] if row else "")
            if column == 0:
                axes.set_ylabel(f"{key.removesuffix('_pct')} [%]")
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=10)
    figure.savefig(path, dpi=100)
    plt.close(figure)
