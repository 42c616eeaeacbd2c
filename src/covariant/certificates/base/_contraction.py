"""Computes how fast a flow `x' = f(t, x)` contracts in a metric, from its generalised Jacobian.

A metric on states is represented as `M = ΘᵀNΘ`: a coframe Θ(t, x) with its inverse, and the Gram matrix N(t, x) of the
frame. With N = I, contraction is condition (8) of Jouffroy & Fossen, on the generalised Jacobian; with Θ = I it is
their condition (9), on M itself.

Source: Jouffroy & Fossen 2004, equations (4)–(9); Lohmiller & Slotine 1998, On contraction analysis for nonlinear
systems, Automatica 34(6); Theorem 2 of Aghannan & Rouchon 2003.
"""

from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from covariant._domains import FINITE, KNOWN, check_numbers
from covariant._linalg import whiten
from covariant._typing import Matrix, Scalar, Vector
from scalargraph import along, jacobian

Flow = Callable[[Scalar, Vector], Array]
"""The right-hand side of a flow, `(t, x (n,)) -> x' (n,)`."""
StateMatrix = Callable[[Scalar, Vector], Array]
"""A matrix field, `(t, x (n,)) -> (n, n)`."""


class StateMetric(NamedTuple):
    """A metric `M = ΘᵀNΘ` on states x (n,), which may change with time.

    Attributes:
        coframe: `(t, x) -> Θ (n, n)`, which maps a variation δx to its components in a moving frame.
        frame: `(t, x) -> Θ⁻¹ (n, n)`; its columns are the vectors of that frame.
        gram: `(t, x) -> N (n, n)`, symmetric positive definite: the inner products of these vectors.
        lift: the metric on configurations of which this one is the lift by `tangent_metric`; None (default) otherwise.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.certificates.base import StateMetric
        >>> theta = jnp.diag(jnp.array([1.0, 2.0]))
        >>> metric = StateMetric(lambda t, x: theta, lambda t, x: jnp.linalg.inv(theta), lambda t, x: jnp.eye(2))
        >>> metric(jnp.array(0.0), jnp.zeros(2)).tolist()
        [[1.0, 0.0], [0.0, 4.0]]
    """

    coframe: StateMatrix
    frame: StateMatrix
    gram: StateMatrix
    lift: Any = None

    def __call__(self, t: Scalar, x: Vector) -> Matrix:
        """Evaluate the metric M (n, n) in coordinates.

        Args:
            t: time [s].
            x: state (n,).
        """
        theta = self.coframe(t, x)
        return theta.T @ self.gram(t, x) @ theta


def in_coordinates(metric: StateMatrix) -> StateMetric:
    """Build a `StateMetric` in the frame of the coordinates, for condition (9).

    Args:
        metric: `(t, x) -> M (n, n)`, symmetric positive definite.

    Returns:
        The metric with Θ = I and N = M.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.certificates.base import in_coordinates
        >>> metric = in_coordinates(lambda t, x: 2 * jnp.eye(2))
        >>> metric.gram(0.0, jnp.zeros(2)).tolist()
        [[2.0, 0.0], [0.0, 2.0]]
    """

    def identity(t, x):
        return jnp.eye(x.shape[0], dtype=x.dtype)

    return StateMetric(identity, identity, metric)


def generalised_jacobian(flow: Flow, metric: StateMetric, t: Scalar, x: Vector) -> Matrix:
    """Compute the generalised Jacobian `F_Θ = (Θ̇ + Θ ∂f/∂x) Θ⁻¹`, equation (6).

    Args:
        flow: `(t, x) -> x'`, the right-hand side f.
        metric: the metric, whose frame is used.
        t: time [s].
        x: state (n,).

    Returns:
        F_Θ (n, n) [1/s]; along the flow, the components `δz = Θ δx` of a variation change as `δz' = F_Θ δz`.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.certificates.base import StateMetric, generalised_jacobian
        >>> theta = jnp.diag(jnp.array([1.0, 2.0]))
        >>> metric = StateMetric(lambda t, x: theta, lambda t, x: jnp.linalg.inv(theta), lambda t, x: jnp.eye(2))
        >>> flow = lambda t, x: jnp.stack([x[1] - x[0], -x[1]])
        >>> generalised_jacobian(flow, metric, jnp.array(0.0), jnp.zeros(2)).tolist()
        [[-1.0, 0.5], [0.0, -1.0]]
    """
    # Θ̇ is the total derivative along the flow: ∂Θ/∂t + (∂Θ/∂x) f.
    coframe, change = along(metric.coframe, (t, x), (jnp.ones_like(t), flow(t, x)))
    return (change + coframe @ jacobian(lambda y: flow(t, y), x)) @ metric.frame(t, x)


def contraction_matrix(flow: Flow, metric: StateMetric, t: Scalar, x: Vector) -> Matrix:
    """Compute `F_ΘᵀN + Ṅ + N F_Θ`, the rate of change of squared lengths in the frame, for conditions (8) and (9).

    It is negative definite where the flow contracts; `Θᵀ(…)Θ = FᵀM + Ṁ + MF` does not depend on the frame.

    Args:
        flow: `(t, x) -> x'`, the right-hand side f.
        metric: the metric.
        t: time [s].
        x: state (n,).

    Returns:
        A symmetric matrix (n, n), N [1/s].

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.certificates.base import contraction_matrix, in_coordinates
        >>> metric = in_coordinates(lambda t, x: jnp.eye(2))
        >>> contraction_matrix(lambda t, x: -3 * x, metric, jnp.array(0.0), jnp.zeros(2)).tolist()
        [[-6.0, 0.0], [0.0, -6.0]]
    """
    gram, change = along(metric.gram, (t, x), (jnp.ones_like(t), flow(t, x)))
    return lengths(gram, change, generalised_jacobian(flow, metric, t, x))


def lengths(gram: Matrix, change: Matrix, jacobian: Matrix) -> Matrix:
    """Compute `FᵀN + Ṅ + NF`, the rate of change of squared lengths."""
    product = gram @ jacobian
    return product + product.T + change


@check_numbers
def contraction_rate(
    flow: Flow,
    metric: StateMetric | StateMatrix,
    t: Annotated[Scalar, FINITE],
    x: Annotated[Vector, FINITE],
) -> Annotated[Scalar, KNOWN]:
    """Compute the largest λ at (t, x) with `FᵀM + Ṁ + MF ≤ −λM`.

    Distances between solutions decrease at least as `e^(−λt/2)` if λ is a lower bound of the rate along the geodesics
    between them.

    Args:
        flow: `(t, x) -> x'`, the right-hand side f.
        metric: a `StateMetric`, or a function `(t, x) -> M (n, n)`.
        t: time [s].
        x: state (n,).

    Returns:
        λ [1/s], the rate of squared lengths: the largest eigenvalue of the left side relative to M, with opposite sign;
        it is negative if some length grows.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.certificates import contraction_rate
        >>> flow = lambda t, x: -2 * x - x**3
        >>> float(contraction_rate(flow, lambda t, x: jnp.eye(1), jnp.array(0.0), jnp.array([1.0])))
        10.0
    """
    metric = metric if isinstance(metric, StateMetric) else in_coordinates(metric)
    # Whitening by N makes the generalised eigenvalues ordinary ones; eigvalsh sorts them in rising order.
    return -jnp.linalg.eigvalsh(whiten(metric.gram(t, x), contraction_matrix(flow, metric, t, x)))[-1]
