"""Adaptive integration by diffrax: to stamps, or to where a condition holds."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.flatten_util
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from covariant._integrate import Flow, flat, rk8
from covariant._typing import Number


class _Steps(dfx.PIDController):
    """Step size controller whose state also holds the start (t, x) of the last step."""

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order) -> Any:
        end, memory = super().init(terms, t0, t1, y0, dt0, args, func, error_order)
        return end, (memory, (t0, y0))

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state: Any) -> Any:
        memory, _ = controller_state
        *step, memory, result = super().adapt_step_size(t0, t1, y0, y1_candidate, args, y_error, error_order, memory)
        return *step, (memory, (t0, y0)), result


def _size(x: Array) -> Array:
    """Root mean square, infinite in place of NaN, which would not shorten the step."""
    return jnp.nan_to_num(optx.rms_norm(x), nan=jnp.inf, posinf=jnp.inf)


class _Run(NamedTuple):
    """Where an adaptive solution ends, and where its last step began."""

    t: Array
    x: Array
    last: tuple[Array, Array]


class _Limits(NamedTuple):
    """Tolerances of an adaptive integration, its largest number of steps, and the shortest step."""

    rtol: Number
    atol: Number
    max_steps: int
    shortest: Any


def _run(slope: Callable[[Any, Array], Array], x0: Array, span: tuple[Any, Any], limits: _Limits, event=None) -> _Run:
    """Integrate over a span of time from x0 to its end, to an event, or to where steps are shorter than allowed."""
    rtol, atol, max_steps, shortest = limits
    # Nothing is raised: callers compare the last time with the end of the span.
    solution: Any = dfx.diffeqsolve(
        dfx.ODETerm(lambda t, x, _: slope(t, x)),
        dfx.Dopri8(),
        *span,
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
    """Integrate adaptively (Dormand–Prince 8) with steps that end at the stamps, and return the state at every stamp;
    differentiable in forward mode."""
    start, unravel = jax.flatten_util.ravel_pytree(x0)
    slope = flat(flow, unravel)

    # One run for each interval: diffrax checks stamps to save at on the host, and such a program cannot be stored.
    def interval(x: Array, bounds: tuple[Array, Array]):
        begin, end = bounds
        escaped = ~jnp.all(jnp.isfinite(x))
        # An escaped state gets an interval of no length, which ends the loop at once.
        end = jnp.where(escaped, begin, end)
        # A step of four roundings of the time, shortened by a tenth, rounds back to four: it would be tried for ever.
        shortest = 10 * jnp.finfo(ts.dtype).eps * jnp.maximum(jnp.abs(begin), jnp.abs(end))
        run = _run(slope, x, (begin, end), _Limits(rtol, atol, max_steps, shortest))
        # A run that stopped before its end ran out of steps, or they became too short: it has no state at the stamp.
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
    """Integrate adaptively (Dormand–Prince 8) from time 0 to the end of the first step where `stop` holds, or to the
    point where `border` falls to zero."""
    start, unravel = jax.flatten_util.ravel_pytree(x0)
    slope, zero, tiny = flat(flow, unravel), jnp.zeros((), start.dtype), jnp.finfo(start.dtype).tiny

    def margin(x: Array) -> Array:
        return zero + 1 if border is None else border(unravel(x))

    ended = jax.jit(lambda x: stop(unravel(x)) | (margin(x) <= 0))
    event = dfx.Event(lambda t, y, args, **_: ended(y))
    run = _run(slope, start, (zero, zero + jnp.inf), _Limits(rtol, atol, max_steps, tiny), event)
    if border is None:
        return run.t, unravel(run.x)
    # The last step is repeated in part: interpolation within a step is a hundred times less accurate than its end.
    t, x, (begin, before) = run
    crossed = (t != begin) & (margin(x) <= 0)

    def partial_step(fraction: Array) -> Array:
        return rk8(slope, begin, before, fraction * (t - begin))

    fraction = _root(lambda fraction: margin(partial_step(fraction)), margin(before), crossed)
    end = begin + jnp.where(crossed, fraction, 1.0) * (t - begin)
    return end, unravel(jnp.where(crossed, partial_step(fraction), x))


def _root(function: Callable[[Array], Array], start: Array, wanted: Array) -> Array:
    """Root in [0, 1] of a function with the value `start` at 0, by regula falsi with halved weights (Illinois)."""
    end = jnp.ones((), start.dtype)

    def closer(carry):
        a, at_a, b, at_b, count = carry
        # The secant through both ends; b is always the latest point, so that the loop ends by the value there.
        c = b - at_b * (b - a) / (at_b - at_a)
        at_c = function(c)
        between = at_c * at_b < 0
        # Halving the value at an end that stays (Illinois) keeps the secant from stalling on one side.
        return jnp.where(between, b, a), jnp.where(between, at_b, at_a / 2), c, at_c, count + 1

    def unfinished(carry):
        *_, value, count = carry
        # Relative to the value at the start of the step, so that the scale of the border function has no influence.
        # The order of Illinois is 3^⅓ = 1.44, so that a dozen steps usually do; 50 end a search that rounding stalls.
        return wanted & (jnp.abs(value) > 1e-12 * start) & (count < 50)

    first = jnp.zeros_like(end), start, end, function(end), jnp.zeros((), jnp.int32)
    return jax.lax.while_loop(unfinished, closer, first)[2]
