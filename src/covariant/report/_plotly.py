"""Draws panels stacked above one time axis, as a plotly figure."""

import math
from collections.abc import Collection
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from covariant.report._axis_range import AxisRange, axis_range
from covariant.report._estimate import BANDS
from covariant.report._optional import optional
from covariant.report._panels import Curve, Quantity, depths
from covariant.report._polylines import polygons, polyline
from covariant.report._style import BAND, BOUNDS, BOUNDS_DARK, GRID, INK, MUTED, SHADE, Style
from covariant.report._whiteness import Autocorrelation

if TYPE_CHECKING:
    import plotly.graph_objects

Spans = Float[np.ndarray, "k 2"]

_ROW, _GAP, _TOP, _BOTTOM = 170, 46, 58, 44
"""Heights of a panel, of the gap between two, and of the margins [px]."""


def stack(
    shown: list[Quantity],
    column: int,
    styled: dict[str, Style],
    shaded: Spans | None = None,
    hidden: Collection[str] = (),
) -> "plotly.graph_objects.Figure":
    """Draw one column of several quantities above a common time axis, with a common zoom in time."""
    inner = len(shown) * (_ROW + _GAP) - _GAP
    layout = _layout(inner) | {
        "hoversubplots": "axis",  # the cursor shows the values of all panels
        "xaxis": {"title": {"text": "t [s]"}, "anchor": _axis("y", len(shown)), **_FRAME, **_SPIKE},
    }
    first, last = shown[0].curves[0].t[[0, -1]]
    if last > first:
        layout["xaxis"]["range"] = [first, last]
    traces = []
    for k, quantity in enumerate(shown, start=1):
        # Domains are fractions of the height, counted from the bottom, while panels are listed from the top.
        top = 1 - (k - 1) * (_ROW + _GAP) / inner
        limits = axis_range(quantity, column, hidden)
        layout[f"yaxis{k}"] = _y_axis(quantity, column, limits) | {"domain": [max(0.0, top - _ROW / inner), top]}
        layout["annotations"] += _captions(_caption(quantity), top, limits)
        for curve, depth in zip(quantity.curves, depths(quantity, column), strict=True):
            traces += _traces(curve, column, quantity, styled[curve.label], _axis("y", k), depth)
    layout["shapes"] = [] if shaded is None else [_shade(begin, end) for begin, end in shaded.tolist()]
    return optional("plotly.graph_objects").Figure(data=traces, layout=layout)


def correlogram(values: Autocorrelation, column: int, style: Style) -> "plotly.graph_objects.Figure":
    """Draw the autocorrelation of an innovation over the lag, with the bounds for white noise."""
    go = optional("plotly.graph_objects")
    layout = _layout(_ROW) | {
        "xaxis": {"title": {"text": "lag [ms]"}, **_FRAME},
        "yaxis": {"title": {"text": "autocorrelation", "standoff": 8}, "nticks": 6, "automargin": True, **_FRAME},
        "bargap": 0.35,
    }
    layout["yaxis"] |= {"zeroline": True, "zerolinecolor": MUTED, "zerolinewidth": 1}
    line = {"type": "line", "xref": "paper", "x0": 0, "x1": 1, "line": {"color": MUTED, "width": 1, "dash": "dash"}}
    layout["shapes"] = [line | {"y0": y, "y1": y} for y in (-values.bound, values.bound)]
    bar = go.Bar(
        x=values.lags * 1e3,
        y=values.values[:, column],
        marker={"color": style.color},
        meta={"dark": style.dark},
        hovertemplate="%{x:.4~g} ms: %{y:.3f}<extra></extra>",
    )
    return go.Figure(data=[bar], layout=layout)


def _layout(inner: int) -> dict[str, Any]:
    return {
        "template": "none",
        "height": inner + _TOP + _BOTTOM,
        "margin": {"l": 70, "r": 12, "t": _TOP, "b": _BOTTOM},
        "font": {"family": "system-ui, sans-serif", "size": 12, "color": INK},
        "showlegend": False,  # the page has one legend for all figures
        "hovermode": "x unified",
        "annotations": [],
    }


def _caption(quantity: Quantity) -> str:
    """The title of a panel; none if the heading of its section says it already."""
    return "" if quantity.name == "distance" else quantity.title


def _shade(begin: float, end: float) -> dict[str, Any]:
    """A shaded interval, in which an external force acts."""
    return {
        "type": "rect",
        "xref": "x",
        "yref": "paper",
        "x0": begin,
        "x1": end,
        "y0": 0,
        "y1": 1,
        "fillcolor": SHADE,
        "opacity": BAND,
        "line": {"width": 0},
        "layer": "below",
    }


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
    axis |= {"exponentformat": "power"}  # avoids 400µ beside a unit
    if quantity.deviation and not quantity.log:
        axis |= {"zeroline": True, "zerolinecolor": MUTED, "zerolinewidth": 1}
    if quantity.log:
        axis |= {"type": "log"} | _log_ticks(limits)
    if limits is None:
        axis |= {"showticklabels": False, "ticks": ""}
    else:
        # plotly expects the ends of a logarithmic axis as exponents of 10.
        axis["range"] = [math.log10(y) if quantity.log else y for y in (limits.low, limits.high)]
    return axis


def _log_ticks(limits: AxisRange | None) -> dict[str, Any]:
    """Ticks of a logarithmic axis, as numbers of the same format: equally spaced, at 1, 2 and 5, or at powers of 10."""
    if limits is None:
        return {}
    decades = math.log10(limits.high / limits.low)
    if decades < math.log10(5):
        size = (limits.high - limits.low) / 3
        power = 10.0 ** math.floor(math.log10(size))
        step = max(k * power for k in (1, 2, 5) if k * power <= size)
        return {"dtick": f"L{step:g}", "tickformat": "~g"}
    lowest, highest = math.floor(math.log10(limits.low)), math.ceil(math.log10(limits.high))
    powers = range(lowest, highest + 1, max(1, round(decades / 5)))
    ticks = [k * 10.0**power for power in powers for k in ((1, 2, 5) if decades < 2.5 else (1,))]
    return {"tickvals": ticks, "ticktext": [f"{tick:g}" for tick in ticks]}


def _captions(heading: str, top: float, limits: AxisRange | None) -> list[dict[str, Any]]:
    """Captions above a panel: its title and, below it, a note on the samples outside."""
    place = {"xref": "paper", "yref": "paper", "x": 0, "xanchor": "left", "y": top, "yanchor": "bottom"}
    place |= {"showarrow": False}
    title = {**place, "text": f"<b>{heading}</b>"}
    message = "nothing to draw" if limits is None else limits.outside
    if not message:
        return [title]
    note = {"text": escape(message, quote=False), "font": {"size": 10.5}, "opacity": 0.75}
    return [title | {"yshift": 14}, place | note]


def _traces(curve: Curve, column: int, quantity: Quantity, style: Style, axis: str, depth: int) -> list[dict[str, Any]]:
    """The line of a curve and its isolated samples, a band, or marks; the page's legend switches the `legendgroup`."""
    shared = {
        "type": "scatter",
        "xaxis": "x",
        "yaxis": axis,
        "zorder": depth,
        "name": escape(curve.label, quote=False),
        "legendgroup": curve.label,
        # The page uses this colour if it is dark, and fits the y axis to the curves marked with `fits`. It shows a
        # band if both its curve and the legend's entry for bands, `band`, are switched on.
        "meta": {"dark": style.dark, "fits": curve.role not in ("raw", "mark")},
        "hovertemplate": "%{y:.4~g}",
    }
    if curve.role == "bounds":
        shared["meta"]["band"] = BANDS
    dash = ",".join(f"{length}px" for length in style.dash) or "solid"
    stroke = {"color": style.color, "width": style.width, "dash": dash}
    values = curve.values[:, column]
    if curve.role == "mark":
        marker = {"color": style.color, "size": 7, "symbol": style.symbol, "line": {"width": 1.5}}
        drawn = [((curve.t, values), {"mode": "markers", "marker": marker})]
    elif curve.below is not None and quantity.deviation:
        edges = {"mode": "lines", "line": {"color": BOUNDS, "width": 1.2}, "hoverinfo": "skip", "hovertemplate": None}
        edges["meta"] = shared["meta"] | {"dark": BOUNDS_DARK}
        drawn = [((curve.t, edge), edges) for edge in (values, curve.below[:, column])]
    elif curve.below is not None:
        faint = "rgba({},{},{},{})".format(*bytes.fromhex(style.color[1:]), BAND)
        fill = {"mode": "none", "fill": "toself", "fillcolor": faint, "hoverinfo": "skip", "hovertemplate": None}
        drawn = [(polygons(curve.t, curve.below[:, column], values), fill)]
    else:
        line, dots = polyline(curve.t, values, quantity.log)
        thin = stroke | {"width": min(1.0, style.width)} if quantity.deviation and not quantity.log else stroke
        drawn = [(line, {"mode": "lines", "line": thin})]
        if curve.role != "raw":
            drawn += [(dots, {"mode": "markers", "marker": {"color": style.color, "size": 2 + style.width}})]
    return [{**shared, **look, "x": t, "y": _round_values(y)} for (t, y), look in drawn if len(t)]


def _round_values(values: np.ndarray) -> np.ndarray:
    """Values rounded to more than 4 digits, enough to zoom: single precision with a short mantissa that compresses."""
    bits = values.astype(np.float32).view(np.uint32)
    # Half of the last remaining digit is added before the 9 low bits are cut off, which rounds to nearest.
    short = ((bits + np.uint32(1 << 8)) & np.uint32(0xFFFFFE00)).view(np.float32)
    return np.where(np.isfinite(values), short, np.float32(np.nan))
