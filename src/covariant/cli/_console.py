"""Progress on standard error, so that standard output holds only results."""

from collections.abc import Iterator
from contextlib import contextmanager

from covariant.signals import Result


@contextmanager
def working(what: str, quiet: bool = False) -> Iterator[None]:
    """Show a spinner while a task of unknown length runs."""
    from rich.console import Console

    console = Console(stderr=True, quiet=quiet)
    with console.status(what):
        yield


@contextmanager
def stages(what: str, total: int, quiet: bool = False):
    """A progress bar over named stages; yields a function to call with the name of each stage when it begins."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True, quiet=quiet), transient=True) as progress:
        task = progress.add_task(what, total=total)
        begun = 0

        def begin(stage: str) -> None:
            nonlocal begun
            progress.update(task, description=stage, completed=begun)
            begun += 1

        yield begin


def note(result: str) -> str:
    """The sentence for a result code, given by its name."""
    return Result[result.upper()].message
