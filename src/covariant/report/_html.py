"""A report as one interactive, self-contained HTML page.

Its figures and the code that draws them are compressed, and the browser unpacks them: without that a page has 5 MB.
"""

import base64
import functools
import gzip
import importlib.resources
import os
from collections.abc import Callable, Mapping, Sequence
from html import escape
from pathlib import Path

from covariant._files import write_atomically
from covariant.report._condensed import condensed
from covariant.report._estimate import EstimateReport
from covariant.report._optional import optional
from covariant.report._panels import Quantity, quantities
from covariant.report._plotly import stack
from covariant.report._style import Style, styles
from covariant.report._table import cells

_HINT = """<p class="hint">Drag along the time axis to zoom: all figures follow. Double-click to go back, and again to \
see what is off scale. A label hides its curve everywhere; double-click it to see that curve alone.</p>
"""


def write_html(report: EstimateReport, path: str | os.PathLike[str]) -> Path:
    """Write the report as one complete file, a page that contains its data and its plotting code; returns its path.

    Raises `ValueError` from `EstimateReport.check`, `ImportError` without plotly.
    """
    page = _page(report.check())
    return write_atomically(path, lambda file: file.write(page.encode()))


def _page(report: EstimateReport) -> str:
    library = _library(optional("plotly.offline").get_plotlyjs)
    found, styled = condensed(quantities(report)), styles(report)
    stacked = [quantity for quantity in found.values() if quantity.name != "distance"]
    figures = [stack(stacked, i, styled) for i in range(len(report.coordinates))]
    sections = [_section(name) for name in report.coordinates]
    if "distance" in found:
        figures.append(stack([found["distance"]], 0, styled))
        sections.append(_section(found["distance"].title, "wide"))
    data = ",".join(str(figure.to_json()) for figure in figures)
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'; \
script-src 'unsafe-inline'; img-src data: blob:">
<link rel="icon" href="data:,">
<title>{escape(report.title)}</title>
<style>
{asset("page.css")}</style>
</head>
<body>
<header>
<h1>{escape(report.title)}</h1>
{_notes(report, found)}{table_html(report.rows)}{_HINT}</header>
<nav aria-label="Curves shown">{_legend(styled)}</nav>
<main style="--columns: {len(report.coordinates)}">
{chr(10).join(sections)}
</main>
<noscript>The figures need JavaScript.</noscript>
{_packed("figures", f"[{data}]")}
{library}
<script>
{asset("page.js")}</script>
</body>
</html>
"""


def asset(name: str) -> str:
    return (importlib.resources.files("covariant.report") / name).read_text(encoding="utf-8")


def _section(heading: str, kind: str = "") -> str:
    return f'<section class="{kind}"><h2>{escape(heading)}</h2><div class="figure"></div></section>'


@functools.cache
def _library(source: Callable[[], str]) -> str:
    return _packed("plotly", source())


def _packed(name: str, text: str) -> str:
    """An element with a text for `unpack` in page.js: compressed, in base 85 without the character that opens a tag."""
    squeezed = gzip.compress(text.encode(), mtime=0)
    letters = base64.b85encode(squeezed, pad=True).decode().replace("<", ",")
    return f'<script type="text/plain" id="{name}" data-bytes="{len(squeezed)}">{letters}</script>'


def _notes(report: EstimateReport, found: dict[str, Quantity]) -> str:
    samples = len(report.t)
    notes = list(report.notes)
    if any(curve.below is not None for quantity in found.values() for curve in quantity.curves):
        notes.append(
            f"The log has {samples} samples. Positions and velocities are drawn as the range from the smallest to the "
            "largest in short intervals, those of the first estimate only; errors and innovations as their "
            "running root mean square (RMS)."
        )
    return "<ul>" + "".join(f"<li>{escape(note)}</li>" for note in notes) + "</ul>\n" if notes else ""


def table_html(rows: Sequence[Mapping[str, object]], mark_best: bool = True) -> str:
    """A table in HTML; `mark_best` highlights its first row."""
    if not rows:
        return ""
    header, body, numeric = cells(rows)
    side = [' class="number"' if right else "" for right in numeric]

    def line(tag: str, texts: list[str]) -> str:
        return "".join(f"<{tag}{at}>{escape(text)}</{tag}>" for text, at in zip(texts, side, strict=True))

    first, *others = (line("td", texts) for texts in body)
    mark = ' class="best"' if mark_best else ""
    lines = [f"<tr{mark}>{first}</tr>", *(f"<tr>{other}</tr>" for other in others)]
    head, rest = f"<thead><tr>{line('th', header)}</tr></thead>", f"<tbody>{''.join(lines)}</tbody>"
    return f'<div class="table"><table>{head}{rest}</table></div>\n'


def _legend(styled: dict[str, Style]) -> str:
    """Buttons that show or hide a label in all panels at once."""
    return "".join(
        f'<button type="button" aria-pressed="true" data-label="{name}">{_swatch(style)}{name}</button>'
        for name, style in ((escape(label), style) for label, style in styled.items())
    )


def _swatch(style: Style) -> str:
    dash = " ".join(map(str, style.dash))
    line = f'<line x1="1" x2="25" y1="5" y2="5" stroke="{style.color}" stroke-width="3" stroke-dasharray="{dash}"/>'
    return f'<svg width="26" height="10" aria-hidden="true">{line}</svg>'
