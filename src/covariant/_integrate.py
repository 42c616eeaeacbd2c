"""Numerical integration by Runge–Kutta methods with fixed steps.

The stages of a step run in a loop, so that the vector field is compiled once. This takes half a second, against several
seconds if the program contains it fourteen times. Here programs are compiled often, and few run for long.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

Flow = Callable[[Array, Any], Any]
"""A vector field `(t, x) -> dx/dt` over any pytree."""


def compiled(function: Callable) -> Callable:
    """Decorator that compiles a function once for all floating-point arguments, which are passed as arrays.

    For every other value in the arguments, such as an integer or a plain function, a separate program is compiled.

    Args:
        function: A function of pytrees.

    Returns:
        The compiled function, with the same arguments.
    """
    program = eqx.filter_jit(function)

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        arguments, named = jax.tree.map(_as_array, (arguments, named))
        return program(*arguments, **named)

    return call


def _as_array(leaf: Any) -> Any:
    # A Python float would be a constant of the program, and each new number would compile it again.
    return jnp.asarray(leaf) if isinstance(leaf, float | np.ndarray) else leaf


def rk4_step(flow: Flow, t, x, dt):
    """One classical Runge–Kutta step of fourth order."""

    real = jax.tree.leaves(x)[0].dtype
    # The first stage gets a zero slope, unused since `ahead` is 0 there, so that all four stages are one loop.
    ahead, weight = jnp.array([0.0, 0.5, 0.5, 1.0], real), jnp.array([1 / 6, 1 / 3, 1 / 3, 1 / 6], real)

    def stage(i, carry):
        total, slope = carry
        here = jax.tree.map(lambda a, b: a + ahead[i] * dt * b, x, slope)
        slope = flow(t + ahead[i] * dt, here)
        return jax.tree.map(lambda a, b: a + weight[i] * dt * b, total, slope), slope

    return jax.lax.fori_loop(0, 4, stage, (x, jax.tree.map(jnp.zeros_like, x)))[0]


def rk4(flow: Flow, t, x, dt, steps):
    """Advance a state by classical Runge–Kutta steps of fourth order."""
    real = jax.tree.leaves(x)[0].dtype
    # With strict type promotion, a traced integer cannot divide a real number.
    h = dt / jnp.asarray(steps, real)
    once = jax.jit(flow)  # traced once, not at each of the four slopes
    return jax.lax.fori_loop(0, steps, lambda i, y: rk4_step(once, t + jnp.asarray(i, real) * h, y, h), x)


def linearised(flow: Callable[[Any, Array], Array]) -> Flow:
    """Vector field of a state x (N,) and of its derivative D (N, k) by k numbers, `D' = J D`.

    A step of it has the derivative of the step of x exactly. J along the axes has zeros that derivatives along the
    columns of D have not, which is a third of the work for an arm.
    """

    def field(t, both):
        x, slope = both
        jacobian, rate = jax.jacfwd(lambda x: (flow(t, x),) * 2, has_aux=True)(x)
        return rate, jacobian @ slope

    return field


def rk8(flow: Flow, t, x, dt, steps: int = 1):
    """Advance a state by steps of Dormand and Prince's eighth-order method, for work offline."""
    start, unravel = jax.flatten_util.ravel_pytree(x)
    slope, h = flat(flow, unravel), dt / steps
    a, b, c = (jnp.asarray(part, start.dtype) for part in dormand_prince())

    def step(i, x):
        def stage(j, k):
            # Row j of A is zero from column j on, so that slopes not yet computed have no influence.
            return k.at[j].set(slope(t + (i + c[j]) * h, x + h * (a[j] @ k)))

        return x + h * (b @ jax.lax.fori_loop(0, len(b), stage, jnp.zeros((len(b), len(x)), x.dtype)))

    return unravel(jax.lax.fori_loop(0, steps, step, start))


@functools.cache
def dormand_prince() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coefficients of Dormand and Prince's eighth-order method."""
    import diffrax  # imported here, since only offline work needs this quarter of a second

    tableau = diffrax.Dopri8.tableau
    # The last stage is the slope at the end of the step, for the error estimate alone: its weight here is zero.
    count = len(tableau.b_sol) - 1
    a = np.stack([np.zeros(count), *(np.pad(row, (0, count - len(row))) for row in tableau.a_lower[:-1])])
    return a, tableau.b_sol[:-1], np.append(0.0, tableau.c[:-1])


def flat(flow: Flow, unravel: Callable[[Array], Any]) -> Callable[[Any, Array], Array]:
    """Vector field of the state as one array, traced only once, since tracing takes most of the compile time."""
    return jax.jit(lambda t, x: jax.flatten_util.ravel_pytree(flow(t, unravel(x)))[0])
