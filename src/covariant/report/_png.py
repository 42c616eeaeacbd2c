"""Draws a report as PNG figures."""

import io
import os
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

from covariant.report._axis_range import axis_range
from covariant.report._condensed import condensed
from covariant.report._estimate import EstimateReport
from covariant.report._optional import optional
from covariant.report._panels import Quantity, depths, quantities, shorten
from covariant.report._polylines import polyline
from covariant.report._style import BAND, BOUNDS, DPI, GRID, INK, MUTED, SHADE, Style, legend_styles, new_figure, styles

if TYPE_CHECKING:
    import matplotlib.axes
    import matplotlib.figure

_FIGURES = {
    "velocity": ("velocity", "error"),
    "position": ("position", "innovation"),
    "distance": ("distance",),
    "along": ("along",),
}


def draw_png(report: EstimateReport, path: str | os.PathLike[str]) -> dict[Path, bytes]:
    """Draw a row of panels for each coordinate, with a column for each quantity.

    The figures are `<path>_velocity.png`, `<path>_position.png` and `<path>_distance.png`, if they have curves.
    """
    panels, styled = condensed(quantities(report.check())), styles(report)
    path = Path(path)
    stem = path.with_suffix("") if path.suffix.lower() == ".png" else path
    files = {}
    for name, members in _FIGURES.items():
        shown = [panels[member] for member in members if member in panels]
        if shown:
            buffer = io.BytesIO()
            _figure(report.title, shown, styled, report.shaded).savefig(buffer, format="png", dpi=DPI)
            files[stem.with_name(f"{stem.name}_{name}.png")] = buffer.getvalue()
    return files


def figure(report: EstimateReport) -> "matplotlib.figure.Figure":
    """Draw velocities or states and, if there is a reference, their errors, with a row for each coordinate.

    Below them are the quantities estimated along with the motion, such as forces.

    Args:
        report: The curves; `write_report` also draws those of the motion, to `<path>_velocity.png`.

    Returns:
        A `matplotlib.figure.Figure` that belongs to no window; a notebook shows it, and `save_figure` writes it.

    Raises:
        ValueError: The report is not consistent: see `EstimateReport.check`.
        ImportError: matplotlib is not installed.

    Example:
        >>> import numpy as np
        >>> from covariant.report import EstimateReport, figure, save_figure
        >>> t = np.linspace(0.0, 5.0, 501)
        >>> velocity = np.cos(t)[:, None]
        >>> report = EstimateReport("Pendulum", ("dθ/dt",), ("rad/s",), t, None, {"intrinsic": velocity})
        >>> save_figure(figure(report), "pendulum.svg").name
        'pendulum.svg'
    """
    panels = condensed(quantities(report.check()))
    shown = [panels[member] for member in _FIGURES["velocity"] if member in panels]
    return _figure(report.title, shown, styles(report), report.shaded, panels.get("along"))


def _figure(
    title: str, shown: list[Quantity], styled: dict[str, Style], shaded: Any = None, below: Quantity | None = None
) -> "matplotlib.figure.Figure":
    """Draw a column for each quantity, and below them the panels of `below`, with the intervals `shaded` shaded."""
    count, cols = len(shown[0].labels), len(shown)
    more = 0 if below is None else len(below.labels)
    rows = count + -(-more // cols)  # rounded up
    panel = (4.8, 2.3) if len(shown) > 1 else (7.2, 3.0 if rows == 1 else 2.3)
    figure, axes = new_figure(rows, cols, panel=panel, titles=[quantity.title for quantity in shown])
    for j, quantity in enumerate(shown):
        for i in range(count):
            _draw(axes[i, j], quantity, i, styled)
        axes[-1, j].set_xlabel("t [s]")
    drawn = [*axes[:count].flat]
    if below is not None:
        rest = [*axes[count:].flat]
        for i, ax in enumerate(rest[:more]):
            _draw(ax, below, i, styled)
        rest[0].set_title(below.title, loc="left", fontsize=10, color=INK)
        drawn += rest[:more]
        for ax, above in zip(rest[more:], drawn[len(drawn) - cols :], strict=False):
            ax.set_axis_off()
            above.set_xlabel("t [s]")
            above.tick_params(labelbottom=True)
    for ax in drawn:
        for begin, end in () if shaded is None else shaded:
            ax.axvspan(begin, end, color=SHADE, alpha=0.15, linewidth=0, zorder=0)
    legend_lines = _legend(figure, legend_styles(styled, shown if below is None else [*shown, below]))
    lines = textwrap.wrap(title, int(10 * figure.get_figwidth()))
    figure.suptitle(_plain("\n".join(lines)), x=0.012, ha="left", fontsize=11, fontweight="bold", color=INK)
    # The figure grows by the height of title and legend, so that the panels keep their size.
    figure.set_figheight(figure.get_figheight() + 0.19 * (len(lines) + legend_lines))
    return figure


def _draw(ax: "matplotlib.axes.Axes", quantity: Quantity, column: int, styled: dict[str, Style]) -> None:
    limits = axis_range(quantity, column)
    ax.set_ylabel(_plain(quantity.labels[column]))
    if quantity.deviation and not quantity.log:
        ax.axhline(0.0, color=MUTED, linewidth=0.7)
    if quantity.log:
        ax.set_yscale("log")
    first, last = quantity.curves[0].t[[0, -1]]
    if last > first:
        ax.set_xlim(first - 0.01 * (last - first), last + 0.01 * (last - first))
    if limits is None:
        ax.tick_params(axis="y", which="both", left=False, labelleft=False)
        ax.text(0.5, 0.5, "nothing to draw", transform=ax.transAxes, ha="center", va="center", color=MUTED, fontsize=9)
        return
    for curve, depth in zip(quantity.curves, depths(quantity, column), strict=True):
        style = styled[curve.label]
        color, width, order = style.color, style.width, 2 + depth / 100  # between grid and text
        values = curve.values[:, column]
        if curve.role == "mark":
            ax.plot(curve.t, values, **_MARKERS[style.symbol], color=color, linestyle="none", zorder=order)
        elif curve.below is not None and quantity.deviation:
            for edge in (values, curve.below[:, column]):
                ax.plot(curve.t, edge, color=BOUNDS, linewidth=0.8, zorder=order)
        elif curve.below is not None:
            ax.fill_between(curve.t, curve.below[:, column], values, color=color, alpha=BAND, linewidth=0, zorder=order)
        else:
            line, dots = polyline(curve.t, values, quantity.log)
            width = min(width, 0.6) if quantity.deviation and not quantity.log else width
            stroke = (0, style.dash) if style.dash else "-"
            ax.plot(*line, color=color, linewidth=width, linestyle=stroke, zorder=order)
            ax.plot(*dots, ".", color=color, markersize=1.5 + width, zorder=order)
    ax.set_ylim(limits.low, limits.high)
    ax.set_title(_plain(limits.outside), loc="right", fontsize=7, color=MUTED)


_BAR = [(-1, -0.3), (1, -0.3), (1, 0.3), (-1, 0.3), (-1, -0.3)]
_MARKERS = {
    "circle-open": {"marker": "o", "markersize": 4, "markerfacecolor": "none", "markeredgewidth": 0.8},
    "x": {"marker": "x", "markersize": 4},
    "diamond-open": {"marker": "D", "markersize": 4, "markerfacecolor": "none", "markeredgewidth": 0.8},
    "band": {"marker": _BAR, "markersize": 20, "markerfacecolor": GRID, "markeredgewidth": 0.8},
}
"""Markers of matplotlib for the plotly symbols named in styles."""


def _legend(figure: "matplotlib.figure.Figure", styled: dict[str, Style]) -> int:
    """Draw one legend below all panels, in as many columns as fit its labels; return its number of lines."""
    line = optional("matplotlib.lines").Line2D
    handles = [
        line([], [], color=each.color, linestyle="none", **_MARKERS[each.symbol])
        if each.symbol
        else line(
            [], [], color=each.color, linewidth=max(each.width, 1.5), linestyle=(0, each.dash) if each.dash else "-"
        )
        for each in styled.values()
    ]
    labels = [_plain(shorten(label, 60)) for label in styled]
    fitting = max(1, int(11.5 * figure.get_figwidth() / (max(map(len, labels)) + 7)))
    lines = -(-len(labels) // fitting)  # rounded up; the labels are then spread evenly over the lines
    cols = -(-len(labels) // lines)
    look = {"frameon": False, "fontsize": 8.5, "handlelength": 2.8, "labelcolor": INK}
    figure.legend(handles, labels, loc="outside lower center", ncols=cols, **look)
    return lines


def _plain(text: str) -> str:
    """Text in which a dollar sign is shown as such, and does not start a formula in matplotlib."""
    return text.replace("$", r"\$")
