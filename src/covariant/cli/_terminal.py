"""Text as a terminal shows it: wrapped at words, tables within its width, verdicts in colour; elsewhere unchanged."""

import html
import itertools
import re
import sys
import textwrap
from collections.abc import Iterator, Sequence
from typing import Any

from scalargraph.errors import printable

INTERNAL_ERROR = 70
"""Exit code of a command that ended with a bug: `EX_SOFTWARE` of sysexits.h."""
BUG = (
    "this is a bug of covariant, unless the traceback ends in a model of your own. Please report it with the lines "
    "above, the command and `covariant doctor`"
)

STYLES = {
    r"^\s*(WRONG|FAILS|fails|Refused)\b|^covariant:": "bold red",
    r"^\s*(OK|PROVED|Verified|holds \(proved\))": "bold green",
    r"^\s*(UNDECIDED|undecided)\b|^covariant: warning:": "bold yellow",
    r"^note\b.*|^- (proved|assumed|sampled):": "dim",
}
"""Styles by what a line begins with."""
MARK = re.compile(r"\s*(?:- |-> |\d+\. )?")
"""What stands before the text of a line, whose further rows begin where this ends."""
LEAST = 20
"""Columns that a text has at least, however narrow the terminal is."""


def say(text: str, file: Any = None) -> None:
    """Print text to a file, by default standard output; unless it is a terminal, every line stays as it is."""
    text = printable(text)
    file = sys.stdout if file is None else file
    if not file.isatty():
        print(text, file=file, flush=True)
        return
    from rich.console import Console
    from rich.text import Text

    console = Console(file=file)  # which honours NO_COLOR
    for tabular, lines in itertools.groupby(text.split("\n"), lambda line: line.startswith("| ")):
        if tabular:
            for table in _tables([*lines], console.width):
                console.print(table)
            continue
        for row in itertools.chain.from_iterable(_rows(line, console.width) for line in lines):
            styled = Text(row)
            for pattern, style in STYLES.items():
                styled.highlight_regex(pattern, style)
            console.print(styled, soft_wrap=True)
    file.flush()


def _rows(line: str, width: int) -> list[str]:
    """A line wrapped at words; a path or a number that is longer than a row stays whole, to be copied."""
    mark: Any = MARK.match(line)
    indent = " " * mark.end()
    width = max(width, mark.end() + LEAST)
    wrapper = textwrap.TextWrapper(width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
    return wrapper.wrap(line) or [""]


def _tables(lines: Sequence[str], width: int) -> Iterator[Any]:
    """A table in Markdown as tables that fit the width: what has no room goes to another one, by the same names."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    cells = [[html.unescape(cell.strip()) for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]
    heads, rule, *body = [[cell.replace("\\|", "|") for cell in row] for row in cells]
    # Headings are wrapped at words, numbers and names never.
    widths = [max(map(len, (*head.split(), *column))) for head, *column in zip(heads, *body, strict=True)]
    parts: list[list[int]] = [[0]]
    for at in range(1, len(heads)):
        if len(parts[-1]) > 1 and sum(widths[each] + 1 for each in (*parts[-1], at)) > width + 1:
            parts.append([0])
        parts[-1].append(at)
    for part in parts:
        table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=0)
        for at in part:
            side = "right" if rule[at].endswith(":") else "left"
            head = textwrap.fill(heads[at], widths[at], break_long_words=False, break_on_hyphens=False)
            table.add_column(Text(head), justify=side, no_wrap=True)
        for row in body:
            table.add_row(*(Text(row[at]) for at in part))
        yield table
