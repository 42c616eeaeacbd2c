"""Describes an intrinsic observer with sampled measurements on rotations, in the body frame, for proofs.

The statement and its inequalities are those of `sampled_system`. The chart around an estimate is the retraction, with
coordinates θ, and everything is evaluated at θ = 0, to first order in θ. Unlike in continuous time, the force of the
potential is evaluated at the estimate, which moves. Hence the matrix entries of the estimate that a potential reads
are variables. As entries of a rotation they lie between −1 and 1; the proof covers all such numbers, whether or not
they belong to a rotation.

With the error e, y = ĝ exp(−e), a displacement θ of the estimate changes `−log(exp(−θ) exp(−e))` by `J_r(e)⁻¹θ`. The
correction moves ĝ to `ĝ exp(−k₁ξ)`. With `C₀ = exp(k₁ξ₀)` of the estimate without displacement, the displaced estimate
ends at the body displacement

    Ad(C₀) θ − k₁ J_r(−k₁ξ₀) (ξ − ξ₀)

from the one without displacement, since the body velocity of `exp(k₁ξ₀) exp(θ) exp(s)` is `Ad(exp(−s)) θ' + J_r(s) s'`.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from covariant._typing import Scalar, Vector
from covariant.certificates.base import Point, Sampling, StateMetric, TwoByTwo, entries_read
from covariant.geometry import differential
from covariant.geometry.lie import SO2, SO3
from covariant.models import MechanicalSystem, acceleration, source
from covariant.observers import Intrinsic, second_order
from scalargraph.errors import InputError


class BodyVariables(NamedTuple):
    """The variables of a box for a system on rotations.

    Attributes:
        entries: indices of the entries of the flattened matrix of the estimate that are variables.
        names: names of all variables.
        units: their units.
    """

    entries: tuple[int, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]


def body_variables(model: MechanicalSystem) -> BodyVariables:
    """Determine the variables of a region for a system on rotations."""
    manifold = model.manifold
    if manifold not in (SO2, SO3):
        raise InputError(
            "a certificate of the sampled step needs coordinates or rotations, SO2 or SO3; systems on "
            f"{type(manifold).__name__} are not covered"
        )
    origin = manifold.origin()
    used = {*entries_read(model.potential, origin)}
    used |= entries_read(lambda g: differential(manifold, model.potential, g), origin)
    # A displacement of the estimate changes each row of its matrix within itself, and never mixes two rows.
    rows = {k // origin.shape[1] for k in used}
    read = [k for k in range(origin.size) if k // origin.shape[1] in rows]
    named = ["g" + "".join(str(i + 1) for i in np.unravel_index(k, origin.shape)) for k in read]
    speeds, units = model.velocities, model.velocity_units
    angles = tuple(unit.removesuffix("/s") for unit in units)
    names = (*named, *speeds, *(f"{prefix}_{name}" for prefix in "efwd" for name in speeds), "age")
    return BodyVariables(tuple(read), names, (*("",) * len(read), *units, *angles, *("",) * (3 * len(speeds)), "s"))


def body_point(
    observer: Intrinsic, bare: Intrinsic, variables: BodyVariables, q: TwoByTwo, sampling: Sampling
) -> Callable[..., Point]:
    """Build the system on rotations as a function of a point of the box."""
    model, space, manifold = bare.model, bare.model.space, bare.model.manifold
    origin = manifold.origin()
    inertia = np.array(space(origin))
    n, count = len(inertia), len(variables.entries)

    def at(z, running=1.0):
        entries, rest = z[:count], z[count:-1]
        velocity, error, force, total, drag = jnp.split(rest, 5)
        age, still = z[-1], jnp.zeros((), z.dtype)
        g = _matrix(variables.entries, entries, origin.shape)

        def flow(t, x):
            theta, v = jnp.split(x, 2)
            # The joint force as a function of the velocity, with any slope of the friction within its bounds.
            acting = total - drag * (v - velocity)
            rate = acceleration(model, t, manifold.nudged(g, theta), v, acting)
            return jnp.concatenate([manifold.local_rate(origin, theta, v), rate])

        def deviation(theta):
            e = error + manifold.local_rate(origin, error, theta)
            return e if observer.order == 1 else second_order(space, origin, e)

        def lacking(x):
            theta, v = jnp.split(x, 2)
            xi, here = deviation(theta), manifold.nudged(g, theta)
            drive = bare.measured_acceleration(still, here, v, force, manifold.retract(g, -error), xi)
            return drive - source(model, still, here, force)

        def corrected(x):
            theta, v = jnp.split(x, 2)
            first, xi = deviation(jnp.zeros_like(theta)), deviation(theta)
            k1, _ = observer.sample_gains(age)
            group: Any = manifold
            turned = group.adjoint(group.exp(k1 * first), theta)
            moved = turned - manifold.frame_velocity(origin, -k1 * first, k1 * (xi - first))
            return jnp.concatenate([moved, bare.smoothly_moved(origin, v, xi, lacking(x), age).v])

        x = jnp.concatenate([jnp.zeros(n, z.dtype), velocity])
        metric = body_metric(model, q, sampling, g, age, running)

        def error_jacobian():
            rates = _each(functools.partial(manifold.local_rate, origin, error), n, z.dtype)
            rows = jnp.concatenate([rates, jnp.zeros((n, n), z.dtype)], axis=1)
            return jnp.concatenate([rows, metric.frame(still, x)[n:]])

        return Point(
            flow,
            metric,
            x,
            error_jacobian,
            lambda: -_each(functools.partial(manifold.local_rate, origin, -error), n, z.dtype),
            corrected,
            # After the correction the estimate is elsewhere. Without an age there is no shear, which would read it.
            body_metric(model, q, sampling._replace(shear=False), g, still, running),
            lacking,
            lambda x: (jnp.asarray(inertia, z.dtype), jnp.asarray(inertia, z.dtype)),
        )

    return at


def _matrix(indices: tuple[int, ...], entries: Vector, shape: tuple[int, ...]) -> Array:
    """The matrix with some given entries; the other entries, which are not used, are zero."""
    place = {k: i for i, k in enumerate(indices)}
    zero = jnp.zeros((), entries.dtype)
    flat = [entries[place[k]] if k in place else zero for k in range(int(np.prod(shape)))]
    return jnp.stack(flat).reshape(shape)


def _each(linear: Callable[[Vector], Array], n: int, dtype) -> Array:
    return jax.vmap(linear, out_axes=1)(jnp.eye(n, dtype=dtype))


def body_matrix(model: MechanicalSystem, variables: BodyVariables, entries: Vector) -> Array:
    """Build the matrix of an estimate from the entries that are variables."""
    return _matrix(variables.entries, entries, model.manifold.origin().shape)


def body_metric(
    model: MechanicalSystem, q: TwoByTwo, sampling: Sampling, g: Array, age: Scalar, running: float = 0.0
) -> StateMetric:
    """Build the metric M_τ of an age, in the chart around a configuration."""
    inertia = model.space(model.manifold.origin())
    space, manifold = model.space, model.manifold
    origin, n = manifold.origin(), len(inertia)

    def turn(t, x):
        """Maps body displacements to `Γ(v)`, and the shear."""
        theta, v = jnp.split(x, 2)
        block = _each(lambda e: space.connection(origin, e, v), n, x.dtype)
        if not sampling.shear:
            return block
        here = manifold.nudged(g, theta)
        return block + (age + running * t) * _each(lambda e: _stiffness(model, here, v, e), n, x.dtype)

    def coframe(t, x):
        body = _each(functools.partial(manifold.frame_velocity, origin, x[:n]), n, x.dtype)
        return jnp.block([[body, jnp.zeros((n, n), x.dtype)], [turn(t, x) @ body, jnp.eye(n, dtype=x.dtype)]])

    def frame(t, x):
        # [[E, 0], [TE, I]]⁻¹ = [[E⁻¹, 0], [−T, I]]; E maps the rate of θ to the body velocity.
        local = _each(functools.partial(manifold.local_rate, origin, x[:n]), n, x.dtype)
        return jnp.block([[local, jnp.zeros((n, n), x.dtype)], [-turn(t, x), jnp.eye(n, dtype=x.dtype)]])

    def gram(t, x):
        return jnp.kron(sampling.at(q, age + running * t) / 2, jnp.asarray(inertia, x.dtype))

    return StateMetric(coframe, frame, gram)


def _stiffness(model: MechanicalSystem, g: Array, v: Vector, a: Vector) -> Vector:
    """`K₀a = R(a, v)v − ∇_a S` of the model without input, as a choice of metric; any other field would be valid."""
    space, manifold = model.space, model.manifold
    nothing = jnp.zeros_like(v)

    def free(s):
        return source(model, jnp.zeros((), v.dtype), manifold.nudged(g, s), nothing)

    value, change = jax.jvp(free, (nothing,), (a,))
    return space.curvature(g, a, v, v) - change - space.connection(g, a, value)
