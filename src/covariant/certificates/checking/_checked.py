"""Checks a saved certificate, and returns the result as a statement."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from covariant._domains import Count, check_numbers
from covariant.certificates.base import Document, Hypothesis, Resolved, Statement, contraction_statement
from covariant.certificates.checking._check import Shown, show, show_found
from scalargraph.errors import InputError

CHECKER = "the checker, which forms the matrices of the claims anew and bounds them in another way, accepts"


class Checked(NamedTuple):
    """Result of a successful check of a certificate.

    Attributes:
        statement: the complete claim that was verified.
        rate: rate λ of the certificate [1/s], of squared lengths.
        radius: radius ε of the certificate, in its metric.
        leaves: number of verified leaves of its trees of boxes.
        seconds: time it took [s].
        model_given: whether the caller provided the model, instead of the one named in the file.

    Example:
        >>> from covariant.certificates import Checked, Hypothesis, Statement
        >>> statement = Statement("the observer contracts", (), (Hypothesis("all leaves", "proved"),), 2.0)
        >>> result = Checked(statement, 2.0, 0.1, 12, 0.5)  # usually from `check`
        >>> result.statement.short, result.leaves
        ('holds (proved)', 12)
    """

    statement: Statement
    rate: float
    radius: float
    leaves: int
    seconds: float
    model_given: bool = False


@check_numbers
def check(
    source: str | Path | Document,
    *,
    model: object = None,
    processes: Count = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Checked:
    """Check a saved certificate: that its claims hold, and that its statement follows from them.

    Use it on a certificate that somebody else has made: it repeats the proof with a separate checker, and does not rely
    on the verdict in the file. The assumptions of the statement remain assumptions. The code of a given `model` is run.
    A fault raises `ValueError`; `verbs.check_certificate` returns it as a result.

    Args:
        source: the file, or the result of `parse`.
        model: for a certificate about a model that is not part of this library, whose code the file does not contain: a
            model, a function that creates one from the recipe's parameters, or the `module:attribute` of either.
        processes: largest number of processes; with several, a script needs the `if __name__ == "__main__"` guard. A
            certificate of at most 1024 leaves is checked in this process, since others take longer to start.
        progress: called with the number of leaves done and of all leaves.

    Returns:
        The statement as verified, and the number of leaves.

    Raises:
        ValueError: A claim is wrong or cannot be shown; the message names it and the place.

    Example:
        >>> from covariant.certificates import check
        >>> check("missing.json")
        Traceback (most recent call last):
        ...
        scalargraph.errors.InputError: missing.json: No such file or directory; give the path of a saved certificate
    """
    shown = show(source, model=model, processes=processes, progress=progress)
    document = shown.resolved.document
    statement = contraction_statement(shown.resolved.stated(), "proved", _checker_hypothesis(shown))
    if statement.verdict != "holds":
        raise InputError(f"{document.file}: its claims hold, and the statement does not follow: {statement.claim}")
    return Checked(statement, document.rate, document.radius, shown.leaves, shown.seconds, model is not None)


def judged(resolved: Resolved, seconds: float) -> Hypothesis:
    """Check claims that were proved in this process, as a hypothesis of their statement."""
    try:
        return _checker_hypothesis(show_found(resolved, seconds))
    except InputError as error:
        return Hypothesis(f"{CHECKER} the proofs", "proved", "undecided", place=str(error))


def _checker_hypothesis(shown: Shown) -> Hypothesis:
    if shown.shown == shown.leaves:
        return Hypothesis(f"{CHECKER} all {shown.leaves} leaves", "proved")
    text = (
        f"{CHECKER} all {shown.leaves} leaves; it was stopped after {shown.seconds:.0f} s with {shown.shown} of them "
        "shown, and `covariant certify --check` takes the time that it needs"
    )
    return Hypothesis(text, "assumed")
