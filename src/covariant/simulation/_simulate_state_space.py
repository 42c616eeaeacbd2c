"""Simulation of state-space models, alone or with an observer that measures the output h along the motion."""

from typing import Any

import jax
from jaxtyping import Array, Float

from covariant._adaptive import solve
from covariant._integrate import compiled
from covariant._typing import Controller, Number, Vector
from covariant.models import StateSpace
from covariant.observers import AbstractFlowObserver, continuous
from covariant.signals import Record
from covariant.simulation._simulate import Input, Measurement, no_input, observe, position, simulate


@simulate.register(StateSpace)
@compiled
def _(
    model: StateSpace,
    x0: Vector,
    t: Float[Array, "T"],
    u: Input | None = None,
    *,
    rtol: Number = 1e-10,
    atol: Number = 1e-12,
) -> Record:
    input_at = u or no_input(model, x0)
    x = solve(lambda s, x: model.f(s, x, input_at(s, x)), x0, t, rtol=rtol, atol=atol)
    inputs = jax.vmap(input_at)(t, x)
    return Record(t, inputs, jax.vmap(model.h)(t, x, inputs), x)


@observe.register(StateSpace)
@compiled
def _(
    model: StateSpace,
    observer: AbstractFlowObserver,
    x0: Vector,
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
    input_at = u or no_input(model, x0)

    def flow(s, joint):
        x, state = joint
        now = input_at(s, x)
        # The measurement comes before the input of a controller, so h must not depend on the input then.
        y = measure(s, model.h(s, x, now))
        if controller is not None:
            now = controller(s, y, observer.estimate(state))
        return model.f(s, x, now), observer.flow(s, state, now, y)

    return solve(flow, (x0, continuous(state0)), t, rtol=rtol, atol=atol, max_steps=max_steps)
