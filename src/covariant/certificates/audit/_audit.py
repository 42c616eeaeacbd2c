"""The laws that the convergence of an intrinsic observer rests on, measured at random states.

Source: Aghannan & Rouchon 2003; on groups Maithripala, Berg & Dayawansa 2004.
"""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._errors import InputError
from covariant._names import unknown
from covariant.certificates import Hypothesis, Statement, lyapunov, rate_of
from covariant.certificates.audit._laws import (
    STEP,
    States,
    along_the_flow,
    between_charts,
    between_observers,
    compiled_quickly,
    configuration,
    exact,
    mechanical,
    of_the_geometry,
    order_of,
    own,
)
from covariant.certificates.base import need_no_loops
from covariant.models import MechanicalSystem, input_count, source
from covariant.observers import AbstractFlowObserver, AbstractObserver
from covariant.proofs import Box, check_box

FLOOR = 1e-9
"""Differences below this fraction of the correction are rounding, and no order is fitted to them."""
RESOLVED = 1e-6
"""Largest spacing of floating-point numbers near a coordinate, as a fraction of the smallest error that is used."""
CANDIDATES = 16
"""Configurations drawn for each one needed, since a chart may be singular at some points of the box."""


class Law(NamedTuple):
    """One law, and how much the observer deviates from it.

    Attributes:
        name: name of the law, as in `LAWS`.
        statement: what should hold.
        source: where it is published.
        verdict: "holds", "fails", or "skipped" where there is nothing to measure.
        deviation: the largest one, relative to the terms of the law; NaN where skipped or not a number.
        tolerance: the largest deviation allowed.
        reason: the reason for this tolerance, or why the law is skipped.
        detail: further results, such as an order or a rate; may be empty.
        point: the state of the largest deviation, position (on a group: exponential coordinates) and then velocity.

    Example:
        >>> from covariant.certificates.audit import Law
        >>> law = Law("torsion", "it is symmetric", "section II", "fails", 0.5, 1e-9, "rounding", "", (1.0, 2.0))
        >>> law.passed, law.remark
        (False, 'worst at (1, 2)')
    """

    name: str
    statement: str
    source: str
    verdict: Literal["holds", "fails", "skipped"]
    deviation: float
    tolerance: float
    reason: str
    detail: str
    point: tuple[float, ...]

    @property
    def passed(self) -> bool:
        """Whether the law is not violated: it holds or is skipped. Only the verdict "holds" is evidence for the law."""
        return self.verdict != "fails"

    @property
    def remark(self) -> str:
        """The remarks beside the numbers, in one line."""
        if self.verdict == "skipped":
            return self.reason
        parts = [self.detail] if self.detail else []
        parts += [] if self.passed else [f"worst at ({', '.join(f'{x:.3g}' for x in self.point)})"]
        return "; ".join(parts)


class Audit(NamedTuple):
    """The laws of one observer; `str` of it is a table.

    Attributes:
        observer: its kind and gains, as text.
        domain: the states at which it was audited, as text.
        rows: the laws, in the order of `LAWS`.

    Example:
        >>> from covariant.certificates.audit import Audit, Law
        >>> law = Law("plant", "it moves as the plant", "(2), (5)", "holds", 1e-12, 1e-9, "rounding", "", ())
        >>> result = Audit("Intrinsic", "24 states", (law,))  # usually from `audit`
        >>> result.passed, result.verdict
        (True, 'passed: 1 laws hold')
    """

    observer: str
    domain: str
    rows: tuple[Law, ...]

    @property
    def passed(self) -> bool:
        """Whether no law is violated, and at least one of them was measured."""
        return not self.broken and self.measured > 0

    @property
    def measured(self) -> int:
        """Number of laws that were measured, and not skipped."""
        return sum(row.verdict != "skipped" for row in self.rows)

    @property
    def broken(self) -> tuple[str, ...]:
        """Names of the laws that are violated."""
        return tuple(row.name for row in self.rows if not row.passed)

    @property
    def statement(self) -> Statement:
        """The statement that the observer satisfies the laws at the audited states, with each law as a hypothesis."""
        premises = tuple(
            Hypothesis(f"{row.name}: {row.statement}; {row.reason}", "assumed")
            if row.verdict == "skipped"
            else Hypothesis(
                f"{row.name}: {row.statement}, relative deviation up to {row.tolerance:.0e}",
                "sampled",
                row.verdict,
                row.tolerance - row.deviation,
                "" if row.passed else f"({', '.join(f'{x:.3g}' for x in row.point)})",
            )
            for row in self.rows
        )
        between = Hypothesis("what holds at these states holds between them", "assumed")
        margin = min((p.margin for p in premises if p.margin is not None), default=math.nan)
        claim = "the observer keeps the laws that its convergence rests on"
        return Statement(claim, (f"observer: {self.observer}",), (*premises, between), margin, self.domain)

    @property
    def verdict(self) -> str:
        """The result in one sentence."""
        skipped = len(self.rows) - self.measured
        rest = f", {skipped} skipped" if skipped else ""
        if not self.measured:
            return f"undecided: no law was measured{rest}"
        if not self.passed:
            return f"failed: {len(self.broken)} of {len(self.rows)} laws broken ({', '.join(self.broken)}){rest}"
        return f"passed: {self.measured} laws hold{rest}"

    def __str__(self) -> str:
        lines = [f"{self.observer}: {self.verdict}", self.domain]
        for row in self.rows:
            figures = f"{row.deviation:.1e} {'≤' if row.passed else '>'} {row.tolerance:.0e}"
            figures = "" if row.verdict == "skipped" else figures
            text = f"{row.statement}; {row.remark}" if row.remark else row.statement
            lines.append(f"  {row.verdict:8} {row.name:14} {figures:18} {text}")
        return "\n".join(lines)


class _Statement(NamedTuple):
    statement: str
    sources: tuple[str, str]  # in coordinates, on a group
    tolerance: float
    reason: str


_ROUNDED = 1e-9, "rounding of the terms summed, enlarged by the condition of the metric"
_FITTED = 0.1, "what a fit leaves over errors that are small but not zero"
_DIFFERENCES = 1e-6, f"second differences of fourth order, over times of {STEP:g}"
_EXACT = 1e-6, "the budget of the observer's geodesics, and rounding over the error"
_AR, _MBD = "Aghannan & Rouchon", "Maithripala, Berg & Dayawansa"
_STATEMENTS = {
    "plant": _Statement(
        "at zero error the estimate moves as the plant", (f"{_AR} (2), (5)", f"{_MBD} (17), (18)"), *_ROUNDED
    ),
    "error": _Statement(
        "in a parallel frame ξ' = ζ − αξ, ζ' = −βξ at any velocity", (f"{_AR} (10)", f"{_AR} (10)"), *_ROUNDED
    ),
    "lyapunov": _Statement(
        "V' = −½(|ξ|² + |ζ|²) along the observer",
        (f"{_AR}, appendix II, with its ½", f"{_AR}, appendix II, with its ½"),
        *_ROUNDED,
    ),
    "metric": _Statement(
        "the connection is metric: ∂ₓ<y, z> = <∇ₓy, z> + <y, ∇ₓz>",
        (f"{_AR}, section II", f"{_MBD} (3)"),
        *_ROUNDED,
    ),
    "torsion": _Statement(
        "the connection is symmetric: ∇ₓy − ∇ᵧx = [x, y]", (f"{_AR}, section II", f"{_MBD} (3)"), *_ROUNDED
    ),
    "transport": _Statement(
        "parallel transport keeps inner products", (f"{_AR}, section II", f"{_MBD}, section II"), *_ROUNDED
    ),
    "curvature": _Statement(
        "geodesics part as the curvature says: D²J/dt² = −R(J, γ')γ'",
        (f"{_AR}, section II, in our sign", f"{_MBD} (6)–(8), corrected"),
        *_DIFFERENCES,
    ),
    "invariance": _Statement(
        "another chart gives the same observer", (f"{_AR}, section III-B", f"{_AR}, section III-B"), *_FITTED
    ),
    "approximation": _Statement(
        "the approximate and the exact observer differ by the square of the error",
        (f"{_AR} (2), (5)", f"{_MBD} (19), corrected"),
        *_FITTED,
    ),
}
LAWS = tuple(_STATEMENTS)
"""Names of all laws."""


class _Finding(NamedTuple):
    """The measurement of one law.

    Attributes:
        deviations: (k,) at the states; None where the law is skipped.
        detail: further results.
        badness: (k,) by which the states are ranked, where this is not the deviation.
        tolerance, reason: replace the usual ones where not None; for a skipped law the reason says why.
    """

    deviations: np.ndarray | None
    detail: str = ""
    badness: np.ndarray | None = None
    tolerance: float | None = None
    reason: str | None = None


def audit(
    observer: AbstractObserver,
    *,
    model: MechanicalSystem | None = None,
    gains: tuple[float, float] | None = None,
    domain: Box | None = None,
    speed: float = 3.0,
    error: float = 1e-2,
    points: int = 24,
    seed: int = 0,
    laws: Sequence[str] = LAWS,
) -> Audit:
    """Measure the laws of an intrinsic observer: `Intrinsic`, `Geodesic`, or one with the same claim.

    Inputs are of the order of 1. A law with a deviation that is not a number counts as violated. Computations are in
    double precision.

    Args:
        observer: the observer.
        model: model of the laws, by default the observer's `model`.
        gains: α [1/s] and β [1/s²] of the laws, by default the observer's `alpha` and `beta`.
        domain: box of coordinates from which positions are drawn; on a group exponential coordinates, x1, x2, ….
            Coordinates that it does not name range from 0.2 to 1.2 [their units], around a whole circle, or on a group
            from −1 to 1.
        speed: largest velocity of each coordinate [units/s].
        error: largest position error for the laws that need one [units]; 0.1 and 0.01 of it are used too.
        points: number of states.
        seed: of their random numbers.
        laws: names of the laws to measure, all of `LAWS` by default. If none can be measured, the verdict is undecided.

    Returns:
        The laws with their deviations.

    Raises:
        ValueError: an observer without that claim (no `flow`, no gains α and β, no mechanical model), gains that are
            not positive, an unknown law, an error that is lost in rounding, or a domain without enough
            configurations at which the model is finite.

    Example:
        >>> from covariant import models, observers
        >>> from covariant.certificates.audit import audit
        >>> result = audit(observers.Intrinsic(models.oscillator(), 2.0, 2.0), points=2, laws=("plant",))
        >>> result.passed
        True
    """
    flow, model = _error_system(observer, model)
    alpha, beta = _gains(observer, gains)
    for name in laws:
        if name not in LAWS:
            raise InputError(f"audit: {unknown('law', name, LAWS)}")
    if points < 1 or not (0 < speed < math.inf and 0 < error < math.inf):
        raise InputError(f"audit: points, speed and error must be positive; got {points}, {speed:g}, {error:g}")
    box = _box(model, domain)
    states, coordinates = _draw(model, box, speed, points, np.random.default_rng(seed))
    # Three errors, each ten times the one before, from whose differences an order is fitted.
    gain_pair, errors = (jnp.asarray(alpha), jnp.asarray(beta)), error * np.array([1e-2, 1e-1, 1.0])
    if not (np.spacing(np.abs(coordinates)) < RESOLVED * errors[0]).all():
        # If the estimate rounds to the measurement, the error is zero, and any two observers agree.
        raise InputError(
            f"audit: an error of {error:g} is lost in the rounding of coordinates up to {np.abs(coordinates).max():g}; "
            "give a larger error, or a domain closer to 0"
        )
    findings: dict[str, _Finding] = {}
    if not {"plant", "error", "lyapunov"}.isdisjoint(laws):
        findings |= _along_the_flow(model, flow, alpha, beta, states)
    if not {"metric", "torsion", "transport", "curvature"}.isdisjoint(laws):
        findings |= _of_the_geometry(model, states)
    if "invariance" in laws:
        findings["invariance"] = _invariance(model, flow, gain_pair, states, errors)
    if "approximation" in laws:
        differences = between_observers(model, flow, gain_pair, states, jnp.asarray(errors))
        findings["approximation"] = _second_order(np.asarray(differences), errors)
    at = np.concatenate([coordinates, np.asarray(states.v)], axis=1)
    return Audit(
        f"{type(observer).__name__}, α = {alpha:.4g} 1/s, β = {beta:.4g} 1/s²",
        f"{points} states, {box}, velocities to ±{speed:g} (seed {seed})",
        tuple(_row(model, name, findings[name], at) for name in LAWS if name in laws),
    )


def _error_system(
    observer: AbstractObserver, model: MechanicalSystem | None
) -> tuple[AbstractFlowObserver, MechanicalSystem]:
    """The observer and its model; raises `ValueError` that says why the laws do not apply to it."""
    kind = type(observer).__name__
    if not isinstance(observer, AbstractFlowObserver):
        raise InputError(f"audit: {kind} is no differential equation; give an Intrinsic or a Geodesic")
    candidate = own(observer, "model") if model is None else model
    if mechanical(candidate):
        need_no_loops("audit", candidate.space)
        return observer, candidate
    lacks = (
        "no model of its own; give model=" if candidate is None else f"a {type(candidate).__name__}; give an Intrinsic"
    )
    raise InputError(f"audit: the laws are those of an observer of a mechanical system, and {kind} has {lacks}")


def _gains(observer: AbstractObserver, explicit: tuple[float, float] | None) -> tuple[float, float]:
    pair = (own(observer, "alpha"), own(observer, "beta")) if explicit is None else explicit
    rate = own(observer, "force_rate")
    if explicit is None and rate is not None:
        # With the force held, the feedback of position and velocity is that of three poles.
        pair = pair[0] + rate, pair[1] + pair[0] * rate
    if any(gain is None for gain in pair):
        raise InputError(
            f"audit: {type(observer).__name__} has no gains alpha and beta, nor the laws that go with them; give an "
            "Intrinsic or a Geodesic"
        )
    alpha, beta = float(pair[0]), float(pair[1])
    if not (0 < alpha < math.inf and 0 < beta < math.inf):
        raise InputError(f"audit: the gains must be positive numbers; got {alpha:g} and {beta:g}")
    return alpha, beta


def _box(model: MechanicalSystem, domain: Box | None) -> Box:
    """All coordinates in order, each with its bounds from the domain, or with default bounds that suit most models."""
    names, units, circles = _coordinates(model)
    if not names and domain is None:
        raise InputError("audit: the model does not name its coordinates; give domain=box(q1=(low, high), …)")
    if domain is not None:
        check_box(domain)
        if not names:
            return domain
        for name in domain.names:
            if name not in names:
                raise InputError(f"audit: {unknown('coordinate', name, names)}")
    low, high = (np.full(len(names), end) for end in ((0.2, 1.2) if model.manifold.commuting else (-1.0, 1.0)))
    low[list(circles)], high[list(circles)] = -np.pi, np.pi
    for name, least, most in zip(domain.names, domain.low, domain.high, strict=True) if domain is not None else ():
        low[names.index(name)], high[names.index(name)] = least, most
    return Box(names, units, low, high)


def _coordinates(model: MechanicalSystem) -> tuple[tuple[str, ...], tuple[str, ...], tuple[int, ...]]:
    """Names and units of the coordinates, or those of the retraction where the model has none; indices of circles."""
    if model.manifold.commuting:
        units = tuple("" if unit == "1" else unit for unit in model.units) or ("",) * len(model.coordinates)
        return model.coordinates, units, model.circles
    n = len(model.velocities)
    return tuple(f"x{i + 1}" for i in range(n)), ("",) * n, ()


def _usable(model: MechanicalSystem, coordinates: Array) -> Array:
    """Whether the model is finite and its metric positive definite at these coordinates."""
    q = configuration(model, coordinates)
    g = model.space(q)
    values = jnp.linalg.eigvalsh(jnp.where(jnp.isfinite(g), g, 0.0))
    u = jnp.zeros(input_count(model, g.shape[0]))
    finite = jnp.all(jnp.isfinite(g)) & jnp.all(jnp.isfinite(source(model, jnp.zeros(()), q, u)))
    # Relative to the largest eigenvalue: a metric that is singular up to rounding is refused, in any units.
    return finite & (values[0] > 1e-12 * values[-1])


def _draw(
    model: MechanicalSystem, box: Box, speed: float, points: int, rng: np.random.Generator
) -> tuple[States, Float[np.ndarray, "k n"]]:
    """Random states, and the coordinates of their positions."""
    n = len(box.low)
    candidates = rng.uniform(box.low, box.high, (CANDIDATES * points, n))
    usable, positions = (np.asarray(a) for a in _configurations(model, jnp.asarray(candidates)))
    if usable.sum() < points:
        raise InputError(
            f"audit: the model is finite and its metric positive definite at only {usable.sum()} of {len(usable)} "
            f"configurations drawn from {box}; give another domain"
        )
    v = rng.uniform(-speed, speed, (points, n))
    y, z, unit = rng.normal(size=(3, points, n))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    u = rng.normal(size=(points, input_count(model, n)))
    # So small that the derivative of the chart stays near the identity at every centre.
    bend = rng.uniform(-0.25 / n, 0.25 / n, (points, 2, n, n))
    centre = rng.uniform(-0.5, 0.5, (points, n))
    rows = (positions[usable][:points], v, y, z, unit, u, bend, centre)
    return States(*map(jnp.asarray, rows)), candidates[usable][:points]


@compiled_quickly
def _configurations(model: MechanicalSystem, coordinates: Array) -> tuple[Array, Array]:
    return jax.lax.map(lambda c: (_usable(model, c), configuration(model, c)), coordinates)


def _along_the_flow(
    model: MechanicalSystem, observer: AbstractFlowObserver, alpha: float, beta: float, states: States
) -> dict[str, _Finding]:
    q = lyapunov(alpha, beta)
    deviations = along_the_flow(model, observer, jnp.asarray(alpha), jnp.asarray(beta), jnp.asarray(q), states)
    details = {"lyapunov": f"a rate of {rate_of(alpha, beta, q):.4g} 1/s where it holds"}
    return {name: _Finding(np.asarray(value), details.get(name, "")) for name, value in deviations._asdict().items()}


def _of_the_geometry(model: MechanicalSystem, states: States) -> dict[str, _Finding]:
    deviations = {name: np.asarray(value) for name, value in of_the_geometry(model, states)._asdict().items()}
    sectional = deviations.pop("sectional")
    findings = {name: _Finding(value) for name, value in deviations.items()}
    curved = findings["curvature"]._replace(
        detail=f"sectional curvatures {sectional.min():.3g} to {sectional.max():.3g}"
    )
    flat = _Finding(None, reason="in one dimension nothing is curved")
    return findings | {"curvature": flat if states.v.shape[1] == 1 else curved}


def _invariance(model: MechanicalSystem, observer: AbstractFlowObserver, gains, states: States, errors) -> _Finding:
    if not model.manifold.commuting:
        return _Finding(None, reason="no chart: the observer on a group is written without coordinates")
    if own(observer, "model") is None:
        return _Finding(None, reason="the observer is written in one chart: it has no model to exchange")
    differences = np.asarray(between_charts(model, observer, gains, states, jnp.asarray(errors)))
    if exact(observer):
        tolerance, reason = _EXACT
        return _Finding(differences[-1], f"at an error of {errors[-1]:.2g}", None, tolerance, reason)
    return _second_order(differences, errors)


def _second_order(relative: Float[np.ndarray, "e k"], errors: Float[np.ndarray, "e"]) -> _Finding:
    """Whether differences, given relative to the error, vanish with its square or faster."""
    order, worst = order_of(relative, errors, FLOOR), relative[-1]
    if order is None:
        return _Finding(0 * worst, "no difference beyond rounding", worst)
    detail = f"differences of order {order:.3f}, {100 * worst.max():.3g} % at an error of {errors[-1]:.2g}"
    # An order above 2 is no deviation.
    return _Finding(np.full_like(worst, np.maximum(0.0, 2 - order)), detail, worst)


def _row(model: MechanicalSystem, name: str, finding: _Finding, points: Float[np.ndarray, "k two_n"]) -> Law:
    law = _STATEMENTS[name]
    origin = law.sources[not model.manifold.commuting]
    reason = law.reason if finding.reason is None else finding.reason
    tolerance = law.tolerance if finding.tolerance is None else finding.tolerance
    if finding.deviations is None:
        return Law(name, law.statement, origin, "skipped", math.nan, tolerance, reason, "", ())
    ranked = finding.deviations if finding.badness is None else finding.badness
    point = points[int(np.where(np.isnan(ranked), np.inf, ranked).argmax())]
    deviation = float(finding.deviations.max())  # NaN where any is
    verdict = "holds" if deviation <= tolerance else "fails"
    return Law(
        name, law.statement, origin, verdict, deviation, tolerance, reason, finding.detail, tuple(point.tolist())
    )
