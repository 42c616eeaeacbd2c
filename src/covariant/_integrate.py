"""Numerical integration by Runge–Kutta methods: fixed steps that can be exported, and adaptive ones.

The stages of a step run in a loop, so that the vector field is compiled once: half a second against several where it
stands in the program fourteen times. Programs are compiled far more often here than they run for long.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._dormand_prince import ORDER, dormand_prince
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
    return unravel(jax.lax.fori_loop(0, steps, lambda i, y: _step(slope, t, y, h, i)[0], start))


def _flat(flow: Flow, unravel: Callable[[Array], Any]) -> Callable[[Any, Array], Array]:
    """The vector field of the state as one array, traced once by all that transforms it: most of the compile time."""
    return jax.jit(lambda t, x: jax.flatten_util.ravel_pytree(flow(t, unravel(x)))[0])


def _step(slope: Callable[[Any, Array], Array], t, x: Array, h, i=0) -> tuple[Array, Array]:
    """Where x is after step i of length h from t, and the estimate of the step's error."""
    a, b, difference, c = (jnp.asarray(part, x.dtype) for part in dormand_prince())

    def stage(j, k):
        return k.at[j].set(slope(t + (i + c[j]) * h, x + h * (a[j] @ k)))

    k = jax.lax.fori_loop(0, len(b), stage, jnp.zeros((len(b), x.shape[0]), x.dtype))
    return x + h * (b @ k), h * (difference @ k)


class _Walk(NamedTuple):
    """An adaptive solution on its way: where it is, the length of the next step, and the number of steps tried."""

    t: Array
    x: Array
    h: Array
    tried: Array


class _Adaptive(NamedTuple):
    """Steps whose estimated error is below `atol + rtol |x|`, in the mean square over the numbers of x.

    Source: Hairer, Nørsett & Wanner 1993, Solving Ordinary Differential Equations I, section II.4.
    """

    slope: Callable[[Any, Array], Array]
    rtol: Number
    atol: Number
    max_steps: int

    def size(self, error: Array, *x: Array) -> Array:
        scale = self.atol + self.rtol * functools.reduce(jnp.maximum, map(jnp.abs, x))
        # A length of zero has no derivative, and lengths of steps need none: a solution does not depend on them.
        return jnp.sqrt(jnp.mean(jax.lax.stop_gradient(error / scale) ** 2))

    def start(self, t: Array, x: Array, way: Array) -> _Walk:
        """At (t, x), bound to go by `way`, with a first step by the first two derivatives."""
        slope = self.slope(t, x)
        still, fast = self.size(x, x), self.size(slope, x)
        known = (still > 1e-5) & (fast > 1e-5)
        small = jnp.where(known, 0.01 * still / jnp.where(known, fast, 1.0), 1e-6)
        sign = jnp.where(way < 0, -1.0, 1.0).astype(t.dtype)
        bent = self.size(self.slope(t + sign * small, x + sign * small * slope) - slope, x) / small
        steep = jnp.maximum(fast, bent)
        h = jnp.where(steep > 1e-15, (0.01 / steep) ** (1 / ORDER), jnp.maximum(1e-6, 1e-3 * small))
        return _Walk(t, x, (sign * jnp.minimum(100 * small, h)).astype(t.dtype), jnp.zeros((), jnp.int32))

    def going(self, at: _Walk) -> Array:
        """Whether another step may be tried and moves on: the steps towards an escape become too short to."""
        return (at.tried < self.max_steps) & (at.t + at.h != at.t)

    def step(self, at: _Walk, end: Array) -> _Walk:
        """One more try, no further than `end`; a step whose error is too large changes h only."""
        last = jnp.abs(at.h) >= jnp.abs(end - at.t)
        h = jnp.where(last, end - at.t, at.h)
        x, error = _step(self.slope, at.t, at.x, h)
        size = self.size(error, at.x, x)
        good = size < 1  # not so where it is NaN
        factor = 0.9 * jnp.where(size > 0, size, 1e-9) ** (-1 / ORDER)
        factor = jnp.where(good, jnp.clip(factor, 1.0, 10.0), jnp.where(factor > 0.2, factor, 0.2))
        following = factor.astype(h.dtype) * h
        following = jnp.where(good & last & (jnp.abs(following) < jnp.abs(at.h)), at.h, following)
        t = jnp.where(good, jnp.where(last, end, at.t + h), at.t)
        return _Walk(t, jnp.where(good, x, at.x), following, at.tried + 1)


def solve(
    flow: Flow, x0, ts: Float[Array, "T"], *, rtol: Number = 1e-10, atol: Number = 1e-12, max_steps: int = 200_000
):
    """Integrate adaptively (Dormand–Prince 8) and return `x` at every stamp of `ts`, time first.

    Steps end at the stamps. Where a solution escapes in finite time, or `max_steps` are used up, `x` is infinite at the
    remaining stamps. Differentiable forward.
    """
    start, unravel = jax.flatten_util.ravel_pytree(x0)
    rule = _Adaptive(_flat(flow, unravel), rtol, atol, max_steps)

    def interval(at: _Walk, end: Array):
        at = jax.lax.while_loop(lambda at: (at.t != end) & rule.going(at), lambda at: rule.step(at, end), at)
        return at, jnp.where(at.t == end, at.x, jnp.inf)

    _, later = jax.lax.scan(interval, rule.start(ts[0], start, ts[-1] - ts[0]), ts[1:])
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
    rule = _Adaptive(_flat(flow, unravel), rtol, atol, max_steps)

    def ahead(x: Array) -> Array:
        return jnp.ones((), x.dtype) if border is None else border(unravel(x))

    def step(carry):
        _, at = carry
        return at, rule.step(at, jnp.full((), jnp.inf, at.t.dtype))

    def going(carry):
        before, at = carry
        moved = at.t != before.t
        return rule.going(at) & ~(moved & (stop(unravel(at.x)) | (ahead(at.x) <= 0)))

    first = rule.start(jnp.zeros((), start.dtype), start, jnp.ones((), start.dtype))
    before, at = jax.lax.while_loop(going, step, (first, first))
    if border is None:
        return at.t, unravel(at.x)
    across = (at.t != before.t) & (ahead(at.x) <= 0)
    length = at.t - before.t

    def within(share: Array) -> Array:
        return _step(rule.slope, before.t, before.x, share * length)[0]

    share = _root(lambda share: ahead(within(share)), ahead(before.x), across)
    return before.t + jnp.where(across, share, 1.0) * length, unravel(jnp.where(across, within(share), at.x))


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
