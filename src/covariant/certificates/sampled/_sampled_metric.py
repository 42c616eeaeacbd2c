"""Searches for the metric of a certificate of the sampled step: R(τ) with both inequalities at many points.

Both are affine in R_0, R_1, …, so that the largest margin over finitely many points is the solution of a semidefinite
programme. Then the worst points of the result are added, and it is solved again. Nothing here is trusted: the result
is proved afterwards.
"""

import copy
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from covariant.certificates.base import (
    Intrinsics,
    Sampling,
    TwoByTwo,
    at_correction,
    at_noisy_correction,
    error_matrix,
    in_frame_along,
    optimal_lyapunov,
)
from covariant.certificates.sampled._sampled_step import sampled_system
from covariant.certificates.theory import minimise
from scalargraph import Lowered, numbers
from scalargraph.proofs import Box

DEGREE = 2
"""Degree of R(τ) in the age."""
POINTS, ADDED, ROUNDS = 160, 24, 6
"""Number of initial points, of points added in each round, and of rounds."""
TRIED = 4096
"""Number of points among which the worst ones are selected."""
SHARE = 0.5
"""Part of the programme's margin that is sufficient at all points tried."""
ACCURACY = 1e-6
"""Tolerance of the solver. A finer one would stall with several hundred matrices; further points are tried anyway."""
LEAST = 1e-3
"""Least eigenvalue of R_0, relative to the largest."""
FASTER, MORE = 0.1, 1.05
"""With noise: part of the rate by which the programme is stricter, and margin on Γ."""
FIRST_SQUARE = 3 * (DEGREE + 1)
"""Index of the first entry of Γ among the unknowns."""


class Found(NamedTuple):
    """A metric found by the search.

    Attributes:
        q: R_0 (2, 2).
        slopes: R_1, … (DEGREE, 2, 2).
        margin: least margin [1/s] at the points tried, relative to the metric of the continuous observer; not positive
            if no such metric was found at this rate.
        squares: with noise, the diagonal of Γ for each number of samples lost before a measurement.
        velocity: with noise, the bound of the velocity error that remains, in lengths of the metric on configurations.
    """

    q: TwoByTwo
    slopes: Float[np.ndarray, "k 2 2"]
    margin: float
    squares: tuple[Float[np.ndarray, "k"], ...] = ()
    velocity: float = np.inf


class _Points(NamedTuple):
    """One inequality at b points, in units in which the continuous observer's metric is half the identity.

    Attributes:
        jacobian: F, or J of the correction (b, 2n, 2n).
        change: ġ (b, n, n); zero for the correction, which does not use it.
        age: ages (b,), as fractions of the oldest.
        corrects: whether the inequality is the one of the correction.
        errors: B of the correction, scaled by the noise (b, 2n, k); no columns for the flow.
    """

    jacobian: np.ndarray
    change: np.ndarray
    age: np.ndarray
    corrects: bool
    errors: np.ndarray

    def joined(self, other: "_Points", places: np.ndarray | slice = slice(None)) -> "_Points":
        """These points together with points of others, at some places."""
        pairs = zip((*self[:3], self.errors), (*other[:3], other.errors), strict=True)
        jacobian, change, age, errors = (np.concatenate([mine, others[places]]) for mine, others in pairs)
        return _Points(jacobian, change, age, self.corrects, errors)


class SampledMetric:
    """The search for one observer.

    Args:
        observer: the observer.
        sampling: when measurements come, and whether the frame is sheared.
        rate: rate λ [1/s] of squared lengths.
        noise: bounds (n,) of the errors of the measured positions. With noise the metric with the best bound of the
            remaining velocity error is chosen, otherwise the one with the largest margin.
    """

    def __init__(self, observer: Intrinsics, sampling: Sampling, rate: float, noise: Float[np.ndarray, "n"]):
        self.sampling, self.rate = sampling._replace(slopes=np.zeros((0, 2, 2))), rate
        self.n = n = len(observer.model.coordinates or observer.model.velocities)
        self.noise, self.joints = noise, np.flatnonzero(noise)
        # With R = 2I, N consists of two blocks g at any age.
        system = sampled_system(observer, 2 * np.eye(2), self.sampling)
        start = jnp.zeros(len(system.names)).at[-1].set(sampling.oldest)

        def together(*blocks):
            return jnp.concatenate([block.ravel() for block in blocks])

        def along(coframe, gram, change, jacobian):
            return together(jacobian, gram[:n, :n], change[:n, :n])

        def corrected(before, after, jacobian, *errors):
            return together(jacobian, before[:n, :n], after[:n, :n], *errors)

        at = at_noisy_correction if len(self.joints) else at_correction
        self.flow, self.step = (form.graph(start) for form in (in_frame_along(system, along), at(system, corrected)))
        alpha, beta = float(observer.alpha), float(observer.beta)
        fastest = -2 * float(np.linalg.eigvals(error_matrix(alpha, beta)).real.max())
        values, vectors = np.linalg.eigh(optimal_lyapunov(alpha, beta, fastest * 2 / 3))
        self.root = vectors * np.sqrt(values) @ vectors.T
        self.wrong: list[tuple[bool, np.ndarray]] = []

    def at_rate(self, rate: float) -> "SampledMetric":
        """Return the same search at another rate."""
        other = copy.copy(self)
        other.rate, other.wrong = rate, []
        return other

    def add(self, wrong: Sequence[tuple[bool, np.ndarray]]) -> None:
        """Add counterexamples of proofs, which the next metric must satisfy."""
        self.wrong += wrong

    def solve(self, domain: Box) -> Found:
        """Search for the metric on a region."""
        rng = np.random.default_rng(0)  # fixed, so that equal regions have equal metrics
        flow, step = self._both(rng, domain, POINTS)
        for corrects, z in self.wrong:
            if corrects:
                step = step.joined(self._step_points(z[None]))
            else:
                flow = flow.joined(self._flow_points(z[None]))
        x, margin = np.zeros(0), -np.inf
        for _ in range(ROUNDS):
            solution = self._solved(flow, step)
            if solution is None and not len(x):
                return Found(self.root @ self.root, np.zeros((DEGREE, 2, 2)), -np.inf)
            if solution is None:
                break  # the solver stalls on some points; what was found on fewer of them remains
            x = solution
            more = self._both(rng, domain, TRIED)
            # With noise the programme has no margin as its cost; instead it is solved for a faster rate.
            noisy, slower = len(self.joints) > 0, 0.0 if not len(self.joints) else FASTER / 2
            least = [np.linalg.eigvalsh(self._form(x, points, slower))[:, 0] for points in more]
            margin = min(float(values.min()) for values in least)
            if (margin > 0) if noisy else (x[-1] <= 0 or margin > SHARE * x[-1]):
                break
            both = zip((flow, step), more, least, strict=True)
            flow, step = (points.joined(others, np.argsort(values)[:ADDED]) for points, others, values in both)
        r = [self.root @ _matrix(x, k) @ self.root / self.sampling.oldest**k for k in range(DEGREE + 1)]
        r = [(each + each.T) / 2 for each in r]
        found = Found(r[0], np.array(r[1:]), margin)
        return self._with_noise(found, x, domain, rng) if len(self.joints) and margin > 0 else found

    def _with_noise(self, found: Found, x: np.ndarray, domain: Box, rng: np.random.Generator) -> Found:
        """The same metric, with Γ computed at points, and the resulting bound of the velocity."""
        ages, squares = self.sampling.ages, []
        for first, last in ages:
            z = random_points(rng, domain, TRIED)
            share = np.round(rng.uniform(size=TRIED) * 4) / 4
            points = self._step_points(np.concatenate([z[:, :-1], (first + share * (last - first))[:, None]], axis=1))
            # By Schur's complement Γ must exceed BᵀN_0B + C(N_h − JᵀN_0J)⁻¹Cᵀ, C = BᵀN_0J.
            gram, after = self._gram(x, points.age), np.kron(_matrix(x, 0), np.eye(self.n))
            cross = np.swapaxes(points.errors, 1, 2) @ after @ points.jacobian
            rest = gram - np.swapaxes(points.jacobian, 1, 2) @ after @ points.jacobian
            needed = np.swapaxes(points.errors, 1, 2) @ after @ points.errors
            # Squared lengths are half of what R gives, since N = ½R ⊗ g.
            needed = (needed + cross @ np.linalg.solve(rest, np.swapaxes(cross, 1, 2))) / 2
            if np.linalg.eigvalsh(rest)[:, 0].min() <= 0:
                return found._replace(margin=-np.inf)
            weights = np.sqrt(np.einsum("bii->bi", needed).max(0))
            largest = np.linalg.eigvalsh(needed / np.outer(weights, weights))[:, -1].max()
            squares.append(MORE * largest * weights**2 * self.noise.max() ** 2)
        # Squared distances r² obey r² ← e^(−λh)r² + G, at the shortest interval.
        steady = max(s.sum() / -np.expm1(-self.rate * h) for s, h in zip(squares, ages[:, 0], strict=True))
        velocity = np.sqrt(steady * 2 * np.linalg.inv(found.q)[1, 1])
        return found._replace(squares=tuple(squares), velocity=float(velocity))

    def _both(self, rng: np.random.Generator, domain: Box, count: int) -> tuple[_Points, _Points]:
        """Both inequalities at random points."""
        return self._flow_points(random_points(rng, domain, count)), self._step_points(self._aged(rng, domain, count))

    def _aged(self, rng: np.random.Generator, domain: Box, count: int) -> np.ndarray:
        """Random points of the domain at ages of a correction."""
        z, ages = random_points(rng, domain, count), self.sampling.ages
        share = rng.uniform(size=count)
        share[::2] = np.round(share[::2])
        low, high = ages[rng.integers(len(ages), size=count)].T
        return np.concatenate([z[:, :-1], (low + share * (high - low))[:, None]], axis=1)

    def _flow_points(self, z: np.ndarray) -> _Points:
        jacobian, metric, change = self._evaluated(self.flow.entries, z)
        inner = np.linalg.cholesky(metric)
        units, small = self._units(inner), np.linalg.inv(inner)
        whitened = small @ change @ np.swapaxes(small, 1, 2)
        none = np.zeros((len(z), 2 * self.n, len(self.joints)))
        return _Points(units @ jacobian @ np.linalg.inv(units), whitened, z[:, -1] / self.sampling.oldest, False, none)

    def _step_points(self, z: np.ndarray) -> _Points:
        jacobian, before, after, *noisy = self._evaluated(self.step.entries, z)
        first, second = (self._units(np.linalg.cholesky(metric)) for metric in (before, after))
        none = np.zeros_like(before)
        # Relative to the largest bound, so that the unknowns are of order one.
        selected = np.diag(self.noise)[:, self.joints] / max(self.noise.max(), 1e-300)
        errors = second @ noisy[0] @ selected if noisy else np.zeros((len(z), 2 * self.n, 0))
        return _Points(second @ jacobian @ np.linalg.inv(first), none, z[:, -1] / self.sampling.oldest, True, errors)

    def _evaluated(self, graph: Lowered, z: np.ndarray) -> list[np.ndarray]:
        n = self.n
        values = np.asarray(numbers(graph, z))
        parts = np.split(values, [k * n * n for k in (4, 5, 6) if k * n * n < values.shape[1]], axis=1)
        shapes = (2 * n, 2 * n), (n, n), (n, n), (2 * n, n)
        return [part.reshape(-1, *shape) for part, shape in zip(parts, shapes, strict=False)]

    def _units(self, inner: np.ndarray) -> np.ndarray:
        """Q^½ ⊗ Lᵀ, for g = LLᵀ: in these units Q ⊗ g is the identity."""
        return _kron(self.root, np.swapaxes(inner, 1, 2))

    def _gram(self, x: np.ndarray, age: np.ndarray) -> np.ndarray:
        """R(τ) ⊗ g at ages (b,), in these units."""
        powers = [_matrix(x, k) * age[:, None, None] ** k for k in range(DEGREE + 1)]
        return _kron(np.sum(powers, axis=0), np.eye(self.n))

    def _form(self, x: np.ndarray, points: _Points, faster: float = 0.0) -> np.ndarray:
        """The matrices of an inequality: twice those of the claims, and for the correction divided by the age.

        `faster` is the part of the rate by which both inequalities must hold more strictly.
        """
        age, oldest, eye = points.age[:, None, None], self.sampling.oldest, np.eye(self.n)
        r = np.stack([_matrix(x, k) for k in range(DEGREE + 1)])
        orders = np.arange(DEGREE + 1)[:, None, None, None]
        gram = self._gram(x, points.age)
        if points.corrects:
            factor, errors = points.jacobian, points.errors
            stricter = (1 - faster * self.rate * age * oldest) * gram
            whole = (stricter - np.swapaxes(factor, 1, 2) @ np.kron(r[0], eye) @ factor) / (age * oldest)
            if not errors.shape[2]:
                return whole
            # Errors are of the order of the age, and so are their squares Γ; in these units both are of order one.
            cross = -np.swapaxes(factor, 1, 2) @ np.kron(r[0], eye) @ errors / (age * oldest) ** 1.5
            corner = np.swapaxes(errors, 1, 2) @ np.kron(r[0], eye) @ errors / (age * oldest) ** 2
            # Γ is constant for all ages after the same number of lost samples, and proportional to the shortest one.
            shortest, longest = self.sampling.interval
            count = np.ceil(age * oldest / longest - 1e-9)
            added = np.diag(x[FIRST_SQUARE:-1]) * count * shortest / (age * oldest) ** 2
            rows = [[whole, cross], [np.swapaxes(cross, 1, 2), added - corner]]
            return np.concatenate([np.concatenate(row, axis=2) for row in rows], axis=1)
        slope = (r[:, None] * orders * age ** np.maximum(orders - 1, 0)).sum(0) / oldest
        product = gram @ points.jacobian
        change = _kron((r[:, None] * age**orders).sum(0), points.change) + _kron(slope, eye)
        return -(product + np.swapaxes(product, 1, 2) + change) - (1 + faster) * self.rate * gram

    def _solved(self, flow: _Points, step: _Points) -> np.ndarray | None:
        """Unknowns of the best metric: the entries of R_0, R_1, … in these units, Γ, then the margin."""
        noisy, d = len(self.joints) > 0, FIRST_SQUARE + len(self.joints) + 1
        forms = []
        for points in (flow, step):
            # The forms are linear in the unknowns, so their values at unit vectors determine them.
            linear = np.stack([self._form(x, points, FASTER if noisy else 0.0) for x in np.eye(d)])
            if not noisy:
                linear[-1] -= np.eye(2 * self.n)
            forms += [lambda x, m=linear[:, i]: np.tensordot(x, m, 1) for i in range(linear.shape[1])]
        if noisy:
            # Choose the metric in which errors add least, among those in which no length is below that of its ζ.
            unit = np.linalg.solve(self.root, np.array([0.0, 1.0]))
            unit /= np.linalg.norm(unit)
            forms += [lambda x: _matrix(x, 0) - np.outer(unit, unit), lambda x: np.diag([x[-1], 1 - x[-1]])]
            cost = np.zeros(d)
            cost[FIRST_SQUARE:-1] = 1.0
            return minimise(cost, forms, ACCURACY)
        # The scale is free: the largest eigenvalue of R_0 is at most that of the continuous observer's metric.
        forms += [lambda x: np.eye(2) - _matrix(x, 0), lambda x: _matrix(x, 0) - LEAST * np.eye(2)]
        return minimise(-np.eye(d)[-1], forms, ACCURACY)


def random_points(rng: np.random.Generator, domain: Box, count: int) -> Float[np.ndarray, "count d"]:
    """Draw points of a box; every second point is a corner."""
    share = rng.uniform(size=(count, len(domain.low)))
    share[::2] = np.round(share[::2])
    return domain.low + share * (domain.high - domain.low)


def _matrix(x: np.ndarray, k: int) -> np.ndarray:
    """R_k from the unknowns."""
    a, b, c = x[3 * k : 3 * k + 3]
    return np.array([[a, b], [b, c]])


def _kron(r: np.ndarray, g: np.ndarray) -> np.ndarray:
    """Kronecker products of stacks of matrices."""
    product = r[..., :, None, :, None] * g[..., None, :, None, :]
    size = r.shape[-1] * g.shape[-1]
    return product.reshape(*product.shape[:-4], size, size)
