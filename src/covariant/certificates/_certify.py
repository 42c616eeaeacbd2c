"""A proved statement about an intrinsic observer: how fast it converges, and from how far.

Three things are proved, each over the whole region. The flow contracts the metric of the tangent bundle at the rate λ,
whatever the measured trajectory. A curve of length ε changes no position error and no velocity by more than the region
allows. The force on the system stays within the bounds taken. It follows as in Theorem 1: along every solution whose
velocity keeps its bound, an estimate that begins within ε of it stays within ε, and the distance falls as `e^(−λt/2)`.

With bounds of the measurement error and of the force that the model does not know there is a fourth: what they add to
the flow is no longer than D. The true motion is then a solution of the observer's own flow but for D, so that the
distance ends below 2D/λ; an estimate within ε stays so where 2D/λ < ε.

Source: Aghannan & Rouchon 2003, Theorems 1 and 2, and Fig. 2; Lohmiller & Slotine 1998, section 3.7 for D.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from covariant._typing import Numbers
from covariant.certificates import _check, _document, _saved
from covariant.certificates._certificate import Certificate
from covariant.certificates._noise import steady_distance
from covariant.certificates._prove import MOST_BOXES, OPEN, Box, Proof, check_box, leaves, prove
from covariant.certificates._region import (
    Intrinsics,
    Subject,
    check_unique,
    contraction,
    disturbed,
    force_bounds,
    force_slopes,
    reach,
    squares,
    subject,
)
from covariant.certificates._tangent import TwoByTwo, check_q, error_matrix, optimal_lyapunov, rate_of
from covariant.geometry.lie import SO2, SO3
from covariant.lowering import Lowered, lower, numbers
from covariant.models import MechanicalSystem, input_count

Bounds = tuple[ArrayLike, ArrayLike]
ROOM = 1.05
"""How much more a reach is allowed to be than was seen, so that it can be proved quickly."""


class Claim(NamedTuple):
    """One proved inequality.

    "contraction"; "reach" of a `row` of (error, velocity), by `square` up to `limit`; or "disturbance": what errors of
    measurement and force, in the unit ball by their sizes, add to the flow is no longer than `√square`.
    """

    kind: _document.Kind
    proof: Proof
    row: int = 0
    square: float = 0.0
    limit: float = 0.0

    def document(self) -> dict[str, Any]:
        """The claim as it is saved."""
        numbers = {key: getattr(self, key) for key in _document.NUMBERS[self.kind]}
        return {"kind": self.kind, **numbers, "levels": _saved.to_letters(self.proof.levels)}


class Followed(NamedTuple):
    """Estimates that began on the border of the proved ball, each beside a motion of its own.

    - `t` (k, T) [s]: until the motion leaves the region or the bound of the velocity, eight time constants at most.
    - `low`, `high` (k, T): their distances from below and from above; `bound` (k, T): `ε e^(−λt/2)`.
    - `certified` [1/s]: λ, of squared lengths.
    """

    t: Float[np.ndarray, "k T"]
    low: Float[np.ndarray, "k T"]
    high: Float[np.ndarray, "k T"]
    bound: Float[np.ndarray, "k T"]
    certified: float

    @property
    def holds(self) -> bool:
        """Whether no distance is above its bound, beyond a millionth for the integration."""
        return bool((self.low <= self.bound * (1 + 1e-6)).all())

    @property
    def rates(self) -> Float[np.ndarray, "k"]:
        """The rate λ [1/s] of each, from its first stamp to its last."""
        return 2 * np.log(self.high[:, 0] / self.high[:, -1]) / (self.t[:, -1] - self.t[:, 0])


class ContractionCertificate(NamedTuple):
    """What was proved about an observer on a region.

    - `summary`: the statement, its verdict, and its margin, the rate λ [1/s] of squared lengths.
    - `radius`: ε, in the metric of Q on states; 0 unless the verdict is "holds".
    - `domain`: the box of estimate, error and force; `velocity` (n,): the bound of the true velocity.
    - `given`: positions, inputs and times that the bounds of the force come from; `noise`, `disturbance`, `slopes`.
    - `recipe`: where the model comes from, as `models.recipe`; None for a model known to this process only.
    - `verified`: whether it was proved in this process. One that was read from a file is as good as the file, until
      `covariant certify --check` has verified it.
    """

    summary: Certificate
    rate: float
    radius: float
    observer: Intrinsics
    q: TwoByTwo
    subject: Subject
    domain: Box
    velocity: Float[np.ndarray, "n"]
    given: dict[str, Any]
    claims: tuple[Claim, ...]
    recipe: dict[str, Any] | None
    verified: bool = False

    @property
    def decay(self) -> float:
        """μ [1/s]: the distance falls as `e^(−μt)`, half the rate."""
        return self.rate / 2

    @property
    def steady(self) -> float:
        """What the distance comes down to under the noise and disturbance of the certificate, `2D/λ`; 0 without."""
        return steady_distance(self.rate, disturbance_length(self.given, self.claims))

    @property
    def boxes(self) -> int:
        """Boxes evaluated."""
        return sum(claim.proof.boxes for claim in self.claims)

    @property
    def seconds(self) -> float:
        """Time that the proofs took [s]."""
        return sum(claim.proof.seconds for claim in self.claims)

    @property
    def counterexample(self) -> Float[np.ndarray, "2 d"] | None:
        """Where the statement was proved wrong."""
        return next((c.proof.counterexample for c in self.claims if c.proof.counterexample is not None), None)

    @property
    def open(self) -> Float[np.ndarray, "k 2 d"]:
        """Boxes on which the time did not suffice to decide."""
        return np.concatenate([claim.proof.open for claim in self.claims])

    def follow(
        self, count: int = 100, *, stamps: int = 25, seed: int = 0, rtol: float = 1e-10, atol: float = 1e-13
    ) -> Followed:
        """Simulate: `count` random motions in the region, and beside each an estimate from a random place on the border
        of the proved ball, integrated with the tolerances given.

        Raises `ValueError` where nothing is proved, or where motions leave the region too soon to say anything.
        """
        from covariant.certificates import _show

        return _show.follow(self, count, stamps, seed, rtol, atol)

    def document(self) -> dict[str, Any]:
        """The certificate as it is saved.

        Raises `ValueError` where the model has no recipe, and for a statement that was proved wrong.
        """
        if self.recipe is None:
            raise ValueError("a certificate is saved with its model; give certify(..., recipe=models.recipe(spec))")
        if self.summary.verdict == "undecided" and not len(self.open):
            raise ValueError(f"nothing is proved that could be saved: {self.summary.statement}")
        if self.counterexample is not None:
            raise ValueError("the statement is wrong, and a counter-example is printed, not saved; certify another one")
        found = {
            "format": _document.FORMAT,
            "recipe": {"parameters": {}} | self.recipe,
            "observer": _saved.observer_document(self.observer),
            "q": self.q.tolist(),
            "rate": self.rate,
            "radius": self.radius,
            "velocity": self.velocity.tolist(),
            "given": self.given,
            "box": {"low": self.domain.low.tolist(), "high": self.domain.high.tolist()},
            "claims": [claim.document() for claim in self.claims],
            "graph": _saved.value_graph(self.subject),
        }
        return found | {"digest": _document.digest(found)}

    def save(self, path: str | Path) -> Path:
        """Write the certificate with all its boxes (JSON), as data that runs nothing where it is read.

        Raises `ValueError` where the model has no recipe, and for a statement that was proved wrong.
        """
        return _document.write(path, self.document())

    @classmethod
    def load(cls, path: str | Path, *, model: Any = None) -> "ContractionCertificate":
        """A saved certificate with all its boxes; how long the proofs took is not in the file (NaN).

        Checked is that the boxes cover the region and that the statement follows from the claims; that these hold is
        for `covariant certify --check` to say, and until then the certificate is not `verified`. `model`: where the
        recipe names somebody's own model, whoever reads the file gives it: the model, or a function that makes it of
        the recipe's parameters, or the `module:attribute` of either. Raises `ValueError` naming file and key.
        """
        document, observer, about = _check.follows(_document.parse(path), model)
        domain = Box(about.names, about.units, document.low, document.high)
        claims = tuple(_stated(claim, domain) for claim in document.claims)
        given = _plain(document.given)
        summary = _summary(domain, document.velocity, document.rate, document.radius, given, claims)
        return cls(
            summary._replace(
                statement=f"{summary.statement} (read from a file, not verified again)", evidence="claimed"
            ),
            document.rate,
            document.radius,
            observer,
            document.q,
            about,
            domain,
            document.velocity,
            given,
            claims,
            document.recipe,
        )


def _stated(claim: _document.Stated, domain: Box) -> Claim:
    """A claim that was read from a file."""
    levels, left = _saved.from_letters(claim.levels), [np.zeros((0, 2, len(domain.low)))]
    if claim.open:
        left += [np.stack([low, high], axis=1)[codes == OPEN] for codes, low, high in leaves(domain, levels)]
    verdict = "undecided" if claim.open else "holds"
    proof = Proof(verdict, domain, levels, None, np.concatenate(left), sum(map(len, levels)), math.nan)
    return Claim(claim.kind, proof, claim.row, claim.square, claim.limit)


def _plain(given: _document.Given) -> dict[str, Any]:
    """What is given, as it is saved."""

    def pair(bounds: np.ndarray) -> dict[str, list[float]]:
        return {"low": bounds[0].tolist(), "high": bounds[1].tolist()}

    rest = {key: getattr(given, key).tolist() for key in ("times", "noise", "disturbance", "slopes")}
    return {"positions": pair(given.positions), "inputs": pair(given.inputs), **rest}


def certify(
    observer: Intrinsics,
    *,
    velocity: ArrayLike,
    error: ArrayLike,
    position: Bounds | None = None,
    input: Bounds | ArrayLike = 0.0,
    times: tuple[float, float] = (0.0, 0.0),
    rate: float | None = None,
    q: Numbers | None = None,
    noise: ArrayLike = 0.0,
    disturbance: ArrayLike = 0.0,
    recipe: dict[str, Any] | None = None,
    boxes: int = MOST_BOXES,
    seconds: float | None = None,
    processes: int = 1,
    progress: Callable[[str, float, int], None] | None = None,
) -> ContractionCertificate:
    """Prove that an intrinsic observer converges at a rate, from within a radius, on a region.

    - `velocity`: bound of each true velocity [unit/s], a number or (n,). There is no certificate without it: the tube
      of Theorem 1 shrinks as the velocity grows.
    - `error`: how far an estimated position may be off, in coordinates or as `log(g⁻¹ g̃)` [unit], a number or (n,).
    - `position`: least and largest true positions, (n,) each; on a group the entries of its matrices (N, N), for which
      rotations need no bounds.
    - `input`: bound of each input, a number or (m,), or a pair of bounds; `times` [s]: where the force depends on time.
    - `rate`: λ [1/s] to prove, of squared lengths; half of what Q allows at q̂ = q by default.
    - `q` (2, 2): the metric's matrix; by default the best conditioned one for two thirds of the rate of the gains.
    - `noise`: bound of the error of each measured position [unit], a number or (n,), in coordinates or as `log(q⁻¹ y)`
      in the body; bounds of matrix entries that `position` gives on a group are then those of the measured ones.
    - `disturbance`: bound of the force that the model does not know, of each component, a number or (n,).
    - `boxes`: effort for all proofs, the same on every machine; `seconds`: a limit of time besides, counted for each
      proof from when its matrix has been written as a graph.
    - `processes`, `progress` (what, share, boxes): as for `prove`.

    Raises `ValueError` naming an argument without its bound, an error up to which a logarithm is not unique, friction
    or force that are not covered, or a `q` that is not symmetric positive definite; `TypeError` for another kind of
    observer.
    """
    alpha, beta = float(observer.alpha), float(observer.beta)
    for name, gain in (("alpha", alpha), ("beta", beta)):
        if not math.isfinite(gain):
            raise ValueError(f"certify: {name} of the observer must be a finite number; got {gain:g}")
    best = -2 * float(np.linalg.eigvals(error_matrix(alpha, beta)).real.max())
    matrix = optimal_lyapunov(alpha, beta, best * 2 / 3) if q is None else check_q("certify", q)
    wanted = rate_of(alpha, beta, matrix) / 2 if rate is None else float(rate)
    if not (math.isfinite(wanted) and wanted > 0):
        raise ValueError(f"certify: the rate must be a positive number; got {wanted:g}")
    about = subject(observer, matrix)
    n = _dimension(observer)
    bound, off = _positive("velocity", velocity, n), _positive("error", error, n)
    noisy, unknown = _amount("noise", noise, n), _amount("disturbance", disturbance, n)
    if not (noisy < off).all():
        raise ValueError(
            f"certify: noise must be below the error {off.tolist()}, which includes it; got {noisy.tolist()}"
        )
    check_unique(observer, off)
    domain, given = _domain(observer, about, bound, off, position, input, times, noisy, unknown)
    left = boxes

    def run(what: str, matrix) -> Proof:
        nonlocal left

        def tell(share: float, boxes: int) -> None:
            if progress is not None:
                progress(what, share, boxes)

        found = prove(matrix, domain, boxes=left, seconds=seconds, processes=processes, progress=tell)
        left = max(left - found.boxes, 0)
        return found

    claims = [Claim("contraction", run("contraction", contraction(about, wanted)))]
    radius = 0.0
    if claims[0].proof.verdict == "holds":
        limits = limits_of(domain, bound, noisy)
        seen = seen_squares(about, domain)
        for row in range(2 * n):
            square, limit = float(ROOM * seen[row]), float(limits[row])
            proof = run(f"reach {row + 1} of {2 * n}", reach(about, row, square))
            claims.append(Claim("reach", proof, row, square, limit))
        sizes = disturbance_sizes(given)
        if sizes.any():
            square = ROOM * _seen_disturbance(about, domain, sizes)
            claims.append(Claim("disturbance", run("noise", disturbed(about, sizes, square)), 0, square))
        if all(claim.proof.verdict == "holds" for claim in claims):
            # Rounded down: a shorter radius is as true.
            radius = min(limit / math.sqrt(claim.square) for claim, limit in zip(claims[1:], limits, strict=False))
            radius *= 1 - 1e-9
            if not steady_distance(wanted, disturbance_length(given, claims)) < radius:
                radius = 0.0
    return ContractionCertificate(
        _summary(domain, bound, wanted, radius, given, claims),
        wanted,
        radius,
        observer,
        matrix,
        about,
        domain,
        bound,
        given,
        tuple(claims),
        recipe,
        verified=True,
    )


def disturbance_sizes(given: dict[str, Any]) -> Float[np.ndarray, "two_n"]:
    """Largest errors of the measured position, and of the force: unknown, or taken at the wrong place.

    All at once are in the ball of radius √m of these sizes, m of them not being zero.
    """
    noise, unknown, slopes = (np.asarray(given[name], float) for name in ("noise", "disturbance", "slopes"))
    through = (np.reshape(slopes, (len(noise), -1)) * noise).sum(axis=1) * (1 + 1e-12)
    return np.concatenate([noise, unknown + through])


def disturbance_length(given: dict[str, Any], claims: Sequence[Claim]) -> float:
    """D: the largest length of what noise and disturbance add to the flow; 0 where none are given, ∞ if not proved."""
    count = np.count_nonzero(disturbance_sizes(given))
    squares = [claim.square for claim in claims if claim.kind == "disturbance"]
    return math.sqrt(count * squares[0]) * (1 + 1e-12) if squares else math.inf if count else 0.0


def _summary(
    domain: Box, velocity, rate: float, radius: float, given: dict[str, Any], claims: Sequence[Claim]
) -> Certificate:
    verdicts = {claim.proof.verdict for claim in claims}
    verdict = "fails" if "fails" in verdicts else "undecided" if "undecided" in verdicts or not radius else "holds"
    wrong = next((c.proof.counterexample for c in claims if c.proof.counterexample is not None), None)
    if verdict == "holds":
        steady = steady_distance(rate, disturbance_length(given, claims))
        statement = _said(velocity, rate, radius, steady) + _under(given)
    else:
        statement = f"squared lengths shrink at {rate:.4g} 1/s or faster on the region"
        reasons = [claim.proof.reason for claim in claims if claim.proof.reason]
        if verdicts == {"holds"}:
            length = steady_distance(rate, disturbance_length(given, claims))
            reasons = [f"noise and disturbance alone lead {length:.4g} away, out of the tube; make them smaller"]
        statement += f"; {reasons[0]}" if reasons and verdict == "undecided" else ""
    return Certificate(
        statement,
        verdict,
        rate,
        str(domain),
        "proved",
        () if wrong is None else tuple(((wrong[0] + wrong[1]) / 2).tolist()),
    )


def _under(given: dict[str, Any]) -> str:
    """The errors that a statement allows for; nothing where it allows for none."""
    words = {"noise": "measurement errors", "disturbance": "unknown forces"}
    bounds = {word: ", ".join(f"{bound:.4g}" for bound in given[key]) for key, word in words.items() if any(given[key])}
    return f", under {' and '.join(f'{word} up to {b}' for word, b in bounds.items())}" if bounds else ""


def _said(velocity, rate: float, radius: float, steady: float) -> str:
    bounds = ", ".join(f"{v:.4g}" for v in velocity)
    fall = f"at {rate / 2:.4g} 1/s or faster" + (f" to {steady:.4g} or less" if steady else "")
    about = f"estimates within {radius:.4g} of a solution with velocities up to {bounds}"
    return f"{about} stay so, and their distance falls {fall}"


def _dimension(observer: Intrinsics) -> int:
    return len(observer.model.coordinates or observer.model.velocities)


def _positive(name: str, value: ArrayLike, n: int) -> Float[np.ndarray, "n"]:
    given = _amounts(name, value, n)
    if not (np.isfinite(given).all() and (given > 0).all()):
        raise ValueError(
            f"certify: {name} must be a positive, finite bound; got {given.tolist()}. No contraction holds at all "
            "speeds and errors, so there is no certificate without such a bound"
        )
    return given


def _amount(name: str, value: ArrayLike, n: int) -> Float[np.ndarray, "n"]:
    given = _amounts(name, value, n)
    if not (np.isfinite(given).all() and (given >= 0).all()):
        raise ValueError(f"certify: {name} must be a finite bound, zero or more; got {given.tolist()}")
    return given


def _amounts(name: str, value: ArrayLike, n: int) -> Float[np.ndarray, "n"]:
    given = np.broadcast_to(np.asarray(value, float), (n,)) if np.ndim(value) == 0 else np.asarray(value, float)
    if given.shape != (n,):
        raise ValueError(f"certify: {name} needs one number, or {n} of them; got {given.size}")
    return given.copy()


def _domain(
    observer, about: Subject, velocity, error, position, given_input, times, noise, disturbance
) -> tuple[Box, dict[str, Any]]:
    """The box of estimate, error and force, and what the bounds of the force come from."""
    model = observer.model
    n = len(velocity)
    if model.manifold.commuting:
        if position is None:
            raise ValueError(f"certify: position needs bounds of {', '.join(model.coordinates)}")
        low, high = (np.broadcast_to(np.asarray(side, float), (n,)).copy() for side in position)
        true = Box(model.coordinates, model.units, low, high)
        check_box(true)
        measured = true._replace(low=_sum(low, -noise, -1), high=_sum(high, noise, 1)) if noise.any() else true
        low, high = _sum(low, -error, -1), _sum(high, error, 1)
    else:
        low, high = np.zeros(0), np.zeros(0)
        measured = true = check_box(_elements(model, position))
    inputs = _inputs(model, given_input, n)
    first, last = _times(times)
    # Between what acts and what the observer takes to act there may be all of the disturbance.
    force = force_bounds(model, measured, inputs, (first, last))
    if disturbance.any():
        force = np.stack([_sum(force[0], -disturbance, -1), _sum(force[1], disturbance, 1)])
    slopes = force_slopes(model, measured, inputs, (first, last)) if noise.any() else np.zeros((n, n))
    given = {
        "positions": {"low": true.low.tolist(), "high": true.high.tolist()},
        "inputs": {"low": inputs[0].tolist(), "high": inputs[1].tolist()},
        "times": [first, last],
        "noise": noise.tolist(),
        "disturbance": disturbance.tolist(),
        "slopes": slopes.tolist(),
    }

    def box(slack):
        reach = _sum(velocity, slack, 1)
        return Box(
            about.names,
            about.units,
            np.concatenate([low, -reach, -error, force[0]]),
            np.concatenate([high, reach, error, force[1]]),
        )

    # The velocity error that goes with the position error: both ends of the tube in the same place.
    slack = np.zeros(n)
    for _ in range(3):
        roots = np.sqrt(seen_squares(about, box(slack)))
        slack = 1.1 * roots[n:] * ((error - noise) / roots[:n]).min()
    return check_box(box(slack)), given


def _elements(model: MechanicalSystem, position: Bounds | None) -> Box:
    order = model.manifold.origin().shape[0]
    names = tuple(f"g{i + 1}{j + 1}" for i, j in itertools.product(range(order), repeat=2))
    if position is None:
        if model.manifold not in (SO2, SO3):
            raise ValueError("certify: on this group position needs bounds of the entries of its matrices (N, N)")
        position = (-np.ones((order, order)), np.ones((order, order)))
    low, high = (np.broadcast_to(np.asarray(side, float), (order, order)).ravel().copy() for side in position)
    return Box(names, ("",) * len(names), low, high)


def _inputs(model, given, n: int) -> Float[np.ndarray, "2 m"]:
    m = input_count(model, n)
    sides = given if isinstance(given, tuple) else (-np.asarray(given, float), np.asarray(given, float))
    try:
        found = np.stack([np.broadcast_to(np.asarray(side, float), (m,)) for side in sides])
    except ValueError:
        raise ValueError(f"certify: input needs one bound, or {m} of them; got {np.size(sides[0])}") from None
    if not (np.isfinite(found).all() and (found[0] <= found[1]).all()):
        raise ValueError(f"certify: input must have finite bounds; got {found.tolist()}")
    return found


def _times(times: tuple[float, float]) -> tuple[float, float]:
    try:
        first, last = (float(t) for t in times)
    except (TypeError, ValueError):
        raise ValueError(f"certify: times needs two instants; got {times!r}") from None
    if not (math.isfinite(first) and math.isfinite(last) and first <= last):
        raise ValueError(f"certify: times must be finite, the earlier one first; got {first:g} and {last:g}")
    return first, last


def limits_of(domain: Box, velocity, noise) -> Float[np.ndarray, "two_n"]:
    """How far each position error, and each velocity beyond its bound, may go before it leaves the region.

    The measured position may be off by the noise before an estimate is.
    """
    n = len(velocity)
    start = len(domain.low) - 3 * n
    speed, error = slice(start, start + n), slice(start + n, start + 2 * n)
    most = np.minimum(domain.high, -domain.low)
    return np.concatenate([_sum(most[error], -noise, -1), _sum(most[speed], -velocity, -1)])


def _sum(a: np.ndarray, b: np.ndarray, side: int) -> np.ndarray:
    """a + b, rounded up (`side` 1) or down (−1); what rounding loses is known exactly (D. E. Knuth, TAOCP 2, 4.2.2)."""
    total = a + b
    part = total - a
    lost = (a - (total - part)) + (b - part)
    return np.where(side * lost > 0, np.nextafter(total, side * np.inf), total)


def seen_squares(about: Subject, domain: Box, count: int = 2000) -> Float[np.ndarray, "two_n"]:
    """The largest `squares` at random points of the region and its corners."""
    return _seen(lambda z: squares(about, z), domain, count).max(axis=0)


def _seen_disturbance(about: Subject, domain: Box, sizes: np.ndarray, count: int = 2000) -> float:
    """The largest square of what errors in the unit ball add to the flow, at such points."""
    matrices = _seen(disturbed(about, sizes, 0.0).graph(jnp.asarray(domain.low)).entries, domain, count)
    return float(-np.linalg.eigvalsh(matrices).min())


def _seen(function: Callable | Lowered, domain: Box, count: int) -> np.ndarray:
    """A function at random points of a box, every other one a corner."""
    share = np.random.default_rng(0).uniform(size=(count, len(domain.low)))
    share[::2] = np.round(share[::2])
    points = domain.low + share * (domain.high - domain.low)
    return numbers(function if isinstance(function, Lowered) else lower(function, points[0]), points)
