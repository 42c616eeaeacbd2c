"""Bounds distances between states in a metric from above and below, and measures Theorem 2 along solutions.

The upper bound is the length of the straight line in the chart. The lower bound uses a function whose differential has
at most the length one everywhere, so that it changes by no more than the distance. It is a linear function of the
coordinates, and the length of its differential is bounded over a box that no shorter curve leaves.
"""

from typing import Annotated, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._adaptive import solve
from covariant._domains import FINITE, KNOWN, Finite, check_numbers
from covariant._linalg import solve as solve_linear
from covariant._typing import Scalar, Vector
from covariant.certificates.base import Flow, Hypothesis, Statement, StateMetric
from covariant.signals import check_rounding
from scalargraph.errors import InputError

NODES, WEIGHTS = ((np.polynomial.legendre.leggauss(12)[0] + 1) / 2, np.polynomial.legendre.leggauss(12)[1] / 2)
SOLVED = 1e-9
"""Tolerance of the computed solutions, relative to the first distance."""
SAMPLES = 3
"""Points per variable at which the length of a differential is maximised."""
MOST_SAMPLES = 729


@check_numbers
def upper_distance(
    metric: StateMetric, t: Annotated[Scalar, FINITE], x0: Annotated[Vector, FINITE], x1: Annotated[Vector, FINITE]
) -> Annotated[Scalar, KNOWN]:
    """Compute the length of the straight line in coordinates from x0 to x1: an upper bound of the distance.

    Args:
        metric: the metric on states.
        t: time [s].
        x0, x1: states (n,).

    Returns:
        The length, by Gauss–Legendre quadrature.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.certificates.base import in_coordinates
        >>> from covariant.certificates.theory import upper_distance
        >>> metric = in_coordinates(lambda t, x: 4 * jnp.eye(2))
        >>> round(float(upper_distance(metric, jnp.array(0.0), jnp.zeros(2), jnp.array([3.0, 4.0]))), 6)
        10.0
    """
    step = x1 - x0

    def speed(s):
        at = x0 + s * step
        # NaN if N is not positive definite, so that no length results.
        return jnp.linalg.norm(jnp.linalg.cholesky(metric.gram(t, at)).T @ metric.coframe(t, at) @ step)

    # The Gauss–Legendre rule with 12 points is exact up to degree 23; the speed along a short line is smooth.
    return jnp.asarray(WEIGHTS, x0.dtype) @ jax.vmap(speed)(jnp.asarray(NODES, x0.dtype))


@check_numbers
def lower_distance(
    metric: StateMetric, t: Annotated[Scalar, FINITE], x0: Annotated[Vector, FINITE], x1: Annotated[Vector, FINITE]
) -> Annotated[Scalar, KNOWN]:
    """Compute a lower bound of the distance from x0 to x1, which is accurate to second order in their difference.

    The maxima over boxes are taken at corners, faces and midpoints; they are not proved.

    Args:
        metric: the metric on states.
        t: time [s].
        x0, x1: states (n,).

    Returns:
        The bound; 0 if no box is found that contains all shorter curves.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.certificates.base import in_coordinates
        >>> from covariant.certificates.theory import lower_distance
        >>> metric = in_coordinates(lambda t, x: 4 * jnp.eye(2))
        >>> round(float(lower_distance(metric, jnp.array(0.0), jnp.zeros(2), jnp.array([3.0, 4.0]))), 6)
        10.0
    """
    upper = upper_distance(metric, t, x0, x1)
    middle = (x0 + x1) / 2

    def dual(at, covectors):
        """Squared lengths of covectors (k, n)."""
        rows = covectors @ metric.frame(t, at)
        return jnp.sum(rows * solve_linear(metric.gram(t, at), rows.T).T, axis=1)

    unit = jnp.eye(x0.shape[0], dtype=x0.dtype)
    shares = _shares(x0.shape[0])

    def widest(half, covectors):
        # No curve through x0 that is shorter than `upper` leaves the box around x0 with these half widths.
        squares = jax.vmap(lambda share: dual(x0 + share * half, covectors))(jnp.asarray(shares, x0.dtype))
        return jnp.max(squares, axis=0)

    # Half widths 1.5 times those at x0, since the metric changes; `inside` checks that this suffices.
    half = 1.5 * upper * jnp.sqrt(dual(x0, unit))
    inside = jnp.all(upper * jnp.sqrt(widest(half, unit)) <= half)
    theta = metric.coframe(t, middle)
    # The differential of x -> (x1 − x0)ᵀM x, with M at the midpoint: for a constant metric the bound is exact.
    covector = theta.T @ metric.gram(t, middle) @ theta @ (x1 - x0)
    size = jnp.sqrt(widest(half, covector[None])[0])
    # Equal states have the distance 0; the inner `where` keeps the unused quotient finite.
    # |dφ| ≤ size on the box, so that φ(x1) − φ(x0) ≤ size · distance.
    lower = jnp.where(upper > 0, (covector @ (x1 - x0)) / jnp.where(size > 0, size, 1.0), 0.0)
    return jnp.where(inside, jnp.maximum(lower, 0.0), 0.0)


def _shares(n: int) -> np.ndarray:
    """Relative points of a box: a grid of corners, faces and midpoints, or a fixed random part if that is too large."""
    if SAMPLES**n <= MOST_SAMPLES:
        return np.stack(np.meshgrid(*[np.linspace(-1, 1, SAMPLES)] * n, indexing="ij"), -1).reshape(-1, n)
    return np.random.default_rng(0).integers(-1, 2, (MOST_SAMPLES, n)).astype(float)


class Decay(NamedTuple):
    """Distances between pairs of solutions, compared with the bound of Theorem 2 of Aghannan & Rouchon.

    Attributes:
        t: stamps (T,) [s].
        low, high: lower and upper bounds (k, T) of the distance in each pair.
        bound: `e^(−λt/2)` times the first distance (k, T), an upper bound of the distance by Theorem 2.

    Example:
        >>> import numpy as np
        >>> from covariant.certificates.theory import Decay
        >>> t = np.array([0.0, 1.0, 2.0])
        >>> distance, bound = np.exp(-t)[None], np.exp(-t / 2)[None]
        >>> measured = Decay(t, distance, distance, bound)
        >>> measured.holds, round(measured.slowest, 6)
        (True, 2.0)
    """

    t: Float[np.ndarray, "T"]
    low: Float[np.ndarray, "k T"]
    high: Float[np.ndarray, "k T"]
    bound: Float[np.ndarray, "k T"]

    @property
    def statement(self) -> Statement:
        """The statement that each distance stays below its bound.

        Returns:
            It holds if all upper bounds stay below, fails if a lower bound exceeds it, and is undecided otherwise. It
            is
            also undecided if neither bounds nor distances change by more than the tolerance, as nothing was measured.
        """
        # Tolerance of the integration: relative to the bound, and to the first distance if the bound is tiny.
        rounding = 1e-6 * self.bound + SOLVED * self.high[:, :1]
        fails = bool((self.low > self.bound + rounding).any())
        share = (self.low if fails else self.high) / (self.bound + rounding)
        k, i = np.unravel_index(int(share.argmax()), share.shape)
        # Over too short a time even a zero flow would satisfy any rate, within the tolerance.
        changes = np.maximum(*(np.abs(each - each[:, :1]).max(axis=1) for each in (self.bound, self.high)))
        still = not (changes > rounding.max(axis=1)).all()
        margin = float(1 - share[k, i])
        place = f"pair {k + 1}, t = {self.t[i]:.4g} s"
        if still and not fails:
            place = "no stamp: bound and distance change by no more than the tolerance; follow a pair for longer"
        verdict = "fails" if fails else "holds" if share[k, i] <= 1 and not still else "undecided"
        text = "the upper bound of each distance stays below its bound at each stamp"
        premise = Hypothesis(text, "sampled", verdict, margin, place)
        stamps = f"{len(self.t)} stamps from {self.t[0]:.4g} to {self.t[-1]:.4g} s"
        extent = f"{len(self.low)} pairs of solutions at {stamps}"
        rest = Hypothesis("other pairs, and times between the stamps, do likewise", "assumed")
        return Statement("distances fall at least as fast as the rate says", (extent,), (premise, rest), margin, extent)

    @property
    def holds(self) -> bool:
        """Whether every distance stays below its bound."""
        return self.statement.verdict == "holds"

    @property
    def slowest(self) -> float:
        """The least rate λ [1/s] of the upper bounds between the first stamp and the last."""
        return float((2 * np.log(self.high[:, 0] / self.high[:, -1]) / (self.t[-1] - self.t[0])).min())


@check_numbers
def decay(
    flow: Flow,
    metric: StateMetric,
    rate: Finite,
    x0: Annotated[Float[Array, "k n"], FINITE],
    x1: Annotated[Float[Array, "k n"], FINITE],
    t: Annotated[Float[Array, "T"], FINITE],
) -> Decay:
    """Follow pairs of solutions, and measure their distances at the stamps t.

    Source: Aghannan & Rouchon 2003, Theorem 2.

    Args:
        flow: `(t, x) -> x'`, the right-hand side.
        metric: the metric on states.
        rate: rate λ [1/s] of squared lengths, which determines the bound.
        x0, x1: initial states (k, n) of the pairs.
        t: stamps (T,) [s], increasing, at least two.

    Returns:
        Bounds of the distances.

    Raises:
        ValueError: there are no pairs; stamps do not increase, or JAX would round two to one; the states of a pair are
            equal; the metric is not positive definite along a pair; or a solution cannot be followed.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.certificates import decay
        >>> from covariant.certificates.base import in_coordinates
        >>> metric = in_coordinates(lambda t, x: jnp.eye(1))
        >>> pair, t = (jnp.array([[0.0]]), jnp.array([[1.0]])), jnp.linspace(0.0, 1.0, 5)
        >>> measured = decay(lambda t, x: -x, metric, 1.9, *pair, t)
        >>> measured.holds, round(measured.slowest, 3)
        (True, 2.0)
    """
    stamps = np.asarray(t, float)
    if np.ndim(x0) != 2 or np.shape(x0) != np.shape(x1) or not len(x0):
        raise InputError(f"decay needs pairs x0 and x1 (k, n), at least one; got {np.shape(x0)} and {np.shape(x1)}")
    if stamps.ndim != 1 or len(stamps) < 2 or not (np.diff(stamps) > 0).all():
        raise InputError("decay needs at least two stamps t [s], each later than the one before")
    check_rounding(stamps, jnp.asarray(t).dtype)
    low, high, least = (np.asarray(a) for a in _bound_distances(flow, metric, x0, x1, t))
    if (degenerate := (least <= 0).any(axis=1)).any():
        k = int(degenerate.argmax())
        raise InputError(
            f"decay: the metric is not positive definite along pair {k + 1}, so that it measures no distance"
        )
    if not np.isfinite(high).all():
        raise InputError("a solution leaves every bound before the last stamp; there is no distance to measure")
    if not (high[:, 0] > 0).all():
        k = int((~(high[:, 0] > 0)).argmax())
        raise InputError(f"decay: pair {k + 1} has no positive distance at first; its states must differ")
    # Half the rate, since λ is a rate of squared lengths.
    shrink = np.exp(-rate / 2 * (np.asarray(t) - float(t[0])))
    return Decay(np.asarray(t), low, high, high[:, :1] * shrink)


@eqx.filter_jit  # compiled once for any rate, starts and stamps of the same shapes
def _bound_distances(flow: Flow, metric: StateMetric, x0: Array, x1: Array, t: Array) -> tuple[Array, Array, Array]:
    """Lower and upper bounds (k, T) of the distances between the solutions of each pair, and the least eigenvalue of
    the metric's matrix at both."""

    def least_eigenvalue(s, x):
        return jnp.linalg.eigvalsh(metric.gram(s, x))[0]

    def bounds(pair):
        ends = jax.vmap(lambda start: solve(flow, start, t))(pair)
        low = jax.vmap(lambda s, p, q: lower_distance(metric, s, p, q))(t, *ends)
        high = jax.vmap(lambda s, p, q: upper_distance(metric, s, p, q))(t, *ends)
        return low, high, jnp.minimum(*(jax.vmap(least_eigenvalue)(t, end) for end in ends))

    return jax.vmap(bounds, 1)(jnp.stack([x0, x1]))
