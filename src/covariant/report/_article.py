"""Writes text, tables and figures as one self-contained HTML page."""

import base64
import os
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from types import MappingProxyType

from covariant.report._html import facts_html, table_html, verdict_html
from scalargraph.errors import printable
from scalargraph.files import utf8, write_atomically
from scalargraph.template import fill, template

Block = str | Path | Sequence[Mapping[str, object]]
"""A paragraph ("# …" makes it a heading), preformatted lines, a PNG file, or the rows of a table."""


def write_article(
    title: str,
    blocks: Sequence[Block],
    path: str | os.PathLike[str],
    headline: str = "",
    warnings: Sequence[str] | None = None,
    facts: Mapping[str, str] = MappingProxyType({}),
) -> Path:
    """Write blocks one below the other, with figures embedded, as one complete file.

    Args:
        title: Title, plain text.
        blocks: Paragraphs, headings, figures and tables.
        path: The page (.html).
        headline: The result in one line, under the title.
        warnings: Sentences on anything unusual; None to show no such section.
        facts: Facts about the computation, by name: inputs, settings, versions.

    Returns:
        The path.

    Example:
        >>> from covariant.report import write_article
        >>> blocks = ["# Errors", "Against the true velocity.", [{"observer": "intrinsic", "RMSE [m/s]": 0.012}]]
        >>> write_article("Pendulum", blocks, "article.html").name
        'article.html'
    """
    heading, parts = title, [f'<p class="verdict">{escape(headline)}</p>'] if headline else []
    if warnings is not None:
        parts = [verdict_html(headline, warnings)]
    parts.append(facts_html(facts))
    for block in blocks:
        heading = block[2:] if isinstance(block, str) and block.startswith("# ") else heading
        parts.append(block_html(block, heading))
    words = {"TITLE": escape(printable(title)), "STYLE": template("covariant.report", "page.css"), "BLOCKS": parts}
    page = fill("covariant.report", "article.html", words)
    return write_atomically(path, lambda file: file.write(utf8(page)))


def block_html(block: Block, heading: str) -> str:
    """A block in HTML; the heading above a figure serves as its description."""
    if isinstance(block, Path):
        data = base64.b64encode(block.read_bytes()).decode()
        label = escape(f"Figure: {heading}")
        picture = f'<img alt="{label}" src="data:image/png;base64,{data}">'
        # A scrolling container gets `tabindex`, so that the keyboard can reach it.
        return f'<div class="picture" tabindex="0" role="region" aria-label="{label}">{picture}</div>'
    if isinstance(block, str):
        if "\n" in block:
            return f'<pre class="lines">{escape(block)}</pre>'
        return f"<h2>{escape(block[2:])}</h2>" if block.startswith("# ") else f"<p>{escape(block)}</p>"
    return table_html(block)
