"""Progress on standard error, and results on standard output."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from covariant.workflow import AbstractResult, Progress


@contextmanager
def progress_bar(quiet: bool = False) -> Iterator[Progress]:
    """Show a progress bar on standard error; yields the function that a verb reports its progress to."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress as Bar, TaskProgressColumn, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    console = Console(stderr=True)
    with Bar(*columns, console=console, transient=True, disable=quiet or not console.is_interactive) as bar:
        task = bar.add_task("reading", total=None)

        def report(description: str, fraction: float | None = None) -> None:
            total = None if fraction is None else 1.0
            bar.update(task, description=description, total=total, completed=fraction or 0.0)

        yield report


def show(
    result: AbstractResult,
    as_json: bool = False,
    out: Path | None = None,
    report: Path | None = None,
    figure: Path | None = None,
    **save: bool,
) -> None:
    """Save a result, print it, and then draw its page or figure: what cannot be drawn loses nothing.

    Args:
        result: What a verb returned.
        as_json: Whether to print one JSON object instead of text.
        out: Where `result.save` writes, or None.
        report: Where `result.report` writes its page, or None.
        figure: Where `result.draw` draws its figures, or None.
        save: Further arguments of `result.save`.
    """
    written = [] if out is None else [str(result.save(out, **save))]
    if not as_json:
        print(result, *(f"wrote {path}" for path in written), sep="\n", flush=True)
    pages: dict[str, Any] = {} if report is None else {"report": []}
    drawn: list[Path] = []
    try:
        with progress_bar(quiet=as_json or report is figure is None) as progress:
            progress("drawing")
            if report is not None:
                drawn += result.report(report)
                pages["report"] = [str(path) for path in drawn]
            if figure is not None:
                drawn += result.draw(figure)
                pages["figure"] = str(figure)
    finally:
        if as_json:
            print(json.dumps(result.summary | ({"out": written[0]} if written else {}) | pages), flush=True)
    if drawn and not as_json:
        print(*(f"wrote {path}" for path in drawn), sep="\n", flush=True)


@contextmanager
def working(what: str, quiet: bool = False) -> Iterator[None]:
    """Show a spinner while a task of unknown length runs."""
    from rich.console import Console

    console = Console(stderr=True, quiet=quiet)
    with console.status(what):
        yield
