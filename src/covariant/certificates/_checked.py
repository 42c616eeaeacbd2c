"""What the check of a certificate says, in words."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from covariant.certificates._check import Resolved, Shown, show, show_found
from covariant.certificates._contraction_statement import Contraction, contraction_statement
from covariant.certificates._document import Document
from covariant.certificates._statement import Hypothesis, Statement

CHECKER = "the checker, which forms the matrices of the claims anew and bounds them in another way, accepts"


class Checked(NamedTuple):
    """Result of a successful check.

    - `rate` [1/s], `radius`: those of the certificate; `statement`: the whole claim, as it is verified.
    - `leaves`: number of leaves shown; `seconds`: time it took.
    - `model_given`: whether the caller gave the model, in place of the one that the file names.
    """

    statement: Statement
    rate: float
    radius: float
    leaves: int
    seconds: float
    model_given: bool = False


def check(
    source: str | Path | Document,
    *,
    model: Any = None,
    processes: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Checked:
    """Check a saved certificate, a file or the result of `parse`.

    - `model`: for a certificate about a model that is not of this library, whose code the file cannot give: a model, a
      function that makes one from the recipe's parameters, or the `module:attribute` of either.
    - `processes`: number of processes; with several, a script needs the `if __name__ == "__main__"` guard.
    - `progress`: called with the number of leaves done and of all leaves.

    Raises `ValueError` saying what is wrong, or what cannot be shown, and where.
    """
    found = show(source, model=model, processes=processes, progress=progress)
    facts = Contraction.stated(*found.resolved)
    statement = contraction_statement(facts, "proved", _accepted(found))
    return Checked(statement, facts.rate, facts.radius, found.leaves, found.seconds, model is not None)


def judged(resolved: Resolved, seconds: float) -> Hypothesis:
    """What the check says of claims that were found in this process, in about that time [s]."""
    try:
        return _accepted(show_found(resolved, seconds))
    except ValueError as error:
        return Hypothesis(f"{CHECKER} the proofs", "proved", "undecided", place=str(error))


def _accepted(found: Shown) -> Hypothesis:
    if found.shown == found.leaves:
        return Hypothesis(f"{CHECKER} all {found.leaves} leaves", "proved")
    text = (
        f"{CHECKER} all {found.leaves} leaves; it was stopped after {found.seconds:.0f} s with {found.shown} of them "
        "shown, and `covariant certify --check` takes the time that it needs"
    )
    return Hypothesis(text, "assumed")
