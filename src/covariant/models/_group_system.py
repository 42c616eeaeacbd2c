"""A mechanical system whose configurations are a Lie group and whose kinetic energy is left-invariant.

Source: Maithripala, Berg & Dayawansa 2004, section II-D, equations (12)–(16); dissipation is an addition.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Inexact

from covariant._integrate import rk4_step
from covariant._typing import Element, Number, Scalar, Vector
from covariant.geometry.lie import AbstractGroup, LeftInvariant, munthe_kaas
from covariant.models._lagrangian import (
    FrozenDict,
    Parameter,
    acceleration,
    applied_force,
    check_shapes,
    energy,
    friction,
    input_itself,
    no_dissipation,
    source,
)


class Motion(NamedTuple):
    """Configuration g (N, N) and body velocity v (n,): `g' = g hat(v)`."""

    g: Inexact[Array, "*T N N"]
    v: Float[Array, "*T n"]


class GroupSystem(eqx.Module):
    """A system on a group: `g' = g v`, `I v' = ad*_v I v + force + dissipation`, all in the body.

    - `group`: such as `lie.SO3` or `lie.SE3`.
    - `inertia`: matrix (n, n), or an `AbstractInertia`; the twist of a motion is (v, ω).
    - `potential`: potential energy `g -> ()` [J], a smooth function of the matrix entries.
    - `force`: generalised force in the body `(t, g, u) -> (n,)` of the input u (m,); by default u itself.
    - `dissipation`: friction force in the body `(g, v) -> (n,)`, evaluated at the estimate by observers; it opposes v.
    - `velocities`, `units`: names and units of the components of v, for people.
    - `inputs`: number of inputs m where it is not n.
    - `parameters`: `Parameter` by name, for people.

    Raises `ValueError` when a function has the wrong shape.
    """

    metric: LeftInvariant
    potential: Callable[[Array], Array]
    force: Callable[[Array, Array, Array], Array]
    dissipation: Callable[[Array, Array], Array]
    velocities: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    inputs: int = eqx.field(static=True)
    parameters: dict[str, Parameter] = eqx.field(static=True)

    def __init__(
        self,
        group: AbstractGroup,
        inertia,
        potential: Callable[[Array], Array] | None = None,
        force: Callable[[Array, Array, Array], Array] | None = None,
        dissipation: Callable[[Array, Array], Array] | None = None,
        *,
        velocities: tuple[str, ...] = (),
        units: tuple[str, ...] = (),
        inputs: int | None = None,
        parameters: dict[str, Parameter] | None = None,
    ):
        n = group.dimension
        self.metric = LeftInvariant(group, inertia)
        self.potential = _no_potential if potential is None else potential
        self.force = input_itself if force is None else force
        self.dissipation = no_dissipation if dissipation is None else dissipation
        self.velocities = tuple(velocities) or tuple(f"v{i + 1}" for i in range(n))
        self.units = tuple(units) or ("",) * n
        self.inputs = n if inputs is None else inputs
        self.parameters = FrozenDict(parameters or {})
        if not len(self.velocities) == len(self.units) == n:
            raise ValueError(f"the group has {n} velocities; got {len(self.velocities)} names, {len(self.units)} units")
        _check(self)

    @property
    def group(self) -> AbstractGroup:
        return self.metric.group


def _no_potential(g):
    return jnp.zeros((), g.real.dtype)


def _check(system: GroupSystem) -> None:
    n = system.group.dimension
    g = jax.eval_shape(lambda: system.group.identity())
    v, u, t = (jax.ShapeDtypeStruct(shape, jnp.float64) for shape in ((n,), (system.inputs,), ()))
    functions = (
        ("potential", system.potential, (g,), ()),
        ("force", system.force, (t, g, u), (n,)),
        ("dissipation", system.dissipation, (g, v), (n,)),
    )
    check_shapes(functions, f"elements {g.shape} and {system.inputs} inputs", "this group")


def potential_force(system: GroupSystem, g: Element) -> Vector:
    """`f` with `<f, y> = −dU(g hat(y))`, in the body."""
    zero = jnp.zeros(system.group.dimension, g.real.dtype)
    return -jax.grad(lambda y: system.potential(g + g @ system.group.hat(y)))(zero)


@applied_force.register
def _(model: GroupSystem, t: Scalar, q: Element, u: Float[Array, "m"]) -> Vector:
    return model.force(t, q, u) + potential_force(model, q)


@source.register
def _(model: GroupSystem, t: Scalar, q: Element, u: Float[Array, "m"]) -> Vector:
    return model.metric.inertia.solve(applied_force(model, t, q, u))


@friction.register
def _(model: GroupSystem, q: Element, v: Vector) -> Vector:
    return model.metric.inertia.solve(model.dissipation(q, v))


@acceleration.register
def _(model: GroupSystem, t: Scalar, q: Element, v: Vector, u: Float[Array, "m"]) -> Vector:
    return model.metric.spray(v) + source(model, t, q, u) + friction(model, q, v)


@energy.register
def _(model: GroupSystem, q: Element, v: Vector) -> Scalar:
    return model.metric.inner(v, v) / 2 + model.potential(q)


def spatial_momentum(system: GroupSystem, g: Element, v: Vector) -> Vector:
    """`Ad*_{g⁻¹} I v`: the momentum as seen from outside, constant where no force acts."""
    return system.group.coadjoint_action(system.group.inverse(g), system.metric.inertia(v))


def body_velocity(system: GroupSystem, g: Element, momentum: Vector) -> Vector:
    """The body velocity v that has this spatial momentum at g."""
    return system.metric.inertia.solve(system.group.coadjoint_action(g, momentum))


def advance(
    system: GroupSystem,
    t: Number,
    motion: Motion,
    u: Callable[[Scalar, Motion], Array] | Float[Array, "m"],
    dt: Number,
    steps,
    rule=rk4_step,
) -> Motion:
    """Integrate the system over dt [s] in equal steps, under the input u (m,), held, or `(t, motion) -> u`.

    The configuration stays on the group. Beside it the unknown of each step is the momentum as seen from where the body
    was at its start: without forces it is constant, so that the momentum in the body keeps its Casimirs to rounding,
    whatever the step.
    """
    group, inertia = system.group, system.metric.inertia
    h = dt / jnp.asarray(steps, motion.v.dtype)

    def step(i, now):
        g0, momentum0 = now

        def flow(s, moved, momentum):
            g, v = g0 @ moved, inertia.solve(group.coadjoint_action(moved, momentum))
            held = u(s, Motion(g, v)) if callable(u) else u
            pull = applied_force(system, s, g, held) + system.dissipation(g, v)
            return v, group.coadjoint_action(group.inverse(moved), pull)

        begin = t + jnp.asarray(i, h.dtype) * h
        moved, momentum = munthe_kaas(group, flow, begin, group.identity(h.dtype), momentum0, h, 1, rule)
        return g0 @ moved, group.coadjoint_action(moved, momentum)

    g, momentum = jax.lax.fori_loop(0, steps, step, (motion.g, inertia(motion.v)))
    return Motion(g, inertia.solve(momentum))
