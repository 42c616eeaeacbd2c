"""The search of `certify` for the largest error, rate or interval that is proved."""

from collections.abc import Callable
from typing import Any

import numpy as np

from covariant import certificates
from covariant.certificates import Attempt, ContractionCertificate
from scalargraph.errors import InputError

FIND = {
    "error": "multiple of the errors",
    "rate": "rate λ [1/s]",
    "interval": "longest time between samples [s]",
}
"""What `find` may name, and what is varied then."""


def largest_proved(
    find: str, settings: dict[str, Any], prove: Callable[..., ContractionCertificate], runs: int
) -> tuple[ContractionCertificate, tuple[Attempt, ...]]:
    """Search the largest value of a setting that is proved."""
    if find not in FIND:
        raise InputError(f"find: choose one of {', '.join(FIND)}; got {find!r}")
    if find != "error" and settings[find] is None:
        raise InputError(f"find: give {find}, with which the search for the largest begins")
    error, interval = settings["error"], settings["interval"]
    first, least = 1.0, 0.0
    if find == "rate":
        first = settings["rate"]
    if find == "interval":
        least, first = (float(h) for h in interval)

    def changed(value: float) -> dict[str, Any]:
        match find:
            case "error":
                return {"error": value * np.asarray(error)}
            case "rate":
                return {"rate": value}
            case _:
                return {"interval": (least, value)}

    # The checker examines what is returned, and none of the attempts before it.
    found = certificates.largest(lambda value: prove(**changed(value), checker="off"), first, least=least, runs=runs)
    certificate = found.certificate
    assert certificate is not None
    if settings["checker"] != "off" and found.value is not None:
        certificate = prove(**changed(found.value))
    return certificate, found.attempts
