"""`certify` proves that an observer converges."""

import functools
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from jaxtyping import Float

from covariant import certificates, models
from covariant._names import unknown
from covariant.certificates import Attempt, CheckerName, ContractionCertificate, LostRows
from covariant.models import ModelFile, Overrides, input_count
from covariant.observers import OBSERVER_NAMES
from covariant.verbs.base.arguments import Amounts, Region, above_zero, amounts, bounds, given_gains, numbers
from covariant.verbs.base.certify_sentences import in_degrees, start_errors, undecided_claims, verdict
from covariant.verbs.base.design import Design, design, runs_otherwise
from covariant.verbs.base.find import FIND, largest_proved
from covariant.verbs.base.globally import GLOBALLY, GlobalResult, certify_globally
from covariant.verbs.base.inputs import numbered
from covariant.verbs.base.progress import Progress, notebook_line
from covariant.verbs.base.result import AbstractResult
from scalargraph.errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

OBSERVERS = "intrinsic", "geodesic", GLOBALLY
"""The observers that there are certificates for."""
VERDICTS = {"holds": "proved", "fails": "wrong", "undecided": "not decided"}
"""What people call the verdicts."""
_KINDS = {"estimate": "estimate of", "velocity": "estimated velocity", "error": "position error", "force": "force"}
_KINDS |= {
    "friction": "friction",
    "joint force": "force with friction",
    "friction slope": "slope of the friction",
    "age": "measurement of",
    "signal": "given",
}


def certify(
    model: Any,
    *,
    velocity: Amounts | None = None,
    error: Amounts | None = None,
    region: Region | None = None,
    observer: str | None = None,
    alpha: Amounts | None = None,
    beta: Amounts | None = None,
    sampling: float | None = None,
    input: Amounts | None = None,
    times: Sequence[float] | None = None,
    rate: float | None = None,
    q: Sequence[float | int] | None = None,
    noise: Amounts = 0.0,
    disturbance: Amounts = 0.0,
    interval: Sequence[float] | None = None,
    lost: int = 0,
    lost_rows: LostRows = "empty",
    boxes: int = 200_000,
    seconds: float | None = None,
    processes: int = 1,
    checker: CheckerName = "auto",
    find: str | None = None,
    runs: int = 10,
    overrides: Overrides = (),
    jerk: Amounts = 0.0,
    progress: Progress = notebook_line,
) -> "CertifyResult | GlobalResult":
    """Prove that an intrinsic observer converges: on which region, at which rate, from how far.

    Use it to state how far an estimate may start from the truth and still converge. The result holds for the whole
    region and not only for motions that were simulated. The bounds decide whether a proof exists: a smaller region,
    velocity or error makes it easier. The rate is that of squared lengths, so that errors decrease at half of it.
    `certificates.certify` takes an observer that you have built yourself.

    Args:
        model: A model file (.toml), a robot, `module:attribute`, the name of a system, a `ModelFile`, or a system.
        velocity: Bound of the true velocities [unit/s], one for all or one each; required. There is no certificate
            without it.
        error: How far estimated positions may be off [unit], one bound for all or one each; without it the statement is
            about all first errors, of the observer "measured-coefficients".
        region: Ends by name of positions, and of inputs. Coordinates on which nothing depends need none, such as north
            and east of a ship, nor do rotations, nor limits of joints for all first errors. On a group the positions
            are the entries of its matrices, named g11, g12, ….
        observer: "intrinsic" (default with an `error`) or "geodesic"; or "measured-coefficients" (default without an
            `error`), without `times`, `q`, `input`, `find`, in one process, and with a checker of files alone.
        alpha: Gain α [1/s], together with `beta`; by default designed from the numbers of the model file, for all
            first errors the least that are proved. There it may be one for each coordinate.
        beta: Gain β [1/s²], together with `alpha`.
        sampling: Sampling rate [Hz] that gains are designed for.
        input: Bound of the inputs, one for all or one each, 0 by default; ends in `region` come first. An input that
            friction depends on, such as the angle of a rudder, needs one of these.
        times: First and last time [s] of the statement; needed where force or friction depend on time.
        rate: λ [1/s] of squared lengths to prove; by default half of what the metric Q allows.
        q: Entries a, c, b of the metric Q = [[a, c], [c, b]]; by default the best conditioned one.
        noise: Bound of the error of each measured position [unit], one for all or one each.
        disturbance: Bound of the force that the model does not know, one for all or one each.
        interval: Shortest and longest time between two samples [s], for a statement about the observer with sampled
            measurements; without it the observer runs in continuous time.
        lost: With `interval`, how many samples in a row may be lost.
        lost_rows: Whether each lost sample is still a row ("empty"), or its row may be missing ("missing"), so that one
            step of the observer covers the gap.
        boxes: Effort: boxes that may be evaluated, the same on every machine.
        seconds: A limit of time [s] besides, for each of the proofs.
        processes: Processes to prove with. With several, a script needs the `if __name__ == "__main__"` guard.
        checker: "auto" gives what was proved to the checker for as long as the proof took, or ten seconds; "all" until
            it is through; "off" not at all. What it does not accept is not proved.
        find: Search the largest value that is proved, each attempt with at most `boxes` boxes, beginning with the one
            given: "error" multiplies all bounds of the error, and with them grows the radius; "rate" varies `rate`;
            "interval" the longest time between two samples.
        runs: With `find`, how many certificates are tried at most.
        overrides: Values that replace those of the model file.
        jerk: For all first errors, bound of the change of each acceleration within a sample, per second.
        progress: Called with the current proof and the fraction of its region that is decided.

    Returns:
        The verdict with the whole statement; `result.holds` says whether it is proved.

    Raises:
        ValueError: For a bound that is missing, or that does not fit the model.

    Example:
        >>> import covariant
        >>> bounds = {"velocity": 1.0, "error": 0.1, "region": {"q": (-1.0, 1.0)}}
        >>> covariant.certify("oscillator", alpha=10.0, beta=50.0, rate=1.0, **bounds).holds
        True
    """
    if velocity is None:
        raise InputError(
            "velocity is missing: no certificate exists without a bound of the velocity, because the tube in which "
            "estimates converge shrinks as the velocity grows; give one bound, or one for each velocity"
        )
    if observer is not None and observer not in OBSERVERS:
        raise InputError(unknown("observer", observer, OBSERVERS, OBSERVER_NAMES))
    pair = given_gains(alpha, beta)
    name = models.spec_name(model)
    progress("reading the model")
    file = _read(model, name, overrides)
    if observer is None:
        observer = GLOBALLY if error is None and file.model.manifold.commuting else OBSERVERS[0]
    recipe = models.recipe(name, overrides) if isinstance(model, str | os.PathLike) else None
    limits = _effort(boxes, seconds, processes)
    if observer == GLOBALLY:
        within = {"error": error, "times": times, "q": q, "input": input, "find": find, "checker": checker == "all"}
        del limits["processes"]  # it takes one, whatever the command line's default is
        disturbed = {"noise": noise, "disturbance": disturbance, "jerk": jerk}
        every = None if sampling is None else (1 / above_zero("sampling", sampling),) * 2
        limits |= {"lost": lost, "rate": rate, "interval": every if interval is None else tuple(interval)}
        about = {"recipe": recipe, "velocity": velocity, "disturbed": disturbed}
        return certify_globally(name, file, pair, region, progress, within, **about, **limits)
    if error is None:
        raise InputError("error is missing: give how far an estimated position may be off, one bound or one each")
    if np.any(jerk):
        raise InputError(f"jerk is for certificates of {GLOBALLY}; leave it out")
    designed = design(file, observer, pair, None if sampling is None else above_zero("sampling", sampling))
    settings = _region(file, velocity, error, region, input, noise, disturbance)
    settings |= {
        "times": None if times is None else tuple(times),
        "rate": None if rate is None else above_zero("rate", rate),
        "q": _metric(q),
        "interval": None if interval is None else tuple(interval),
        "lost": lost,
        "lost_rows": lost_rows,
    }
    settings |= limits | {"checker": checker}
    prove = functools.partial(_prove, designed, recipe, progress, **settings)
    notes = designed.notes + runs_otherwise(file, observer)
    if find is None:
        return CertifyResult(name, prove(), notes)
    certificate, attempts = largest_proved(find, settings, prove, runs)
    return CertifyResult(name, certificate, notes, FIND[find], attempts)


@dataclass(frozen=True, repr=False)
class CertifyResult(AbstractResult):
    """Verdict on a statement about an observer, with the numbers of its proof.

    Attributes:
        model_name: The model, by its path or name.
        certificate: The statement with its proofs.
        design: A sentence on where the gains come from.
        varied: With `find`, what was varied.
        attempts: With `find`, each value that was tried, with its verdict.

    Example:
        >>> import covariant
        >>> bounds = {"velocity": 1.0, "error": 0.1, "region": {"q": (-1.0, 1.0)}}
        >>> result = covariant.certify("oscillator", alpha=10.0, beta=50.0, rate=1.0, checker="off", **bounds)
        >>> result.summary["verdict"], result.certificate.rate
        ('holds', 1.0)
    """

    model_name: str
    certificate: ContractionCertificate
    design: str
    varied: str = ""
    attempts: tuple[Attempt, ...] = ()

    written: ClassVar[tuple[str, ...]] = (".json",)

    @property
    def holds(self) -> bool:
        """Whether the statement is proved."""
        return self.certificate.statement.verdict == "holds"

    @property
    def wrong(self) -> bool:
        """Whether there is a counter-example to the statement; then no certificate can be saved."""
        return self.certificate.counterexample is not None

    @property
    def headline(self) -> str:
        certificate = self.certificate
        verdict = VERDICTS[certificate.statement.verdict]
        tube = f", radius ε = {certificate.radius:.4g}" if self.holds else ""
        return f"{self.model_name}, {verdict}: rate λ = {certificate.rate:.4g} 1/s{tube}"

    @property
    def summary(self) -> dict[str, Any]:
        cert, domain = self.certificate, self.certificate.domain
        ends = zip(domain.names, domain.low.tolist(), domain.high.tolist(), strict=True)
        wrong = None
        if cert.counterexample is not None:
            wrong = dict(zip(domain.names, cert.counterexample.mean(axis=0).tolist(), strict=True))
        return {
            "model": self.model_name,
            "observer": type(cert.observer).__name__,
            "verdict": cert.statement.verdict,
            "evidence": cert.statement.evidence,
            "statement": cert.statement.claim,
            "about": list(cert.statement.about),
            "hypotheses": cert.statement.document()["hypotheses"],
            "alpha": float(cert.observer.alpha),
            "beta": float(cert.observer.beta),
            "q": cert.q.tolist(),
            "rate": cert.rate,
            "decay": cert.decay,
            "radius": cert.radius,
            "steady": cert.steady if math.isfinite(cert.steady) else None,
            "half_widths": cert.half_widths.tolist() if self.holds else None,
            "start": None if cert.start is None else start_errors(cert.start),
            "attempts": [attempt._asdict() for attempt in self.attempts],
            "velocity": cert.velocity.tolist(),
            "domain": {name: [low, high] for name, low, high in ends},
            "boxes": cert.boxes,
            "seconds": cert.seconds,
            "checker_seconds": cert.checker_seconds,
            "open": len(cert.open),
            "open_share": {claim.kind: claim.proof.open_share for claim in undecided_claims(cert)},
            "counterexample": wrong,
        }

    def __str__(self) -> str:
        cert, domain = self.certificate, self.certificate.domain
        lines = [
            *([verdict(cert), ""] if self.holds else []),  # other statements begin with their verdict themselves
            str(cert.statement),
            "",
            self.design,
            *(self._tube() if self.holds else ["no tube is proved"]),
            *([f"tried for the largest {self.varied}:"] if self.attempts else []),
            *(f"  {attempt}" for attempt in self.attempts),
            *(["  all of them are proved, and larger ones were not tried: give more runs"] if self._unlimited else []),
            "the domain of the proofs:",
        ]
        rows = zip(cert.kinds, domain.names, domain.units, domain.low, domain.high, strict=True)
        for kind, name, unit, low, high in rows:
            low, high = low + 0.0, high + 0.0  # takes the sign from a zero
            ends = f"  {low:.4g} ≤ {_KINDS[kind]} {name} ≤ {high:.4g} {unit}".rstrip()
            lines.append(ends + in_degrees(high, unit, low))
        if cert.counterexample is not None:
            point = cert.counterexample.mean(axis=0)
            lines.append("it is wrong at")
            lines += [
                f"  {name} = {x:.6g} {unit}".rstrip() + in_degrees(x, unit)
                for name, unit, x in zip(domain.names, domain.units, point, strict=True)
            ]
        lines += [
            f"{claim.kind}: {len(claim.proof.open)} boxes remain, {claim.proof.open_share:.2%} of the domain; more "
            "boxes, smaller bounds or a lower rate may decide it"
            for claim in undecided_claims(cert)
        ]
        lines.append(f"{cert.boxes} boxes, {cert.seconds:.1f} s; checker {cert.checker_seconds:.1f} s")
        if self.wrong:
            lines.append("no certificate is written of a statement that is wrong")
        return "\n".join(lines)

    @property
    def _unlimited(self) -> bool:
        """Whether a search ended before it met a value that is not proved."""
        return bool(self.attempts) and all(attempt.verdict == "holds" for attempt in self.attempts)

    def _tube(self) -> list[str]:
        """Lines on the half widths of the tube."""
        cert = self.certificate
        names, units, n = cert.domain.names, cert.domain.units, len(cert.velocity)
        rates = [f"{unit}/s" if unit and not unit.endswith("/s") else unit for unit in units[:n]]
        turns = [unit.removesuffix("/s") for unit in units[:n]]
        lines = [] if cert.start is None else ["every start is covered whose errors are, all at once, within"]
        lines += [] if cert.start is None else [f"  {line}" for line in cert.start.lines]
        lines.append(f"tube of the radius ε = {cert.radius:.4g}: every estimate in it stays within")
        position, velocity = ("position", cert.half_widths[:n], turns), ("velocity", cert.half_widths[n:], rates)
        for what, widths, each in (position, velocity):
            rows = zip(names[:n], widths, each, strict=True)
            lines += [f"  {w:.4g} {unit} of {what} {name}{in_degrees(w, unit)}" for name, w, unit in rows]
        return lines

    def _write(self, path: Path) -> None:
        if self.wrong:
            raise InputError(f"{path}: no certificate is written of a statement that is wrong")
        self.certificate.save(path)

    def _write_page(self, path: Path) -> list[Path]:
        from covariant.verbs.base.pages import write_result_page

        title, drawn = f"Certificate of {Path(self.model_name).stem}", self.certificate.sampling is None
        return write_result_page(path, title, self, [str(self)], drawn=drawn)

    def _figure(self) -> "Figure":
        from covariant.report import certificate_figure

        if self.certificate.sampling is not None:
            raise InputError("figures are of certificates in continuous time; this one is about sampled measurements")
        return certificate_figure(self.certificate)


def _read(model: Any, name: str, overrides: Overrides) -> ModelFile:
    """The model file, which must be of a mechanical system without feet."""
    file = models.load(model, overrides)
    if file.need_mechanical(name, "certificates are about intrinsic observers of").feet is not None:
        raise InputError(
            f"{name} has feet: no certificate covers impacts; of the same model without feet one is about the motion "
            "between them"
        )
    return file


def _region(
    file: ModelFile,
    velocity: Amounts,
    error: Amounts,
    region: Region | None,
    input: Amounts | None,
    noise: Amounts,
    disturbance: Amounts,
) -> dict[str, Any]:
    """Bounds of the motions, measurements and forces that the statement is about."""
    system: Any = file.model
    n, on_group = file.dimension, not system.manifold.commuting
    names = system.velocities if on_group else system.coordinates or numbered("q", n)
    return {
        "velocity": numbers("velocity", velocity, [f"d{k}/dt" for k in names], positive=True, one=True),
        "error": numbers("error", error, names, positive=True, one=True),
        "position": bounds("region", region or {}, tuple(region or ()), equal=True),
        "input": None if input is None else amounts("input", input, numbered("u", input_count(system, n))),
        "noise": amounts("noise", noise, names),
        "disturbance": amounts("disturbance", disturbance, names),
    }


def _effort(boxes: float, seconds: float | None, processes: float) -> dict[str, Any]:
    """Limits of the work."""
    return {
        "boxes": int(above_zero("boxes", boxes)),
        "seconds": None if seconds is None else above_zero("seconds", seconds),
        "processes": int(above_zero("processes", processes)),
    }


def _prove(
    designed: Design, recipe: dict[str, Any] | None, progress: Progress, **settings: Any
) -> ContractionCertificate:
    """Prove the statement, of an observer whose substeps suit the longest time between two samples."""
    observer, interval = designed.inner, settings["interval"]
    if interval is not None:
        lost, lost_rows = settings["lost"], settings["lost_rows"]
        steps = lost + 1 if lost_rows == "missing" else 1
        longest = steps * certificates.check_interval(interval, lost, lost_rows)[1]
        observer = designed.with_substeps_for(settings["velocity"], longest)

    def shown(what: str, share: float, count: int) -> None:
        progress(f"proving {what}, {count} boxes", share)

    return certificates.certify(observer, recipe=recipe, progress=shown, **settings)


def _metric(entries: Sequence[float | int] | None) -> Float[np.ndarray, "2 2"] | None:
    """Q from its entries a, c, b."""
    if entries is None:
        return None
    a, c, b = numbers("q", entries, ("a", "c", "b"))
    if not (a > 0 and a * b > c * c):  # Sylvester's criterion
        raise InputError(f"q: [[a, c], [c, b]] must be positive definite, a > 0 and ab > c²; got {a:g}, {c:g}, {b:g}")
    return np.array([[a, c], [c, b]])
