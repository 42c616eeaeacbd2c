"""The metric on the tangent bundle in which an intrinsic observer contracts.

A variation (δq, δv) of a state (q, v) has the components `ξ = δq` and `ζ = δv + Γ(v, δq)`, both tangent vectors at q.
The squared length is `½(a<ξ,ξ> + 2c<ξ,ζ> + b<ζ,ζ>)`, with a matrix `Q = [[a, c], [c, b]]` chosen for the gains.

Source: Aghannan & Rouchon 2003, section IV and equations (6), (11); their dV/dt lacks a factor ½.
"""

import contextlib
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from covariant._typing import MatrixField, Number, Numbers
from covariant.certificates._contraction import StateMetric
from covariant.geometry import as_space

TwoByTwo = Float[np.ndarray, "2 2"]


def error_matrix(alpha: Number, beta: Number) -> TwoByTwo:
    """`A = [[−α, 1], [−β, 0]]`: the law ξ' = ζ − αξ, ζ' = −βξ of a small error in a parallel frame, equation (10)."""
    return np.array([[-alpha, 1.0], [-beta, 0.0]])


def lyapunov(alpha: Number, beta: Number, rate: float = 0.0, weight: float = 1.0) -> TwoByTwo:
    """Q (2, 2) with `AᵀQ + QA + rate Q = −diag(1, weight)`, A being `error_matrix(alpha, beta)`.

    `rate` [1/s] must be below twice the decay rate of the slower pole; with rate 0 and weight 1 it is the metric of the
    paper. Raises `ValueError` for gains that do not converge, or converge no faster than `e^(−rate t/2)`, for a weight
    that is not positive, and where rounding leaves no positive definite matrix.
    """
    _check_finite("lyapunov", alpha=alpha, beta=beta, rate=rate, weight=weight)
    if weight <= 0:
        raise ValueError(f"lyapunov: weight must be a positive number; got {weight:g}")
    return _solutions(alpha, beta, rate, np.array([weight]))[0]


def _solutions(alpha: Number, beta: Number, rate: Number, weights: np.ndarray) -> np.ndarray:
    """The matrices (k, 2, 2) of `lyapunov` for weights (k,)."""
    shifted = error_matrix(alpha, beta) + rate / 2 * np.eye(2)
    if not (np.linalg.eigvals(shifted).real < 0).all():
        slowest = -2 * np.linalg.eigvals(error_matrix(alpha, beta)).real.max()
        raise ValueError(
            f"gains alpha {alpha:g}, beta {beta:g} shrink squared lengths at {slowest:.4g} 1/s at best; "
            f"ask for a rate below that; got {rate:g}"
        )
    operator = np.kron(shifted.T, np.eye(2)) + np.kron(np.eye(2), shifted.T)
    zero = np.zeros_like(weights)
    right = np.stack([np.ones_like(weights), zero, zero, weights], axis=1)
    with contextlib.suppress(np.linalg.LinAlgError):
        q = np.linalg.solve(operator, -right[..., None]).reshape(-1, 2, 2)
        q = (q + q.transpose(0, 2, 1)) / 2
        np.linalg.cholesky(q)
        if np.isfinite(q).all():
            return q
    raise ValueError(
        f"gains alpha {alpha:g}, beta {beta:g} at rate {rate:g} 1/s: rounding leaves no positive definite matrix; "
        "ask for a lower rate, or for gains of less different size"
    )


def rate_of(alpha: Number, beta: Number, q: Numbers) -> float:
    """The largest λ [1/s] with `AᵀQ + QA ≤ −λQ`: the rate of squared lengths at q̂ = q.

    Raises `ValueError` for a gain that is not finite, and where q is not symmetric positive definite.
    """
    _check_finite("rate_of", alpha=alpha, beta=beta)
    q = check_q("rate_of", q)
    a = error_matrix(alpha, beta)
    half = np.linalg.inv(np.linalg.cholesky(q))
    return float(-np.linalg.eigvalsh(half @ (a.T @ q + q @ a) @ half.T)[-1])


def conditioning(beta: Number, q: Numbers) -> float:
    """The condition number of Q, with velocities in units of √β times those of positions, so that it is dimensionless.

    Raises `ValueError` for a beta that is not positive, and where q is not symmetric positive definite.
    """
    if not 0 < beta < math.inf:
        raise ValueError(f"conditioning: beta must be a positive number; got {beta:g}")
    return float(_conditions(beta, check_q("conditioning", q)[None])[0])


def _conditions(beta: Number, q: np.ndarray) -> np.ndarray:
    """`conditioning` of matrices (k, 2, 2)."""
    scale = np.diag([1.0, math.sqrt(beta)])
    return np.linalg.cond(scale @ q @ scale)


def check_q(whose: str, q: Any) -> TwoByTwo:
    """The matrix Q as an array; raises `ValueError` where it is not a symmetric positive definite (2, 2) matrix."""
    try:
        given = np.asarray(q, float)
    except (TypeError, ValueError):
        given = np.zeros(0)
    if given.shape == (2, 2) and np.isfinite(given).all():
        with contextlib.suppress(np.linalg.LinAlgError):
            # The off-diagonal entries may differ by rounding, as after products of matrices.
            if abs(given[0, 1] - given[1, 0]) <= 1e-12 * np.abs(given).max():
                np.linalg.cholesky(given)
                return (given + given.T) / 2
    found = " ".join(str(q).split())
    raise ValueError(f"{whose}: q must be a symmetric positive definite matrix (2, 2) of finite numbers; got {found}")


def _check_finite(whose: str, **given: Number) -> None:
    for name, value in given.items():
        if not math.isfinite(value):
            raise ValueError(f"{whose}: {name} must be a finite number; got {value:g}")


def optimal_lyapunov(alpha: Number, beta: Number, rate: float) -> TwoByTwo:
    """Among the matrices of `lyapunov` for a rate, the one with the smallest condition number.

    Raises `ValueError` as `lyapunov` does.
    """
    alpha, beta = float(alpha), float(beta)
    lyapunov(alpha, beta, rate)
    matrices = _solutions(alpha, beta, rate, np.logspace(-6, 6, 241) / beta)
    return matrices[np.argmin(_conditions(beta, matrices))]


def tangent_metric(metric: MatrixField, q: TwoByTwo) -> StateMetric:
    """The metric on states x = (q, v) (2n,) from a metric on configurations and a matrix Q, in the frame (ξ, ζ)."""
    geometry = as_space(metric)
    lower = np.array([[0.0, 0.0], [1.0, 0.0]])

    def connection(x):
        at, v = jnp.split(x, 2)
        return jax.vmap(lambda e: geometry.connection(at, v, e), out_axes=1)(jnp.eye(at.shape[0], dtype=x.dtype))

    def coframe(t, x, sign=1.0):
        return jnp.eye(x.shape[0], dtype=x.dtype) + sign * jnp.kron(jnp.asarray(lower, x.dtype), connection(x))

    def gram(t, x):
        return jnp.kron(jnp.asarray(q / 2, x.dtype), geometry(jnp.split(x, 2)[0]))

    return StateMetric(coframe, lambda t, x: coframe(t, x, -1.0), gram)
