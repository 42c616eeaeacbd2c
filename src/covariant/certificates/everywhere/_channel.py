"""The linear channel of one coordinate of `MeasuredCoefficients` from sample to sample, and its gain.

After a sample let x = (ωe, ζ), ω = √β. During the time τ to the next sample the acceleration is off by a constant d, of
which the prediction makes e + τζ + τ²d/2 and ζ + τd, and the sample takes the fractions k₁ and k₂ of e from e and ζ:

    x⁺ = A x + b d/ω + (k₁, k₂/ω) ω n,   A, b functions of ωτ,

with n the error of the measurement. The matrix P > 0 proves the gain γ at the rate μ, if for every τ that occurs

    (Ax + bδ)ᵀP(Ax + bδ) ≤ e^(−2μτ) xᵀPx + τ(γ²δ² − ζ²)   for all x and δ,

the bounded real lemma in discrete time; the factor τ, the same for all coordinates, makes long and short times alike.
As τ → 0, γ² tends to 2/((r − 1)(3 − r)), r = √(1 + 2α²/β), which is least, 2, at a damping of .612. Encoder noise at
equal proof is least near .693, γ = 1.443.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant.observers.base import sampled_gains

DAMPING = math.sqrt(1.92)
"""α/√β of gains that are chosen here, at which noise is least for equal proof."""
NONE = 1e30
"""A gain that nothing proves; finite, so that a search may subtract it."""


class Channel(NamedTuple):
    """The maps of one coordinate over a time τ between two samples.

    Attributes:
        flow: A (2, 2).
        force: b (2,).
        noise: (k₁, k₂/ω).
        first: change (2,) of x by an acceleration at the beginning of the time, for each rad/s that it makes.
        last: the same at its end.
    """

    flow: Any
    force: Any
    noise: Any
    first: Any
    last: Any

    @classmethod
    def of(cls, alpha: Any, beta: Any, tau: Any) -> "Channel":
        """The channel of given gains."""
        omega = jnp.sqrt(beta)
        part, rate = sampled_gains(alpha, beta, tau)
        kept, rate, s = 1 - part, rate / omega, omega * tau
        last = jnp.stack([0.0 * kept, 1.0 + 0.0 * kept])
        first = jnp.stack([kept * s, 1 - rate * s])
        flow = jnp.stack([jnp.stack([kept, -rate]), first], axis=-1)
        return cls(flow, jnp.stack([kept * s * s / 2, s - rate * s * s / 2]), jnp.stack([part, rate]), first, last)


def gain_matrix(alpha: float, beta: float, p: Any, rate: float, square: float) -> Callable[[Array], Array]:
    """The matrix (3, 3) of τ that is positive definite where P proves the gain γ, γ² = `square`, at the rate μ."""

    def matrix(z):
        a, b = Channel.of(alpha, beta, z[0])[:2]
        new, old = a.T @ p @ a, jnp.exp(-2 * rate * z[0]) * p
        output = jnp.array([[0.0, 0.0], [0.0, 1.0]])
        cross = -(a.T @ p @ b)[:, None]
        corner = (z[0] * square - b @ p @ b)[None, None]
        return jnp.block([[old - new - z[0] * output, cross], [cross.T, corner]])

    return matrix


@jax.jit
def _forms(alpha: float, beta: float, p: Array, rate: float, ages: Array) -> Array:
    """The matrices (a, 3, 3) of `gain_matrix` at the gain 0."""
    return jax.vmap(gain_matrix(alpha, beta, p, rate, 0.0))(ages[:, None])


def least_gain_of(
    alpha: float, beta: float, rate: float, ages: Float[np.ndarray, "a"]
) -> tuple[float, Float[np.ndarray, "2 2"]]:
    """The least square of the gain at some times between samples, and its P, by a search; `NONE` if none is found."""
    from scipy.linalg import solve_discrete_lyapunov
    from scipy.optimize import minimize

    def matrix(x):
        roots, bend = np.exp(x[:2]), math.tanh(x[2])
        return np.array([[1.0, bend], [bend, 1.0]]) * np.outer(roots, roots)

    def square(x):
        p = matrix(x)
        forms = np.asarray(_forms(alpha, beta, p, rate, ages))
        if not np.isfinite(forms).all() or np.linalg.eigvalsh(forms[:, :2, :2]).min() <= 0:
            return NONE
        # The last pivot, with which the determinant is 0: γ² is what has to be added to it.
        return float((-1 / np.linalg.inv(forms)[:, 2, 2] / ages).max())

    shortest = float(ages[0])
    step = math.exp(rate * shortest) * np.asarray(Channel.of(alpha, beta, shortest).flow)
    if max(abs(np.linalg.eigvals(step))) >= 1:
        return NONE, np.eye(2)
    start = solve_discrete_lyapunov(step.T, shortest * np.diag([0.02, 2.02]))
    roots = np.sqrt(np.diag(start))
    x = np.array([*np.log(roots), math.atanh(start[0, 1] / roots.prod())])
    x = min((x + np.array([shift, shift, 0.0]) for shift in (0.0, 0.35, 0.7, 1.05)), key=square)
    for size in (0.3, 0.03):
        simplex = x + np.vstack([np.zeros(3), size * np.eye(3)])
        x = minimize(square, x, method="Nelder-Mead", options={"initial_simplex": simplex, "maxiter": 400}).x
    return square(x), matrix(x)
