"""Numerical integration by Runge–Kutta methods: fixed steps that can be exported, and adaptive ones by diffrax.

The stages of a step run in a loop, so that the vector field is compiled once: half a second against several where it
stands in the program fourteen times. Programs are compiled far more often here than they run for long.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import optimistix as optx
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
    """Advance `x` by `dt` in `steps` equal steps of Dormand and Prince's eighth-order method, for work offline."""
    start, unravel = jax.flatten_util.ravel_pytree(x)
    slope, h = _flat(flow, unravel), dt / steps
    a, b, c = (jnp.asarray(part, start.dtype) for part in dormand_prince())

    def step(i, x):
        def stage(j, k):
            return k.at[j].set(slope(t + (i + c[j]) * h, x + h * (a[j] @ k)))

        return x + h * (b @ jax.lax.fori_loop(0, len(b), stage, jnp.zeros((len(b), len(x)), x.dtype)))

    return unravel(jax.lax.fori_loop(0, steps, step, start))


@functools.cache
def dormand_prince() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coefficients A (13, 13), the weights b (13,) of order eight, and the nodes c (13,).

    Without the last of the fourteen stages, which only estimates the error of the following step.
    """
    tableau = dfx.Dopri8.tableau
    count = len(tableau.b_sol) - 1
    a = np.stack([np.zeros(count), *(np.pad(row, (0, count - len(row))) for row in tableau.a_lower[:-1])])
    return a, tableau.b_sol[:-1], np.append(0.0, tableau.c[:-1])


def _flat(flow: Flow, unravel: Callable[[Array], Any]) -> Callable[[Any, Array], Array]:
    """The vector field of the state as one array, traced once by all that transforms it: most of the compile time."""
    return jax.jit(lambda t, x: jax.flatten_util.ravel_pytree(flow(t, unravel(x)))[0])


class _Steps(dfx.PIDController):
    """Steps by their error, with the start (t, x) of the last step beside the state of the controller."""

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order) -> Any:
        end, memory = super().init(terms, t0, t1, y0, dt0, args, func, error_order)
        return end, (memory, (t0, y0))

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state: Any) -> Any:
        memory, _ = controller_state
        *step, memory, result = super().adapt_step_size(t0, t1, y0, y1_candidate, args, y_error, error_order, memory)
        return *step, (memory, (t0, y0)), result


def _size(x: Array) -> Array:
    """Root of the mean square; infinite where that is not a number, which would shorten no step."""
    return jnp.nan_to_num(optx.rms_norm(x), nan=jnp.inf, posinf=jnp.inf)


class _Run(NamedTuple):
    """Where an adaptive solution ends, and where its last step began."""

    t: Array
    x: Array
    last: tuple[Array, Array]


def _run(
    slope: Callable[[Any, Array], Array], x0: Array, begin, end, shortest, *, rtol, atol, max_steps, event=None
) -> _Run:
    """From x0 to `end`, to an event, or to where steps become shorter than `shortest`."""
    solution: Any = dfx.diffeqsolve(
        dfx.ODETerm(lambda t, x, _: slope(t, x)),
        dfx.Dopri8(),
        begin,
        end,
        None,
        x0,
        saveat=dfx.SaveAt(t1=True, controller_state=True),
        stepsize_controller=_Steps(rtol, atol, _size, dtmin=shortest, force_dtmin=False),
        adjoint=dfx.ForwardMode(),
        event=event,
        max_steps=max_steps,
        throw=False,
    )
    return _Run(solution.ts[0], solution.ys[0], solution.controller_state[1])


def solve(
    flow: Flow, x0, ts: Float[Array, "T"], *, rtol: Number = 1e-10, atol: Number = 1e-12, max_steps: int = 200_000
):
    """Integrate adaptively (Dormand–Prince 8) and return `x` at every stamp of `ts`, time first.

    Steps end at the stamps. Where a solution escapes in finite time, or uses `max_steps` between two stamps, `x` is
    infinite at the remaining stamps. Differentiable forward.
    """
    start, unravel = jax.flatten_util.ravel_pytree(x0)
    slope = _flat(flow, unravel)

    # One run for each interval: stamps to save at are checked on the host, and no such program can be stored.
    def interval(x: Array, bounds: tuple[Array, Array]):
        begin, end = bounds
        escaped = ~jnp.all(jnp.isfinite(x))
        end = jnp.where(escaped, begin, end)
        # A step of four roundings of the time, shortened by a tenth, is rounded to four: it would be tried for ever.
        shortest = 10 * jnp.finfo(ts.dtype).eps * jnp.maximum(jnp.abs(begin), jnp.abs(end))
        run = _run(slope, x, begin, end, shortest, rtol=rtol, atol=atol, max_steps=max_steps)
        x = jnp.where(escaped | (run.t != end), jnp.inf, run.x)
        return x, x

    _, later = jax.lax.scan(interval, start, (ts[:-1], ts[1:]))
    return jax.vmap(unravel)(jnp.concatenate([start[None], later]))


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
    start, unravel = jax.flatten_util.ravel_pytree(x0)
    slope, zero, tiny = _flat(flow, unravel), jnp.zeros((), start.dtype), jnp.finfo(start.dtype).tiny

    def ahead(x: Array) -> Array:
        return zero + 1 if border is None else border(unravel(x))

    over = jax.jit(lambda x: stop(unravel(x)) | (ahead(x) <= 0))
    event = dfx.Event(lambda t, y, args, **_: over(y))
    run = _run(slope, start, zero, zero + jnp.inf, tiny, rtol=rtol, atol=atol, max_steps=max_steps, event=event)
    if border is None:
        return run.t, unravel(run.x)
    # The last step again, in part: the interpolation within a step is a hundred times less accurate than its end.
    t, x, (begin, before) = run
    across = (t != begin) & (ahead(x) <= 0)

    def within(share: Array) -> Array:
        return rk8(slope, begin, before, share * (t - begin))

    share = _root(lambda share: ahead(within(share)), ahead(before), across)
    return begin + jnp.where(across, share, 1.0) * (t - begin), unravel(jnp.where(across, within(share), x))


def _root(function: Callable[[Array], Array], start: Array, wanted: Array) -> Array:
    """Where in 0 … 1 the function, `start` at 0, changes its sign: by regula falsi with halved weights (Illinois)."""
    end = jnp.ones((), start.dtype)

    def closer(carry):
        a, at_a, b, at_b, tried = carry
        c = b - at_b * (b - a) / (at_b - at_a)
        at_c = function(c)
        between = at_c * at_b < 0
        return jnp.where(between, b, a), jnp.where(between, at_b, at_a / 2), c, at_c, tried + 1

    def going(carry):
        *_, value, tried = carry
        return wanted & (jnp.abs(value) > 1e-12 * start) & (tried < 50)

    first = jnp.zeros_like(end), start, end, function(end), jnp.zeros((), jnp.int32)
    return jax.lax.while_loop(going, closer, first)[2]
