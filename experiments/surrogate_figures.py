"""Pictures of surrogates: the ladder, the glass box's weights, examples, learning curves."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

from seal_gym.core.frames import Array
from seal_gym.sealant.laydown.sections import BELOW_M, COLUMNS, PIXEL_M, ROWS
from seal_gym.sealant.surrogate import Surrogate

mpl.use("Agg")  # no screen needed
import matplotlib.pyplot as plt  # the backend has to be chosen first

_MM = 1e3 * PIXEL_M
_EXTENT = (-COLUMNS / 2 * _MM, COLUMNS / 2 * _MM, -1e3 * BELOW_M, ROWS * _MM - 1e3 * BELOW_M)
_FIXED = ("reference itself", "mean section", "fast tier, one station", "fast tier, along the path")
# inputs shown, from the first of a row to the last
_SHOWN = {f"$v_{a}$": slice(k, k + 1) for k, a in enumerate("xyz")}
_SHOWN |= {rf"$\omega_{a}$": slice(3 + k, 4 + k) for k, a in enumerate("xyz")}
_SHOWN |= {f"$g_{a}$": slice(6 + k, 7 + k) for k, a in enumerate("xyz")}
_SHOWN |= {"heights left of the nozzle": slice(9, 29), "all heights": slice(9, 50)}
_SHOWN |= {"heights right of the nozzle": slice(30, 50)}


def ladder(path: Path, rows: list[dict[str, Any]]) -> None:
    """Intersection over union and area error of each model.

    Args:
        path: The PNG file.
        rows: Of the table.
    """
    rows = [r for r in rows if r["model"] != "reference itself"]
    figure, axes = plt.subplots(
        1, 2, figsize=(11, 1.4 + 0.36 * len(rows)), sharey=True, constrained_layout=True
    )
    place = np.arange(len(rows))[::-1]
    colours = ["#9a9a9a" if r["model"] in _FIXED else "#2b6cb0" for r in rows]
    titles = {"iou": "IoU (more is better)", "area_error_pct": "area error [%] (less is better)"}
    for spot, (key, title) in zip(axes, titles.items(), strict=True):
        for y, r, colour in zip(place, rows, colours, strict=True):
            spot.barh(y, r[key], color=colour, height=0.7)
            interval = r[f"{key.removesuffix('_pct')}_ci"]
            if interval:
                spot.plot(interval, [y, y], color="#222222", lw=1.5)
        spot.set_title(title, fontsize=11)
        spot.grid(axis="x", color="#dddddd", lw=0.6)
        spot.set_axisbelow(True)
    axes[0].set_yticks(place, [r["model"] for r in rows])
    figure.suptitle("obstacle course; grey: nothing learned but a mean; lines: 95 % intervals", fontsize=10)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def glass_box(path: Path, model: Surrogate) -> None:
    """The linear model: its section at mean inputs, and what one deviation more of an input adds.

    Args:
        path: The PNG file.
        model: Of kind ``"linear"`` without neighbours.
    """
    net = model.net
    weights = net.glass.weight.detach().numpy().T.reshape(-1, ROWS, COLUMNS)
    bias = net.glass.bias.detach().numpy().reshape(ROWS, COLUMNS)
    figure, axes = plt.subplots(5, 3, figsize=(11, 10), sharex=True, sharey=True, constrained_layout=True)
    spots = iter(axes.flat)
    first = next(spots)
    first.imshow(bias, origin="lower", extent=_EXTENT, cmap="Greys", vmin=0, vmax=1)
    first.set_title("b: section at mean inputs (black: full)", fontsize=9)
    for _ in range(2):
        next(spots).set_axis_off()
    maps = {name: weights[chosen].sum(0) for name, chosen in _SHOWN.items()}
    bound = max(float(np.abs(m).max()) for m in maps.values())
    for (name, change), spot in zip(maps.items(), spots, strict=True):
        picture = spot.imshow(change, origin="lower", extent=_EXTENT, cmap="RdBu_r", vmin=-bound, vmax=bound)
        spot.set_title(f"{name}, + one deviation", fontsize=9)
    for spot in axes[-1]:
        spot.set_xlabel("across [mm]")
    for spot in axes[:, 0]:
        spot.set_ylabel("along the nozzle [mm]", fontsize=8)
    figure.colorbar(picture, ax=axes, shrink=0.5, label="change of the share of sealant")
    figure.savefig(path, dpi=100)
    plt.close(figure)


def examples(path: Path, rows: Sequence[tuple[str, Sequence[Array]]], names: Sequence[str]) -> None:
    """Sections side by side.

    Args:
        path: The PNG file.
        rows: Title and sections, the reference first.
        names: Of the columns.
    """
    figure, axes = plt.subplots(
        len(rows),
        len(names),
        figsize=(3.1 * len(names), 1.75 * len(rows) + 0.5),
        sharex=True,
        sharey=True,
        squeeze=False,
        constrained_layout=True,
    )
    for line, (title, images) in zip(axes, rows, strict=True):
        for k, (spot, image) in enumerate(zip(line, images, strict=True)):
            spot.imshow(image, origin="lower", extent=_EXTENT, cmap="Greys", vmin=0, vmax=1)
            if k:  # the reference's outline over each prediction
                x, z = (np.arange(n) + 0.5 for n in (COLUMNS, ROWS))
                spot.contour(
                    _EXTENT[0] + x * _MM,
                    _EXTENT[2] + z * _MM,
                    images[0],
                    [0.5],
                    colors="#d1382c",
                    linewidths=1,
                )
        line[0].set_ylabel(
            title.replace(", ", "\n").replace(": ", ":\n").replace("but for", "but\nfor"), fontsize=9
        )
    for spot, name in zip(axes[0], names, strict=True):
        spot.set_title(name, fontsize=10)
    for spot in axes[-1]:
        spot.set_xlabel("across [mm]")
    figure.suptitle("black: sealant; red: where the reference is half full; height in mm", fontsize=10)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def curves(path: Path, histories: dict[str, tuple[tuple[float, float], ...]]) -> None:
    """Learning curves.

    Args:
        path: The PNG file.
        histories: Training and held-out error of each epoch, by model.
    """
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.8), sharey=True, constrained_layout=True)
    colours = mpl.colormaps["tab10"](np.arange(len(histories)))
    for k, (name, history) in enumerate(histories.items()):
        for spot, column in zip(axes, (0, 1), strict=True):
            values = [h[column] for h in history]
            spot.plot(np.arange(1, len(values) + 1), values, color=colours[k], label=name)
    for spot, title in zip(axes, ("training centre paths", "held-out centre paths"), strict=True):
        spot.set(title=title, xlabel="epoch", yscale="log")
        spot.grid(color="#dddddd", lw=0.6, which="both")
    axes[0].set_ylabel("mean square error of a pixel")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=9)
    figure.savefig(path, dpi=110)
    plt.close(figure)
