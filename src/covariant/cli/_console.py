"""Progress on standard error, and results on standard output."""

import json
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from covariant.cli._terminal import say

if TYPE_CHECKING:
    from covariant.verbs import AbstractResult, Progress

LINE_EVERY = 10.0
"""Seconds from one line of progress to the next where there is no terminal."""


@contextmanager
def progress_bar(quiet: bool = False) -> Iterator["Progress"]:
    """Show a progress bar on standard error, as long as the context lasts.

    Args:
        quiet: Whether nothing is shown. Where standard error is no terminal, it gets a line every ten seconds.

    Yields:
        The function that a verb calls with its progress.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress as Bar, TaskProgressColumn, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    console = Console(stderr=True)
    if not (quiet or console.is_interactive):
        with _progress_lines() as report:
            yield report
        return
    with Bar(*columns, console=console, transient=True, disable=quiet) as bar:
        task = bar.add_task("reading", total=None)

        def report(description: str, fraction: float | None = None) -> None:
            total = None if fraction is None else 1.0
            bar.update(task, description=description, total=total, completed=fraction or 0.0)

        yield report


@contextmanager
def _progress_lines() -> Iterator["Progress"]:
    """Write what is being done to standard error from time to time, for whoever reads it in a file or over a pipe."""
    began, done, latest = time.monotonic(), threading.Event(), ["reading"]

    def report(description: str, fraction: float | None = None) -> None:
        latest[0] = description if fraction is None else f"{description}, {100 * fraction:.0f} %"

    def write() -> None:
        # A thread, since a stage may compute for minutes without a call.
        while not done.wait(LINE_EVERY):
            print(f"covariant: {latest[0]}, {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)

    writer = threading.Thread(target=write, daemon=True)
    writer.start()
    try:
        yield report
    finally:
        done.set()
        writer.join()


def show(
    result: "AbstractResult",
    as_json: bool = False,
    out: Path | None = None,
    report: Path | None = None,
    figure: Path | None = None,
    words: Callable[[str], str] = str,
    **save: bool,
) -> None:
    """Print a result, save it, and then draw its page or figure: what fails later loses nothing.

    Args:
        result: What a verb returned.
        as_json: Whether to print one JSON object instead of text.
        out: Where `result.save` writes, or None.
        report: Where `result.report` writes its page, or None.
        figure: Where `result.draw` draws its figures, or None.
        words: Puts the text of the result into the words of the command line.
        save: Further arguments of `result.save`.

    Raises:
        ValueError: Where the result cannot be saved or drawn so; the JSON object is printed all the same.
    """
    if not as_json:
        say(words(str(result)))  # before anything is written: what fails later leaves the answer on the screen
    places: dict[str, Any] = {} if report is None else {"report": []}
    try:
        if out is not None:
            places["out"] = str(result.save(out, **save))
            _print_paths([str(path) for path in result.written_files(out)], quiet=as_json)
        if report is not None or figure is not None:
            _print_paths(_draw(result, report, figure, places, as_json), quiet=as_json)
    finally:  # a result that cannot be drawn is still printed, with the files that were written
        if as_json:
            print(json.dumps(result.summary | places), flush=True)


def _draw(
    result: Any,
    report: Path | None,
    figure: Path | None,
    places: dict[str, Any],
    quiet: bool,
) -> list[str]:
    """Draw page and figures of a result; returns their paths, which are noted in `places`."""
    paths: list[Path] = []
    with progress_bar(quiet) as progress:
        progress("drawing")
        if report is not None:
            paths += result.report(report)
            places["report"] = [str(path) for path in paths]
        if figure is not None:
            paths += result.draw(figure)
            places["figure"] = str(figure)
    return [str(path) for path in paths]


def _print_paths(paths: list[str], quiet: bool) -> None:
    for path in () if quiet else paths:
        say(f"wrote {path}")
