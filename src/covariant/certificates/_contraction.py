"""Contraction of a flow `x' = f(t, x)` in a metric: the generalised Jacobian, and the rate at which lengths decrease.

A metric on states is represented as `M = ΘᵀNΘ`: a coframe Θ(t, x) with its inverse, and the Gram matrix N(t, x) of the
frame. With N = I the condition is (8) of the paper, on the generalised Jacobian; with Θ = I it is (9), on M itself.

Source: Jouffroy & Fossen 2004, equations (4)–(9); Lohmiller & Slotine 1998, On contraction analysis for nonlinear
systems, Automatica 34(6); Theorem 2 of Aghannan & Rouchon 2003.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._linalg import solve, whiten
from covariant._typing import Matrix, Scalar, Vector

Flow = Callable[[Scalar, Vector], Array]
"""The right-hand side of a flow, `(t, x (n,)) -> x' (n,)`."""
StateMatrix = Callable[[Scalar, Vector], Array]
"""A matrix field, `(t, x (n,)) -> (n, n)`."""


class StateMetric(NamedTuple):
    """A metric `M = ΘᵀNΘ` on states x (n,), which may change with time.

    - `coframe`: `(t, x) -> Θ (n, n)`, which gives the components of a variation δx in a moving frame.
    - `frame`: `(t, x) -> Θ⁻¹ (n, n)`; its columns are the vectors of that frame.
    - `gram`: `(t, x) -> N (n, n)`, symmetric positive definite: the inner products of these vectors.
    """

    coframe: StateMatrix
    frame: StateMatrix
    gram: StateMatrix

    def __call__(self, t: Scalar, x: Vector) -> Matrix:
        """The metric M (n, n) in coordinates."""
        theta = self.coframe(t, x)
        return theta.T @ self.gram(t, x) @ theta


def in_coordinates(metric: StateMatrix) -> StateMetric:
    """The `StateMetric` of a metric `(t, x) -> M (n, n)`, in the frame of the coordinates: condition (9)."""

    def identity(t, x):
        return jnp.eye(x.shape[0], dtype=x.dtype)

    return StateMetric(identity, identity, metric)


def in_frame(theta: StateMatrix) -> StateMetric:
    """The metric `M = ΘᵀΘ` of a transformation `δz = Θ(t, x) δx`, (4) and (7), in its own frame: condition (8)."""

    def inverse(t, x):
        value = theta(t, x)
        return solve(value.T @ value, value.T)

    return StateMetric(theta, inverse, lambda t, x: jnp.eye(x.shape[0], dtype=x.dtype))


def generalised_jacobian(flow: Flow, metric: StateMetric, t: Scalar, x: Vector) -> Matrix:
    """`F_Θ = (Θ̇ + Θ ∂f/∂x) Θ⁻¹` (n, n), equation (6): the Jacobian of components in the frame along the flow [1/s]."""
    change = jax.jvp(metric.coframe, (t, x), (jnp.ones_like(t), flow(t, x)))[1]
    frame = metric.frame(t, x)
    moved = jax.vmap(lambda e: jax.jvp(lambda y: flow(t, y), (x,), (e,))[1], in_axes=1, out_axes=1)(frame)
    return change @ frame + metric.coframe(t, x) @ moved


def contraction_matrix(flow: Flow, metric: StateMetric, t: Scalar, x: Vector) -> Matrix:
    """`F_ΘᵀN + Ṅ + N F_Θ` (n, n): the rate of change of squared lengths, in the frame; for both conditions (8) and (9).

    It is negative definite where the flow contracts; `Θᵀ(…)Θ = FᵀM + Ṁ + MF` does not depend on the frame.
    """
    gram, change = jax.jvp(metric.gram, (t, x), (jnp.ones_like(t), flow(t, x)))
    return lengths(gram, change, generalised_jacobian(flow, metric, t, x))


def lengths(gram: Matrix, change: Matrix, jacobian: Matrix) -> Matrix:
    """`FᵀN + Ṅ + NF` from N, Ṅ and F."""
    moved = gram @ jacobian
    return moved + moved.T + change


def contraction_rate(flow: Flow, metric: StateMetric | StateMatrix, t: Scalar, x: Vector) -> Scalar:
    """The largest λ at (t, x) with `FᵀM + Ṁ + MF ≤ −λM` [1/s]: minus the largest generalised eigenvalue.

    Distances between solutions decrease as `e^(−λt/2)` where λ is a lower bound along the geodesics between them.
    """
    metric = metric if isinstance(metric, StateMetric) else in_coordinates(metric)
    return -jnp.linalg.eigvalsh(whiten(metric.gram(t, x), contraction_matrix(flow, metric, t, x)))[-1]


def log_norm(matrix: Matrix, order: float | int = 2) -> Scalar:
    """The logarithmic norm of a Jacobian (n, n) for the vector norm ℓ1, ℓ2 or ℓ∞ [1/s]: `|δx|' ≤ μ |δx|`.

    A quick test: where it is negative on a convex set, the flow contracts in that norm. Source: Desoer & Haneda 1972,
    The measure of a matrix as a tool to analyze computer algorithms, IEEE Trans. Circuit Theory 19(5).

    Raises `ValueError` for an order other than 1, 2 or infinity.
    """
    if order == 2:
        return jnp.linalg.eigvalsh((matrix + matrix.T) / 2)[-1]
    if order not in (1, jnp.inf):
        raise ValueError(f"log_norm: order must be 1, 2 or inf; got {order!r}")
    sizes = jnp.abs(matrix) if order == 1 else jnp.abs(matrix).T
    diagonal = jnp.diagonal(matrix)
    return jnp.max(diagonal + jnp.sum(sizes, axis=0) - jnp.abs(diagonal))


def rates_along(
    flow: Flow, metric: StateMetric | StateMatrix, t: Float[Array, "T"], x: Float[Array, "T n"]
) -> Float[Array, "T"]:
    """`contraction_rate` at each stamp of a trajectory."""
    return jax.vmap(lambda time, state: contraction_rate(flow, metric, time, state))(t, x)
