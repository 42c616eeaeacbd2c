"""How a verb reports its progress to whoever shows it, such as a progress bar."""

from typing import Protocol, runtime_checkable


@runtime_checkable
class Progress(Protocol):
    """Called with a description of what is being done and the fraction of all the work that is done, in [0, 1].

    A fraction of None means that it is not known.
    """

    def __call__(self, description: str, fraction: float | None = None) -> None: ...


def silent(description: str, fraction: float | None = None) -> None:
    """Show nothing."""
