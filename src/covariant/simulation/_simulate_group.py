"""The same for systems on groups, integrated so that every configuration is on the group.

Source: Munthe-Kaas 1998, Runge–Kutta methods on Lie groups, with the eighth-order method of Dormand and Prince.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._integrate import solve
from covariant._typing import Number
from covariant.geometry.lie import Product, munthe_kaas
from covariant.models import GroupSystem, Motion, advance, body_velocity, friction, source, spatial_momentum
from covariant.observers import AbstractFlowObserver, continuous
from covariant.signals import Record
from covariant.simulation._simulate import Controller, Input, Measurement, observe, simulate

REACH = 0.5
"""How far a motion may go, as the fastest component of v times time [rad or m], before its chart is moved along."""


@simulate.register
def _(
    model: GroupSystem,
    x0: Motion,
    t: Float[Array, "T"],
    u: Input | None = None,
    *,
    rtol: Number = 1e-10,
    atol: Number = 1e-12,
) -> Record:
    push = u or (lambda s, x: jnp.zeros(model.inputs, x0.v.dtype))

    def interval(motion, bounds):
        start, end = bounds
        charts = _charts(end - start, motion.v)
        moved = advance(model, start, motion, push, end - start, charts, _adaptive(rtol, atol))
        return moved, moved

    after = jax.lax.scan(interval, x0, (t[:-1], t[1:]))[1]
    x = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), x0, after)
    return Record(t, jax.vmap(push)(t, x), x.g, x)


@observe.register
def _(
    model: GroupSystem,
    observer: AbstractFlowObserver,
    x0: Motion,
    state0: Any,
    t: Float[Array, "T"],
    u: Input | None = None,
    measure: Measurement = lambda t, q: q,
    *,
    rtol: Number = 1e-10,
    atol: Number = 1e-12,
    max_steps: int = 200_000,
    controller: Controller | None = None,
) -> tuple[Any, Any]:
    push = u or (lambda s, x: jnp.zeros(model.inputs, x0.v.dtype))
    both = Product((model.group, model.group))

    def flow(s, g, beside):
        momentum, state = beside
        actual, estimated = both.blocks(g)
        x = Motion(actual, body_velocity(model, actual, momentum))
        y, full = measure(s, x.g), state._replace(g=estimated)
        now = push(s, x) if controller is None else controller(s, y, observer.estimate(full))
        pull = model.metric.inertia(source(model, s, x.g, now) + friction(model, x.g, x.v))
        rate = model.group.coadjoint_action(model.group.inverse(x.g), pull)
        slope = observer.flow(s, full, now, y)
        return jnp.concatenate([x.v, slope.g]), (rate, slope._replace(g=None))

    def interval(carry, bounds):
        (start, end), (g, beside) = bounds, carry
        actual, estimated = both.blocks(g)
        v = body_velocity(model, actual, beside[0]), observer.estimate(beside[1]._replace(g=estimated)).v
        charts = _charts(end - start, jnp.concatenate(v))
        rule = _adaptive(rtol, atol, max_steps)
        moved = munthe_kaas(both, flow, start, g, beside, end - start, charts, rule)
        return moved, moved

    first = (both.join([x0.g, state0.g]), (spatial_momentum(model, *x0), continuous(state0)._replace(g=None)))
    after = jax.lax.scan(interval, first, (t[:-1], t[1:]))[1]
    g, (momentum, state) = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, after)
    actual, estimated = jax.vmap(both.blocks)(g)
    return Motion(actual, jax.vmap(lambda a, m: body_velocity(model, a, m))(actual, momentum)), state._replace(
        g=estimated
    )


def _charts(duration: Number, v: Array) -> Array:
    count = jnp.ceil(duration * jnp.max(jnp.abs(v)) / REACH)
    return jnp.clip(jnp.nan_to_num(count, nan=1.0), 1, 100_000).astype(jnp.int32)


def _adaptive(rtol: Number, atol: Number, max_steps: int = 200_000):
    """One step of `munthe_kaas`, as many of Dormand and Prince's as the tolerances ask for."""

    def rule(flow, t, x, dt):
        ends = jnp.stack([t, t + dt])
        return jax.tree.map(lambda a: a[-1], solve(flow, x, ends, rtol=rtol, atol=atol, max_steps=max_steps))

    return rule
