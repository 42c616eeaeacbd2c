"""A report as one interactive, self-contained HTML page.

Its figures and the code that draws them are compressed, and the browser unpacks them: without that a page has 5 MB.
"""

import base64
import functools
import gzip
import os
from collections.abc import Callable, Mapping, Sequence
from html import escape
from pathlib import Path

from covariant._templates import fill, template
from covariant.report._condensed import condensed
from covariant.report._estimate import EstimateReport
from covariant.report._glossary import glossary
from covariant.report._optional import optional
from covariant.report._panels import Quantity, quantities
from covariant.report._plotly import stack
from covariant.report._png import draw_png, write_all
from covariant.report._style import Style, styles
from covariant.report._table import cells


def write_html(report: EstimateReport, path: str | os.PathLike[str]) -> Path:
    """Write a report as one complete file, a page that contains its data and its plotting code.

    Args:
        report: What is drawn.
        path: The page to write (.html).

    Returns:
        The path.

    Raises:
        ValueError: The report is not consistent: see `EstimateReport.check`.
        ImportError: plotly is not installed.

    Example:
        >>> import numpy as np
        >>> from covariant.report import EstimateReport, write_html
        >>> t = np.linspace(0.0, 5.0, 501)
        >>> velocity = np.cos(t)[:, None]
        >>> report = EstimateReport("Pendulum", ("dθ/dt",), ("rad/s",), t, None, {"intrinsic": velocity})
        >>> write_html(report, "pendulum.html").name
        'pendulum.html'
    """
    return write_all({Path(path): page(report).encode()})[0]


def write_report(report: EstimateReport, path: str | os.PathLike[str]) -> list[Path]:
    """Write the page, and beside it the figures of `write_png`: all of them or none.

    Args:
        report: What is drawn.
        path: The page, such as `velocities.html`; the figures are `velocities_velocity.png` and so on.

    Returns:
        The paths of all files, the page first.

    Raises:
        ValueError: The report is not consistent: see `EstimateReport.check`.
        ImportError: matplotlib or plotly is not installed; nothing is written then.

    Example:
        >>> import numpy as np
        >>> from covariant.report import EstimateReport, write_report
        >>> t = np.linspace(0.0, 5.0, 501)
        >>> velocity = np.cos(t)[:, None]
        >>> report = EstimateReport("Pendulum", ("dθ/dt",), ("rad/s",), t, None, {"intrinsic": velocity})
        >>> [path.name for path in write_report(report, "pendulum.html")]
        ['pendulum.html', 'pendulum_velocity.png']
    """
    files = {Path(path): page(report).encode()}
    return write_all(files | draw_png(report, Path(path).with_suffix("")))


def page(report: EstimateReport) -> str:
    """Compose the text of the page of a report."""
    report.check()
    library = _library(optional("plotly.offline").get_plotlyjs)
    panels, styled = condensed(quantities(report)), styles(report)
    stacked = [quantity for quantity in panels.values() if quantity.name != "distance"]
    figures = [stack(stacked, i, styled) for i in range(len(report.coordinates))]
    names = ", ".join(quantity.title.lower() for quantity in stacked)
    sections = [_section(name, f"{name}: {names} over time in seconds") for name in report.coordinates]
    if "distance" in panels:
        figures.append(stack([panels["distance"]], 0, styled))
        title = panels["distance"].title
        sections.append(_section(title, f"{title} over time in seconds", "wide"))
    data = ",".join(str(figure.to_json()) for figure in figures)
    words = {
        "TITLE": escape(report.title),
        "STYLE": template("report", "page.css"),
        "VERDICT": _verdict(report),
        "TABLE": table_html(report.rows, report.ranked),
        "DETAILS": _details(report, panels),
        "LEGEND": _legend(styled),
        "COLUMNS": len(report.coordinates),
        "SECTIONS": sections,
        "FIGURES": _pack_text("figures", f"[{data}]"),
        "LIBRARY": library,
        "SCRIPT": template("report", "page.js"),
    }
    return fill("report", "page.html", words)


def _section(heading: str, description: str, kind: str = "") -> str:
    label = escape(description)
    return (
        f'<section class="{kind}"><h2>{escape(heading)}</h2>'
        f'<div class="figure" role="figure" aria-label="{label}"></div></section>'
    )


@functools.cache
def _library(source: Callable[[], str]) -> str:
    return _pack_text("plotly", source())


def _pack_text(name: str, text: str) -> str:
    """An element with a text for `unpack` in page.js: compressed, in base 85 without the character that opens a tag."""
    squeezed = gzip.compress(text.encode(), mtime=0)  # no time stamp: equal texts give equal bytes
    # The alphabet of base 85 has "<" and no comma, so that the page can put it back.
    letters = base64.b85encode(squeezed, pad=True).decode().replace("<", ",")
    return f'<script type="text/plain" id="{name}" data-bytes="{len(squeezed)}">{letters}</script>'


def _verdict(report: EstimateReport) -> str:
    """The result in one line, and the warnings."""
    if not report.headline:
        return _odd(report.warnings)
    line = report.headline[:1].upper() + report.headline[1:].rstrip(".")
    calm = "" if report.warnings else ' <span class="calm">No warnings.</span>'
    return f'<p class="verdict">{escape(line)}.{calm}</p>\n{_odd(report.warnings)}'


def _odd(warnings: Sequence[str]) -> str:
    lines = "".join(f"<li>{escape(warning)}</li>" for warning in warnings)
    return f'<ul class="odd" aria-label="Warnings">{lines}</ul>\n' if warnings else ""


def _details(report: EstimateReport, panels: dict[str, Quantity]) -> str:
    """Notes and terms; page.js folds them on a narrow screen, where they would fill it."""
    text = _notes(report, panels) + _glossary(report, panels)
    return f"<details open><summary>Design, notes and terms</summary>\n{text}</details>\n" if text else ""


def _glossary(report: EstimateReport, panels: dict[str, Quantity]) -> str:
    terms = glossary(report, panels)
    text = " ".join(f"<strong>{escape(term)}</strong>: {escape(meaning)}" for term, meaning in terms.items())
    return f'<p class="glossary">{text}</p>\n' if terms else ""


def _notes(report: EstimateReport, panels: dict[str, Quantity]) -> str:
    samples = len(report.t)
    notes = list(report.notes)
    if any(curve.below is not None for quantity in panels.values() for curve in quantity.curves):
        notes.append(
            f"The log has {samples} samples. Positions and velocities are drawn as the range from the smallest to the "
            "largest in short intervals, those of the first estimate only; errors and innovations as their "
            "running root mean square (RMS)."
        )
    return "<ul>" + "".join(f"<li>{escape(note)}</li>" for note in notes) + "</ul>\n" if notes else ""


def table_html(rows: Sequence[Mapping[str, object]], mark_best: bool) -> str:
    """Format a table in HTML."""
    if not rows:
        return ""
    header, body, numeric = cells(rows)
    side = [' class="number"' if right else "" for right in numeric]

    def line(tag: str, texts: list[str]) -> str:
        return "".join(f"<{tag}{at}>{escape(text)}</{tag[:2]}>" for text, at in zip(texts, side, strict=True))

    first, *others = (line("td", texts) for texts in body)
    mark = ' class="best"' if mark_best else ""
    lines = [f"<tr{mark}>{first}</tr>", *(f"<tr>{other}</tr>" for other in others)]
    heading = line('th scope="col"', header)
    head, rest = f"<thead><tr>{heading}</tr></thead>", f"<tbody>{''.join(lines)}</tbody>"
    # A container that scrolls can be reached by the keyboard.
    return f'<div class="table" tabindex="0" role="region" aria-label="Table"><table>{head}{rest}</table></div>\n'


def _legend(styled: dict[str, Style]) -> str:
    """Buttons that show or hide a label in all panels at once."""
    return "".join(
        f'<button type="button" aria-pressed="true" data-label="{name}">{_swatch(style)}{name}</button>'
        for name, style in ((escape(label), style) for label, style in styled.items())
    )


def _swatch(style: Style) -> str:
    dash = " ".join(map(str, style.dash))
    look = f"--light: {style.color}; --dark: {style.dark}"
    width = min(5.0, 1.2 + style.width)
    line = f'<line x1="1" x2="25" y1="5" y2="5" style="{look}" stroke-width="{width:g}" stroke-dasharray="{dash}"/>'
    return f'<svg width="26" height="10" aria-hidden="true">{line}</svg>'
