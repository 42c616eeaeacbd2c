"""Constant output-injection gains that make a copy of the plant contracting."""

from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np

from covariant._domains import FINITE, Finite, NotNegative, check_numbers
from covariant._typing import Numbers
from covariant.certificates import MetricDesign, observer_gain
from covariant.certificates.base import show_no_jumps
from covariant.models import StateSpace
from scalargraph import jacobian
from scalargraph.errors import InputError


@check_numbers
def contracting_gain(
    model: StateSpace,
    states: Annotated[Numbers, FINITE],
    rate: Finite,
    *,
    inputs: Annotated[Numbers, FINITE] | None = None,
    t: Finite = 0.0,
    effort: NotNegative = 1e-3,
) -> MetricDesign:
    """Constant gain K and metric M for `observers.Contracting`, from Jacobians of the model at chosen states.

    The virtual system is the copy of the plant with output injection; its Jacobians are taken at fixed input, and
    `certificates.observer_gain` solves the linear matrix inequalities. Needs `covariant[lmi]`.

    Args:
        model: State-space model with n states, m inputs and p outputs.
        states: States (k, n) at which the virtual system has to contract. Between them contraction has to be certified.
        rate: Rate [1/s] at which squared lengths decay at these states.
        inputs: Input (k, m) at each state; zero by default.
        t: Time [s] passed to the model.
        effort: Weight of the norm of MK beside the condition number of M, as for `certificates.observer_gain`.

    Returns:
        The design: gain K (n, p), metric M (n, n), its condition number, and the statement. It is undecided if f or h
        may jump between the states, and "sampled" if they have no graph, so that JAX has to differentiate them.

    Raises:
        ValueError: The states or inputs do not fit the model, or no gain attains the rate.

    Example:
        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> from covariant.calibration import contracting_gain
        >>> from covariant.models import StateSpace
        >>> pendulum = StateSpace(
        ...     lambda t, x, u: jnp.stack([x[1], -9.81 * jnp.sin(x[0])]), lambda t, x, u: x[:1], coordinates=("q", "v")
        ... )
        >>> design = contracting_gain(pendulum, [[0.0, 0.0], [np.pi, 0.0]], rate=2.0)
        >>> design.gain.shape, bool(np.linalg.eigvalsh(design.metric).min() > 0)
        ((2, 1), True)
    """
    x = np.atleast_2d(np.asarray(states, float))
    n = len(model.coordinates) or x.shape[1]
    if x.ndim != 2 or x.shape[1] != n:
        raise InputError(f"states must have the shape (k, {n}); got {np.shape(states)}")
    u = np.zeros((len(x), model.inputs)) if inputs is None else np.asarray(inputs, float)
    if u.shape != (len(x), model.inputs):
        raise InputError(f"inputs must have the shape ({len(x)}, {model.inputs}), one row a state; got {u.shape}")
    time = jnp.asarray(t)

    def jacobians(x, u):
        return jacobian(lambda x: model.f(time, x, u), x), jacobian(lambda x: model.h(time, x, u), x)

    f, h = jax.jit(jax.vmap(jacobians))(jnp.asarray(x), jnp.asarray(u))
    design = observer_gain(np.asarray(f), np.asarray(h), rate, effort=effort)
    names = (*(model.coordinates or (f"x{i + 1}" for i in range(n))), *(f"u{i + 1}" for i in range(model.inputs)))
    premises = (
        premise
        for what, function in (("f", model.f), ("h", model.h))
        for premise in show_no_jumps(what, lambda x, u, function=function: function(time, x, u), (x, u), names)
    )
    statement = design.statement
    return design._replace(statement=statement._replace(hypotheses=(*statement.hypotheses, *premises)))
