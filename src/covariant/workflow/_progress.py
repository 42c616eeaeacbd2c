"""How a verb reports its progress to whoever shows it, such as a progress bar."""

from typing import Protocol, runtime_checkable


@runtime_checkable
class Progress(Protocol):
    """Function that a verb calls as its work goes on, for instance to move a progress bar.

    Args:
        description: What is being done.
        fraction: Fraction of all the work that is done, in [0, 1]; None where it is not known.

    Example:
        >>> from covariant import workflow
        >>> def show(description, fraction=None):
        ...     print(description)
        >>> isinstance(show, workflow.Progress)
        True
        >>> result = workflow.describe_model("oscillator", samples=5, progress=show)
        reading the model
        measuring the geometry of oscillator
    """

    def __call__(self, description: str, fraction: float | None = None) -> None: ...


def silent(description: str, fraction: float | None = None) -> None:
    """Ignore progress; the default of all verbs."""
