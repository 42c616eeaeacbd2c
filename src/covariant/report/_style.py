"""Defines the common look of all figures: colours, panels, files."""

import functools
import io
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from covariant.report._estimate import BANDS, DIFFERENCE, MARKS, MEASURED, EstimateReport
from covariant.report._optional import optional
from covariant.report._panels import Quantity
from scalargraph.errors import InputError
from scalargraph.files import write_atomically

if TYPE_CHECKING:
    import matplotlib.figure

BACKDROP = "#A8AEB5"
"""Grey, for measurements and true values."""

INK, MUTED, GRID = "#24292F", "#6B737C", "#E4E7EA"


class Palette(NamedTuple):
    """Colours by their meaning, the same in every figure; further curves take the remaining colours in order."""

    covariant: str
    ekf: str
    filter: str
    purple: str
    amber: str
    sky: str
    brown: str
    olive: str
    violet: str
    mint: str
    plum: str
    lavender: str
    navy: str

    @property
    def truth(self) -> str:
        """Colour of true or measured values: a wide grey line behind all others."""
        return BACKDROP

    @property
    def text(self) -> str:
        """Colour of remarks and marks beside the curves."""
        return MUTED

    @property
    def shade(self) -> str:
        """Colour of shaded intervals, such as a gap in a log."""
        return GRID


PALETTE = Palette(
    *("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#5D4037", "#8C8A2E"),
    *("#4A1FE0", "#1BCB7E", "#4A0E4E", "#8A7CFF", "#0A1464"),
)
"""Colours for all kinds of colour vision. They are those of Okabe & Ito 2008, with brown and olive for its black and
yellow, and five more that people without red, green or blue cones distinguish from these and from each other (Machado,
Oliveira & Fernandes 2009). `PALETTE.covariant` (blue), `PALETTE.ekf` (orange), `PALETTE.filter` (green) and
`PALETTE.truth` (grey) keep their meaning in all figures."""

DARK = {
    "#5D4037": "#FFC266",
    "#4A1FE0": "#A329FF",
    "#4A0E4E": "#94FFB3",
    "#0A1464": "#C2FF29",
}
"""Replacements for the darkest colours on a dark page, as distinct from all others as the originals are on white."""

DPI = 150

BAND = 0.2
"""Opacity of bands."""

SHADE = "#E69F00"
"""Colour of intervals in which an external force acts; its opacity is `BAND`."""

BOUNDS, BOUNDS_DARK = "#24292F", "#F2F4F6"
"""Colour of the bounds of errors, which are drawn in front of the errors."""

_DASHES = ((), (7, 3), (2, 2), (7, 2, 2, 2))


class Style(NamedTuple):
    """Style of a label in all panels.

    Attributes:
        color: Colour on white.
        dark: Colour on a dark page.
        width: Width of the line [points].
        dash: Lengths of dashes and gaps [points], empty if solid.
        symbol: Name of the plotly symbol of marks, and "band" for bands.
    """

    color: str
    dark: str
    width: float
    dash: tuple[int, ...] = ()
    symbol: str = ""


def styles(report: EstimateReport) -> dict[str, Style]:
    """Choose the style of every label of a report.

    Measurements are wide and grey, a reference is a thin dashed line in the colour of the text, and the first estimate
    is slightly wider than the others.
    """
    styled = {}
    if report.q_measured is not None:
        styled[MEASURED] = Style(BACKDROP, BACKDROP, 3.2)
        styled[DIFFERENCE] = Style(BACKDROP, BACKDROP, 0.8)  # it never shares a panel with measurements
    if report.v_reference is not None:
        styled[report.v_reference_label] = Style(INK, "#F2F4F6", 1.2, (4, 5))
    # Curves that are visible at first, among them the first estimate, get the colours that differ most.
    for i, label in enumerate(sorted(report.estimates, key=lambda label: label in report.hidden)):
        dash = _DASHES[i // len(PALETTE) % len(_DASHES)]
        color = PALETTE[i % len(PALETTE)]
        styled[label] = Style(color, DARK.get(color, color), 1.1 if i else 2.0, dash)
    for label in report.marks:
        styled[label] = Style(*_MARK_COLORS[label], 2.0, symbol=MARKS[label])
    return styled


def legend_styles(styled: Mapping[str, Style], shown: Iterable[Quantity]) -> dict[str, Style]:
    """The legend of some panels: the styles of their curves and, if any has a band, of the bands."""
    curves = [curve for quantity in shown for curve in quantity.curves]
    labels = {curve.label for curve in curves}
    banded = any(curve.role == "bounds" for curve in curves)
    bands = {BANDS: Style(BOUNDS, BOUNDS_DARK, 2.0, symbol="band")} if banded else {}
    return {label: style for label, style in styled.items() if label in labels} | bands


_MARK_COLORS = {
    "no measurement": (INK, "#F2F4F6"),
    "refused": ("#D55E00", "#FF8A3D"),
    "restarted": ("#9C2A78", "#FF7AD0"),
}
"""Colours of the marks, on white and on a dark page."""


def _png(figure: Any) -> bytes:
    """A figure as a PNG image."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def new_figure(
    rows: int = 1,
    cols: int = 1,
    *,
    panel: tuple[float, float] = (4.5, 2.3),
    titles: Sequence[str] = (),
    sharex: bool | str = "col",
) -> "tuple[matplotlib.figure.Figure, np.ndarray]":
    """Create a figure in the common style, whose lines take the colours of `PALETTE`.

    Use it for plots that should look like those of the library, in scripts and in notebooks. It opens no window; write
    the figure by `save_figure`.

    Args:
        rows: Number of rows of panels.
        cols: Number of columns of panels.
        panel: Width and height of one panel [inch]. A figure of 9 inch has 8 to 9 pt text in a column of 870 pixels.
        titles: Titles of the panels, row by row.
        sharex: Panels that share their x axis, as in `matplotlib`; by default those of a column.

    Returns:
        The figure, which has no window and no global state, and its axes (rows, cols). `save_figure` writes it.

    Raises:
        ImportError: matplotlib is not installed.

    Example:
        >>> from covariant.report import new_figure
        >>> figure, axes = new_figure(2, 1, titles=("position", "velocity"))
        >>> line = axes[0, 0].plot([0.0, 1.0], [0.0, 1.0])
        >>> axes.shape
        (2, 1)
    """
    width, height = panel[0] * cols, panel[1] * rows + 0.5
    figure = optional("matplotlib.figure").Figure(
        figsize=(width, height), dpi=DPI, layout="constrained", facecolor="white"
    )
    # A notebook asks an object for this method; matplotlib defines it only for figures with windows.
    figure._repr_png_ = functools.partial(_png, figure)
    axes = figure.subplots(rows, cols, sharex=sharex, squeeze=False)
    for ax in axes.flat:
        ax.set_prop_cycle(color=PALETTE)
        ax.spines[["top", "right"]].set_visible(False)
        ax.spines[["bottom", "left"]].set_color(MUTED)
        ax.tick_params(which="both", labelsize=8, color=MUTED, labelcolor=INK)
        ax.tick_params(which="minor", length=1.5)
        ax.grid(color=GRID, linewidth=0.7)
        ax.set_axisbelow(True)
        ax.xaxis.label.set(fontsize=9, color=INK)
        ax.yaxis.label.set(fontsize=9, color=INK)
        # Defaults for this figure only, since matplotlib's own are global.
        ax.legend = functools.partial(ax.legend, fontsize=8, labelcolor=INK, framealpha=0.85, edgecolor="none")
    for ax, title in zip(axes.flat, titles, strict=False):
        ax.set_title(title, loc="left", fontsize=10, color=INK)
    return figure, axes


def save_figure(figure: "matplotlib.figure.Figure", path: str | os.PathLike[str]) -> Path:
    """Write a figure to a file, completely or not at all.

    A failure leaves an existing file unchanged. Choose .svg or .pdf for print and .png for the screen; the resolution
    of bitmaps is fixed. Figures made directly with matplotlib are accepted too.

    Args:
        figure: The figure.
        path: The file; its suffix is the format, such as .png, .pdf or .svg.

    Returns:
        The path.

    Raises:
        ValueError: There is no suffix, or matplotlib does not know it.

    Example:
        >>> from covariant.report import new_figure, save_figure
        >>> figure, axes = new_figure()
        >>> save_figure(figure, "empty.png").name
        'empty.png'
    """
    name = figure_format(path)
    return write_atomically(path, lambda file: figure.savefig(file, format=name, dpi=DPI))


def figure_format(path: str | os.PathLike[str]) -> str:
    """Format of a figure, from the suffix of its file; this checks it before the figure is computed."""
    suffix = Path(path).suffix.removeprefix(".")
    if not suffix:
        raise InputError(f"{path}: name the format by a suffix, such as .png, .pdf or .svg")
    return suffix
