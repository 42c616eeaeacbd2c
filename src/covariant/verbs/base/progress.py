"""How a verb reports its progress to whoever shows it, such as a progress bar."""

import sys
import time
from typing import Any, NamedTuple, Protocol, runtime_checkable


@runtime_checkable
class Progress(Protocol):
    """Function that a verb calls as its work goes on, for instance to move a progress bar.

    Args:
        description: What is being done.
        fraction: Fraction of all the work that is done, in [0, 1]; None where it is not known.

    Example:
        >>> from covariant import verbs
        >>> def show(description, fraction=None):
        ...     print(description)
        >>> isinstance(show, verbs.Progress)
        True
        >>> result = verbs.describe_model("oscillator", samples=5, progress=show)
        reading the model
        measuring the geometry of oscillator
    """

    def __call__(self, description: str, fraction: float | None = None) -> None: ...


def time_left(began: float, first: float | int, done: float | int, total: float | int) -> str:
    """Time left at the pace since `began` [s, monotonic], when `first` of the work was done; "" before any was."""
    if done <= first:
        return ""
    return f", {(time.monotonic() - began) * (total - done) / (done - first):.0f} s left"


OFTEN = 0.1
"""Seconds between two updates of a line whose description stays."""


class _Line(NamedTuple):
    """The line that a cell of a notebook shows: its handle, what it describes, and when it was last updated."""

    handle: Any
    description: str
    time: float


_lines: list[_Line] = []


def notebook_line(description: str, fraction: float | None = None) -> None:
    """Show progress as one line under the running cell of a notebook, and nothing elsewhere; the default of all verbs.

    The line goes when the cell ends, so that only results stay.
    """
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    if shell is None or not hasattr(shell, "kernel"):
        return
    from IPython.display import display

    now = time.monotonic()
    last = _lines.pop() if _lines else None
    if last is not None and last.description == description and now < last.time + OFTEN:
        _lines.append(last)
        return
    text = {"text/plain": description + ("" if fraction is None else f" {100 * fraction:.0f} %")}
    if last is None:
        handle = display(text, raw=True, display_id=True)
        shell.events.register("post_run_cell", _clear)
    else:
        handle = last.handle
        handle.update(text, raw=True)
    _lines.append(_Line(handle, description, now))


def _clear(*_: object) -> None:
    """Empty the line of the cell that has ended."""
    shell = sys.modules["IPython"].get_ipython()
    shell.events.unregister("post_run_cell", _clear)
    while _lines:
        _lines.pop().handle.update({"text/plain": ""}, raw=True)
