"""Controls a body on a Lie group along a reference: proportional-derivative feedback, from an estimate of its velocity.

Source: Bullo & Murray 1999, Tracking for fully actuated mechanical systems, Automatica 35, in the body frame and with
the logarithm as error; Maithripala, Berg & Dayawansa 2004 for the observer and the metric, equations (1)–(16).
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from covariant._typing import Element, Matrix, Numbers, Scalar, Vector
from covariant.geometry.lie import AbstractGroup
from covariant.models import GroupSystem, Motion, applied_force, resistance
from covariant.simulation._backstepping import gain_matrix
from covariant.simulation._reference import Path
from scalargraph.errors import InputError


class GroupTracking(eqx.Module):
    """A tracking controller of a fully actuated body on a Lie group, such as an attitude or a pose.

    With e the logarithm of the error `g_d⁻¹g`, w the reference's velocity seen from the body, s = v − w, B the
    connection, D the dissipation and ṽ the error of the estimated velocity, the closed loop is

        e' = J_r(e)⁻¹s
        I(s' + B(v, s)) = −J_r(e)⁻ᵀK_p e − K_d s + D(v) − D(w) + I B(w, ṽ) − K_d ṽ

    and `V = ½(sᵀIs + eᵀK_p e)` has `V' = −sᵀK_d s + sᵀ(D(v) − D(w) + I B(w, ṽ) − K_d ṽ)`, until e turns by π. The
    potential is cancelled. K_p and K_d must be symmetric positive definite.

    Args:
        model: The body, a `GroupSystem` whose input (n,) is the force in its frame [N, N m].
        path: The reference to follow, `t -> Reference` whose position is an element (N, N): `follow` of a function
            `t -> g_d`.
        kp: Gain K_p [N/m, N m/rad], a matrix (n, n), a vector (n,) for a diagonal one, or a number.
        kd: Gain K_d of the velocity error [N s/m, N m s/rad], likewise.

    Raises:
        ValueError: The model is not on a group, or has fewer or more inputs than velocities; or a gain is not symmetric
            positive definite.

    Example:
        A body that should turn about its third axis at 2 rad/s, and is 0.1 rad behind:

        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> from covariant.geometry.lie import SO3
        >>> from covariant.simulation import GroupTracking, follow
        >>> path = follow(lambda t: SO3.exp(jnp.stack([0.0 * t, 0.0 * t, 2.0 * t])))
        >>> controller = GroupTracking(models.free_body(), path, kp=10.0, kd=5.0)
        >>> g, v = SO3.exp(jnp.array([0.0, 0.0, -0.1])), jnp.array([0.0, 0.0, 2.0])
        >>> controller(jnp.zeros(()), g, models.Motion(g, v)).round(6).tolist()
        [0.0, 0.0, 1.0]
    """

    model: GroupSystem
    path: Path
    kp: Matrix
    kd: Matrix

    def __init__(self, model: GroupSystem, path: Path, kp: Numbers, kd: Numbers):
        if not isinstance(model.manifold, AbstractGroup) or model.inputs not in (None, model.manifold.dimension):
            raise InputError(f"GroupTracking needs a system on a group with a force on each velocity; got {model!r}")
        n = model.manifold.dimension
        self.model, self.path = model, path
        self.kp, self.kd = gain_matrix("kp", kp, n), gain_matrix("kd", kd, n)

    def reference(self, t: Scalar, q: Element) -> tuple[Vector, Vector, Vector]:
        """Configuration error, and the reference's motion seen from the body.

        Args:
            t: Time [s].
            q: Configuration g (N, N).

        Returns:
            `e = log(g_d⁻¹g)` (n,), the velocity `w = Ad_h⁻¹ v_d` (n,) with h = g_d⁻¹g, and the acceleration
            `Ad_h⁻¹ v_d'` (n,).
        """
        group: Any = self.model.manifold
        desired = self.path(t)
        inverse = group.inverse(desired.position)
        rate, error = inverse @ desired.velocity, inverse @ q
        back = group.inverse(error)
        # (g⁻¹g')' = g⁻¹g″ − (g⁻¹g')² is in the algebra. Its two terms are not, which shows on SE(3).
        turning = group.vee(inverse @ desired.acceleration - rate @ rate)
        return group.log(error), group.adjoint(back, group.vee(rate)), group.adjoint(back, turning)

    def __call__(self, t: Scalar, z: Element, estimate: Motion) -> Vector:
        """Force (n,) [N, N m] from the measured configuration z (N, N) and an estimate, whose velocity is used."""
        model, v = self.model, estimate.v
        group: Any = model.manifold
        e, w, acceleration = self.reference(t, z)
        kp, kd = (jnp.asarray(gain, v.dtype) for gain in (self.kp, self.kd))
        spring = jax.linear_transpose(lambda s: group.right_jacobian_inverse(e, s), v)(kp @ e)[0]
        # The change of w along the motion is the acceleration − [v, w]; B is free of torsion, so B(w, v) remains of
        # B(v, w) − [v, w]. It is linear in v: an error of the estimate enters as in the class's equation.
        forward = model.space.lower(z, acceleration + model.space.connection(z, w, v))
        # Friction is compensated at w, which needs no estimate; that at v − that at w opposes s if friction grows.
        given = applied_force(model, t, z, jnp.zeros_like(v)) + resistance(model, t, z, w, jnp.zeros_like(v))
        return forward - given - spring - kd @ (v - w)
