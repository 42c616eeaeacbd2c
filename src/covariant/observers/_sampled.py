"""A continuous mechanical observer between samples: predict with the model, correct with matched gains.

The error law ξ' = ζ − αξ, ζ' = −βξ is a double integrator with two poles. Over a step dt the model is integrated alone
(which leaves the double integrator), then the measured error is fed back with the two gains that give the sampled loop
the poles exp(λ dt) of the continuous one. For dt → 0 the gains are α dt and β dt; for any dt the loop is stable.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._typing import Code, Number, Scalar, Vector
from covariant.models import MechanicalSystem, Motion, advance, friction

LONGEST_STEP = 0.01
"""Longest Runge–Kutta step [s] of a prediction whose number of substeps is left open."""
MOST_SUBSTEPS = 10_000


def predict(
    model: MechanicalSystem, t: Number, q: Array, v: Vector, u: Float[Array, "m"], dt: Number, substeps: int | None
) -> Motion:
    """Integrate the model over dt [s] with u held; `substeps=None` uses as many steps as friction and dt ask for."""
    count = needed_substeps(model, t, q, v, u, dt) if substeps is None else substeps
    return advance(model, t, Motion(q, v), u, dt, count)


def needed_substeps(model: MechanicalSystem, t: Number, q: Array, v: Vector, u: Float[Array, "m"], dt: Number) -> Code:
    """Steps that keep h·rate ≤ 1, the rate being a bound on that of the friction at rest and at v [1/s].

    Friction is steepest at rest where it is Coulomb's and at speed where it is drag. The trace bounds the fastest rate,
    since monotone friction has a Jacobian similar to a symmetric negative one.
    """
    n = v.shape[0]

    def rate(at):
        jacobian = jax.jacfwd(lambda w: friction(model, jnp.asarray(t), q, w, u))(at)
        return -sum(jacobian[i, i] for i in range(n))

    fastest = jnp.maximum(jnp.maximum(rate(jnp.zeros_like(v)), rate(v)), 1 / LONGEST_STEP)
    count = jnp.ceil(jnp.nan_to_num(dt * fastest, nan=1.0))
    return jnp.clip(count, 1, MOST_SUBSTEPS).astype(jnp.int32)


def sampled_gains(alpha: Number, beta: Number, dt: Number) -> tuple[Scalar, Scalar]:
    """Position and velocity gains of one sample: `k1 = 1 − ab`, `k2 = (1 − a)(1 − b)/dt`, sampled poles a and b.

    Complex poles `√p exp(±iφ)`, p = exp(−α dt), give `k2 = (1 − √p)²/dt + 2√p (1 − cos φ)/dt`.
    """
    safe = jnp.where(dt > 0, dt, 1.0)
    square = beta - alpha * alpha / 4
    apart = jnp.sqrt(jnp.where(square != 0, jnp.abs(square), 1.0))  # half the distance between the poles
    swing = jnp.where(square > 0, jnp.sin(apart * safe / 2) ** 2, 0.0)
    root = jnp.exp(-alpha * safe / 2)
    fast = alpha / 2 + apart
    real_poles = jnp.expm1(-fast * safe) * jnp.expm1(-beta / fast * safe)
    k2 = jnp.where(square < 0, real_poles, jnp.expm1(-alpha * safe / 2) ** 2 + 4 * root * swing) / safe
    return jnp.where(dt > 0, -jnp.expm1(-alpha * safe), 0.0), jnp.where(dt > 0, k2, 0.0)
