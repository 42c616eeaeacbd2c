"""What a certificate means, in a sentence and in degrees."""

import math
from collections.abc import Callable, Iterable, Sequence

from covariant.certificates import AbstractClaim, ContractionCertificate, Start


def verdict(cert: ContractionCertificate) -> str:
    """The answer in one line: the errors that a proof allows, and how fast they fall."""
    names = [unit.removesuffix("/s") for unit in cert.domain.units[: len(cert.velocity)]]
    units = [*names, *(f"{name}/s" if name else "" for name in names)]
    largest = _by_unit(cert.half_widths, units, max, up=True)
    whose = "the truth"
    subject = "any estimate in the tube stays in it, so"
    if cert.start is not None:
        # The smallest bound of each unit, for all entries: that box is within the one that is proved.
        covered = _by_unit(cert.start.together, units, min, up=False)
        subject, whose = f"any estimate that starts within {covered} of the truth stays", "it"
    mark = "PROVED" if cert.statement.proved else f"HOLDS ({cert.statement.evidence})"
    halved = ""
    if cert.decay > 0:
        every = _by_unit([math.log(2) / cert.decay], ["s"], max, up=True)
        end = f" down to {100 * cert.steady / cert.radius:.2g} % of the tube's radius" if cert.steady else ""
        halved = f", and its distance in the metric halves every {every} or sooner{end}"
    return f"{mark}: {subject} within {largest} of {whose}{halved}"


def _by_unit(values: Iterable[float], units: Sequence[str], of: Callable[..., float], up: bool) -> str:
    """One number of two digits for each unit, angles in degrees, rounded to the safe side."""
    by: dict[str, list[float]] = {}
    for value, unit in zip(values, units, strict=True):
        by.setdefault(unit, []).append(float(value))
    written: list[str] = []
    for unit, each in by.items():
        angle = unit in ("rad", "rad/s")
        value = math.degrees(of(each)) if angle else of(each)
        sign = unit.replace("rad", "°") if angle else f" {unit}".rstrip()
        step = 10.0 ** (math.floor(math.log10(value)) - 1) if 0 < value < math.inf else 1.0
        written.append(f"{(math.ceil if up else math.floor)(value / step) * step:.10g}{sign}")
    return " and ".join([", ".join(written[:-1]), written[-1]] if len(written) > 1 else written)


def in_degrees(value: float, unit: str, low: float | None = None) -> str:
    """An angle also in degrees, in brackets; empty for other units."""
    if unit not in ("rad", "rad/s"):
        return ""
    each = unit.removeprefix("rad")
    start = "" if low is None else f"{math.degrees(low):.4g} to "
    return f" ({start}{math.degrees(value):.4g}°{each})"


def start_errors(start: Start) -> dict[str, dict[str, float]]:
    """The errors of a start by name, in radians and metres."""
    rows = zip(start.names, start.together.tolist(), start.alone.tolist(), start.farthest.tolist(), strict=True)
    return {name: {"together": a, "alone": b, "farthest": c} for name, a, b, c in rows}


def undecided_claims(certificate: ContractionCertificate) -> list[AbstractClaim]:
    """The claims that a proof left open."""
    return [claim for claim in certificate.claims if claim.proof.verdict == "undecided"]
