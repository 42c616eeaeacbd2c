"""Converts models, observers and closed loops to `control.NonlinearIOSystem` of the package python-control.

Such a system takes and returns plain vectors, so the state of an observer, a pytree, is flattened into one vector.
"""

from typing import Any

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np

from covariant._optional import load_optional
from covariant._typing import Controller, Numbers
from covariant.models import StateSpace
from covariant.observers import AbstractFlowObserver, continuous


def plant(model: StateSpace, name: str = "plant") -> Any:
    """Convert a model to a `control.NonlinearIOSystem` from u to y.

    Args:
        model: The model.
        name: Name of the system.

    Raises:
        ImportError: The package python-control is not installed.

    Example:
        >>> import importlib.util
        >>> import jax.numpy as jnp
        >>> from covariant import codegen, models
        >>> f, h = lambda t, x, u: jnp.stack([x[1], u[0] - jnp.sin(x[0])]), lambda t, x, u: x[:1]
        >>> model = models.StateSpace(f, h, coordinates=("q", "v"), inputs=1)
        >>> if importlib.util.find_spec("control"):
        ...     assert codegen.plant(model).state_labels == ["q", "v"]
    """
    return _system(
        # Lambdas, since `jax.jit` hashes a bound method, and a model whose parameters are a dictionary has no hash.
        jax.jit(lambda t, x, u: model.f(t, x, u)),
        jax.jit(lambda t, x, u: model.h(t, x, u)),
        inputs=_inputs(model.inputs),
        outputs=list(model.outputs),
        states=list(model.coordinates),
        name=name,
    )


def observer_system(
    observer: AbstractFlowObserver, model: StateSpace, y0: Numbers, t0: float = 0.0, name: str = "observer"
) -> Any:
    """Convert an observer to a `control.NonlinearIOSystem` from (u, y) to its estimate, to be connected with `plant`.

    Args:
        observer: The observer.
        model: Model of the observer, which provides the names of the signals.
        y0: First measurement.
        t0: Its time [s].
        name: Name of the system, and prefix of its outputs.

    Returns:
        The system; its attribute `initial` is the flattened state `observer.init(y0, t0)`.

    Raises:
        ImportError: The package python-control is not installed.

    Example:
        >>> import importlib.util
        >>> import jax.numpy as jnp
        >>> from covariant import codegen, models, observers
        >>> f, h = lambda t, x, u: jnp.stack([x[1], u[0] - jnp.sin(x[0])]), lambda t, x, u: x[:1]
        >>> model = models.StateSpace(f, h, coordinates=("q", "v"), inputs=1)
        >>> observer = observers.Contracting(model, jnp.array([[3.0], [2.0]]), jnp.zeros(2))
        >>> if importlib.util.find_spec("control"):
        ...     system = codegen.observer_system(observer, model, [0.2])
        ...     assert system.output_labels == ["observer_q", "observer_v"]
    """
    start, unravel = jax.flatten_util.ravel_pytree(continuous(observer.init(jnp.asarray(y0, float), t0)))
    m = model.inputs

    @jax.jit
    def update(t, x, signals):
        # The first inputs are u, the others y, as in the labels below.
        return jax.flatten_util.ravel_pytree(observer.flow(t, unravel(x), signals[:m], signals[m:]))[0]

    @jax.jit
    def output(t, x, signals):
        return jnp.ravel(observer.estimate(unravel(x)))

    system = _system(
        update,
        output,
        inputs=[*_inputs(m), *model.outputs],
        outputs=[f"{name}_{c}" for c in model.coordinates],
        states=len(start),
        name=name,
    )
    system.initial = np.asarray(start)
    return system


def closed_loop(
    model: StateSpace,
    observer: AbstractFlowObserver,
    controller: Controller,
    y0: Numbers,
    t0: float = 0.0,
    name: str = "loop",
) -> Any:
    """Connect plant, observer and controller to a `control.NonlinearIOSystem` without inputs and with outputs x, x̂, u.

    Use it to examine a loop with tools of python-control, such as linearisation or simulation. Everything is in
    continuous time, so the observer must have a `flow`, such as `Contracting`. The measurement must not depend on the
    input. For a simulation alone, use `simulation.observe`.

    Args:
        model: The plant.
        observer: The observer of its state.
        controller: Function `(t, y, estimate) -> u`.
        y0: First measurement.
        t0: Its time [s].
        name: Name of the system.

    Returns:
        The system; its function `initial(x0)` gives the initial state for x0 and `observer.init(y0, t0)`.

    Raises:
        ImportError: The package python-control is not installed.

    Example:
        >>> import importlib.util
        >>> import jax.numpy as jnp
        >>> from covariant import codegen, models, observers
        >>> f, h = lambda t, x, u: jnp.stack([x[1], u[0] - jnp.sin(x[0])]), lambda t, x, u: x[:1]
        >>> model = models.StateSpace(f, h, coordinates=("q", "v"), inputs=1)
        >>> observer = observers.Contracting(model, jnp.array([[3.0], [2.0]]), jnp.zeros(2))
        >>> if importlib.util.find_spec("control"):
        ...     loop = codegen.closed_loop(model, observer, lambda t, y, estimate: -estimate[1:], [0.2])
        ...     assert loop.output_labels == ["q", "v", "q_hat", "v_hat", "u1"]
    """
    start, unravel = jax.flatten_util.ravel_pytree(continuous(observer.init(jnp.asarray(y0, float), t0)))
    n, zero = len(model.coordinates), jnp.zeros(model.inputs)

    def evaluate(t, stacked):
        x, state = stacked[:n], unravel(stacked[n:])
        # The controller computes u from y, so y is evaluated at u = 0: an output that depended on u would close an
        # algebraic loop.
        y = model.h(t, x, zero)
        estimate = observer.estimate(state)
        return x, state, y, estimate, controller(t, y, estimate)

    @jax.jit
    def update(t, stacked, _):
        x, state, y, _, u = evaluate(t, stacked)
        return jnp.concatenate([model.f(t, x, u), jax.flatten_util.ravel_pytree(observer.flow(t, state, u, y))[0]])

    @jax.jit
    def output(t, stacked, _):
        x, _, _, estimate, u = evaluate(t, stacked)
        return jnp.concatenate([x, jnp.ravel(estimate), u])

    names = model.coordinates
    system = _system(
        update,
        output,
        inputs=0,
        outputs=[*names, *(f"{c}_hat" for c in names), *_inputs(model.inputs)],
        states=n + len(start),
        name=name,
    )
    system.initial = lambda x0: np.concatenate([np.asarray(x0, float), np.asarray(start)])
    return system


def _inputs(count: int) -> list[str]:
    return [f"u{i + 1}" for i in range(count)]


def _system(update, output, **named) -> Any:
    package = load_optional("control", use="such a system needs the package", extra="control")

    def with_numpy(function):
        return lambda t, x, u, params: np.asarray(function(jnp.asarray(t, float), jnp.asarray(x), jnp.asarray(u)))

    return package.NonlinearIOSystem(with_numpy(update), with_numpy(output), **named)
