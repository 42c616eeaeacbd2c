"""Search for the metric of a certificate of the sampled step: R(τ) for which both inequalities hold at many points.

Both are affine in R_0, R_1, …, so that the largest margin over finitely many points is the solution of a semidefinite
programme. Points at which the result is worst are added, and it is solved again. Nothing here is trusted: what is found
is proved afterwards, or not.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from covariant.certificates._document import Kind, Sampling
from covariant.certificates._inequalities import at_correction, in_frame_along
from covariant.certificates._intrinsic import Intrinsics
from covariant.certificates._lmi import minimise
from covariant.certificates._sampled_step import sampled_system
from covariant.certificates._tangent_metric import TwoByTwo, error_matrix, optimal_lyapunov
from covariant.lowering import Lowered, numbers
from covariant.proofs import Box

DEGREE = 2
"""Degree of R(τ) in the age."""
POINTS, ADDED, ROUNDS = 160, 24, 6
"""Number of points at first, of those added in each round, and of rounds."""
TRIED = 4096
"""Number of points among which the worst ones are looked for."""
SHARE = 0.5
"""Part of the margin at the points of the programme that is enough at all points tried."""
LEAST = 1e-3
"""Least eigenvalue of R_0, where the largest is 1."""


class Found(NamedTuple):
    """A metric that was found.

    Attributes:
        q: R_0 (2, 2).
        slopes: R_1, … (DEGREE, 2, 2).
        margin: least margin [1/s] at the points tried, relative to the metric of the continuous observer; not positive
            where no such metric was found at this rate.
    """

    q: TwoByTwo
    slopes: Float[np.ndarray, "k 2 2"]
    margin: float


class _Points(NamedTuple):
    """One inequality at b points, in units in which the continuous observer's metric is half the identity.

    Attributes:
        jacobian: F, or J of the correction (b, 2n, 2n).
        change: ġ (b, n, n); zero for the correction, which does not use it.
        age: ages (b,), as fractions of the oldest.
        corrects: whether the inequality is that of the correction.
    """

    jacobian: np.ndarray
    change: np.ndarray
    age: np.ndarray
    corrects: bool

    def joined(self, other: "_Points", places: np.ndarray | slice = slice(None)) -> "_Points":
        """These points, and those at some places of others."""
        pairs = zip(self[:3], other[:3], strict=True)
        jacobian, change, age = (np.concatenate([mine, others[places]]) for mine, others in pairs)
        return _Points(jacobian, change, age, self.corrects)


class SampledMetric:
    """The search for one observer.

    Args:
        observer: the observer.
        sampling: when measurements come, and whether the frame is sheared.
        rate: rate λ [1/s] of squared lengths.
    """

    def __init__(self, observer: Intrinsics, sampling: Sampling, rate: float):
        self.sampling, self.rate = sampling._replace(slopes=np.zeros((0, 2, 2))), rate
        self.n = n = len(observer.model.coordinates or observer.model.velocities)
        # With R = 2I, N consists of two blocks g, whatever the age.
        system = sampled_system(observer, 2 * np.eye(2), self.sampling)
        start = jnp.zeros(len(system.names)).at[-1].set(sampling.oldest)

        def together(*blocks):
            return jnp.concatenate([block.ravel() for block in blocks])

        self.flow = in_frame_along(
            system,
            lambda coframe, gram, change, jacobian: together(jacobian, gram[:n, :n], change[:n, :n]),
            lambda z: z,
        ).graph(start)
        self.step = at_correction(
            system, lambda before, after, jacobian: together(jacobian, before[:n, :n], after[:n, :n])
        ).graph(start)
        alpha, beta = float(observer.alpha), float(observer.beta)
        fastest = -2 * float(np.linalg.eigvals(error_matrix(alpha, beta)).real.max())
        values, vectors = np.linalg.eigh(optimal_lyapunov(alpha, beta, fastest * 2 / 3))
        self.root = vectors * np.sqrt(values) @ vectors.T
        self.wrong: list[tuple[Kind, np.ndarray]] = []

    def add(self, wrong: Sequence[tuple[Kind, np.ndarray]]) -> None:
        """Add counter-examples of proofs, which the next metric has to satisfy.

        Args:
            wrong: kind of the claim, and the point (d,).
        """
        self.wrong += wrong

    def solve(self, domain: Box) -> Found:
        """Search for the metric on a region.

        Args:
            domain: the box of the variables of `sampled_system`.

        Raises:
            ImportError: the solver clarabel is missing.
        """
        rng = np.random.default_rng(0)  # fixed, so that equal regions have equal metrics
        flow, step = self._both(rng, domain, POINTS)
        for kind, z in self.wrong:
            if kind == "contraction":
                flow = flow.joined(self._flow_points(z[None]))
            else:
                step = step.joined(self._step_points(z[None]))
        x, margin = np.zeros(0), -np.inf
        for _ in range(ROUNDS):
            solution = self._solved(flow, step)
            if solution is None:
                return Found(self.root @ self.root, np.zeros((DEGREE, 2, 2)), -np.inf)
            x = solution
            more = (
                self._flow_points(random_points(rng, domain, TRIED)),
                self._step_points(self._aged(rng, domain, TRIED)),
            )
            least = [np.linalg.eigvalsh(self._form(x, points))[:, 0] for points in more]
            margin = min(float(values.min()) for values in least)
            if x[-1] <= 0 or margin > SHARE * x[-1]:
                break
            flow, step = (
                points.joined(others, np.argsort(values)[:ADDED])
                for points, others, values in zip((flow, step), more, least, strict=True)
            )
        r = [self.root @ _matrix(x, k) @ self.root / self.sampling.oldest**k for k in range(DEGREE + 1)]
        r = [(each + each.T) / 2 for each in r]
        return Found(r[0], np.array(r[1:]), margin)

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
        return _Points(units @ jacobian @ np.linalg.inv(units), whitened, z[:, -1] / self.sampling.oldest, False)

    def _step_points(self, z: np.ndarray) -> _Points:
        jacobian, before, after = self._evaluated(self.step.entries, z)
        first, second = (self._units(np.linalg.cholesky(metric)) for metric in (before, after))
        none = np.zeros_like(before)
        return _Points(second @ jacobian @ np.linalg.inv(first), none, z[:, -1] / self.sampling.oldest, True)

    def _evaluated(self, graph: Lowered, z: np.ndarray) -> list[np.ndarray]:
        n = self.n
        parts = np.split(np.asarray(numbers(graph, z)), [4 * n * n, 5 * n * n], axis=1)
        return [part.reshape(-1, size, size) for part, size in zip(parts, (2 * n, n, n), strict=True)]

    def _units(self, inner: np.ndarray) -> np.ndarray:
        """Q^½ ⊗ Lᵀ, for g = LLᵀ: in these units Q ⊗ g is the identity."""
        return _kron(self.root, np.swapaxes(inner, 1, 2))

    def _form(self, x: np.ndarray, points: _Points) -> np.ndarray:
        """The matrices of an inequality, twice those of the claims and for the correction divided by the age."""
        age, oldest, eye = points.age[:, None, None], self.sampling.oldest, np.eye(self.n)
        r = np.stack([_matrix(x, k) for k in range(DEGREE + 1)])
        orders = np.arange(DEGREE + 1)[:, None, None, None]
        gram = _kron((r[:, None] * age**orders).sum(0), eye)
        if points.corrects:
            factor = points.jacobian
            return (gram - np.swapaxes(factor, 1, 2) @ np.kron(r[0], eye) @ factor) / (age * oldest)
        slope = (r[:, None] * orders * age ** np.maximum(orders - 1, 0)).sum(0) / oldest
        product = gram @ points.jacobian
        change = _kron((r[:, None] * age**orders).sum(0), points.change) + _kron(slope, eye)
        return -(product + np.swapaxes(product, 1, 2) + change) - self.rate * gram

    def _solved(self, flow: _Points, step: _Points) -> np.ndarray | None:
        """Unknowns of the largest margin: the entries of R_0, R_1, … in units, then the margin."""
        d = 3 * (DEGREE + 1) + 1
        # Affine in the unknowns, without a constant: the matrices of unit vectors say all.
        linear = np.stack(
            [
                np.concatenate([self._form(x, points) - x[-1] * np.eye(2 * self.n) for points in (flow, step)])
                for x in np.eye(d)
            ]
        )
        forms = [lambda x, i=i: np.tensordot(x, linear[:, i], 1) for i in range(linear.shape[1])]
        # The scale is free: the largest eigenvalue of R_0 is at most that of the continuous observer's metric.
        forms += [lambda x: np.eye(2) - _matrix(x, 0), lambda x: _matrix(x, 0) - LEAST * np.eye(2)]
        return minimise(-np.eye(d)[-1], forms)


def random_points(rng: np.random.Generator, domain: Box, count: int) -> Float[np.ndarray, "count d"]:
    """Draw points of a box, every second one a corner.

    Args:
        rng: the source of random numbers.
        domain: the box.
        count: number of points.
    """
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
