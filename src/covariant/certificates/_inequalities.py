"""The inequalities to be proved of a subject: symmetric matrices that must be positive definite on its region."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._linalg import solve
from covariant._typing import Vector
from covariant.certificates._contraction import contraction_matrix, lengths
from covariant.certificates._subject import Subject, values
from covariant.proofs import Form, as_form, derivative_form


def contraction(subject: Subject, rate: float) -> Form:
    """`z -> −(F_ΘᵀN + Ṅ + N F_Θ) − rate N`: positive definite where squared lengths decrease at the rate [1/s]."""

    def numbers(z):
        point, t = subject.at(z), jnp.zeros((), z.dtype)
        return -contraction_matrix(point.flow, point.metric, t, point.x) - rate * point.metric.gram(t, point.x)

    return length_change(subject, lambda coframe, gram, change: -change - rate * gram, numbers)


def length_change(subject: Subject, formula: Callable[[Array, Array, Array], Array], numbers: Callable) -> Form:
    """A formula of Θ, of N, and of `F_ΘᵀN + Ṅ + N F_Θ`, the rate of squared lengths, in the form that proofs need."""

    def parts(derivatives, nodes, count):
        flow, coframe, frame, gram, *_ = nodes
        state = range(1, count + 1)
        along = {0: derivatives.graph.constant(1.0), **dict(zip(state, flow.tolist(), strict=True))}
        return (
            coframe,
            frame,
            gram,
            derivatives.each(flow, state, frame),
            derivatives.along(coframe, along),
            derivatives.along(gram, along),
        )

    def whole(coframe, frame, gram, moved, turn, change):
        return formula(coframe, gram, lengths(gram, change, turn @ frame + coframe @ moved))

    return derivative_form(values(subject), lambda z: subject.at(z).x, parts, whole, numbers)


def width_bound(subject: Subject, row: int, square: float) -> Form:
    """`z -> square N − r rᵀ`, with r the given row of the Jacobian of (error, velocity).

    It is positive definite where a curve of length ℓ changes that entry of (error, velocity) by less than `ℓ √square`.
    """

    def matrix(z):
        point, t = subject.at(z), jnp.zeros((), z.dtype)
        r = point.error_jacobian()[row]
        return square * point.metric.gram(t, point.x) - jnp.outer(r, r)

    return as_form(matrix)


def squared_widths(subject: Subject, z: Vector) -> Float[Array, "two_n"]:
    """The least `square` of each row for which `width_bound` is positive semidefinite at z."""
    point = subject.at(z)
    gram, rows = point.metric.gram(jnp.zeros((), z.dtype), point.x), point.error_jacobian()
    return jnp.sum(rows * solve(gram, rows.T).T, axis=1)


def disturbance_bound(subject: Subject, sizes: Float[np.ndarray, "two_n"], square: float) -> Form:
    """`z -> square I − BᵀMB`, with B the Jacobian of the flow in errors of measurement and force, scaled by `sizes`.

    It is positive definite where errors `δ = sizes w` with |w| ≤ 1 (in the Euclidean norm) change the flow by a vector
    shorter than `√square`. The first n sizes are those of the measured position, the others those of the force.
    """
    n = len(sizes) // 2

    def parts(derivatives, nodes, count):
        last = 1 + count + len(subject.names)
        flow, coframe, _, gram, _, noise = nodes
        return coframe, gram, noise, derivatives.each(flow, range(last - 2 * n, last))

    def formula(coframe, gram, noise, change):
        moved = jnp.concatenate([change[:, :n] @ noise, change[:, n:]], axis=1) * jnp.asarray(sizes)[None]
        return square * jnp.eye(2 * n) - (coframe @ moved).T @ gram @ (coframe @ moved)

    def numbers(z):
        point, t = subject.at(z), jnp.zeros((), z.dtype)
        change = jax.jacfwd(lambda z: subject.at(z).flow(t, point.x))(z)[:, -2 * n :]
        return formula(point.metric.coframe(t, point.x), point.metric.gram(t, point.x), point.noise_jacobian(), change)

    return derivative_form(values(subject), lambda z: subject.at(z).x, parts, formula, numbers)
