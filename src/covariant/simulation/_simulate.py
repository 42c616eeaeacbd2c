"""Trajectories of a model, alone or with an observer attached in continuous time."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._integrate import solve
from covariant._typing import Number
from covariant.models import Lagrangian, acceleration
from covariant.observers import AbstractFlowObserver, continuous
from covariant.signals import Record

Input = Callable[[Array, Any], Array]
"""Input `(t, x) -> u (m,)`; it may feed the true state x back."""
Measurement = Callable[[Array, Array], Array]
"""Continuous measurement `(t, q) -> y`; by default q itself. For a `StateSpace` q is the output h."""
Controller = Callable[[Array, Array, Any], Array]
"""`(t, y, estimate) -> u (m,)`: what a controller makes of the measurement and of an observer's estimate."""


@functools.singledispatch
def simulate(
    model: Lagrangian,
    x0: Any,
    t: Float[Array, "T"],
    u: Input | None = None,
    *,
    rtol: float = 1e-10,
    atol: float = 1e-12,
) -> Record:
    """Integrate the model from x0 and record its noise-free state and inputs at the stamps t [s].

    x0 is (q, v) (2n,); for a `GroupSystem` it is a `Motion`, and so is the record's x, with y = g (T, N, N); for a
    `StateSpace` it is the state (n,), with y = h (T, p). Stamps that the motion does not reach, because it escapes
    before, are not finite.
    """
    push = u or no_input(model, x0.shape[0] // 2)
    x = solve(_plant(model, push), x0, t, rtol=rtol, atol=atol)
    return Record(t, jax.vmap(push)(t, x), x[:, : x.shape[1] // 2], x)


@functools.singledispatch
def observe(
    model: Lagrangian,
    observer: AbstractFlowObserver,
    x0: Any,
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
    """Integrate plant and observer as one system; returns the true states and the observer's, time first.

    With a `controller` the loop is closed: the input is what it makes of the measurement and the estimate, in place of
    u. Stamps after a breakdown, such as an observer escaping in finite time, are not finite in both. The true states of
    a `GroupSystem` are a `Motion`; the observer of a `StateSpace` sees `measure(t, h)`, and where a controller closes
    the loop h must not depend on the input.
    """
    n = x0.shape[0] // 2
    push = u or no_input(model, n)

    def flow(s, joint):
        x, state = joint
        y = measure(s, x[:n])
        now = push(s, x) if controller is None else controller(s, y, observer.estimate(state))
        return _plant(model, lambda *_: now)(s, x), observer.flow(s, state, now, y)

    return solve(flow, (x0, continuous(state0)), t, rtol=rtol, atol=atol, max_steps=max_steps)


def no_input(model: Lagrangian, n: int) -> Input:
    """Zero input of the size the model takes."""
    zero = jnp.zeros(n if model.inputs is None else model.inputs)
    return lambda t, x: zero


def hold(t: Float[Array, "T"], u: Float[Array, "T m"]) -> Input:
    """Recorded inputs, each held from its stamp to the next."""

    def held(s, x):
        return u[jnp.clip(jnp.searchsorted(t, s, side="right") - 1, 0, t.shape[0] - 1)]

    return held


def _plant(model: Lagrangian, push: Input):
    def flow(s, x):
        q, v = jnp.split(x, 2)
        return jnp.concatenate([v, acceleration(model, s, q, v, push(s, x))])

    return flow
