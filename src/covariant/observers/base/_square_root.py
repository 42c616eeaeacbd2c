"""Operations of Kalman filters on a square root S of the covariance `P = S Sᵀ`, which rounding cannot make indefinite.

Source: Kailath, Sayed & Hassibi 2000, Linear Estimation, chapter 12, the array form.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from covariant._linalg import semidefinite_root, solve, triangular
from covariant._typing import Matrix, Scalar, Vector


def diagonal(a: Array, b: Array) -> Array:
    """Block-diagonal matrix of two blocks."""
    top = jnp.concatenate([a, jnp.zeros((a.shape[0], b.shape[1]), a.dtype)], axis=1)
    bottom = jnp.concatenate([jnp.zeros((b.shape[0], a.shape[1]), a.dtype), b.astype(a.dtype)], axis=1)
    return jnp.concatenate([top, bottom])


def white_acceleration(density: Matrix, h: Scalar) -> Float[Array, "two_n two_n"]:
    """Square root of the covariance that white acceleration noise adds to position and velocity."""
    # The double and the single integral of white noise over h have the covariance h³/3, h²/2; h²/2, h.
    integrals = jnp.sqrt(h) * jnp.array([[h / 3**0.5, 0.0], [0.75**0.5, 0.5]])
    return jnp.kron(integrals, semidefinite_root(density))


def updated(
    root: Float[Array, "k k"], shown: Float[Array, "n k"], noise: Float[Array, "n n"], used: Array
) -> tuple[Float[Array, "k n"], Float[Array, "k k"]]:
    """Correct a square root by a measurement of n linear functions H of the state, in array form."""
    n = noise.shape[0]
    both = used[:, None] & used[None, :]
    # An unused entry gets unit noise and zero output: its gain is zero, and the matrix to be solved stays regular.
    noise_root = semidefinite_root(jnp.where(both, noise, jnp.eye(n, dtype=noise.dtype)))
    measured_root = jnp.where(used[:, None], shown, 0.0)
    above = jnp.concatenate([noise_root, measured_root], axis=1)
    below = jnp.concatenate([jnp.zeros((root.shape[0], n), root.dtype), root], axis=1)
    # The triangular factor has the same `A Aᵀ`; its blocks are the innovation's root, the cross term and the new root.
    joint = triangular(jnp.concatenate([above, below]))
    innovation_root, cross = joint[:n, :n], joint[n:, :n]
    # The gain cross · L⁻¹, with the innovation's root L, is computed as cross Lᵀ (L Lᵀ)⁻¹ by a symmetric solver.
    return solve(innovation_root @ innovation_root.T, innovation_root @ cross.T).T, joint[n:, n:]


def normalised_square(spread: Matrix, innovation: Vector, present: Bool[Array, "n"]) -> Scalar:
    """Normalised square `rᵀS⁻¹r` of the measured components of an innovation."""
    both = present[:, None] & present[None, :]
    r = jnp.where(present, innovation, 0.0)
    # A component that is not measured gets unit variance and r = 0: it adds nothing, and the matrix stays regular.
    return r @ solve(jnp.where(both, spread, jnp.eye(len(r), dtype=r.dtype)), r)
