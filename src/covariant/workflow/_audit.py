"""`audit`: the laws that an observer's convergence rests on, measured at random states."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from covariant import models
from covariant.certificates import audit
from covariant.certificates.audit import Audit, Law
from covariant.models import ModelFile, Overrides
from covariant.proofs import Box
from covariant.workflow._arguments import Region, above_zero, bounds, gain_pair
from covariant.workflow._design import design
from covariant.workflow._kinds import kind_of
from covariant.workflow._progress import Progress, notebook_line
from covariant.workflow._result import AbstractResult

if TYPE_CHECKING:
    from matplotlib.figure import Figure

GAINS = math.sqrt(2), 1.0
"""Default α [1/s] and β [1/s²]: the laws hold with any gains."""


def audit_observer(
    model: Any,
    *,
    observer: str | None = None,
    alpha: float | None = None,
    beta: float | None = None,
    region: Region | None = None,
    speed: float = 3.0,
    points: int = 24,
    seed: int = 0,
    overrides: Overrides = (),
    progress: Progress = notebook_line,
) -> "AuditResult":
    """Measure the laws that an observer's convergence rests on, at random states.

    Use it after you have changed a model or written an observer, to find mistakes before a proof. It measures and does
    not prove: laws that hold at all sampled states may fail elsewhere. `certificates.audit.audit` takes an observer
    that you have built.

    Args:
        model: A model file (.toml), a robot, `module:attribute`, the name of a system, a `ModelFile`, or a system.
        observer: `intrinsic`, `intrinsic2`, `geodesic`, `implicit-geodesic` or `copy`; by default the first that fits
            the model.
        alpha: Gain α [1/s]; √2 by default.
        beta: Gain β [1/s²]; 1 by default.
        region: Lower and upper end of each coordinate between which positions are sampled; on a group, of the
            exponential coordinates x1, x2, ….
        speed: Largest velocity of each coordinate [unit/s].
        points: Number of states.
        seed: Seed of the states.
        overrides: Values that replace those of the model file.
        progress: Called with a description of the work.

    Returns:
        Each law with its largest deviation; `result.passed` says whether all hold.

    Raises:
        ValueError: The observer does not fit the model, or the region names other coordinates.

    Example:
        >>> from covariant import workflow
        >>> workflow.audit_observer("oscillator", points=4).passed
        True
    """
    gains = gain_pair(alpha, beta) or GAINS
    above_zero("speed", speed)
    name = models.spec_name(model)
    progress("reading the model")
    file = models.load(model, overrides)
    file.need_mechanical(name, "the laws are those of observers of")
    designed = design(file, observer, gains, spec=name)
    domain = _domain(file, region)
    progress(f"auditing {designed.name} on {file.name}")
    audited = audit.audit(designed.inner, domain=domain, speed=speed, points=points, seed=seed)
    return AuditResult(name, file.name, designed.name, audited)


@dataclass(frozen=True, repr=False)
class AuditResult(AbstractResult):
    """Laws of an observer, with the largest deviation from each.

    Attributes:
        model_name: Path or name of the model.
        title: Short name of the model.
        observer_name: Name of the observer.
        audit: The laws, a `covariant.certificates.audit.Audit`.

    Example:
        >>> from covariant import workflow
        >>> result = workflow.audit_observer("oscillator", points=4)
        >>> result.passed, result.observer_name, len(result.audit.rows) > 5
        (True, 'intrinsic', True)
    """

    model_name: str
    title: str
    observer_name: str
    audit: Audit

    @property
    def passed(self) -> bool:
        """Whether at least one law was measured and none is violated; skipped laws do not count."""
        return self.audit.passed

    @property
    def headline(self) -> str:
        return f"{self.observer_name} on {self.title}: {self.audit.verdict}"

    @property
    def summary(self) -> dict[str, Any]:
        measured = self.audit
        result = {"model": self.model_name, "observer": self.observer_name, "passed": measured.passed}
        result |= {
            "verdict": measured.verdict,
            "domain": measured.domain,
            "laws": [_plain(row) for row in measured.rows],
        }
        return result

    def __str__(self) -> str:
        return str(self.audit)

    def _write_page(self, path: Path) -> list[Path]:
        from covariant.report import write_audit

        return [write_audit(self.audit, f"Audit of {self.title}", path)]

    def _figure(self) -> "Figure":
        from covariant.report import audit_figure

        return audit_figure(self.audit)


def _domain(file: ModelFile, region: Region | None) -> Box | None:
    """Bounds of the sampled coordinates, or on a group of exponential coordinates; None if no region is given."""
    ends = bounds("region", region or {}, kind_of(file).chart, "coordinate")
    if not ends:
        return None
    low, high = np.array(list(ends.values())).T
    return Box(tuple(ends), ("",) * len(ends), low, high)


def _plain(row: Law) -> dict[str, Any]:
    """A row as plain data, with None for a deviation that is not finite."""
    return row._asdict() | {"deviation": row.deviation if math.isfinite(row.deviation) else None}
