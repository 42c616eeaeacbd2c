"""What Kalman filters do to a square root S of their covariance `P = S Sᵀ`, which no rounding makes indefinite.

Source: Kailath, Sayed & Hassibi 2000, Linear Estimation, chapter 12, the array form.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from covariant._linalg import semidefinite_root, solve, triangular
from covariant._typing import Matrix, Scalar, Vector


def diagonal(a: Array, b: Array) -> Array:
    """Block-diagonal."""
    top = jnp.concatenate([a, jnp.zeros((a.shape[0], b.shape[1]), a.dtype)], axis=1)
    bottom = jnp.concatenate([jnp.zeros((b.shape[0], a.shape[1]), a.dtype), b.astype(a.dtype)], axis=1)
    return jnp.concatenate([top, bottom])


def white_acceleration(density: Matrix, h: Scalar) -> Float[Array, "two_n two_n"]:
    """Root of what white acceleration noise of this density (n, n) adds to position and velocity over h [s]."""
    # The double and the single integral of white noise over h have the covariance h³/3, h²/2; h²/2, h.
    integrals = jnp.sqrt(h) * jnp.array([[h / 3**0.5, 0.0], [0.75**0.5, 0.5]])
    return jnp.kron(integrals, semidefinite_root(density))


def updated(
    root: Float[Array, "k k"], shown: Float[Array, "n k"], noise: Float[Array, "n n"], used: Array
) -> tuple[Float[Array, "k n"], Float[Array, "k k"]]:
    """Gain, and root of the covariance after the correction, where n linear functions H of the state are measured with
    this noise (n, n); only those that are `used` (n,).

    - `shown`: H times the root.
    """
    n = noise.shape[0]
    both = used[:, None] & used[None, :]
    own = semidefinite_root(jnp.where(both, noise, jnp.eye(n, dtype=noise.dtype)))
    measured_root = jnp.where(used[:, None], shown, 0.0)
    above = jnp.concatenate([own, measured_root], axis=1)
    below = jnp.concatenate([jnp.zeros((root.shape[0], n), root.dtype), root], axis=1)
    joint = triangular(jnp.concatenate([above, below]))
    spread, cross = joint[:n, :n], joint[n:, :n]
    return solve(spread @ spread.T, spread @ cross.T).T, joint[n:, n:]


def normalised_square(spread: Matrix, innovation: Vector, present: Bool[Array, "n"]) -> Scalar:
    """`rᵀS⁻¹r` of the measured components `present` of an innovation r (n,) with the covariance S."""
    both = present[:, None] & present[None, :]
    r = jnp.where(present, innovation, 0.0)
    return r @ solve(jnp.where(both, spread, jnp.eye(len(r), dtype=r.dtype)), r)
