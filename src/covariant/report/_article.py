"""Text, tables and figures as one self-contained HTML page."""

import base64
import os
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from covariant._files import write_atomically
from covariant.report._html import asset, table_html

Block = str | Path | Sequence[Mapping[str, object]]
"""A paragraph ("# …" makes it a heading), a PNG file, or the rows of a table."""


def write_article(title: str, blocks: Sequence[Block], path: str | os.PathLike[str]) -> Path:
    """Write blocks one below the other, with figures embedded, as one complete file; returns its path."""
    body = "\n".join(_block(block) for block in blocks)
    page = f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">
<title>{escape(title)}</title>
<style>
{asset("page.css")}img {{ max-width: 100%; background: #fff; }} p {{ max-width: 60rem; }}</style>
</head>
<body>
<h1>{escape(title)}</h1>
{body}
</body>
</html>
"""
    return write_atomically(path, lambda file: file.write(page.encode()))


def _block(block: Block) -> str:
    if isinstance(block, Path):
        data = base64.b64encode(block.read_bytes()).decode()
        return f'<p><img alt="{escape(block.stem)}" src="data:image/png;base64,{data}"></p>'
    if isinstance(block, str):
        return f"<h2>{escape(block[2:])}</h2>" if block.startswith("# ") else f"<p>{escape(block)}</p>"
    return table_html(block, mark_best=False)
