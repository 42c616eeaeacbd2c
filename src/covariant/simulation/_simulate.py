"""Simulates trajectories of a model, alone or with an observer attached in continuous time.

In coordinates the motion is one differential equation. In any other frame it is solved in a sequence of charts that
follow the motion, so every configuration stays on its manifold. Source: Munthe-Kaas 1998, Runge–Kutta methods on Lie
groups, here with the eighth-order method of Dormand and Prince.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._adaptive import solve
from covariant._integrate import compiled
from covariant._typing import Controller, Number, Vector
from covariant.models import MechanicalSystem, MomentumChart, Motion, StateSpace, acceleration, advance, input_count
from covariant.observers import AbstractFlowObserver, continuous
from covariant.signals import Record

Input = Callable[[Array, Any], Array]
"""Input `(t, x) -> u (m,)`; it may be a feedback of the true state x."""
Measurement = Callable[[Array, Array], Array]
"""Continuous measurement `(t, q) -> y`; by default q itself. For a `StateSpace`, q stands for the output h."""

CHART_SIZE = 0.5
"""Largest motion within one chart, as the fastest component of v times time [rad or m]."""


class _Plant(NamedTuple):
    """A model in the form that the integrator uses.

    Attributes:
        start: Initial velocity or state (n,); the input has the same size if the model states none.
        in_charts: Whether the motion is solved in a sequence of charts.
        output: `(t, x, u)` to the measured quantity: the configuration or the output h.
        slope: `(t, x, u)` to x', if the motion is one differential equation.
    """

    start: Vector
    in_charts: bool
    output: Callable[[Any, Any, Any], Array]
    slope: Callable[[Any, Any, Any], Array]


@functools.singledispatch
def _plant(model: MechanicalSystem, x0: Any) -> _Plant:
    def output(t, x, u):
        return model.motion(x).q

    def slope(t, x, u):
        q, v = model.motion(x)
        return jnp.concatenate([v, acceleration(model, t, q, v, u)])

    return _Plant(model.motion(x0).v, not model.manifold.commuting, output, slope)


@_plant.register
def _(model: StateSpace, x0: Vector) -> _Plant:
    return _Plant(x0, False, model.h, model.f)


@compiled
def simulate(
    model: MechanicalSystem | StateSpace,
    x0: Any,
    t: Float[Array, "T"],
    u: Input | None = None,
    *,
    rtol: Number = 1e-10,
    atol: Number = 1e-12,
) -> Record:
    """Integrate a model from an initial state, and record its noise-free state and inputs at the stamps.

    Use it as the truth in tests and studies: its tolerance is tight, and its y has no noise. Add a sensor by `stamps`
    and `sense`. The verb `covariant.simulate` does all of this for a model file. The input is a function of time and
    state; for a control loop that is closed through an observer, use `observe`.

    Args:
        model: A mechanical system, or a `StateSpace`.
        x0: Initial state: (q, v) (2n,) in coordinates, a `Motion` on another manifold; for a `StateSpace` the state
            (n,).
        t: Stamps (T,) [s].
        u: Input `(t, x) -> u (m,)`, zero by default.
        rtol: Relative tolerance of the integrator.
        atol: Absolute tolerance of the integrator.

    Returns:
        The record; its x has the form of x0, time first, with y = q; for a `StateSpace` y = h (T, p). If the motion
        escapes in finite time, rows at later stamps are not finite.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> from covariant.simulation import simulate
        >>> record = simulate(models.oscillator(), jnp.array([1.0, 0.0]), jnp.linspace(0.0, 1.0, 5))
        >>> record.x.shape, record.y.shape, round(float(record.y[-1, 0]), 3)
        ((5, 2), (5, 1), 0.54)
    """
    plant = _plant(model, x0)
    input_at = u or no_input(model, plant.start)
    if plant.in_charts:
        x = _simulate_in_charts(model, x0, t, input_at, _adaptive(rtol, atol))
    else:
        x = solve(lambda s, x: plant.slope(s, x, input_at(s, x)), x0, t, rtol=rtol, atol=atol)
    inputs = jax.vmap(input_at)(t, x)
    return Record(t, inputs, jax.vmap(plant.output)(t, x, inputs), x)


def _simulate_in_charts(model: Any, x0: Motion, t: Float[Array, "T"], input_at: Input, rule) -> Motion:
    def interval(motion, bounds):
        begin, end = bounds
        # A chart around a configuration is singular after a turn by 2π; this many charts keep displacements small.
        charts = _charts(end - begin, motion.v)
        moved = advance(model, begin, motion, input_at, end - begin, charts, rule)
        return moved, moved

    start = model.motion(x0)
    return _prepend(start, jax.lax.scan(interval, start, (t[:-1], t[1:]))[1])


def position(t, q):
    """Noise-free measurement of the whole configuration q at the time t, the default of `observe`."""
    return q


@compiled
def observe(
    model: MechanicalSystem | StateSpace,
    observer: AbstractFlowObserver,
    x0: Any,
    state0: Any,
    t: Float[Array, "T"],
    u: Input | None = None,
    measure: Measurement = position,
    *,
    rtol: Number = 1e-10,
    atol: Number = 1e-12,
    max_steps: int = 200_000,
    controller: Controller | None = None,
) -> tuple[Any, Any]:
    """Integrate plant and observer as one system in continuous time.

    It shows an observer without sampling, so that its error law can be compared with theory. Use it also for a control
    loop that is closed through the estimate. It needs an observer with a `flow`, which a Kalman filter with sampled
    measurements does not have. For the effects of sampling and noise use `observers.run` on a simulated log.

    Args:
        model: The plant, a mechanical system or a `StateSpace`.
        observer: An observer that has a `flow`.
        x0: Initial state of the plant, as in `simulate`.
        state0: Initial state of the observer, as from `observer.init`.
        t: Stamps (T,) [s].
        u: Input `(t, x) -> u (m,)`, zero by default.
        measure: Measurement `(t, q) -> y` in continuous time. The observer of a `StateSpace` receives `measure(t, h)`.
        rtol: Relative tolerance of the integrator.
        atol: Absolute tolerance of the integrator.
        max_steps: Largest number of integration steps between two stamps.
        controller: Closes the loop: the input is then `controller(t, y, estimate)` instead of u. The output h of a
            `StateSpace` must not depend on the input in this case.

    Returns:
        The true states, as in the record of `simulate`, and the observer's states, both with time first. After a
        breakdown, such as an observer that escapes in finite time, neither is finite.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> from covariant.simulation import observe
        >>> plant = models.oscillator()
        >>> observer = observers.Intrinsic(plant, 10.0, 50.0)
        >>> t = jnp.linspace(0.0, 5.0, 11)
        >>> x, state = observe(plant, observer, jnp.array([1.0, 0.0]), observer.init(jnp.array([0.5])), t)
        >>> bool(abs(x[-1, 1] - state.v[-1, 0]) < 1e-6)
        True
    """
    plant = _plant(model, x0)
    input_at = u or no_input(model, plant.start)

    def answer(s, x, state) -> tuple[Array, Any]:
        """The input, and the derivative of the observer's state."""
        now = input_at(s, x)
        # The controller needs the measurement first, so an output h must not depend on the input here.
        y = measure(s, plant.output(s, x, now))
        if controller is not None:
            now = controller(s, y, observer.estimate(state))
        return now, observer.flow(s, state, now, y)

    if plant.in_charts:
        rule = _adaptive(rtol, atol, max_steps)
        return _observe_in_charts(model, observer, answer, x0, continuous(state0), t, rule)

    def flow(s, joint):
        now, slope = answer(s, *joint)
        return plant.slope(s, joint[0], now), slope

    return solve(flow, (x0, continuous(state0)), t, rtol=rtol, atol=atol, max_steps=max_steps)


def _observe_in_charts(model: Any, observer: AbstractFlowObserver, answer, x0: Motion, state0, t, rule):
    """Integrate the plant, by its momentum, and the observer, each in a chart around its configuration at a step's
    start.
    """
    manifold = model.manifold

    def step(i, now, begin, h):
        q, momentum, state = now
        plant = MomentumChart(model, q)

        def flow(s, joint):
            (sigma, mu), moved, rest = joint
            x = plant.motion(sigma, mu)
            inputs, slope = answer(s, x, rest._replace(q=manifold.retract(state.q, moved)))
            # The velocity is in the frame at the estimate, but coordinates in the chart are integrated.
            turning = manifold.local_rate(state.q, moved, slope.q)
            return plant.flow(s, (sigma, mu), lambda *_: inputs)[0], turning, slope._replace(q=None)

        none = jnp.zeros_like(momentum)
        # The configuration is None, as it moves with the chart: only the displacement from its centre is integrated.
        first = (none, momentum), none, state._replace(q=None)
        (sigma, mu), moved, rest = rule(flow, begin + jnp.asarray(i, h.dtype) * h, first, h)
        return *plant.end(sigma, mu), rest._replace(q=manifold.retract(state.q, moved))

    def interval(now, bounds):
        begin, end = bounds
        q, momentum, state = now
        # The faster of plant and observer decides, since each moves in a chart of its own.
        v = jnp.concatenate([model.space.raise_(q, momentum), observer.estimate(state).v])
        charts = _charts(end - begin, v)
        h = (end - begin) / jnp.asarray(charts, v.dtype)
        moved = jax.lax.fori_loop(0, charts, lambda i, now: step(i, now, begin, h), now)
        return moved, moved

    first = (x0.q, model.space.lower(*x0), state0)
    q, momentum, state = _prepend(first, jax.lax.scan(interval, first, (t[:-1], t[1:]))[1])
    return Motion(q, jax.vmap(model.space.raise_)(q, momentum)), state


def no_input(model: MechanicalSystem | StateSpace, v: Float[Array, "n"]) -> Input:
    """Zero input of the size that a model needs.

    Args:
        model: A mechanical system, or a `StateSpace`.
        v: A velocity or state (n,); if the model states no number of inputs, it has n of them.

    Returns:
        A function `(t, x) -> u (m,)`.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> from covariant.simulation._simulate import no_input
        >>> no_input(models.ball_and_beam(), jnp.zeros(2))(0.0, None).tolist()
        [0.0]
    """
    return eqx.Partial(_zero, jnp.zeros(input_count(model, v.shape[-1]), v.dtype))


def _zero(zero, t, x):
    return zero


def hold(t: Float[Array, "T"], u: Float[Array, "T m"]) -> Input:
    """Recorded inputs as a function of time, each held constant from its stamp to the next.

    Args:
        t: Stamps (T,) [s].
        u: Inputs (T, m). Before the first stamp the first one acts, after the last one the last.

    Returns:
        A function `(t, x) -> u (m,)`, as `simulate` takes it.

    Example:
        >>> import numpy as np
        >>> from covariant.simulation import hold
        >>> hold(np.array([0.0, 1.0]), np.array([[2.0], [5.0]]))(0.9, None).tolist()
        [2.0]
    """
    return eqx.Partial(_zero_order_hold, jnp.asarray(t), jnp.asarray(u))


def _zero_order_hold(t, u, s, x):
    # side="right": at a stamp, the input of that stamp acts, not the one before.
    return u[jnp.clip(jnp.searchsorted(t, s, side="right") - 1, 0, t.shape[0] - 1)]


def _prepend(first: Any, after: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, after)


def _charts(duration: Number, v: Array) -> Array:
    # After an escape the velocity is not finite: such a motion gets one chart, or the most allowed, so that loops end.
    count = jnp.ceil(duration * jnp.max(jnp.abs(v)) / CHART_SIZE)
    return jnp.clip(jnp.nan_to_num(count, nan=1.0), 1, 100_000).astype(jnp.int32)


def _adaptive(rtol: Number, atol: Number, max_steps: int = 200_000):
    """A one-step method that makes as many Dormand–Prince steps as the tolerances require."""

    def rule(flow, t, x, dt):
        ends = jnp.stack([t, t + dt])
        return jax.tree.map(lambda a: a[-1], solve(flow, x, ends, rtol=rtol, atol=atol, max_steps=max_steps))

    return rule
