"""Formats tables of a comparison: rows are dictionaries, and columns appear in the order of their first use."""

import math
import numbers
from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeGuard

import numpy as np

MISSING = "—"


class Cells(NamedTuple):
    """Cells of a table as text.

    Attributes:
        header: Headings of the c columns.
        body: Rows, each with c cells.
        numeric: Which of the c columns are numbers; these are right-aligned.
    """

    header: list[str]
    body: list[list[str]]
    numeric: list[bool]


def cells(rows: Sequence[Mapping[str, object]]) -> Cells:
    """Convert rows to text, with four digits of each number."""
    header = list(dict.fromkeys(key for row in rows for key in row))
    columns = [[row.get(key) for row in rows] for key in header]
    numeric = [any(map(_is_number, column)) and all(v is None or _is_number(v) for v in column) for column in columns]
    return Cells(header, [list(line) for line in zip(*map(_column, columns), strict=True)], numeric)


def table(rows: Sequence[Mapping[str, object]]) -> str:
    """Format a table in GitHub's Markdown, with right-aligned numbers to four digits.

    Use it for results in Markdown pages, issues and notebooks. Columns are in the order in which their headings first
    occur, and columns of numbers are aligned to the right. Numbers are rounded, so use the original ones for further
    computations.

    Args:
        rows: Rows, each with its cells by heading; a missing key, None and NaN become a dash.

    Returns:
        The table, ending in a newline; "" if there are no rows.

    Example:
        >>> from covariant.report import table
        >>> print(table([{"observer": "intrinsic", "RMSE": 0.0125}, {"observer": "pll", "RMSE": 0.0181}]), end="")
        | observer  |   RMSE |
        | --------- | -----: |
        | intrinsic | 0.0125 |
        | pll       | 0.0181 |
    """
    if not rows:
        return ""
    header, body, numeric = cells(rows)
    lines = [[_markdown(text) for text in line] for line in (header, *body)]
    width = [max(3, *map(len, column)) for column in zip(*lines, strict=True)]
    rule = ["-" * (w - 1) + ":" if right else "-" * w for w, right in zip(width, numeric, strict=True)]
    padded = [
        [text.rjust(w) if right else text.ljust(w) for text, w, right in zip(line, width, numeric, strict=True)]
        for line in lines
    ]
    return "".join(f"| {' | '.join(line)} |\n" for line in (padded[0], rule, *padded[1:]))


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


def _column(values: list[object]) -> list[str]:
    """A column as text; numbers of similar size get the same number of decimals, so that they are easy to compare."""
    sizes = [abs(float(v)) for v in values if _is_number(v) and math.isfinite(v) and v]
    # Outside this range, or over four decades, decimals would be long or lose digits; %.4g is used then.
    alike = bool(sizes) and min(sizes) >= 1e-4 and max(sizes) < min(1e7, 1e4 * min(sizes))
    decimals = _decimals(sizes) if alike else None
    return [_text(value, decimals) for value in values]


def _decimals(sizes: list[float]) -> int:
    """The largest number of decimals that any number needs for four digits, limited by what the smallest needs."""
    shown = (np.format_float_positional(x, precision=4, fractional=False, trim="-") for x in sizes)
    most = max(len(text.partition(".")[2]) for text in shown)
    # Four significant digits of x end at decimal 3 − ⌊log10 x⌋.
    return min(most, max(0, 3 - math.floor(math.log10(min(sizes)))))


def _text(value: object, decimals: int | None) -> str:
    if value is None:
        return MISSING
    if not _is_number(value):
        return {True: "yes", False: "no"}[value] if isinstance(value, bool) else str(value)
    if decimals is None and isinstance(value, numbers.Integral):
        return str(value)
    text = format(float(value), ".4g" if decimals is None else f".{decimals}f")
    return MISSING if text == "nan" else text.replace("inf", "∞")


def _markdown(text: str) -> str:
    """Text escaped so that it cannot end a cell or open an HTML tag; emphasis and links are not escaped."""
    return " ".join(text.split()).replace("|", r"\|").replace("<", "&lt;")
