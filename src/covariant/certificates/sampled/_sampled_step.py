"""Describes an intrinsic observer with sampled measurements on a region, for proofs.

Between samples the estimate follows the model; at a sample it is corrected. Lengths are measured by a metric that
depends on the age τ of the last measurement,

    M_τ = Θᵀ N_τ Θ,   N_τ = ½ R(τ) ⊗ g,   R(τ) = Σ_j R_j τ^j,

where Θ is the coframe (ξ, ζ) of the continuous observer. With `shear`, ζ is replaced by `ζ + τ K₀ξ`, where
`K₀ = R(·, v)v − ∇S` of the model without input. Two inequalities ensure that each predict–correct step shrinks lengths
by `e^(−μh)`:

    (P)  −(FᵀN_τ + Ṅ_τ + ∂N_τ/∂τ + N_τF) − 2μN_τ > 0        for the flow of the model, at all ages
    (C)  DC_hᵀ M_0(C_h x) DC_h < M_h(x)                      for the correction C_h by a measurement of age h

(P) is the inequality `contraction` for the flow of the model, with a metric that changes with time. In it, the sum w of
input force and friction, and the slopes −d of the friction, are variables of the box. So any force and any friction
within these bounds is covered, however steep, and however the input varies between samples. A lost sample makes the
next measurement older, and the gains account for its age.

Source: the argument is that of Theorem 1 of Aghannan & Rouchon 2003, for the composition of both maps.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array

from covariant.certificates.base import (
    ErrorSystem,
    Intrinsics,
    Point,
    Sampling,
    StateMetric,
    TwoByTwo,
    any_configuration,
    dimension,
    entries_read,
    friction_of,
    need_joint_friction,
    need_known,
    need_symmetry,
    with_model,
)
from covariant.certificates.sampled._prediction import Prediction, prediction_of
from covariant.certificates.sampled._sampled_body import body_matrix, body_metric, body_point, body_variables
from covariant.models import MechanicalSystem, acceleration, input_count, source
from covariant.observers import Intrinsic
from scalargraph.errors import InputError


def sampled_system(observer: Intrinsics, q: TwoByTwo, sampling: Sampling) -> ErrorSystem:
    """Describe an intrinsic observer with sampled measurements on a region, for `contraction` and `correction`.

    Args:
        observer: an `Intrinsic` in coordinates or on rotations, but no subclass.
        q: matrix R_0 (2, 2) of the metric right after a measurement.
        sampling: the samples and the metric between them.

    Returns:
        The flow between samples, the metric, and the correction, as functions of estimate, position error, input force,
        joint force, slopes of the friction, and age of the measurement.

    Raises:
        TypeError: another kind of observer.
        ValueError: a space, a force or a friction that is not covered.

    Example:
        >>> import numpy as np
        >>> from covariant import models, observers
        >>> from covariant.certificates import sampled_system
        >>> from covariant.certificates.base import Sampling
        >>> sampling = Sampling(np.array([0.01, 0.01]))
        >>> sampled_system(observers.Intrinsic(models.oscillator(), 2.0, 2.0), np.eye(2), sampling).names
        ('q', 'v_q', 'e_q', 'f_q', 'w_q', 'd_q', 'age')
    """
    if type(observer) is not Intrinsic:
        raise TypeError(
            f"certificates of the sampled step are about Intrinsic itself; got {type(observer).__name__}, whose step "
            "may be another one"
        )
    model = observer.model
    # Force and friction are variables of the box; their sum enters as the input.
    bare = with_model(observer, MechanicalSystem(model.space, model.potential, None, None))
    need_known(model)
    if not model.manifold.commuting:
        variables = body_variables(model)
        need_symmetry(model)
        _check_forces(model, len(model.velocities))
        in_body = body_point(observer, bare, variables, q, sampling)
        standing = functools.partial(in_body, running=0.0)
        return ErrorSystem(variables.names, variables.units, in_body, standing, has_samples=True)
    n = dimension(model)
    _check_forces(model, n)

    def at(z, running=1.0):
        place, velocity, error, force, total, drag, age = jnp.split(z, [k * n for k in range(1, 7)])

        def flow(t, x):
            # The joint force as a function of the velocity, with any slope of the friction within its bounds.
            joint_force = total - drag * (x[n:] - velocity)
            return jnp.concatenate([x[n:], acceleration(bare.model, t, x[:n], x[n:], joint_force)])

        def corrected(x):
            t = jnp.zeros((), z.dtype)
            return jnp.concatenate(bare.smooth_correction(t, x[:n], x[n:], force, place - error, age[0]))

        def missing(x):
            t = jnp.zeros((), z.dtype)
            return bare.missing_acceleration(t, x[:n], x[n:], force, place - error)[1]

        x = jnp.concatenate([place, velocity])
        metric = aged_metric(bare.model, q, sampling, age[0], running)
        return Point(
            flow,
            metric,
            x,
            lambda: metric.frame(jnp.zeros((), z.dtype), x),
            lambda: -jnp.eye(n, dtype=z.dtype),
            corrected,
            aged_metric(bare.model, q, sampling, jnp.zeros((), z.dtype), running),
            missing,
            lambda x: (model.space(x[:n]), model.space(place - error)),
        )

    names, units = model.coordinates, model.units or ("",) * n
    rates = tuple(f"{unit}/s" if unit else "" for unit in units)
    prefixes = ("", "v_", "e_", "f_", "w_", "d_")
    return ErrorSystem(
        (*(f"{prefix}{name}" for prefix in prefixes for name in names), "age"),
        (*units, *rates, *units, *("",) * (3 * n), "s"),
        at,
        # Each instant is the first instant of the box at another age.
        functools.partial(at, running=0.0),
        has_samples=True,
    )


def sampled_prediction(observer: Intrinsics, q: TwoByTwo, sampling: Sampling) -> Prediction:
    """Describe the Runge–Kutta steps between samples, for `defect_bound`."""
    model, system = observer.model, sampled_system(observer, q, sampling)
    n = len(model.coordinates or model.velocities)
    free = MechanicalSystem(model.space, model.potential, None, None)
    rubbed = MechanicalSystem(model.space, model.potential, None, functools.partial(friction_of, model))
    if model.manifold.commuting:
        return prediction_of(
            rubbed, n, system.names, system.units, lambda q0, age: aged_metric(free, q, sampling, age), lambda p: p
        )
    variables = body_variables(model)
    metric = functools.partial(body_metric, free, q, sampling)
    configuration = functools.partial(body_matrix, model, variables)
    return prediction_of(rubbed, n, system.names, system.units, metric, configuration)


def aged_metric(
    model: MechanicalSystem, q: Array | TwoByTwo, sampling: Sampling, age: Array, running: float = 1.0
) -> StateMetric:
    """Build the metric M_τ of an age that grows with time."""
    space = model.space

    def turn(t, x):
        """The lower left block of the coframe: Γ(v), and the shear."""
        position, v = jnp.split(x, 2)
        columns = jnp.eye(position.shape[0], dtype=x.dtype)
        block = jax.vmap(lambda a: space.connection(position, v, a), out_axes=1)(columns)
        if not sampling.shear:
            return block
        return block + (age + running * t) * jax.vmap(lambda a: _stiffness(model, position, v, a), out_axes=1)(columns)

    def coframe(t, x, sign=1.0):
        lower_left = jnp.asarray([[0.0, 0.0], [1.0, 0.0]], x.dtype)
        # The inverse of [[I, 0], [turn, I]] has −turn, hence the sign.
        return jnp.eye(x.shape[0], dtype=x.dtype) + sign * jnp.kron(lower_left, turn(t, x))

    def gram(t, x):
        return jnp.kron(sampling.at(q, age + running * t) / 2, space(jnp.split(x, 2)[0]))

    return StateMetric(coframe, lambda t, x: coframe(t, x, -1.0), gram)


def _stiffness(model: MechanicalSystem, q: Array, v: Array, a: Array) -> Array:
    """`K₀a = R(a, v)v − ∇_a S` of the model without input, as a choice of metric; any other field would be valid."""
    nothing = jnp.zeros_like(v)

    def free(at):
        return source(model, jnp.zeros((), at.dtype), at, nothing)

    value, change = jax.jvp(free, (q,), (a,))
    return model.space.curvature(q, a, v, v) - change - model.space.connection(q, a, value)


def _check_forces(model: MechanicalSystem, n: int) -> None:
    """Raise `ValueError` unless the force depends on the input alone, and the friction of a joint on its velocity."""
    q, u = any_configuration(model), jnp.zeros(input_count(model, n))
    read = entries_read(model.force, jnp.zeros(()), q, u)
    names = model.coordinates or [f"entry {i + 1} of the configuration" for i in range(q.size)]
    reads = ["time"] * (0 in read) + [name for i, name in enumerate(names) if 1 + i in read]
    if reads:
        raise InputError(
            f"the force of this model depends on {', '.join(reads)}; a certificate of the sampled step covers forces "
            "of the input alone"
        )
    need_joint_friction(model)
