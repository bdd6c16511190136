"""The style of the figures: one palette, log-log axes with units, reference slopes."""

import pathlib

import matplotlib


matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D


FOLDER = pathlib.Path(__file__).parent.parent / "docs/img"
# Marker and line of each group of methods.
GROUPS = ("o-", "s--", "^:")


def panels(count, columns, size, **options):
    """A figure of `count` panels, each of a `size` in inches, and its axes."""
    rows = -(-count // columns)
    options |= {"figsize": (size[0] * columns, size[1] * rows), "squeeze": False}
    fig, axes = plt.subplots(rows, columns, layout="constrained", **options)
    for ax in axes.flat[:count]:
        ax.grid(alpha=0.3)
    for ax in axes.flat[count:]:
        ax.axis("off")
    return fig, axes.flat[:count]


def save(fig, path):
    path.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(path, dpi=100)
    plt.close(fig)


def colors(names):
    """A color for each name: the strong ones of the palette first."""
    palette = plt.get_cmap("tab20")
    return {
        name: palette((2 * i + i // 10) % 20)
        for i, name in enumerate(dict.fromkeys(names))
    }


def slope(ax, x, y, power, label=None):
    """A dotted line of the power law through the first of the points."""
    x = np.asarray(x)
    ax.loglog(x, y * (x / x[0]) ** power, ":", color="0.5", lw=1)
    if label:
        where = np.sqrt(x[0] * x[-1])
        style = {"color": "0.4", "fontsize": 7, "clip_on": True}
        ax.text(where, y * (where / x[0]) ** power, label, **style)


def error_against_time(results, groups, path, columns):
    """Time over error, a panel for each problem; slopes of orders 2, 4 and 8.

    `results` are the curves by problem and method, `groups` the methods by group.
    """
    fig, axes = panels(len(results), columns, (4.6, 3.4))
    color = colors(name for names in groups for name in names)
    style = {
        name: form
        for names, form in zip(groups, GROUPS, strict=False)
        for name in names
    }
    for ax, (problem, curves) in zip(axes, results.items(), strict=True):
        for name, curve in curves.items():
            error, seconds = np.array(curve).T[:2]
            form = {"ms": 3, "lw": 1, "color": color[name]}
            ax.loglog(error, seconds * 1e6, style[name], **form)
        ax.set(title=problem, xlabel="relative error at the final time")
        ax.set(xlim=(1e1, 1e-15), ylabel="time of a solve (microseconds)")
        limits = ax.get_ylim()
        for order in (2, 4, 8):
            slope(ax, [1e-2, 1e-10], limits[0], -1 / order, f"order {order}")
        ax.set_ylim(limits)
    handles = [
        Line2D([], [], color=color[name], marker=style[name][0], ls=style[name][1:])
        for name in color
    ]
    fig.legend(handles, list(color), loc="outside right upper", fontsize=8)
    save(fig, path)


def ratio_dots(ratios, targets, title, path):
    """One line for each problem, and a dot for the ratio at each target; the last line
    is that of geometric means."""
    fig, ax = plt.subplots(figsize=(7.5, 0.3 * len(ratios) + 1.2), layout="constrained")
    lines = np.arange(len(ratios))[::-1]
    table = np.array([*ratios.values()], float)
    ax.hlines(lines, table.min(axis=1), table.max(axis=1), color="0.8", lw=2, zorder=1)
    for column, target in zip(table.T, targets, strict=True):
        ax.scatter(column, lines, s=36, zorder=2, label=f"to an error of {target:.0e}")
    ax.axvline(1, color="black", lw=1)
    ax.axhline(0.5, color="0.8", lw=1)
    ax.set_xscale("log")
    ticks = [x for x in (0.2, 0.5, 1, 2, 5, 10, 20) if 0.7 < x / table.min()]
    ticks = [x for x in ticks if x / table.max() < 1.4]
    ax.set_xticks(ticks, map(str, ticks))
    ax.minorticks_off()
    ax.set_yticks(lines, ratios)
    ax.set(title=title, xlabel="times faster than the fastest solver of Diffrax")
    ax.spines[["top", "right", "left"]].set_visible(False)
    ax.tick_params(axis="y", length=0)
    fig.legend(loc="outside lower center", ncols=len(targets), fontsize=9)
    save(fig, path)
