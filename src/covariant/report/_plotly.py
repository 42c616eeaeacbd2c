"""Panels stacked above one time axis, as a plotly figure."""

import math
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from covariant.report._axis_range import AxisRange, axis_range
from covariant.report._optional import optional
from covariant.report._panels import Curve, Quantity, depths
from covariant.report._polylines import outline, polygons, polyline
from covariant.report._style import BAND, EDGE, GRID, INK, MUTED, Style

if TYPE_CHECKING:
    import plotly.graph_objects

_ROW, _GAP, _TOP, _BOTTOM = 170, 46, 58, 44
"""Heights of a panel, of the gap between two, and of the margins [px]."""


def stack(shown: list[Quantity], column: int, styled: dict[str, Style]) -> "plotly.graph_objects.Figure":
    """Draw one column of several quantities above a common time axis, with a common zoom in time."""
    inner = len(shown) * (_ROW + _GAP) - _GAP
    layout: dict[str, Any] = {
        "template": "none",
        "height": inner + _TOP + _BOTTOM,
        "margin": {"l": 70, "r": 12, "t": _TOP, "b": _BOTTOM},
        "font": {"family": "system-ui, sans-serif", "size": 12, "color": INK},
        "showlegend": False,  # the page has one legend for all figures
        "hovermode": "x unified",
        "annotations": [],
        "xaxis": {"title": {"text": "t [s]"}, "anchor": _axis("y", len(shown)), **_FRAME, **_SPIKE},
    }
    first, last = shown[0].curves[0].t[[0, -1]]
    if last > first:
        layout["xaxis"]["range"] = [first, last]
    traces = []
    for k, quantity in enumerate(shown, start=1):
        # Domains are fractions of the height from the bottom, and panels are listed from the top.
        top = 1 - (k - 1) * (_ROW + _GAP) / inner
        limits = axis_range(quantity, column)
        layout[f"yaxis{k}"] = _y_axis(quantity, column, limits) | {"domain": [max(0.0, top - _ROW / inner), top]}
        layout["annotations"] += _captions(quantity.title if len(shown) > 1 else "", top, limits)
        for curve, depth in zip(quantity.curves, depths(quantity, column), strict=True):
            traces += _traces(curve, column, quantity, styled[curve.label], _axis("y", k), depth)
    return optional("plotly.graph_objects").Figure(data=traces, layout=layout)


_FRAME = {"gridcolor": GRID, "linecolor": MUTED, "showline": True, "zeroline": False, "ticks": "outside", "ticklen": 4}
_SPIKE = {
    "hoverformat": ".4~f",
    "showspikes": True,
    "spikemode": "across",
    "spikethickness": 1,
    "spikedash": "solid",
    "spikecolor": MUTED,
}


def _axis(letter: str, k: int) -> str:
    return letter if k == 1 else f"{letter}{k}"


def _y_axis(quantity: Quantity, column: int, limits: AxisRange | None) -> dict[str, Any]:
    label = escape(quantity.labels[column], quote=False).replace("\n", "<br>")
    axis = {"title": {"text": label, "standoff": 8}, "nticks": 6, "automargin": True, **_FRAME}
    axis |= {"exponentformat": "power"}  # not 400µ beside a unit
    if quantity.deviation and not quantity.log:
        axis |= {"zeroline": True, "zerolinecolor": MUTED, "zerolinewidth": 1}
    if quantity.log:
        axis |= {"type": "log"} | _log_ticks(limits)
    if limits is None:
        axis |= {"showticklabels": False, "ticks": ""}
    else:
        # plotly takes the ends of a logarithmic axis as exponents of 10.
        axis["range"] = [math.log10(y) if quantity.log else y for y in (limits.low, limits.high)]
    return axis


def _log_ticks(limits: AxisRange | None) -> dict[str, str]:
    """Ticks of a short logarithmic axis with whole numbers: plotly writes lone digits between powers of 10."""
    if limits is None or limits.high >= 100 * limits.low:
        return {}
    if limits.high >= 5 * limits.low:
        return {"dtick": "D2", "tickformat": "~g"}  # at 1, 2 and 5
    size = (limits.high - limits.low) / 3
    power = 10.0 ** math.floor(math.log10(size))
    step = max(k * power for k in (1, 2, 5) if k * power <= size)
    return {"dtick": f"L{step:g}", "tickformat": "~g"}  # equally far apart


def _captions(heading: str, top: float, limits: AxisRange | None) -> list[dict[str, Any]]:
    """Captions above a panel: its title, and under it a note on what lies outside."""
    place = {"xref": "paper", "yref": "paper", "x": 0, "xanchor": "left", "y": top, "yanchor": "bottom"}
    place |= {"showarrow": False}
    title = {**place, "text": f"<b>{heading}</b>"}
    message = "nothing to draw" if limits is None else limits.outside
    if not message:
        return [title]
    note = {"text": escape(message, quote=False), "font": {"size": 10.5}, "opacity": 0.75}
    return [title | {"yshift": 14}, place | note]


def _traces(curve: Curve, column: int, quantity: Quantity, style: Style, axis: str, depth: int) -> list[dict[str, Any]]:
    """The line of a curve and its isolated samples, or its band; the legend of the page switches the `legendgroup`."""
    shared = {
        "type": "scatter",
        "xaxis": "x",
        "yaxis": axis,
        "zorder": depth,
        "name": escape(curve.label, quote=False),
        "legendgroup": curve.label,
        "meta": style.dark,  # the page takes this colour where it is dark
        "hovertemplate": "%{y:.3~g}",
    }
    dash = ",".join(f"{length}px" for length in style.dash) or "solid"
    stroke = {"color": style.color, "width": style.width, "dash": dash}
    if curve.below is not None:
        band = curve.t, curve.below[:, column], curve.values[:, column]
        faint = "rgba({},{},{},{})".format(*bytes.fromhex(style.color[1:]), BAND[curve.role])
        fill = {"mode": "none", "fill": "toself", "fillcolor": faint, "hoverinfo": "skip", "hovertemplate": None}
        edges = {"mode": "lines", "line": {**stroke, "width": EDGE[curve.role] * style.width}}
        drawn = [(polygons(*band), fill)] if curve.backdrop or quantity.deviation else []
        drawn += [] if quantity.deviation else [(outline(*band), edges)]
    else:
        line, dots = polyline(curve.t, curve.values[:, column], quantity.log)
        drawn = [
            (line, {"mode": "lines", "line": stroke}),
            (dots, {"mode": "markers", "marker": {"color": style.color, "size": 2 + style.width}}),
        ]
    return [{**shared, **look, "x": t, "y": _round_values(y)} for (t, y), look in drawn if len(t)]


def _round_values(values: np.ndarray) -> np.ndarray:
    """Values to 3 digits, as on a screen: single precision with a short mantissa, which compresses well."""
    bits = values.astype(np.float32).view(np.uint32)
    # Half of the last digit that stays is added before the 12 low bits are cut: this rounds to nearest.
    short = ((bits + np.uint32(1 << 11)) & np.uint32(0xFFFFF000)).view(np.float32)
    return np.where(np.isfinite(values), short, np.float32(np.nan))
