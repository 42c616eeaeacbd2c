"""Writes a report as one interactive, self-contained HTML page.

Its figures and the code that draws them are compressed, and the browser unpacks them; otherwise a page would have 5 MB.
"""

import base64
import functools
import gzip
import io
import json
import os
from collections.abc import Callable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from covariant.report._condensed import condensed
from covariant.report._estimate import EstimateReport
from covariant.report._glossary import glossary
from covariant.report._optional import optional
from covariant.report._panels import Quantity, quantities
from covariant.report._plotly import correlogram, stack
from covariant.report._png import draw_png
from covariant.report._style import Style, legend_styles, styles
from covariant.report._table import cells
from covariant.report._whiteness import autocorrelation
from covariant.scoring import scored_window
from scalargraph.errors import printable
from scalargraph.files import utf8, write_together
from scalargraph.template import fill, template


def write_report(report: EstimateReport, path: str | os.PathLike[str]) -> list[Path]:
    """Write a page with its data and plotting code, and figures beside it; either all files are written or none.

    Args:
        report: The report to draw.
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
    files = {Path(path): utf8(page(report))}
    files |= draw_png(report, Path(path).with_suffix(""))
    write_together(files)
    return list(files)


def page(report: EstimateReport) -> str:
    """Compose the text of the page of a report."""
    report.check()
    library = _library(optional("plotly.offline").get_plotlyjs)
    panels, styled = quantities(report), styles(report)
    # Innovations show the difference of measurement and estimate better than two curves that nearly coincide.
    panels = {name: each for name, each in panels.items() if "innovation" not in panels or name not in _SAID_BETTER}
    panels = condensed(panels)
    sections, figures = _sections(report, panels, styled)
    legend = legend_styles(styled, panels.values())
    words = {
        "TITLE": escape(printable(report.title)),
        "STYLE": template("covariant.report", "page.css"),
        "VERDICT": verdict_html(report.headline, report.warnings),
        "FACTS": facts_html(report.facts) + _code(report),
        "TABLE": table_html(report.rows, report.best),
        "DETAILS": _details(report, panels, legend),
        "LEGEND": _legend(legend, report.hidden),
        "COLUMNS": len(report.coordinates),
        "SECTIONS": sections,
        "FIGURES": _pack_text("figures", _with_common_stamps(figures)) + _csv(report),
        "LIBRARY": library,
        "SCRIPT": template("covariant.report", "page.js"),
    }
    return fill("covariant.report", "page.html", words)


_SAID_BETTER = ("position", "distance")
"""Panels that are left out if there are innovations, which show the same better."""


def _sections(
    report: EstimateReport, panels: dict[str, Quantity], styled: dict[str, Style]
) -> tuple[list[str], list[Any]]:
    """The sections of a page with the figure of each: coordinates, other estimated quantities, and correlations."""
    stacked = [quantity for quantity in panels.values() if quantity.name not in ("distance", "along")]
    names = ", ".join(quantity.title.lower() for quantity in stacked)
    figures = [stack(stacked, i, styled, report.shaded, report.hidden) for i in range(len(report.coordinates))]
    sections = [_section(name, f"{name}: {names} over time in seconds") for name in report.coordinates]
    if "along" in panels and report.along is not None:
        for i, name in enumerate(report.along.names):
            figures.append(stack([panels["along"]], i, styled, report.shaded))
            sections.append(_section(name, f"{name} over time in seconds"))
    if "distance" in panels:
        figures.append(stack([panels["distance"]], 0, styled))
        title = panels["distance"].title
        sections.append(_section(title, f"{title} over time in seconds", "wide"))
    if len(report.innovation) == 1:
        [(label, innovation)] = report.innovation.items()
        t = np.asarray(report.t, float)
        late = scored_window(t, tail=0.0)  # the start of an observer tells nothing about its model
        found = autocorrelation(t[late], np.asarray(innovation, float)[late])
        if found is None:
            return sections, figures
        for i, name in enumerate(report.coordinates):
            figures.append(correlogram(found, i, styled[label]))
            title = f"{name}: autocorrelation of the innovation"
            about = f"{title} over lag in milliseconds after its start, with 95 % bounds of white noise"
            sections.append(_section(title, about, "lag"))
    return sections, figures


def _with_common_stamps(figures: Sequence[Any]) -> str:
    """The figures as JSON in which each array of stamps occurs once; traces refer to it by number."""
    stamps: dict[str, int] = {}
    drawn = [json.loads(figure.to_json()) for figure in figures]
    for figure in drawn:
        for trace in figure["data"]:
            trace["x"] = stamps.setdefault(json.dumps(trace["x"]), len(stamps))
    return f'{{"stamps":[{",".join(stamps)}],"figures":{json.dumps(drawn, separators=(",", ":"))}}}'


def _csv(report: EstimateReport) -> str:
    """The table as a CSV file for the download button; empty if it is too long for a page."""
    if not 0 < sum(map(len, report.table.values())) <= MOST_CELLS:
        return ""
    text = io.StringIO()
    columns = np.column_stack([np.asarray(column, float) for column in report.table.values()])
    np.savetxt(text, columns, fmt="%.6g", delimiter=",", header=",".join(report.table), comments="")
    return _pack_text("csv", text.getvalue().replace("nan", ""))


MOST_CELLS = 60_000
"""Largest number of cells of a table that is embedded in a page."""


LONG = 60
"""Number of characters above which a fact gets a line of its own."""


def facts_html(facts: Mapping[str, str]) -> str:
    """The facts about a computation: inputs, settings, versions."""
    lines = "".join(
        f"<div{' class=long' * (len(text) > LONG)}><dt>{escape(name)}</dt><dd>{escape(printable(text))}</dd></div>"
        for name, text in sorted(facts.items(), key=lambda fact: len(fact[1]) > LONG)
    )
    return f'<dl class="facts">{lines}</dl>\n' if lines else ""


def _code(report: EstimateReport) -> str:
    """Lines to copy, with a button that copies them."""
    if not report.code:
        return ""
    button = '<button type="button" id="copy">Copy</button>'
    return f'<div class="code">{button}<pre><code>{escape(report.code)}</code></pre></div>\n'


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
    """An element with text for `unpack` in page.js: compressed, in base 85 without the character that opens a tag."""
    squeezed = gzip.compress(utf8(text), mtime=0)  # no time stamp: equal texts give equal bytes
    # The alphabet of base 85 contains "<" but no comma, so the page can restore it.
    letters = base64.b85encode(squeezed, pad=True).decode().replace("<", ",")
    return f'<script type="text/plain" id="{name}" data-bytes="{len(squeezed)}">{letters}</script>'


def verdict_html(headline: str, warnings: Sequence[str]) -> str:
    """The result in one line, and the warnings."""
    if not headline:
        return _odd(warnings)
    line = headline.rstrip(".")
    if line.split()[0].isalpha() and " = " not in line:  # otherwise it begins with a name, such as com[0]
        line = line[:1].upper() + line[1:]
    calm = "" if warnings else ' <span class="calm">No warnings.</span>'
    return f'<p class="verdict">{escape(line)}.{calm}</p>\n{_odd(warnings)}'


def _odd(warnings: Sequence[str]) -> str:
    lines = "".join(f"<li>{escape(warning)}</li>" for warning in warnings)
    return f'<ul class="odd" aria-label="Warnings">{lines}</ul>\n' if warnings else ""


def _details(report: EstimateReport, panels: dict[str, Quantity], legend: dict[str, Style]) -> str:
    """Notes, and folded terms; on a narrow screen, which notes would fill, page.js folds them too."""
    notes, terms = _notes(report, panels), _glossary(report, {*panels, *legend})
    text = f"<details open><summary>Notes</summary>\n{notes}</details>\n" if notes else ""
    return text + (f"<details><summary>Terms</summary>\n{terms}</details>\n" if terms else "")


def _glossary(report: EstimateReport, shown: set[str]) -> str:
    terms = glossary(report, shown)
    text = " ".join(f"<strong>{escape(term)}</strong>: {escape(meaning)}" for term, meaning in terms.items())
    return f'<p class="glossary">{text}</p>\n' if terms else ""


def _notes(report: EstimateReport, panels: dict[str, Quantity]) -> str:
    notes = list(report.notes)
    samples, drawn = len(report.t), len(panels["velocity"].curves[0].t)
    if drawn < samples:
        share = f"Of each {2 * samples / drawn:.3g} of the {samples} samples"
        notes.append(f"{share} the smallest and the largest are drawn.")
    return "<ul>" + "".join(f"<li>{escape(note)}</li>" for note in notes) + "</ul>\n" if notes else ""


def table_html(rows: Sequence[Mapping[str, object]], best: int = 0) -> str:
    """Format a table in HTML; the first `best` rows are marked as the best."""
    if not rows:
        return ""
    header, body, numeric = cells(rows)
    side = [' class="number"' if right else "" for right in numeric]

    def line(tag: str, texts: list[str]) -> str:
        return "".join(f"<{tag}{at}>{escape(text)}</{tag[:2]}>" for text, at in zip(texts, side, strict=True))

    marks = [' class="best"' if i < best else "" for i in range(len(body))]
    lines = [f"<tr{mark}>{line('td', texts)}</tr>" for mark, texts in zip(marks, body, strict=True)]
    heading = line('th scope="col"', header)
    head, rest = f"<thead><tr>{heading}</tr></thead>", f"<tbody>{''.join(lines)}</tbody>"
    # A scrolling container gets `tabindex`, so that the keyboard can reach it.
    return f'<div class="table" tabindex="0" role="region" aria-label="Table"><table>{head}{rest}</table></div>\n'


def _legend(styled: dict[str, Style], hidden: Sequence[str]) -> str:
    """Buttons that show or hide a label in all panels at once."""
    return "".join(
        f'<button type="button" aria-pressed="{"false" if label in hidden else "true"}" data-label="{escape(label)}">'
        f"{_swatch(style)}{escape(label)}</button>"
        for label, style in styled.items()
    )


def _swatch(style: Style) -> str:
    look = f"--light: {style.color}; --dark: {style.dark}"
    if style.symbol:
        return f'<span class="mark" style="{look}" aria-hidden="true">{_SYMBOLS[style.symbol]}</span>'
    dash = " ".join(map(str, style.dash))
    width = min(5.0, 1.2 + style.width)
    line = f'<line x1="1" x2="25" y1="5" y2="5" style="{look}" stroke-width="{width:g}" stroke-dasharray="{dash}"/>'
    return f'<svg width="26" height="10" aria-hidden="true">{line}</svg>'


_SYMBOLS = {"circle-open": "○", "x": "✕", "diamond-open": "◇", "band": "▭"}
"""Characters that resemble the symbols named in styles."""
