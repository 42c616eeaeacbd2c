"""Continuous mechanical observers with sampled measurements: predict with the model, correct with matched gains.

The error law ξ' = ζ − αξ, ζ' = −βξ is a double integrator with two poles. Over a step dt the model is integrated
without correction; then the measured error is fed back so that the sampled loop has the poles a, b = exp(λ dt) of the
continuous one.

Without correction the model changes an error by `ξ' = ζ, ζ' = Nξ` with N = ∇S − R(·, v)v. For a constant number N the
gains are
`K1 = 1 − ab` and `K2 = √N ((1 + ab) cosh(√N dt) − a − b)/sinh(√N dt) = k2 + κN + O(N²)`, with `k2 = (1 − a)(1 − b)/dt`
and `κ = ½(1 + ab) dt − k2 dt²/6`. For dt → 0 they are α dt and β dt + N dt.
"""

import dataclasses
import math
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Inexact

from covariant._typing import Code, Flag, Number, Scalar, Vector
from covariant.geometry import AbstractSpace
from covariant.models import MechanicalSystem, Motion, advance, friction
from covariant.observers._protocol import since
from covariant.signals import Result

Observer = TypeVar("Observer", bound=Any)

LONGEST_STEP = 0.01
"""Longest Runge–Kutta step [s] of a prediction whose number of substeps is not given."""
MOST_SUBSTEPS = 10_000
LONGEST_GAP = (jnp.pi / 2) ** 2
"""Largest `|N| dt²` at which a sample is used for the velocity, a quarter of the period of an oscillation: beyond it
the error may have changed its sign."""


def predict(
    model: MechanicalSystem, t: Number, q: Array, v: Vector, u: Float[Array, "m"], dt: Number, substeps: int | None
) -> Motion:
    """Integrate the model over dt [s] with u held constant; `substeps=None` uses as many as friction and dt need."""
    count = needed_substeps(model, t, q, v, u, dt) if substeps is None else substeps
    return advance(model, t, Motion(q, v), u, dt, count)


def predicted(model: MechanicalSystem, state: Any, u: Float[Array, "m"], dt: Scalar, substeps: int | None) -> Any:
    """A state with q, v, t and `age`, predicted by the model over dt [s]; see `predict`."""
    q, v = predict(model, state.t, state.q, state.v, u, dt, substeps)
    return state._replace(q=q, v=v, t=state.t + dt, age=since(state, dt))


def needed_substeps(model: MechanicalSystem, t: Number, q: Array, v: Vector, u: Float[Array, "m"], dt: Number) -> Code:
    """Number of steps that keep h·rate ≤ 1, with a bound on the rate [1/s] of the friction at rest and at v.

    Coulomb friction is steepest at rest, drag at speed. The trace bounds the fastest rate, since the Jacobian of
    monotone friction is similar to a symmetric negative semidefinite matrix.
    """
    n = v.shape[0]

    def rate(at):
        jacobian = jax.jacfwd(lambda w: friction(model, jnp.asarray(t), q, w, u))(at)
        return -sum(jacobian[i, i] for i in range(n))

    rates = jax.vmap(rate)(jnp.stack([jnp.zeros_like(v), v]))
    return steps_for(dt, jnp.maximum(jnp.max(rates), 1 / LONGEST_STEP))


def chooses_substeps(observer: Any) -> bool:
    """Whether an observer chooses its number of substeps in each sample, by the friction of its mechanical model."""
    return getattr(observer, "substeps", 0) is None and isinstance(observer.model, MechanicalSystem)


def with_fixed_substeps(
    observer: Observer, rate: float, q: Inexact[Array, "K *n"], v: Float[Array, "K n"], u: Float[Array, "K m"]
) -> Observer:
    """An observer as a program of fixed length: its number of substeps is chosen now, no longer in every sample.

    It is the largest that any of K motions needs at `rate` [Hz], such as those of a simulation or of a log: q and v in
    the frame, and inputs u. With a slower rate, or friction steeper than at these motions, take the number anew.

    Raises `ValueError` for an observer whose number of substeps is fixed already or that has no mechanical model, and
    for a rate that is not positive.
    """
    if not chooses_substeps(observer):
        raise ValueError(f"with_fixed_substeps: {type(observer).__name__} does not choose its substeps by friction")
    if not 0 < rate < math.inf:
        raise ValueError(f"with_fixed_substeps: rate must be a positive, finite number; got {rate}")
    model, dt = observer.model, 1 / rate
    needed = jax.jit(jax.vmap(lambda q, v, u: needed_substeps(model, 0.0, q, v, u, dt)))(q, v, u)
    return dataclasses.replace(observer, substeps=int(needed.max()))


def steps_for(dt: Number, rate: Number) -> Code:
    """Number of equal steps in dt [s] that keep h·rate ≤ 1, at most `MOST_SUBSTEPS`."""
    count = jnp.ceil(jnp.nan_to_num(jnp.asarray(dt * rate), nan=1.0))
    return jnp.clip(count, 1, MOST_SUBSTEPS).astype(jnp.int32)


def sampled_gains(alpha: Number, beta: Number, dt: Number) -> tuple[Scalar, Scalar]:
    """Position and velocity gains of one sample: `k1 = 1 − ab`, `k2 = (1 − a)(1 − b)/dt`, for sampled poles a and b.

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


class Correction(NamedTuple):
    """The correction by one sample: the fraction `part` of ξ to take away, and the change of the `velocity`.

    `restarted`: the sample came too late to be used for the velocity, so the estimate starts anew from the measured
    configuration and the predicted velocity.
    """

    part: Scalar
    velocity: Vector
    restarted: Flag


def sampled_correction(
    space: AbstractSpace, motion: Motion, alpha: Number, beta: Number, dt: Number, xi: Vector, missing: Vector
) -> Correction:
    """The correction of a predicted motion by the error ξ.

    - `missing`: −Nξ, the acceleration missing in the prediction, which was made at the estimate.

    N is an operator and known in the direction of ξ only; terms beyond first order in `|N| dt²` use its size instead.
    """
    k1, k2 = sampled_gains(alpha, beta, dt)
    size, gap = space.norm(motion.q, xi), space.norm(motion.q, missing) * dt * dt
    # An error below the rounding of the distance moved says nothing about N.
    faint = float(jnp.finfo(xi.dtype).eps) ** 0.5 * dt * space.norm(*motion)
    restarted = gap > LONGEST_GAP * size + faint
    square = gap / jnp.where(size > 0, size, 1.0)
    kappa = dt * (1 - k1 / 2) - k2 * dt * dt / 6
    velocity = kappa / (1 + square / 18) * missing - k2 * xi  # for large |N| dt² it grows as x coth x does
    return Correction(jnp.where(restarted, 1.0, k1), jnp.where(restarted, 0.0, velocity), restarted)


def worth(taken: Correction, result: Code) -> Code:
    """The result code of a step: its own, or `RESTARTED`, whichever is worse."""
    return jnp.where(taken.restarted, jnp.maximum(result, int(Result.RESTARTED)), result)
