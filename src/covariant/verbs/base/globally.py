"""Certifies convergence from all first errors: the part of `certify` for the observer with measured coefficients."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from covariant import certificates
from covariant.calibration import DataSheet, gains, observer_gains, predict_sampled_errors
from covariant.certificates.everywhere import GlobalCertificate
from covariant.models import ModelFile
from covariant.observers import MeasuredCoefficients
from covariant.verbs.base.arguments import Amounts, Region, amounts, bounds, numbers
from covariant.verbs.base.inputs import numbered
from covariant.verbs.base.progress import Progress
from covariant.verbs.base.result import AbstractResult
from covariant.verbs.base.sheet import data_sheet, tells_noise
from scalargraph.errors import InputError

GLOBALLY = "measured-coefficients"
"""The observer whose certificate is about all first errors."""
SETTINGS = "`estimate`, `compare` and `export` run it with these alpha, beta and speed in [design] of the model file."
INTERVAL = 0.001
"""Time between samples [s] where none is given."""


def certify_globally(
    name: str,
    file: ModelFile,
    gains: dict[str, Any] | None,
    region: Region | None,
    progress: Progress,
    without: dict[str, Any],
    *,
    rate: float | None,
    interval: Sequence[float] | None,
    velocity: Amounts,
    disturbed: dict[str, Amounts],
    **settings: Any,
) -> "GlobalResult":
    """Prove the statement about all first errors; `without` are settings of others, which it refuses."""
    if given := [key for key, value in without.items() if value is not None and np.any(value)]:
        raise InputError(f"a certificate of {GLOBALLY} has no {', '.join(given)}; leave it out")
    model: Any = file.model
    names = model.coordinates or numbered("q", file.dimension)
    ends = bounds("region", region or {}, names, "coordinate", equal=True)
    position = np.array([ends.get(each, (np.nan, np.nan)) for each in names]).T
    speeds = numbers("velocity", velocity, [f"d{each}/dt" for each in names], positive=True, one=True)
    observer = model if gains is None else MeasuredCoefficients(model, **gains, speed=speeds)
    interval = (INTERVAL, INTERVAL) if (assumed := interval is None) else interval
    errors = {key: amounts(key, value, names) for key, value in disturbed.items()}
    sizes = _known_sizes(file, errors["noise"], interval[-1]) if min(interval, default=0.0) > 0 else None
    certificate = certificates.certify_globally(
        observer,
        velocity=speeds,
        position=(position[0], position[1]),
        interval=interval,
        rate=None if rate is None else rate / 2,  # of the errors, not of their squares
        progress=lambda what, share, count: progress(f"bounding {what}, {count} boxes", share),
        omega=0.0 if sizes is None or gains is not None else observer_gains(*sizes).beta ** 0.5,
        **errors,
        **settings,
    )
    notes = f"Samples every {INTERVAL:g} s are assumed; give `interval` or `sampling`." if assumed else ""
    steady, worth = ({}, "") if sizes is None else _compare_noise(*sizes, certificate)
    return GlobalResult(name, certificate, f"{notes} {worth}".strip(), steady)


def _known_sizes(file: ModelFile, noise: np.ndarray, interval: float) -> tuple[DataSheet, float] | None:
    """The data sheet with the noise that is stated, or else that of the model file, and the sampling rate [Hz]."""
    file = file._replace(measurement_std=tuple(noise.tolist())) if noise.all() else file
    return (data_sheet(file), float(1 / interval)) if tells_noise(file) else None


def _compare_noise(sheet: DataSheet, rate: float, certificate: GlobalCertificate) -> tuple[dict[str, list[float]], str]:
    """Steady velocity errors (n,) by observer, and when this one is worth its noise; empty where noise is not known.

    They are of the linear channel of each coordinate, by noise and by accelerations that the model lacks.
    """
    document, n = certificate.document, len(certificate.document.low)
    if not certificate.statement.proved:
        return {}, ""
    rule, stds, time = observer_gains(sheet, rate), sheet.stds(n).tolist(), sheet.white_time(rate)
    steady, omega = rule.beta**0.5, document.omega.max()
    density = 2 * sheet.acceleration_std**2 * time
    # The steady Kalman filter of a channel has the gains of the rule for its own noise, to 1e-7 up to ωh = 1.
    kalman = [gains(std, rate, sheet.acceleration_std, sheet.correlation_time)[:2] for std in stds]
    own = zip(document.alpha.tolist(), document.beta.tolist(), strict=True)
    pairs = {GLOBALLY: own, "intrinsic": [rule[:2]] * n, "intrinsic-kalman": kalman}

    def error(pair, std):
        alpha, beta = pair
        return predict_sampled_errors(alpha, beta, rate, std, density).velocity_std

    errors = {name: list(map(error, each, stds)) for name, each in pairs.items()}
    each = "; ".join(f"{name} {', '.join(f'{std:.3g}' for std in stds)}" for name, stds in errors.items())
    text = f"Steady errors of velocities [unit/s]: {each}. Noise grows with ω^1.5. The gain rule of `intrinsic` has "
    if steady > omega * (1 + 1e-9):
        text += f"alpha = {rule.alpha:.4g} and beta = {rule.beta:.4g}: prove these, and the proof is free."
        return errors, text
    if steady > omega * (1 - 1e-9):
        return errors, f"{text}the same ω, more than a proof needs: it is free."
    # The rule has this ω where the density of accelerations is ω⁴ times that of the noise.
    missing = omega**2 * sheet.measurement_std / (2 * time * rate) ** 0.5
    text += f"ω = {steady:.4g} 1/s. The proof is worth it if estimates start far off, and free if "
    return errors, f"{text}the model lacks accelerations of {missing:.3g}, not of {sheet.acceleration_std:.3g}."


@dataclass(frozen=True, repr=False)
class GlobalResult(AbstractResult):
    """Verdict on a statement about all first errors of position and velocity.

    Attributes:
        model_name: The model, by its path or name.
        certificate: The statement with its proof, and the observer that it is about.
        note: Sentences on what was assumed, and on when the observer is worth its noise; may be empty.
        velocity_std: Steady errors (n,) of the velocities by noise and by accelerations that the model lacks, for this
            observer, for `intrinsic` with gains by its rule, and for the steady Kalman filter; empty for a model file
            without these sizes, `measurement.std` (or a stated noise) and `uncertainty.acceleration`.

    Example:
        >>> import covariant
        >>> covariant.certify("pendulum_chain", velocity=1.0).holds
        True
    """

    model_name: str
    certificate: GlobalCertificate
    note: str
    velocity_std: dict[str, list[float]]

    wrong: ClassVar[bool] = False
    written: ClassVar[tuple[str, ...]] = (".json",)

    @property
    def holds(self) -> bool:
        """Whether the statement is proved."""
        return self.certificate.statement.proved

    @property
    def headline(self) -> str:
        verdict, document = self.certificate.statement.short, self.certificate.document
        return f"{self.model_name}, {verdict}: rate μ = {document.rate:.4g} 1/s, ω up to {document.omega.max():.4g} 1/s"

    @property
    def summary(self) -> dict[str, Any]:
        document = self.certificate.document.document()
        kept = {key: document[key] for key in ("velocity", "alpha", "beta", "interval", "lost", "rate", "coupling")}
        numbers = {"omega": self.certificate.document.omega.tolist(), "boxes": self.certificate.proof.boxes}
        numbers |= {"velocity_std": self.velocity_std, "note": self.note}
        return {"model": self.model_name, **self.certificate.statement.document(), **kept, **numbers}

    def __str__(self) -> str:
        cert = self.certificate
        lines = [str(cert.statement), ""]
        rows = zip(cert.observer.model.coordinates, cert.document.omega, cert.velocity_noise(1.0), strict=True)
        lines += [
            f"{name}: ω = {omega:.4g} 1/s; noise σ of the position gives the velocity {noise:.4g} σ 1/s"
            for name, omega, noise in (rows if self.holds else ())
        ]
        lines += [self.note] if self.note else []
        lines += [SETTINGS] if self.holds else []
        return "\n".join([*lines, f"{cert.proof.boxes} boxes, {cert.proof.seconds:.1f} s"])

    def _write(self, path: Path) -> None:
        if not self.holds:
            raise InputError(f"{path}: nothing is proved that could be saved; a smaller region or velocity may do")
        self.certificate.document.save(path)
