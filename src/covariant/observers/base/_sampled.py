"""Samples continuous mechanical observers: predicts with the model, and corrects with matched gains.

The error law ξ' = ζ − αξ, ζ' = −βξ is a double integrator with two poles. Over a step dt the model is integrated
without correction; then the measured error is fed back such that the sampled loop has the poles a, b = exp(λ dt) of the
continuous one.

Without correction the model changes an error by `ξ' = ζ, ζ' = Nξ` with N = ∇S − R(·, v)v. For a constant number N the
gains are
`K1 = 1 − ab` and `K2 = √N ((1 + ab) cosh(√N dt) − a − b)/sinh(√N dt) = k2 + κN + O(N²)`, with `k2 = (1 − a)(1 − b)/dt`
and `κ = ½(1 + ab) dt − k2 dt²/6`. For dt → 0 they are α dt and β dt + N dt.

If an unknown force is estimated too, the error law is a triple integrator, `ξ' = ζ, ζ' = Nξ + η, η' = 0` without
correction, and has a third pole c = exp(−ρ dt). Matching determinant, trace and second invariant of the sampled loop
gives,
for a constant N, with T = a + b + c, P = ab + bc + ca, `S = sinh(√N dt)/√N` and `C = (cosh(√N dt) − 1)/N`,
`K1 = 1 − abc`, `K2 = (2(1 + abc) cosh(√N dt) + 1 + abc − T − P)/2S`, `K3 = (1 − abc − T + P)/2C`. To first order K2 is
again k2 + κN, with κ as above, and K3 is k3 (1 − N dt²/12).
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
from covariant.observers.base._protocol import since
from covariant.signals import StepCode
from scalargraph.errors import InputError

Observer = TypeVar("Observer", bound=Any)

LONGEST_STEP = 0.01
"""Longest Runge–Kutta step [s] in a prediction with a variable number of substeps."""
MOST_SUBSTEPS = 10_000
LONGEST_GAP = (jnp.pi / 2) ** 2
"""Largest `|N| dt²` at which a sample corrects the velocity: dt is a quarter of an oscillation period then, after which
the error may have changed its sign."""


def predict(
    model: MechanicalSystem, t: Number, q: Array, v: Vector, u: Float[Array, "m"], dt: Number, substeps: int | None
) -> Motion:
    """Integrate the model over dt with the input held constant."""
    count = needed_substeps(model, t, q, v, u, dt) if substeps is None else substeps
    return advance(model, t, Motion(q, v), u, dt, count)


def predicted(model: MechanicalSystem, state: Any, u: Float[Array, "m"], dt: Scalar, substeps: int | None) -> Any:
    """State of a mechanical observer predicted by the model over dt; see `predict`."""
    q, v = predict(model, state.t, state.q, state.v, u, dt, substeps)
    return state._replace(q=q, v=v, t=state.t + dt, age=since(state, dt))


def needed_substeps(model: MechanicalSystem, t: Number, q: Array, v: Vector, u: Float[Array, "m"], dt: Number) -> Code:
    """Number of Runge–Kutta steps that keep h·rate ≤ 1, for a bound on the rate [1/s] of the friction.

    The bound is the larger one of those at rest and at v, since Coulomb friction is steepest at rest and drag at speed.
    The trace bounds the fastest rate, since the Jacobian of monotone friction is similar to a symmetric negative
    semidefinite matrix. No step is longer than `LONGEST_STEP`.

    Args:
        model: Mechanical system.
        t: Time [s].
        q: Configuration.
        v: Velocity (n,).
        u: Input (m,).
        dt: Length of the prediction [s].

    Returns:
        The number of steps.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> from covariant.observers.base import needed_substeps
        >>> needed_substeps(models.oscillator(), 0.0, jnp.zeros(1), jnp.zeros(1), jnp.zeros(1), 0.04).item()
        4
    """
    n = v.shape[0]

    def rate(velocity):
        jacobian = jax.jacfwd(lambda w: friction(model, jnp.asarray(t), q, w, u))(velocity)
        return -sum(jacobian[i, i] for i in range(n))

    rates = jax.vmap(rate)(jnp.stack([jnp.zeros_like(v), v]))
    return steps_for(dt, jnp.maximum(jnp.max(rates), 1 / LONGEST_STEP))


def chooses_substeps(observer: Any) -> bool:
    """Whether an observer chooses its number of substeps in each sample, from the friction of its mechanical model.

    Args:
        observer: Any observer.

    Returns:
        True if its `substeps` is None and its model is a `MechanicalSystem`.

    Example:
        >>> from covariant import models, observers
        >>> model = models.oscillator()
        >>> observers.chooses_substeps(observers.ModelCopy(model, 2.0, 4.0))
        True
        >>> observers.chooses_substeps(observers.ModelCopy(model, 2.0, 4.0, substeps=2))
        False
    """
    return observer.substeps is None and isinstance(observer.model, MechanicalSystem)


def with_fixed_substeps(
    observer: Observer, rate: float, q: Inexact[Array, "K *n"], v: Float[Array, "K n"], u: Float[Array, "K m"]
) -> Observer:
    """Fix the number of substeps of an observer, so that its program has a fixed length.

    The number is the largest that any of K motions, such as those of a simulation or log, needs at `rate`. For a slower
    rate, or if friction may be steeper than in these motions, determine the number again.

    Args:
        observer: Observer that chooses its substeps; see `chooses_substeps`.
        rate: Sampling rate [Hz].
        q: Configurations (K, n), or on a group (K, N, N).
        v: Velocities (K, n), in the frame.
        u: Inputs (K, m).

    Returns:
        The observer with this number of substeps.

    Raises:
        ValueError: The number of substeps is fixed already, the observer has no mechanical model, or the rate is not
            positive and finite.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> observer = observers.ModelCopy(models.oscillator(), 2.0, 4.0)
        >>> zeros = jnp.zeros((5, 1))
        >>> observers.with_fixed_substeps(observer, 25.0, zeros, zeros, zeros).substeps
        4
    """
    if not chooses_substeps(observer):
        raise InputError(f"with_fixed_substeps: {type(observer).__name__} does not choose its substeps by friction")
    if not 0 < rate < math.inf:
        raise InputError(f"with_fixed_substeps: rate must be a positive, finite number; got {rate}")
    model, dt = observer.model, 1 / rate
    needed = jax.jit(jax.vmap(lambda q, v, u: needed_substeps(model, 0.0, q, v, u, dt)))(q, v, u)
    return dataclasses.replace(observer, substeps=int(needed.max()))


def steps_for(dt: Number, rate: Number) -> Code:
    """Number of equal steps in dt that keep h·rate ≤ 1, at most `MOST_SUBSTEPS`."""
    # NaN cannot be converted to an integer; one step passes it on to the state, and the result code reports it.
    count = jnp.ceil(jnp.nan_to_num(jnp.asarray(dt * rate), nan=1.0))
    return jnp.clip(count, 1, MOST_SUBSTEPS).astype(jnp.int32)


def sampled_gains(alpha: Number, beta: Number, dt: Number) -> tuple[Scalar, Scalar]:
    """Position and velocity gains of one sample: `k1 = 1 − ab`, `k2 = (1 − a)(1 − b)/dt`, for sampled poles a and b.

    Complex poles `√p exp(±iφ)`, p = exp(−α dt), give `k2 = (1 − √p)²/dt + 2√p (1 − cos φ)/dt`.
    """
    # For dt ≤ 0, the 1 keeps the unused branch and its derivative finite.
    positive_dt = jnp.where(dt > 0, dt, 1.0)
    square = beta - alpha * alpha / 4
    # At a double pole the derivative of the root is infinite, so the root is replaced by 1, which is not used there.
    half_gap = jnp.sqrt(jnp.where(square != 0, jnp.abs(square), 1.0))  # half the distance between the poles
    sine_square = jnp.where(square > 0, jnp.sin(half_gap * positive_dt / 2) ** 2, 0.0)
    # expm1 and sin² compute differences from 1 that would cancel in the plain formulas for small dt.
    root = jnp.exp(-alpha * positive_dt / 2)
    fast_pole = alpha / 2 + half_gap
    # The slow pole is computed as β over the fast pole, since a difference would cancel.
    real_poles = jnp.expm1(-fast_pole * positive_dt) * jnp.expm1(-beta / fast_pole * positive_dt)
    complex_poles = jnp.expm1(-alpha * positive_dt / 2) ** 2 + 4 * root * sine_square
    k2 = jnp.where(square < 0, real_poles, complex_poles) / positive_dt
    return jnp.where(dt > 0, -jnp.expm1(-alpha * positive_dt), 0.0), jnp.where(dt > 0, k2, 0.0)


def sampled_force_gains(alpha: Number, beta: Number, force_rate: Number, dt: Number) -> tuple[Scalar, Scalar, Scalar]:
    """Gains of position, velocity and unknown acceleration of one sample: `sampled_gains` with a third pole at −ρ.

    With the elementary symmetric functions e1, e2, e3 of 1 − a, 1 − b and 1 − c = r, they are `k1 = e1 − e2 + e3`,
    `k2 = (e2 − 3e3/2)/dt`, `k3 = e3/dt²`. For r = 0 the first two are those of `sampled_gains`.
    """
    k1, k2 = sampled_gains(alpha, beta, dt)
    third = -jnp.expm1(-force_rate * dt)
    # For dt ≤ 0 the 1 keeps the unused branch and its derivative finite.
    per_time = jnp.where(dt > 0, third / jnp.where(dt > 0, dt, 1.0), 0.0)
    return k1 + third * (1 - k1), k2 + per_time * (k1 - k2 * dt / 2), k2 * per_time


def acceleration_gain(k1: Scalar, k2: Scalar, dt: Number) -> Scalar:
    """Gain `κ = ½(1 + ab) dt − k2 dt²/6` of the acceleration that a prediction lacks, to first order in N."""
    # ½(1 + ab) dt, since k1 = 1 − ab.
    return dt * (1 - k1 / 2) - k2 * dt * dt / 6


class Correction(NamedTuple):
    """Correction by one sample.

    Attributes:
        part: Fraction of ξ to subtract.
        velocity: Change (n,) of the velocity.
        restarted: Whether the sample came too late to correct the velocity, so that the estimate restarts from the
            measured configuration and the predicted velocity.
    """

    part: Scalar
    velocity: Vector
    restarted: Flag


def sampled_correction(
    space: AbstractSpace, motion: Motion, gains: tuple[Scalar, Scalar], dt: Number, xi: Vector, missing: Vector
) -> Correction:
    """Correction of a predicted motion by the error ξ, with the position and velocity gains of one sample.

    The operator N is known only in the direction of ξ; terms beyond first order in `|N| dt²` use its size.
    """
    k1, k2 = gains
    size, gap = space.norm(motion.q, xi), space.norm(motion.q, missing) * dt * dt
    # An error below the rounding of the distance moved contains no information on N.
    rounding = float(jnp.finfo(xi.dtype).eps) ** 0.5 * dt * space.norm(*motion)
    restarted = gap > LONGEST_GAP * size + rounding
    square = gap / jnp.where(size > 0, size, 1.0)
    kappa = acceleration_gain(k1, k2, dt)
    velocity = kappa / (1 + square / 18) * missing - k2 * xi  # for large |N| dt² it grows like x coth x
    return Correction(jnp.where(restarted, 1.0, k1), jnp.where(restarted, 0.0, velocity), restarted)


def step_result(correction: Correction, result: Code) -> Code:
    """Result code of a step: `result`, or `RESTARTED` if that is worse."""
    return jnp.where(correction.restarted, jnp.maximum(result, int(StepCode.RESTARTED)), result)
