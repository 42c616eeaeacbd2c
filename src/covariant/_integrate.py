"""Numerical integration: fixed-step methods that can be exported, and adaptive ones by diffrax.

Only this module uses diffrax, and it is imported on first use: it takes longer to load than the rest of this library.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._typing import Number

Flow = Callable[[Array, Any], Any]
"""A vector field `(t, x) -> dx/dt` over any pytree."""


def compiled(function: Callable) -> Callable:
    """The function compiled once for all floating-point numbers in its arguments, which are passed as arrays.

    For every other value in the arguments, such as an integer or a plain function, a separate program is compiled.
    """
    program = eqx.filter_jit(function)

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        arguments, named = jax.tree.map(_as_array, (arguments, named))
        return program(*arguments, **named)

    return call


def _as_array(leaf: Any) -> Any:
    return jnp.asarray(leaf) if isinstance(leaf, float | np.ndarray) else leaf


def rk4_step(flow: Flow, t, x, dt):
    """One classical Runge–Kutta step of fourth order."""

    real = jax.tree.leaves(x)[0].dtype
    ahead, weight = jnp.array([0.0, 0.5, 0.5, 1.0], real), jnp.array([1 / 6, 1 / 3, 1 / 3, 1 / 6], real)

    def stage(i, carry):
        total, slope = carry
        here = jax.tree.map(lambda a, b: a + ahead[i] * dt * b, x, slope)
        slope = flow(t + ahead[i] * dt, here)
        return jax.tree.map(lambda a, b: a + weight[i] * dt * b, total, slope), slope

    return jax.lax.fori_loop(0, 4, stage, (x, jax.tree.map(jnp.zeros_like, x)))[0]


def rk4(flow: Flow, t, x, dt, steps):
    """Advance `x` by `dt` in `steps` equal Runge–Kutta steps; `steps` is a Python int, or a traced integer."""
    real = jax.tree.leaves(x)[0].dtype
    h = dt / jnp.asarray(steps, real)
    once = jax.jit(flow)  # traced once, not at each of the four slopes
    return jax.lax.fori_loop(0, steps, lambda i, y: rk4_step(once, t + jnp.asarray(i, real) * h, y, h), x)


def rk8(flow: Flow, t, x, dt, steps: int = 1):
    """Advance `x` by `dt` in `steps` equal steps of Dormand and Prince's eighth-order method.

    The stages run in a loop, so the vector field is compiled once: quick to compile, for work offline.
    """
    flat, unravel = jax.flatten_util.ravel_pytree(x)
    a, b, c = (jnp.asarray(part, flat.dtype) for part in _tableau())
    h = dt / steps

    @jax.jit  # so that each transformation of the loops traces the field once: tracing is most of the compile time
    def slope(s, y):
        return jax.flatten_util.ravel_pytree(flow(s, unravel(y)))[0]

    def step(i, y):
        def stage(j, k):
            return k.at[j].set(slope(t + (i + c[j]) * h, y + h * (a[j] @ k)))

        k = jax.lax.fori_loop(0, len(b), stage, jnp.zeros((len(b), y.shape[0]), y.dtype))
        return y + h * (b @ k)

    return unravel(jax.lax.fori_loop(0, steps, step, flat))


@functools.cache
def _tableau() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Butcher coefficients (A, b, c) of Dormand and Prince's eighth-order method as dense arrays."""
    import diffrax

    tableau = diffrax.Dopri8().tableau
    stages = len(tableau.b_sol)
    a = np.zeros((stages, stages))
    for i, row in enumerate(tableau.a_lower, start=1):
        a[i, : len(row)] = row
    return a, np.asarray(tableau.b_sol), np.concatenate([[0.0], tableau.c])


def solve(
    flow: Flow, x0, ts: Float[Array, "T"], *, rtol: Number = 1e-10, atol: Number = 1e-12, max_steps: int = 200_000
):
    """Integrate adaptively (Dormand–Prince 8) and return `x` at every stamp of `ts`, time first.

    Where `max_steps` are used up, as when a solution escapes in finite time, `x` is infinite at the remaining stamps.
    """
    import diffrax

    start, unravel = jax.flatten_util.ravel_pytree(x0)
    solution = diffrax.diffeqsolve(
        _term(flow, unravel),
        diffrax.Dopri8(),
        t0=ts[0],
        t1=ts[-1],
        dt0=None,
        y0=start,
        saveat=diffrax.SaveAt(ts=ts),
        # Steps end at the stamps: interpolating between steps would cost a digit or two.
        stepsize_controller=diffrax.ClipStepSizeController(diffrax.PIDController(rtol=rtol, atol=atol), step_ts=ts),
        max_steps=max_steps,
        adjoint=diffrax.ForwardMode(),
        throw=False,
    )
    assert solution.ys is not None  # SaveAt(ts=...) always saves
    return jax.vmap(unravel)(solution.ys)


def solve_until(
    flow: Flow,
    x0,
    stop: Callable[[Any], Array],
    border: Callable[[Any], Array] | None = None,
    *,
    rtol: Number,
    atol: Number,
    max_steps: int,
):
    """Integrate adaptively (Dormand–Prince 8) from time 0 to the end of the first step where `stop(x)` holds, or to
    where `border(x)` falls to zero.

    Returns (t, x) there, or after `max_steps` steps where neither happens.
    """
    import diffrax
    import optimistix

    start, unravel = jax.flatten_util.ravel_pytree(x0)
    conditions = [lambda t, y, args, **_: stop(unravel(y))]
    if border is not None:
        conditions.append(lambda t, y, args, **_: border(unravel(y)))
    real = start.dtype  # of the times too, or single precision would be promoted to double
    solution = diffrax.diffeqsolve(
        _term(flow, unravel),
        diffrax.Dopri8(),
        t0=jnp.zeros((), real),
        t1=jnp.full((), jnp.inf, real),
        dt0=None,
        y0=start,
        saveat=diffrax.SaveAt(t1=True),
        stepsize_controller=diffrax.PIDController(rtol=rtol, atol=atol),
        event=diffrax.Event(conditions, None if border is None else optimistix.Newton(rtol=1e-9, atol=1e-12)),
        max_steps=max_steps,
        adjoint=diffrax.ForwardMode(),
        throw=False,
    )
    assert solution.ts is not None  # SaveAt(t1=True) always saves
    assert solution.ys is not None
    return solution.ts[0], unravel(solution.ys[0])


def _term(flow: Flow, unravel: Callable[[Array], Any]) -> Any:
    """The vector field for diffrax, of the state as one array: diffrax's programs grow with the number of arrays.

    It is traced once though diffrax calls it in several places."""
    import diffrax

    once = jax.jit(lambda t, x: jax.flatten_util.ravel_pytree(flow(t, unravel(x)))[0])
    return diffrax.ODETerm(lambda t, x, _: once(jnp.asarray(t), x))
