"""Implements observers from wrong printed equations, to show that they fail; `errata.ERRATA` lists all misprints.

Sources: Aghannan & Rouchon 2003, equation (14), whose four curvature terms have the wrong sign according to its own
(5). Maithripala, Berg & Dayawansa 2004, equations (8), (18), (19), (21), (44), (45) and the definition of S below (30).
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._typing import Element, Number, Scalar, Vector
from covariant.geometry.lie import SO3
from covariant.models import GroupSystem, Motion, friction, source
from covariant.observers import AbstractFlowObserver, Info, MechanicalState, SampledState
from covariant.papers.errata import ERRATA

CONTINUOUS = "the printed observer is a counter-example in continuous time only"
"""Message: the observers of this file have no sampled steps."""


class PrintedBallAndBeam(AbstractFlowObserver):
    """Observer (14) for the normalised ball and beam, exactly as printed, in continuous time. Do not use it.

    Args:
        alpha: Gain α of the position error [1/s].
        beta: Gain β of the velocity equation [1/s²].
        curvature_sign: 1 as printed, −1 as (5) requires.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.papers._errata import PrintedBallAndBeam
        >>> observer = PrintedBallAndBeam(alpha=2.0, beta=1.0)
        >>> state = observer.init(jnp.array([0.5, 0.0]))
        >>> observer.flow(state.t, state, jnp.zeros(1), jnp.array([0.0, 0.0])).q.tolist()
        [-1.0, 0.0]
    """

    alpha: Number
    beta: Number
    curvature_sign: int = eqx.field(default=1, static=True)
    """1 as printed, −1 as (5) requires."""

    def init(self, y: Vector, t: Number = 0.0) -> MechanicalState:
        return MechanicalState(y, jnp.zeros_like(y), jnp.asarray(t, y.dtype))

    def estimate(self, state: MechanicalState) -> Float[Array, "two_n"]:
        return jnp.concatenate([state.q, state.v])

    def flow(self, t: Scalar, state: MechanicalState, u: Float[Array, "m"], y: Vector) -> MechanicalState:
        (r_hat, theta_hat), (vr, vt) = state.q, state.v
        r, theta = y
        er, et = r_hat - r, theta_hat - theta
        r_dot, theta_dot = vr - self.alpha * er, vt - self.alpha * et
        # The force S = −grad U + g⁻¹u at the measured position, as in (14).
        sr, st = -jnp.sin(theta), (u[0] - r * jnp.cos(theta)) / (1 + r**2)
        k = 1 + r_hat**2
        # By (5), R(ξ, v̂)v̂ is minus these terms: the metric diag(1, k), k = 1 + r̂², has the curvature −1/k².
        curvature_r = (-vr * vt * et + vt**2 * er) / k
        curvature_t = (vr**2 * et - vr * vt * er) / k**2
        vr_dot = r_hat * theta_dot * vt + (sr + r_hat * et * st) - self.beta * er
        vt_dot = -r_hat / k * (r_dot * vt + vr * theta_dot) + (st - r_hat / k * (er * st + et * sr)) - self.beta * et
        return MechanicalState(
            jnp.stack([r_dot, theta_dot]),
            jnp.stack([vr_dot, vt_dot]) + self.curvature_sign * jnp.stack([curvature_r, curvature_t]),
            jnp.ones_like(state.t),
        )

    def predict(self, state: MechanicalState, u: Float[Array, "m"], dt: Scalar) -> MechanicalState:
        raise NotImplementedError(CONTINUOUS)

    def correct(self, state: MechanicalState, u: Float[Array, "m"], y: Vector) -> tuple[MechanicalState, Info]:
        raise NotImplementedError(CONTINUOUS)


SLIPS = {entry.slip: f"{entry.where}: {entry.reason}" for entry in ERRATA if entry.slip}
"""Misprints of Maithripala, Berg & Dayawansa 2004, each with its equation."""


class PrintedGroup(AbstractFlowObserver):
    """Observer (20)–(21) on SO(3) or SE(3) with misprints of the paper, in continuous time. Do not use it.

    Without misprints it is `Intrinsic` with the paper's doubled α.

    Args:
        model: The system.
        alpha: Gain α [1/s], doubled in the observer.
        beta: Gain β [1/s²].
        slips: The misprints to include, keys of `SLIPS`.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> from covariant.papers._errata import PrintedGroup
        >>> observer = PrintedGroup(models.heavy_top((1.0, 1.0, 2.0)), 1.0, 1.0, ("alpha",))
        >>> observer.estimate(observer.init(jnp.eye(3))).v.tolist()
        [0.0, 0.0, 0.0]
    """

    model: GroupSystem
    alpha: Number
    beta: Number
    slips: tuple[str, ...] = eqx.field(static=True)

    def init(self, y: Element, t: Number = 0.0) -> SampledState:
        rest = jnp.zeros(self.model.group.dimension, y.dtype)
        return SampledState(y, rest, jnp.asarray(t, y.dtype))

    def estimate(self, state: SampledState) -> Motion:
        return Motion(state.q, state.v)

    def flow(self, t: Scalar, state: SampledState, u: Float[Array, "m"], y: Element) -> SampledState:
        space, group, q, v = self.model.space, self.model.group, state.q, state.v
        error = _printed_log(y, q) if "logarithm" in self.slips else group.between(y, q)
        s = source(self.model, t, y, u)
        # `source` has raised the force already; lowering it removes the inverse inertia, which the print lacks.
        s = space.lower(q, s) if "source" in self.slips else s
        # The paper's α is half of the α of Aghannan and Rouchon, see (17).
        w = v - 2 * self.alpha * error
        transported = s - (
            space.connection(q, s, error) if "transport" in self.slips else space.connection(q, error, s)
        )
        curvature = space.curvature(q, v, error, v)
        if "curvature count" in self.slips:
            curvature = 2 * curvature - space.connection(q, group.lie_bracket(v, error), v)
        # With R(a, b) = ∇_a∇_b − ∇_b∇_a − ∇_[a, b], as in this library, the term has a minus sign; (18) has a plus.
        v_dot = transported + (curvature if "curvature sign" in self.slips else -curvature) - self.beta * error
        v_dot = v_dot - space.connection(q, w, v) + friction(self.model, t, q, v, u)
        if "alpha" in self.slips:
            # The connection contains the bracket with the factor α; this changes the factor to 1, as in (21).
            v_dot = v_dot + (1 - self.alpha) * group.lie_bracket(error, v)
        return SampledState(w, v_dot, jnp.ones_like(state.t))

    def predict(self, state: SampledState, u: Float[Array, "m"], dt: Scalar) -> SampledState:
        raise NotImplementedError(CONTINUOUS)

    def correct(self, state: SampledState, u: Float[Array, "m"], y: Element) -> tuple[SampledState, Info]:
        raise NotImplementedError(CONTINUOUS)


def _printed_log(y: Element, estimate: Element) -> Vector:
    """Equations (44) and (45) as printed: the spatial logarithm of the rotation, and a difference of two frames."""
    # log(g̃gᵀ) is the rotation vector in space; in the body, log(gᵀg̃) would be gᵀ times it.
    omega = SO3.log(estimate[:3, :3] @ y[:3, :3].T)
    if y.shape[0] == 3:
        return omega
    shift = y[:3, :3].T @ estimate[:3, 3] - estimate[:3, :3].T @ y[:3, 3]
    return jnp.concatenate([SO3.left_jacobian_inverse(omega, shift), omega])
