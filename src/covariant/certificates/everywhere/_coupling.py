"""Bounds by branch and bound how strongly the joints of an arm couple through velocities, over all its configurations.

With the Christoffel symbols Γ and bounds V of the speeds, the coupling is the matrix

    N_ij(q) = Σ_k 2V_k |Γ^i_jk(q)| + Σ_l |M(q)⁻¹|_il F_lj,

F diagonal, the viscous friction. Bounded is the norm `‖diag(1/ω) W⁻¹ N W‖₂`, for given weights W and ω, and beside it
the acceleration `|M⁻¹| f` that unknown forces f can cause.

On a box, M⁻¹ and the symbols are quadratic polynomials with bounded remainders, computed operation by operation, so
that most of what an inverse widens cancels. N is not negative, so that its norm is bounded by that of bounds of its
entries.
"""

import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from covariant._linalg import solve
from covariant.certificates.base import ANALYTIC, Hypothesis, lowered_christoffel, metric_form
from covariant.certificates.everywhere._document import GlobalDocument
from covariant.geometry import AbstractSpace
from covariant.models import MechanicalSystem
from scalargraph import Lowered, LoweringError, lower, numbers
from scalargraph.errors import InputError
from scalargraph.graph import pairs
from scalargraph.proofs import OPEN, PROVED, Box, Proof, polynomials, show_conditions
from scalargraph.proofs.checker import halves

ROUND = 1e-12
"""Relative margin, larger than the rounding of the sums here."""
CHUNK = 1024
"""Boxes evaluated at once."""
MARGIN = 0.1
"""Margin that is added to a sampled bound before it is proved, as a fraction of it."""
SAMPLES = 4000
AGREES = 1e-8
"""Largest relative deviation between two computations of a connection that counts as rounding."""


class CouplingBound(NamedTuple):
    """A proved bound of the coupling.

    Attributes:
        norm: upper bound of the norm everywhere in the domain; infinite if there is none.
        sampled: the largest norm found at points.
        acceleration: upper bounds (n,) of the accelerations by unknown forces.
        proof: the tree of boxes; "undecided" if the norm has no bound.
    """

    norm: float
    sampled: float
    acceleration: Float[np.ndarray, "n"]
    proof: Proof


def coupling_of(document: GlobalDocument, symbols: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """N (B, n, n) from bounds of |Γ^i_jk| (B, n, n, n) and of |M⁻¹|."""
    return (symbols @ (2 * document.velocity) + inverse * document.viscous) * (1 + ROUND)


class Coupling(NamedTuple):
    """The graph of Γ^i_jk, j ≤ k, and of M⁻¹, row by row, on the box of all configurations, and what is bounded there.

    Attributes:
        entries: the graph.
        free: indices (f,) of the coordinates that it reads.
        domain: the box.
        document: speeds, friction, gains, weights and unknown forces.
    """

    entries: Lowered
    free: np.ndarray
    domain: Box
    document: GlobalDocument

    @classmethod
    def of(cls, model: MechanicalSystem, domain: Box, document: GlobalDocument) -> "Coupling":
        """The graph of a model, with the conditions of its metric shown."""
        n = len(domain.low)
        rows, columns = np.triu_indices(n)

        def raised(metric, slopes):
            first = jnp.moveaxis(lowered_christoffel(slopes), 2, 0)[:, rows, columns]
            # The last coordinates, which move least, are eliminated first.
            right = jnp.concatenate([first, jnp.eye(n)], axis=1)
            return solve(metric[::-1, ::-1], right[::-1])[::-1]

        conditions = lower(model.space, jnp.zeros(n), real=True).conditions
        assert conditions is not None
        if reason := show_conditions(conditions, domain):
            raise InputError(f"the metric of the model is not defined everywhere within the limits: {reason}")
        entries = metric_form(model.space, raised).graph(jnp.zeros(n)).entries
        read = {int(node.value or 0) for node in entries.graph.nodes if node.op == "input"}
        free = [i for i in sorted(read) if domain.high[i] > domain.low[i]]
        return cls(entries, np.array(free, int), domain, document)

    def at(self, points: Float[np.ndarray, "P n"]) -> tuple[np.ndarray, np.ndarray]:
        """N and the acceleration (P, n) by unknown forces at points, in doubles, for guesses."""
        return self._values(np.abs(numbers(self.entries, points)))

    def _values(self, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """N (B, n, n) and the acceleration (B, n) from bounds (B, n, ·) of absolute values."""
        n = len(self.domain.low)
        rows, columns = np.triu_indices(n)
        symbols, half = np.zeros((len(sizes), n, n, n)), len(rows)
        symbols[:, :, rows, columns] = symbols[:, :, columns, rows] = sizes[:, :, :half]
        inverse = sizes[:, :, half:]
        return coupling_of(self.document, symbols, inverse), inverse @ self.document.force * (1 + ROUND)

    def norm(self, coupling: np.ndarray) -> np.ndarray:
        """Upper bounds (B,) of the norm; for x > 0 the spectral radius of A ≥ 0 is at most max (Ax)_i/x_i."""
        scaled = self.document.scaled(coupling)
        square = scaled.swapaxes(1, 2) @ scaled
        x = np.ones((*square.shape[:2], 1))
        for _ in range(8):
            x = square @ x
            x = x / (x.max(1, keepdims=True) + 1e-200) + 1e-3
        return np.sqrt((square @ x / x).max((1, 2))) * (1 + ROUND)

    def sampled(self) -> tuple[np.ndarray, np.ndarray]:
        """N and the acceleration at random configurations."""
        points = np.random.default_rng(0).uniform(*self.domain[2:], (SAMPLES, len(self.domain.low)))
        return self.at(points)

    def inverses(self) -> np.ndarray:
        """M⁻¹ (P, n, n) at these configurations."""
        points = np.random.default_rng(0).uniform(*self.domain[2:], (SAMPLES, len(self.domain.low)))
        return numbers(self.entries, points)[..., -len(self.domain.low) :]

    def climb(self, value: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> float:
        """The largest value found of a function of N and acceleration, by random steps from the best random points."""
        (low, high), rng = self.domain[2:], np.random.default_rng(0)
        points = rng.uniform(low, high, (SAMPLES, len(low)))
        best = value(*self.at(points))
        chosen = np.argsort(best)[-20:]
        points, best = points[chosen], best[chosen]
        for width in np.geomspace(0.2, 1e-3, 60):
            tried = np.clip(points + width * (high - low) * rng.normal(size=points.shape), low, high)
            found = value(*self.at(tried))
            better = found > best
            points[better], best[better] = tried[better], found[better]
        return float(best.max())

    def bounds(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Bounds (B,) of the norm and (B, n) of the acceleration on boxes, and the coordinate to halve of each."""
        found = polynomials(self.entries, low, high, self.free)
        sizes, symbols = np.abs(found.terms), range(len(found.owners))

        def values(entries):
            return self._values(np.moveaxis(entries.reshape(len(self.domain.low), -1, len(low)), 2, 0))

        with np.errstate(all="ignore"):
            coupling, acceleration = values((np.abs(found.centre) + sizes.sum(0) + found.rest) * (1 + ROUND))
            norm = np.nan_to_num(self.norm(coupling), nan=np.inf)
            shares = [*found.shares]
            for size, term in zip(sizes, [*((k,) for k in symbols), *pairs(len(symbols))], strict=True):
                for k in {int(found.owners[symbol]) for symbol in term}:
                    shares[k] = shares[k] + size
            weight = np.array([self.norm(values(each)[0]) for each in shares]).reshape(-1, len(low)).T
        # Where there is no bound, that variable is halved which widens the first number without one.
        weight = np.where(np.isfinite(weight).all(1, keepdims=True), weight, found.blame.T)
        axis = self.free[weight.argmax(1)] if len(self.free) else np.full(len(low), OPEN)
        return norm, np.nan_to_num(acceleration, nan=np.inf), axis


def bound_coupling(
    coupling: Coupling,
    enough: float,
    boxes: int,
    seconds: float | None = None,
    progress: Callable[[float, int], None] | None = None,
) -> CouplingBound:
    """Bound norm and accelerations a little above their largest sampled values, or as low as the effort allows.

    A norm of `enough` is not bounded any lower.

    All boxes of one size are evaluated before they are halved, so that the bounds of the last ones are the answer where
    the effort does not suffice for smaller ones.
    """
    start, domain = time.monotonic(), coupling.domain
    sampled = coupling.climb(lambda n, _: coupling.norm(n))
    target, limit = max((1 + MARGIN) * sampled, enough), coupling.sampled()[1].max(0)
    if limit.any():
        limit = limit + 1e-9 * limit.max()  # so that accelerations that are 0 are below a bound too
        limit = (1 + MARGIN) * coupling.climb(lambda _, push: (push / limit).max(1)) * limit
    low, high, levels, evaluated, share = domain.low[None], domain.high[None], [], 0, 0.0
    while len(low):
        parts = [coupling.bounds(low[k : k + CHUNK], high[k : k + CHUNK]) for k in range(0, len(low), CHUNK)]
        norm, acceleration, axis = (np.concatenate(part) for part in zip(*parts, strict=True))
        evaluated += len(low)
        good = (norm <= target) & (acceleration <= limit).all(1)
        share += float(good.sum()) * 0.5 ** len(levels)
        if progress is not None:
            progress(share, evaluated)
        following, spent = 2 * int((~good).sum()), time.monotonic() - start
        late = seconds is not None and spent * (1 + following / evaluated) > seconds
        if following and (evaluated + following > boxes or late or not len(coupling.free)):
            known = np.isfinite(norm) & np.isfinite(acceleration).all(1)
            target = max(target, float(norm.max()))
            limit = np.maximum(limit, acceleration.max(0))
            levels.append(np.where(known, PROVED, OPEN))
            break
        levels.append(np.where(good, PROVED, axis))
        low, high = halves(low[~good], high[~good], axis[~good])
    proof = Proof.stated(domain, levels)._replace(boxes=evaluated, seconds=time.monotonic() - start)
    return CouplingBound(target, sampled, limit, proof)


def compare_connections(space: AbstractSpace, domain: Box, places: int) -> Hypothesis:
    """Compare the connection of the space, used by the observer, with that of the metric, used in the bounds."""
    # The space declares its connection or derives it from the metric by JAX; the bounds use the graph of the metric.
    n = len(domain.low)
    identity = jnp.eye(n)

    def declared(q):
        """Compute `g Γ(e_i, e_j)` and `g g⁻¹` with the operations of the space."""
        pairs = jnp.stack([jnp.stack([space.connection(q, a, b) for b in identity]) for a in identity])
        raised = jnp.stack([space.raise_(q, a) for a in identity])
        return jnp.concatenate([(pairs @ space(q)).ravel(), (raised @ space(q)).ravel()])

    def derived(_, slopes):
        return jnp.concatenate([lowered_christoffel(slopes).ravel(), identity.ravel()])

    points = np.random.default_rng(0).uniform(domain.low, domain.high, (places, n))
    expected = metric_form(space, derived).at(points)
    try:
        lowered = lower(declared, jnp.zeros(n))
        computed = np.asarray(numbers(lowered, points))
        analytic = {node.op for node in lowered.graph.nodes} <= ANALYTIC
    except LoweringError:
        computed, analytic = np.asarray(jax.lax.map(declared, jnp.asarray(points))), False
    off = np.abs(computed - expected).max(axis=1) / np.maximum(np.abs(expected).max(axis=1), 1.0)
    text = f"the connection of the model's space is that of its metric, as at {len(points)} random positions"
    if not (off <= AGREES).all():
        place = ", ".join(f"{x:.4g}" for x in points[int(np.where(np.isnan(off), np.inf, off).argmax())])
        return Hypothesis(text, "sampled", "undecided", place=f"({place}), where the two differ")
    # Analytic functions that agree near one point agree everywhere; others may differ at positions that were not drawn.
    return Hypothesis(text, "assumed" if analytic else "sampled")
