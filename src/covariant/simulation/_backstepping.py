"""Controls a marine craft by vectorial backstepping: a nonlinear PD controller, from the state or an estimate of it.

Source: Jouffroy & Fossen 2004, equations (86)–(98). The paper treats J as constant; here `ν_r'` includes the derivative
of J, so that (88), (90), (97) and (98) hold as printed. With a quaternion, J is replaced by the Jacobian of the error.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from covariant._linalg import solve_square
from covariant._typing import Matrix, Numbers, Scalar, Vector
from covariant.models.marine import Craft
from covariant.simulation._reference import Path
from scalargraph.errors import InputError


class Backstepping(eqx.Module):
    """A tracking controller of a marine craft, by vectorial backstepping.

    With V = ½(sᵀMs + η̃ᵀK_pη̃) and a known state, `V' = −sᵀ(D̄ + K_d)s − η̃ᵀK_pΛη̃`, (92). K_p, K_d and Λ must be
    symmetric positive definite, and so must be `K_pΛ + ΛᵀK_p`.

    Args:
        craft: The craft, a `marine.Craft` with n coordinates and m velocities; n > m with a quaternion.
        path: The reference to follow, `t -> Reference` in the craft's coordinates.
        kp: Gain K_p of the position error [N/m, N m], a matrix (m, m), a vector (m,) for a diagonal one, or a number.
        kd: Gain K_d of the velocity error [N s/m, N m s], likewise.
        lam: Gain Λ [1/s] of the virtual velocity, likewise.

    Raises:
        ValueError: A gain violates these conditions; the message names it.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.models import marine
        >>> from covariant.simulation import Backstepping, lissajous
        >>> path = lissajous([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0])
        >>> controller = Backstepping(marine.cybership(), path, kp=1.0, kd=2.0, lam=0.1)
        >>> t, eta = jnp.zeros(()), jnp.array([0.5, 0.0, 0.0])
        >>> controller.error(t, eta).tolist(), controller.virtual_velocity(t, eta).round(3).tolist()
        ([0.5, 0.0, 0.0], [-0.05, 0.0, 0.0])
    """

    craft: Craft
    path: Path
    kp: Matrix
    kd: Matrix
    lam: Matrix

    def __init__(self, craft: Craft, path: Path, kp: Numbers, kd: Numbers, lam: Numbers):
        self.craft, self.path = craft, path
        n = len(craft.velocities)
        self.kp, self.kd, self.lam = (gain_matrix(name, g, n) for name, g in (("kp", kp), ("kd", kd), ("lam", lam)))
        product = np.asarray(self.kp @ self.lam)
        # In V', only the symmetric part of K_pΛ matters. `not … > 0` is true for NaN as well.
        if not np.linalg.eigvalsh(product + product.T)[0] > 0:
            raise InputError("kp and lam: K_pΛ + ΛᵀK_p must be positive definite; choose both diagonal")

    def error(self, t: Scalar, eta: Vector) -> Vector:
        """Tracking error `η̃ = η − η_d`, with angles wrapped to ±π; if n > m, see `Craft.displacement`.

        Args:
            t: Time [s].
            eta: Position η (n,).

        Returns:
            The error (m,) [m, rad].
        """
        return self.craft.displacement(self.path(t).position, eta)

    def virtual_velocity(self, t: Scalar, eta: Vector) -> Vector:
        """Virtual velocity `ν_r = J⁻¹(η)(η_d' − Λη̃)`, (87).

        Args:
            t: Time [s].
            eta: Position η (n,).

        Returns:
            Body velocity (m,) [m/s, rad/s] with which the position error decays.
        """
        wanted = self.path(t)
        # Rate of the error of a craft at rest, −η_d' in Euler angles.
        error, drift = jax.jvp(lambda at: self.craft.displacement(at, eta), (wanted.position,), (wanted.velocity,))
        return solve_square(self._transform(t, eta), -drift - jnp.asarray(self.lam, eta.dtype) @ error)

    def full_state(self, t: Scalar, eta: Vector, nu: Vector) -> Vector:
        """Force from the true state, (89): `Mν_r' + (C(ν) + D(ν))ν_r + g(η) − JᵀK_pη̃ − K_d s`.

        Args:
            t: Time [s].
            eta: Position η (n,).
            nu: Body velocity ν (m,).

        Returns:
            Generalised force τ (m,) [N, N m].
        """
        nu_r, force = self._common(t, eta, eta, nu)
        return force + (self.craft.coriolis(nu) + self.craft.damping(nu)) @ nu_r

    def __call__(self, t: Scalar, z: Vector, estimate: Vector) -> Vector:
        """τ (m,) from the measured position z = η and an estimate (η̂, ν̂) (n + m,), by (94), with `D(ν_r)ν_r`."""
        eta, nu = jnp.split(estimate, z.shape)
        nu_r, force = self._common(t, z, eta, nu)
        return force + (self.craft.coriolis(nu) + self.craft.damping(nu_r)) @ nu_r

    def _transform(self, t: Scalar, eta: Vector) -> Matrix:
        """Matrix (m, m) that takes ν to η̃' of a reference at rest: J(η), for a quaternion J⁺(η_d)J(η)."""
        slope = jax.jacfwd(self.craft.displacement, 1)(self.path(t).position, eta)
        return slope @ self.craft.transform(eta)

    def _common(self, t: Scalar, z: Vector, eta: Vector, nu: Vector) -> tuple[Vector, Vector]:
        """ν_r, and the terms of τ that both forms share; `ν_r'` is the derivative along the motion `z' = J(z)ν`."""
        # One Jacobian-vector product along (1, Jν) gives ν_r and its total time derivative, including that of J.
        nu_r, nu_r_dot = jax.jvp(self.virtual_velocity, (t, z), (jnp.ones_like(t), self.craft.transform(z) @ nu))
        mass, kp, kd = (jnp.asarray(a, z.dtype) for a in (self.craft.mass, self.kp, self.kd))
        # Jᵀ converts a force in the frame of η to the body frame, as the power η'ᵀF = νᵀJᵀF is the same in both.
        spring = self._transform(t, z).T @ (kp @ self.error(t, eta))
        return nu_r, mass @ nu_r_dot + self.craft.restoring(z) - spring - kd @ (nu - nu_r)


def gain_matrix(name: str, values: Numbers, n: int) -> Matrix:
    array = np.asarray(values, float)
    matrix = np.diag(np.broadcast_to(array, (n,))) if array.ndim < 2 and array.size in (1, n) else array
    if matrix.shape != (n, n):
        raise InputError(f"{name} must be a number, {n} numbers or a matrix ({n}, {n}); its shape is {array.shape}")
    if not np.allclose(matrix, matrix.T) or not np.linalg.eigvalsh(matrix)[0] > 0:
        raise InputError(
            f"{name} must be symmetric positive definite; its eigenvalues are "
            f"{', '.join(f'{e:.3g}' for e in np.linalg.eigvals(matrix).real)}"
        )
    return jnp.asarray(matrix)
