"""Certifies that the distance of an estimate from the truth falls: the part of `certify` for the lifted metric."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from covariant import certificates
from covariant.verbs.base.design import Design
from covariant.verbs.base.result import AbstractResult
from scalargraph.errors import InputError

BY_DISTANCE = "lagrangian-metric"
"""The observer whose certificate is about the distance from the truth."""


def by_distance(
    name: str, designed: Design, recipe: dict[str, Any] | None, settings: dict[str, Any], find: str | None
) -> "DistanceResult":
    """Prove the statement about distances, which has no other settings than these."""
    without = {key: settings[key] for key in ("times", "rate", "q", "noise", "disturbance", "lost", "seconds")}
    without |= {"find": find, "checker": settings["checker"] == "all", "processes": settings["processes"] > 1}
    if given := [key for key, value in without.items() if value is not None and np.any(value)]:
        raise InputError(f"a certificate of {BY_DISTANCE} has no {', '.join(given)}; leave it out")
    shortest, longest = settings["interval"] or (None, None)
    if shortest != longest:
        raise InputError(f"a certificate of {BY_DISTANCE} is about one interval; got {shortest:g} to {longest:g} s")
    kept = {key: settings[key] for key in ("position", "velocity", "error", "input", "boxes")}
    certificate = certificates.certify_distance(designed.inner, interval=longest, recipe=recipe, **kept)
    return DistanceResult(name, certificate, designed.notes)


@dataclass(frozen=True, repr=False)
class DistanceResult(AbstractResult):
    """Verdict on a statement that the distance of an estimate from the truth falls.

    Attributes:
        model_name: The model, by its path or name.
        certificate: The statement with its proofs.
        design: A sentence on where the gains come from.

    Example:
        >>> import covariant
        >>> bounds = {"velocity": 0.2, "error": 0.1, "region": {"r": (-1.0, 1.0), "theta": (-1.0, 1.0)}}
        >>> covariant.certify("ball_and_beam", observer="lagrangian-metric", alpha=40.0, beta=200.0, **bounds).holds
        True
    """

    model_name: str
    certificate: certificates.DistanceCertificate
    design: str

    wrong: ClassVar[bool] = False

    @property
    def holds(self) -> bool:
        """Whether the statement is proved."""
        return self.certificate.statement.verdict == "holds"

    @property
    def headline(self) -> str:
        rate = f": rate μ = {self.certificate.decay.rate:.4g} 1/s" if self.holds else ""
        return f"{self.model_name}, {self.certificate.statement.short}{rate}"

    @property
    def summary(self) -> dict[str, Any]:
        numbers = self.certificate.decay._asdict() if self.holds else {}
        return {"model": self.model_name, **self.certificate.statement.document(), **numbers}

    def __str__(self) -> str:
        return f"{self.certificate.statement}\n\n{self.design}"
