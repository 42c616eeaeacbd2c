"""Searches for the largest value that can be proved, by bisection over certificates."""

import math
from collections.abc import Callable
from typing import Annotated, NamedTuple

import numpy as np

from covariant._domains import POSITIVE, Count, NotNegative, Positive, check_numbers
from covariant.certificates.base import Verdict
from covariant.certificates.proving._contraction_certificate import ContractionCertificate
from scalargraph.errors import InputError

RUNS = 10
"""Largest number of certificates that a search tries."""
STEP = 1.05
"""Ratio of neighbouring values at which a search ends."""


RATIO = POSITIVE._replace(words="be a finite number above 1", contains=lambda a: np.isfinite(a) & (a > 1))


class Attempt(NamedTuple):
    """One value that was tried.

    Attributes:
        value: the value.
        verdict: verdict of its certificate; "undecided" if the value was refused.
        boxes: number of boxes that its proofs took.
        radius: radius of its certificate; 0 unless it holds.
        refusal: the reason if there is no certificate, or "".

    Example:
        >>> from covariant.certificates import Attempt
        >>> str(Attempt(2.5, "holds", 120, 0.01))
        '2.5: holds, 120 boxes'
    """

    value: float
    verdict: Verdict
    boxes: int
    radius: float
    refusal: str = ""

    def __str__(self) -> str:
        return f"{self.value:.6g}: " + (self.refusal or f"{self.verdict}, {self.boxes} boxes")


class Largest(NamedTuple):
    """Result of a search.

    Attributes:
        certificate: the certificate of the largest proved value, or of the last attempt if none was proved.
        attempts: all attempts, in their order.

    Example:
        >>> from covariant.certificates import Attempt
        >>> from covariant.certificates.proving import Largest
        >>> found = Largest(None, (Attempt(1.0, "holds", 9, 0.1), Attempt(2.0, "undecided", 100, 0.0)))
        >>> found.value, found.refused
        (1.0, 2.0)
    """

    certificate: ContractionCertificate | None
    attempts: tuple[Attempt, ...]

    @property
    def value(self) -> float | None:
        """The largest proved value, or None."""
        return max((a.value for a in self.attempts if a.verdict == "holds"), default=None)

    @property
    def refused(self) -> float | None:
        """The least value that was tried and not proved, or None if all were proved."""
        return min((a.value for a in self.attempts if a.verdict != "holds"), default=None)


@check_numbers
def largest(
    prove: Callable[[float], ContractionCertificate],
    first: Positive,
    *,
    least: NotNegative = 0.0,
    runs: Count = RUNS,
    step: Annotated[float, RATIO] = STEP,
) -> Largest:
    """Search for the largest value for which a certificate holds: doubling or halving, then bisection of logarithms.

    `runs` and the boxes of each certificate limit the effort, so that the result is the same on every machine. The
    returned value is proved in any case. Only the search assumes that larger values are harder: it does not try values
    beyond one that was not proved.

    Args:
        prove: a value -> its certificate, such as `lambda rate: certify(observer, rate=rate, …)`. An `InputError`
            counts as not proved, except for the first value.
        first: the value to begin with, positive.
        least: no smaller value is tried.
        runs: largest number of certificates.
        step: the search ends when the least value that was not proved is at most this multiple of the largest proved
            one.

    Returns:
        The certificate of the largest proved value, and all attempts.

    Raises:
        ValueError: `first` is not a positive number or below `least`, `runs` is below 1, or `step` not above 1.

    Example:
        >>> from covariant import models, observers
        >>> from covariant.certificates import certify, largest
        >>> observer = observers.Intrinsic(models.oscillator(), 10.0, 50.0)
        >>> def at(rate):
        ...     region = {"position": (-1.0, 1.0), "velocity": 1.0, "error": 0.1}
        ...     return certify(observer, rate=rate, checker="off", boxes=1000, **region)
        >>> found = largest(at, 4.0, runs=3, step=1.5)
        >>> [(each.value, each.verdict) for each in found.attempts]
        [(4.0, 'holds'), (8.0, 'fails'), (5.656854249492381, 'holds')]
        >>> found.certificate.rate == found.value
        True
    """
    if first < least:
        raise InputError(f"largest: the first value must be {least:g} or more; got {first!r}")
    best, attempts, value = prove(first), [], first
    attempts.append(_attempt(value, best))
    while len(attempts) < runs:
        found = Largest(best, tuple(attempts))
        low, high = found.value, found.refused
        if low is not None and high is not None and high <= step * low:
            break
        if low is None and value <= least:
            break
        value = max(value / 2, least) if low is None else 2 * low if high is None else math.sqrt(low * high)
        try:
            certificate = prove(value)
        except InputError as error:
            attempts.append(Attempt(value, "undecided", 0, 0.0, f"refused: {str(error).splitlines()[0]}"))
            continue
        attempts.append(_attempt(value, certificate))
        if attempts[-1].verdict == "holds" or low is None:
            best = certificate
    return Largest(best, tuple(attempts))


def _attempt(value: float, certificate: ContractionCertificate) -> Attempt:
    return Attempt(value, certificate.statement.verdict, certificate.boxes, float(certificate.radius))
