"""Bounds by branch and bound how strongly the joints of an arm couple through velocities, over all its configurations.

With the Christoffel symbols Γ and bounds V of the speeds, the coupling is the matrix

    N_ij(q) = Σ_k 2V_k |Γ^i_jk(q)| + Σ_l |M(q)⁻¹|_il F_lj,

F diagonal, the viscous friction. Bounded is the norm `‖diag(1/ω) W⁻¹ N W‖₂`, for given weights W and ω, and beside it
the acceleration `|M⁻¹| f` that unknown forces can cause.

On a box, T = M⁻¹C, with C the symbols of the first kind, is bounded without an inverse in intervals: with any R near
M⁻¹, and E = I − RM, `T = RC + E T = RC + E RC + E² T`, so that `|T| ≤ |RC + E RC| + |E|²|T|`. M, its derivatives and
C are expanded about the middle of the box, with second derivatives over all of it, so that only terms of second order
are lost.

Source: Neumaier 1990, Interval Methods for Systems of Equations, section 4.1, for the preconditioned bound.
"""

import time
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from covariant.models import MechanicalSystem
from scalargraph import Lowered, enclose, expand, lower
from scalargraph.errors import InputError
from scalargraph.graph import pairs
from scalargraph.proofs import OPEN, PROVED, Box, Proof, show_conditions
from scalargraph.proofs.checker import halves

ROUND = 1e-12
"""Relative margin, larger than the rounding of the sums here."""
CHUNK = 512
"""Boxes evaluated at once."""
MARGIN = 0.1
"""Margin that is added to a sampled bound before it is proved, as a fraction of it."""
SAMPLES = 4000


class Weights(NamedTuple):
    """What a bound of the coupling is for.

    Attributes:
        speed: bounds V (n,) of the true speeds.
        viscous: viscous friction F (n,).
        omega: ω (n,) [1/s].
        weights: diagonal (n,) of W.
        force: forces f (n,) whose acceleration is bounded.
    """

    speed: Float[np.ndarray, "n"]
    viscous: Float[np.ndarray, "n"]
    omega: Float[np.ndarray, "n"]
    weights: Float[np.ndarray, "n"]
    force: Float[np.ndarray, "n"]

    def coupling(self, t: np.ndarray, inverse: np.ndarray) -> np.ndarray:
        """N (B, n, n) from bounds of |Γ^i_jk| (B, n, n, n) and of |M⁻¹|."""
        return (t @ (2 * self.speed) + inverse * self.viscous) * (1 + ROUND)

    def norm(self, coupling: np.ndarray) -> np.ndarray:
        """Upper bounds (B,) of the norm; for x > 0 the spectral radius of A ≥ 0 is at most max (Ax)_i/x_i."""
        scaled = coupling * self.weights / (self.weights * self.omega)[:, None]
        square = scaled.swapaxes(1, 2) @ scaled
        x = np.ones((*square.shape[:2], 1))
        for _ in range(8):
            x = square @ x
            x = x / (x.max(1, keepdims=True) + 1e-200) + 1e-3
        with np.errstate(all="ignore"):
            return np.sqrt((square @ x / x).max((1, 2))) * (1 + ROUND)

    def acceleration(self, inverse: np.ndarray) -> np.ndarray:
        """Accelerations (B, n) that the forces cause at most."""
        with np.errstate(invalid="ignore"):
            return np.nan_to_num(inverse @ self.force * (1 + ROUND), nan=np.inf)


def first_kind(derivatives: np.ndarray, sign: int = -1) -> np.ndarray:
    """Symbols of the first kind (..., l, j, k) from ∂_m M_ab (..., m, a, b); with the sign 1 a bound from radii."""
    one = np.moveaxis(derivatives, -3, -2)
    return (one + np.swapaxes(one, -1, -2) + sign * derivatives) / 2


class Coupling(NamedTuple):
    """The graphs of a metric and of its derivatives, from which the coupling is bounded on boxes.

    Attributes:
        first: graph of the K entries on and below the diagonal, with their first derivatives by free coordinates.
        second: the same with second derivatives.
        free: indices (f,) of the coordinates that the metric reads.
        domain: box of all n coordinates.
    """

    first: Lowered
    second: Lowered
    free: np.ndarray
    domain: Box

    @classmethod
    def of(cls, model: MechanicalSystem, domain: Box) -> "Coupling":
        """The graphs of a model on a box, with the conditions of the metric shown."""
        n = len(domain.low)
        rows, columns = np.tril_indices(n)
        lowered = lower(lambda q: model.space(q)[rows, columns], jnp.zeros(n), real=True)
        assert lowered.conditions is not None
        reason = show_conditions(lowered.conditions, domain)
        if reason:
            raise InputError(f"the metric of the model is not defined everywhere within the limits: {reason}")
        value = lowered._replace(conditions=None)
        graph = expand(value, range(n), 1)
        nodes = graph.nodes()[1].reshape(n, -1)
        reads = np.array([any(not graph.graph.is_zero(int(i)) for i in row) for row in nodes])
        free = np.flatnonzero(reads)
        return cls(expand(value, free.tolist(), 1), expand(value, free.tolist(), 2), free, domain)

    def at(self, points: Float[np.ndarray, "P n"]) -> tuple[np.ndarray, np.ndarray]:
        """|Γ| (P, n, n, n) and |M⁻¹| (P, n, n) at points, in doubles, for guesses."""
        metric, symbols = self.symbols(points)
        inverse = np.linalg.inv(metric)
        return np.abs(np.einsum("pil,pljk->pijk", inverse, symbols)), np.abs(inverse)

    def symbols(self, points: Float[np.ndarray, "P n"]) -> tuple[np.ndarray, np.ndarray]:
        """M (P, n, n) and the symbols of the first kind (P, n, n, n) at points, the lowered index first."""
        found = enclose(self.first, points, points)
        metric, slopes = self._split((found.low + found.high) / 2, 1)
        return metric, first_kind(self._all(slopes))

    def _split(self, values: np.ndarray, order: int) -> list[np.ndarray]:
        """Entries (B, ·) of an expansion as matrices: M, by coordinate ∂M, and by two coordinates ∂²M."""
        n, f, boxes = len(self.domain.low), len(self.free), len(values)
        rows, columns = np.tril_indices(n)
        k = len(rows)
        full = np.zeros((boxes, values.shape[1] // k, n, n))
        full[:, :, rows, columns] = full[:, :, columns, rows] = values.reshape(boxes, -1, k)
        parts = [full[:, 0], full[:, 1 : 1 + f]]
        if order == 2:
            hessian = np.zeros((boxes, f, f, n, n))
            for number, (i, j) in enumerate(pairs(f), start=1 + f):
                hessian[:, i, j] = hessian[:, j, i] = full[:, number]
            parts.append(hessian)
        return parts

    def _all(self, by_free: np.ndarray) -> np.ndarray:
        """Derivatives by all coordinates, (..., n, n, n), from those by free ones."""
        n = len(self.domain.low)
        result = np.zeros((*by_free.shape[:-3], n, n, n))
        result[..., self.free, :, :] = by_free
        return result

    def sampled(self, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """|Γ| and |M⁻¹| at random configurations."""
        shape = SAMPLES, len(self.domain.low)
        return self.at(np.random.default_rng(seed).uniform(self.domain.low, self.domain.high, shape))

    def climb(self, value: Callable[[np.ndarray, np.ndarray], np.ndarray], seed: int = 0) -> float:
        """The largest value found of a function of |Γ| and |M⁻¹|, by random steps from the best of random points."""
        low, high, rng = self.domain.low, self.domain.high, np.random.default_rng(seed)
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

    def bounds(self, low: np.ndarray, high: np.ndarray, weights: Weights) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Bounds (B,) of the norm and (B, n) of the acceleration on boxes, and the coordinate to halve of each."""
        n, boxes = len(self.domain.low), len(low)
        middle = low / 2 + high / 2
        half = (np.maximum(high - middle, middle - low) * (1 + ROUND))[:, self.free]
        at, on = enclose(self.first, middle, middle), enclose(self.second, low, high)
        (metric, slope), (metric_off, slope_off) = (self._split(x, 1) for x in _ball(at.low, at.high))
        (bend, bend_off) = (self._split(x, 2)[2] for x in _ball(on.low, on.high))
        with np.errstate(all="ignore"):
            r = np.linalg.inv(metric)
            size = np.abs(r)
            identity, h = np.eye(n), half[:, :, None, None]
            # E: its value, linear terms and the rest.
            tilt = r[:, None] @ slope * h
            rest = np.abs(identity - r @ metric) + size @ (metric_off + ROUND * np.abs(metric))
            rest += (size[:, None] @ (slope_off + ROUND * np.abs(slope)) * h).sum(1)
            curved = np.abs(r[:, None, None] @ bend) + size[:, None, None] @ (bend_off + ROUND * np.abs(bend))
            curved *= h[:, :, None] * h[:, None] / 2
            rest += curved.sum((1, 2))
            e = (np.abs(tilt).sum(1) + rest) * (1 + ROUND)
            # RC: likewise. C and the identity are the columns, so that T is all of Γ and M⁻¹.
            c, c_off = self._columns(slope), self._columns(slope_off + ROUND * np.abs(slope), 1)
            turn = self._columns(bend) * h
            turn_off = (self._columns(bend_off + ROUND * np.abs(bend), 1) * h).sum(1)
            g = np.concatenate([r @ c, r], axis=2)
            none = np.zeros((boxes, len(self.free), n, n))
            linear = np.concatenate([r[:, None] @ turn, none], axis=3)
            loose = np.concatenate([size @ (c_off + turn_off), none[:, 0] if len(self.free) else np.zeros_like(r)], 2)
            wander = np.abs(linear).sum(1) + loose
            slant = np.abs(linear - tilt @ g[:, None])
            size_g = np.abs(g)
            b = size_g + slant.sum(1) + loose + rest @ size_g + e @ wander
            b = b * (1 + ROUND) + ROUND * (e @ size_g + np.concatenate([size @ np.abs(c), size], axis=2))
            x = _at_most(e @ e * (1 + ROUND), b)
            shares = slant + np.abs(tilt) @ (e @ size_g + wander)[:, None] + curved.sum(2) @ size_g[:, None]
            parts = [self._norm(each, weights) for each in np.moveaxis(shares, 1, 0)]
            blind = np.moveaxis(np.abs(tilt) * np.sqrt(np.abs(np.einsum("bii->bi", metric)))[:, None, :, None], 1, 0)
            parts = np.stack(parts, 1) if parts else np.zeros((boxes, 0))
            lost = ~np.isfinite(x).all((1, 2))
            if len(self.free):
                parts[lost] = np.stack([each.sum((1, 2)) for each in blind], 1)[lost]
            norm = np.nan_to_num(self._norm(x, weights), nan=np.inf, posinf=np.inf)
        axis = self.free[np.nan_to_num(parts).argmax(1)] if len(self.free) else np.full(boxes, OPEN)
        return norm, weights.acceleration(x[:, :, n * n :]), axis

    def _norm(self, columns: np.ndarray, weights: Weights) -> np.ndarray:
        n = len(self.domain.low)
        symbols, inverse = columns[:, :, : n * n].reshape(-1, n, n, n), columns[:, :, n * n :]
        return weights.norm(weights.coupling(symbols, inverse))

    def _columns(self, by_free: np.ndarray, sign: int = -1) -> np.ndarray:
        """Symbols of the first kind as matrices (..., n, n²)."""
        symbols = first_kind(self._all(by_free), sign)
        return symbols.reshape(*symbols.shape[:-2], symbols.shape[-1] ** 2)


def _ball(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    middle = low / 2 + high / 2
    return middle, np.maximum(high - middle, middle - low) * (1 + ROUND) + 1e-290


def _at_most(k: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Bounds x of every |T| ≤ b + k|T|, infinite where there is none: x > 0 with b + kx ≤ x is one."""
    n, b = k.shape[1], b + 1e-200
    safe = np.asarray(np.isfinite(k).all((1, 2)) & np.isfinite(b).all((1, 2)))
    matrix = np.where(safe[:, None, None], np.eye(n) - k, np.eye(n))
    try:
        x = np.linalg.solve(matrix, b) * (1 + 1e-9)
    except np.linalg.LinAlgError:
        x = np.full_like(b, np.inf)
    good = np.asarray(safe & (x > 0).all((1, 2)) & ((b + k @ x) * (1 + ROUND) <= x).all((1, 2)))
    return np.where(good[:, None, None], x, np.inf)


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


def bound_coupling(
    coupling: Coupling,
    weights: Weights,
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
    sampled = coupling.climb(lambda t, inverse: weights.norm(weights.coupling(t, inverse)))
    target = max((1 + MARGIN) * sampled, enough)
    limit = np.zeros(len(domain.low))
    if weights.force.any():
        limit = weights.acceleration(coupling.sampled()[1]).max(0)
        limit *= (1 + MARGIN) * coupling.climb(lambda _, inverse: (weights.acceleration(inverse) / limit).max(1))
    low, high, levels, evaluated, share = domain.low[None], domain.high[None], [], 0, 0.0
    while len(low):
        parts = [coupling.bounds(low[k : k + CHUNK], high[k : k + CHUNK], weights) for k in range(0, len(low), CHUNK)]
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
