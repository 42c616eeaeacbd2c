"""A proved statement about an intrinsic observer: how fast it converges, and from how far.

Three things are proved, each over the whole region. The flow contracts the metric of the tangent bundle at the rate λ,
whatever the measured trajectory. A curve of length ε changes no position error and no velocity by more than the region
allows. The force on the system stays within the bounds taken. It follows as in Theorem 1: along every solution whose
velocity keeps its bound, an estimate that begins within ε of it stays within ε, and the distance falls as `e^(−λt/2)`.

Source: Aghannan & Rouchon 2003, Theorems 1 and 2, and Fig. 2.
"""

import itertools
import json
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float

from covariant._files import write_atomically
from covariant._typing import Numbers
from covariant.certificates import _saved
from covariant.certificates._certificate import Certificate
from covariant.certificates._prove import Box, Proof, check_box, prove
from covariant.certificates._region import Intrinsics, Subject, contraction, force_bounds, reach, squares, subject
from covariant.certificates._tangent import TwoByTwo, check_q, error_matrix, optimal_lyapunov, rate_of
from covariant.lowering import lower, numbers
from covariant.models import GroupSystem, Lagrangian
from covariant.observers import Group

Bounds = tuple[ArrayLike, ArrayLike]
ROOM = 1.05
"""How much more a reach is allowed to be than was seen, so that it can be proved quickly."""


class Claim(NamedTuple):
    """One proved inequality: "contraction", or "reach" of a `row` of (error, velocity) by `square` up to `limit`."""

    kind: Literal["contraction", "reach"]
    proof: Proof
    row: int = 0
    square: float = 0.0
    limit: float = 0.0


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
    - `given`: positions, inputs and times that the bounds of the force come from.
    - `recipe`: where the model comes from, as `models.recipe`; None for a model known to this process only.
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

    @property
    def decay(self) -> float:
        """μ [1/s]: the distance falls as `e^(−μt)`, half the rate."""
        return self.rate / 2

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
        """The certificate as it is saved. Raises `ValueError` where the model has no recipe."""
        if self.recipe is None:
            raise ValueError("a certificate is saved with its model; give certify(..., recipe=models.recipe(spec))")
        domain = self.domain
        claims = [
            {
                "kind": claim.kind,
                **({"row": claim.row, "square": claim.square, "limit": claim.limit} if claim.kind == "reach" else {}),
                "low": domain.low.tolist(),
                "high": domain.high.tolist(),
                "levels": _saved.to_letters(claim.proof.levels),
            }
            for claim in self.claims
        ]
        wrong = self.counterexample
        found = {
            "format": _saved.FORMAT,
            "statement": self.summary.statement,
            "verdict": self.summary.verdict,
            "rate": self.rate,
            "radius": self.radius,
            "model": self.recipe,
            "observer": _saved.observer_document(self.observer),
            "q": self.q.tolist(),
            "variables": list(domain.names),
            "units": list(domain.units),
            "velocity": self.velocity.tolist(),
            "inputs": self.given,
            "claims": claims,
            "counterexample": None if wrong is None else wrong.tolist(),
            "open": self.open[:1000].tolist(),
            "open_count": len(self.open),
        }
        return found | {"digest": _saved.digest(found)}

    def save(self, path: str | Path) -> Path:
        """Write the certificate with all its boxes (JSON). Raises `ValueError` where the model has no recipe."""
        text = json.dumps(self.document(), indent=1, ensure_ascii=False)
        return write_atomically(path, lambda file: file.write(text.encode("utf-8")))

    @classmethod
    def load(cls, path: str | Path) -> "ContractionCertificate":
        """A saved certificate with all its boxes; how long the proofs took is not in the file (NaN).

        Whether it is right is for `covariant certify --check` to say. Raises `ValueError` for a file that was changed,
        or that proves nothing.
        """
        document = json.loads(Path(path).read_text(encoding="utf-8"))
        if not (isinstance(document, dict) and document.get("digest") == _saved.digest(document)):
            raise ValueError(f"{path} is not a certificate as it was saved: its digest does not fit")
        if document["format"] != _saved.FORMAT or document["verdict"] != "holds":
            raise ValueError(f"{path} proves nothing, or not in the format {_saved.FORMAT!r}")
        observer, q = _saved.observer_from(document)
        about = subject(observer, q)
        velocity, claims = np.asarray(document["velocity"], float), []
        for claim in document["claims"]:
            domain = Box(about.names, about.units, *(np.asarray(claim[end], float) for end in ("low", "high")))
            levels, none = _saved.from_letters(claim["levels"]), np.zeros((0, 2, len(about.names)))
            proof = Proof("holds", domain, levels, None, none, sum(map(len, levels)), math.nan)
            claims.append(
                Claim(claim["kind"], proof, *(claim[key] for key in ("row", "square", "limit") if key in claim))
            )
        rate, radius, domain = document["rate"], document["radius"], claims[0].proof.box
        return cls(
            _summary(about, domain, velocity, rate, radius, claims),
            rate,
            radius,
            observer,
            q,
            about,
            domain,
            velocity,
            document["inputs"],
            tuple(claims),
            document["model"],
        )


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
    recipe: dict[str, Any] | None = None,
    seconds: float = 60.0,
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
    - `seconds`: time for all proofs; `processes`, `progress` (what, share, boxes): as for `prove`.

    Raises `ValueError` naming an argument without its bound, or a `q` that is not symmetric positive definite;
    `TypeError` for another kind of observer.
    """
    alpha, beta = float(observer.alpha), float(observer.beta)
    if isinstance(observer, Group) and observer.doubled_alpha:
        alpha *= 2
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
    domain, given = _domain(observer, about, bound, off, position, input, times)
    until = time.monotonic() + seconds

    def run(what: str, matrix) -> Proof:
        def tell(share: float, boxes: int) -> None:
            if progress is not None:
                progress(what, share, boxes)

        left = max(until - time.monotonic(), 0.0)
        return prove(matrix, domain, seconds=left, processes=processes, progress=tell)

    claims = [Claim("contraction", run("contraction", contraction(about, wanted)))]
    radius = 0.0
    if claims[0].proof.verdict == "holds":
        limits = _limits(domain, bound)
        allowed = ROOM * _seen_squares(about, domain)
        for row in range(2 * n):
            square, limit = float(allowed[row]), float(limits[row])
            proof = run(f"reach {row + 1} of {2 * n}", reach(about, row, square))
            claims.append(Claim("reach", proof, row, square, limit))
        if all(claim.proof.verdict == "holds" for claim in claims):
            # Rounded down: a shorter radius is as true.
            radius = min(limit / math.sqrt(claim.square) for claim, limit in zip(claims[1:], limits, strict=True))
            radius *= 1 - 1e-9
    return ContractionCertificate(
        _summary(about, domain, bound, wanted, radius, claims),
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
    )


def _summary(about: Subject, domain: Box, velocity, rate: float, radius: float, claims: Sequence[Claim]) -> Certificate:
    verdicts = {claim.proof.verdict for claim in claims}
    verdict = "fails" if "fails" in verdicts else "undecided" if "undecided" in verdicts else "holds"
    wrong = next((c.proof.counterexample for c in claims if c.proof.counterexample is not None), None)
    bounds = ", ".join(f"{v:.4g}" for v in velocity)
    return Certificate(
        f"estimates within {radius:.4g} of a solution with velocities up to {bounds} stay so, and their distance falls "
        f"at {rate / 2:.4g} 1/s or faster"
        if verdict == "holds"
        else f"squared lengths shrink at {rate:.4g} 1/s or faster on the region",
        verdict,
        rate,
        str(domain),
        "proved",
        () if wrong is None else tuple(((wrong[0] + wrong[1]) / 2).tolist()),
    )


def _dimension(observer: Intrinsics) -> int:
    model = observer.model
    return model.group.dimension if isinstance(model, GroupSystem) else len(model.coordinates)


def _positive(name: str, value: ArrayLike, n: int) -> Float[np.ndarray, "n"]:
    given = np.broadcast_to(np.asarray(value, float), (n,)) if np.ndim(value) == 0 else np.asarray(value, float)
    if given.shape != (n,):
        raise ValueError(f"certify: {name} needs one number, or {n} of them; got {given.size}")
    if not (np.isfinite(given).all() and (given > 0).all()):
        raise ValueError(
            f"certify: {name} must be a positive, finite bound; got {given.tolist()}. No contraction holds at all "
            "speeds and errors, so there is no certificate without such a bound"
        )
    return given.copy()


def _domain(observer, about: Subject, velocity, error, position, given_input, times) -> tuple[Box, dict[str, Any]]:
    """The box of estimate, error and force, and what the bounds of the force come from."""
    model = observer.model
    n = len(velocity)
    if isinstance(model, Lagrangian):
        if position is None:
            raise ValueError(f"certify: position needs bounds of {', '.join(model.coordinates)}")
        low, high = (np.broadcast_to(np.asarray(side, float), (n,)).copy() for side in position)
        for i in model.circles:
            if error[i] >= np.pi:
                raise ValueError(f"certify: the error of {model.coordinates[i]} must be below π; got {error[i]:g}")
        measured = Box(model.coordinates, model.units, low, high)
        low, high = low - error, high + error
    else:
        low, high = np.zeros(0), np.zeros(0)
        measured = _elements(model, position)
    check_box(measured)
    inputs = _inputs(model, given_input, n)
    force = force_bounds(model, measured, inputs, times)
    given = {
        "positions": {"low": measured.low.tolist(), "high": measured.high.tolist()},
        "low": inputs[0].tolist(),
        "high": inputs[1].tolist(),
        "times": [float(t) for t in times],
    }

    def box(slack):
        reach = velocity + slack
        return Box(
            about.names,
            about.units,
            np.concatenate([low, -reach, -error, force[0]]),
            np.concatenate([high, reach, error, force[1]]),
        )

    # The velocity error that goes with the position error: both ends of the tube in the same place.
    slack = np.zeros(n)
    for _ in range(3):
        roots = np.sqrt(_seen_squares(about, box(slack)))
        slack = 1.1 * roots[n:] * (error / roots[:n]).min()
    return check_box(box(slack)), given


def _elements(model: GroupSystem, position: Bounds | None) -> Box:
    order = model.group.order
    names = tuple(f"g{i + 1}{j + 1}" for i, j in itertools.product(range(order), repeat=2))
    if position is None:
        if type(model.group).__name__ not in ("SpecialOrthogonal2", "SpecialOrthogonal3"):
            raise ValueError("certify: on this group position needs bounds of the entries of its matrices (N, N)")
        position = (-np.ones((order, order)), np.ones((order, order)))
    low, high = (np.broadcast_to(np.asarray(side, float), (order, order)).ravel().copy() for side in position)
    return Box(names, ("",) * len(names), low, high)


def _inputs(model, given, n: int) -> Float[np.ndarray, "2 m"]:
    m = n if model.inputs is None else model.inputs
    sides = given if isinstance(given, tuple) else (-np.asarray(given, float), np.asarray(given, float))
    try:
        found = np.stack([np.broadcast_to(np.asarray(side, float), (m,)) for side in sides])
    except ValueError:
        raise ValueError(f"certify: input needs one bound, or {m} of them; got {np.size(sides[0])}") from None
    if not (np.isfinite(found).all() and (found[0] <= found[1]).all()):
        raise ValueError(f"certify: input must have finite bounds; got {found.tolist()}")
    return found


def _limits(domain: Box, velocity) -> Float[np.ndarray, "two_n"]:
    """How far each position error, and each velocity beyond its bound, may go before it leaves the region."""
    n = len(velocity)
    start = len(domain.low) - 3 * n
    speed, error = slice(start, start + n), slice(start + n, start + 2 * n)
    most = np.minimum(domain.high, -domain.low)
    return np.concatenate([most[error], most[speed] - velocity])


def _seen_squares(about: Subject, domain: Box, count: int = 2000) -> Float[np.ndarray, "two_n"]:
    """The largest `squares` at random points of the region and its corners."""
    share = np.random.default_rng(0).uniform(size=(count, len(domain.low)))
    share[::2] = np.round(share[::2])
    points = domain.low + share * (domain.high - domain.low)
    return numbers(lower(lambda z: squares(about, z), points[0]), points).max(axis=0)
