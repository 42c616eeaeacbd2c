"""Describes the virtual system of a contracting observer on a region, as functions of variables in a box.

Plant and observer both solve `y' = f(t, y, u(t)) + K(z − h(t, y))`, with the same u and z, however these are generated.
So the observer converges if that system contracts for given u and z. The paper's Theorem 2 also differentiates the
dependence of the input on the estimate; its condition is neither necessary nor sufficient.

Source: Jouffroy & Fossen 2004, Theorem 2, corrected.
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from covariant._typing import Numbers
from covariant.certificates.base import ErrorSystem, Point, StateMetric, in_coordinates
from covariant.observers import Contracting
from scalargraph.errors import InputError

OutputMetric = Callable[[Array, Array], Array]
"""`(z, x) -> M (n, n)`: a metric on states that may depend on the measured output."""


def virtual(observer: Contracting, metric: OutputMetric | Numbers) -> ErrorSystem:
    """Describe a contracting observer on any region, in a metric, for `contraction`, `prove` and `falsify`.

    The variables are the state x (n,), the input u (m,), the measurement z (p,) and its rate of change (p,), named `x`,
    `u_1`, `z_x`, `zdot_x` with x the name of a state or output.

    Args:
        observer: the observer, whose model names its states.
        metric: M (n, n), constant, or a function `(z, x) -> M` of measurement and state.

    Returns:
        Flow and metric as functions of these variables.

    Raises:
        ValueError: the states of the model have no names.

    Example:
        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> from covariant.certificates import virtual
        >>> from covariant.models import StateSpace
        >>> from covariant.observers import Contracting
        >>> model = StateSpace(lambda t, x, u: -x, lambda t, x, u: x, coordinates=("x",))
        >>> virtual(Contracting(model, jnp.eye(1), jnp.zeros(1)), np.eye(1)).names
        ('x', 'z_y1', 'zdot_y1')
    """
    model = observer.model
    if not model.coordinates:
        raise InputError("the model's states need names: StateSpace(..., coordinates=...)")
    n, m, p = len(model.coordinates), model.inputs, len(model.outputs)
    field = metric if callable(metric) else lambda z, x: jnp.asarray(np.asarray(metric), x.dtype)
    ends = (n, n + m, n + m + p)

    def at(point):
        x, u, measured, change = jnp.split(point, ends)

        def flow(t, y):
            # The measurement changes at a constant rate, since the condition concerns one instant, t = 0.
            return observer.virtual(t, y, u, measured + t * change)

        moving: StateMetric = in_coordinates(lambda t, y: field(measured + t * change, y))
        return Point(flow, moving, x)

    known = dict(zip(model.coordinates, model.units, strict=False))
    units = [known.get(name, "") for name in model.outputs]
    outputs = (f"{letter}_{name}" for letter in ("z", "zdot") for name in model.outputs)
    rates = (f"{unit}/s" if unit else "" for unit in units)
    return ErrorSystem(
        (*model.coordinates, *(f"u_{i + 1}" for i in range(m)), *outputs),
        (*(model.units or ("",) * n), *("",) * m, *units, *rates),
        at,
        # For a constant measurement the rate of change is set to zero.
        lambda point: at(jnp.concatenate([point[: ends[-1]], jnp.zeros(p, point.dtype)])),
    )
