"""Keys of traced functions: different functions never share one, and equal functions have the same in every process."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend import core

from scalargraph import fingerprint, trace

X = jnp.array([0.3, -0.7, 1.1])
LAST_BIT = 1.0 + 2.0**-52
MATRIX = np.arange(9.0).reshape(3, 3)


def key(function, *arguments: Any) -> str | None:
    return fingerprint(trace(function, *(arguments or (X,))).jaxpr)


def closed_over(constant):
    return lambda x: x * constant


@jax.custom_jvp
def smooth(x):
    return jnp.abs(x)


smooth.defjvp(lambda p, t: (smooth(*p), t[0] * p[0]))


@jax.custom_jvp
def sharp(x):
    return jnp.abs(x)


sharp.defjvp(lambda p, t: (sharp(*p), t[0] * jnp.sign(p[0])))


def turns(count: int, step: float, reverse: bool = False):
    return lambda x: jax.lax.scan(lambda c, row: (c * step + row, c - row), x, jnp.ones((count, 3)), reverse=reverse)


def until(bound: float, factor: float = 2.0):
    return lambda x: jax.lax.while_loop(lambda c: jnp.sum(c) < bound, lambda c: factor * c, x)


def nested(constant: float, depth: int = 3):
    function = closed_over(constant)
    for _ in range(depth):
        function = jax.jit(function)
    return function


def padded(*config):
    return lambda x: jax.lax.pad(x, jnp.asarray(0.0), [config])


DIFFERENT = {
    "the last bit of a number": [closed_over(1.0), closed_over(LAST_BIT), closed_over(-1.0)],
    "the sign of zero": [closed_over(0.0), closed_over(-0.0)],
    "numbers that are none": [closed_over(np.nan), closed_over(np.inf), closed_over(-np.inf)],
    "subnormal numbers": [closed_over(5e-324), closed_over(1e-323)],
    "the last bit of an array": [closed_over(np.array([1.0, 2, 3])), closed_over(np.array([LAST_BIT, 2, 3]))],
    "an entry in the middle of a large array": [
        (lambda mark: lambda x: x.sum() * mark)(jnp.asarray(np.eye(1, 5000, at)[0])) for at in (2499, 2500)
    ],
    "the order of entries": [lambda x: MATRIX @ x, lambda x: MATRIX.T @ x, lambda x: x @ (MATRIX @ MATRIX)],
    "the shape of a constant": [
        (lambda ones: lambda x: jnp.sum(x[0] * ones))(jnp.ones(shape)) for shape in ((3,), (1, 3), (3, 1))
    ],
    "the type of a constant": [
        lambda x: x * jnp.asarray(np.array([1, 2, 3])).astype(float),
        lambda x: x * jnp.asarray(np.array([1, 2, 3], np.int32)).astype(float),
        lambda x: x * jnp.asarray(np.array([1, 2, 3], np.float32)).astype(float),
    ],
    "rounding to another type": [lambda x: x, lambda x: x.astype(np.float32).astype(float)],
    "operations": [jnp.sin, jnp.cos, jnp.tan, jnp.sinh, lambda x: x + x, lambda x: x * x, lambda x: x - x],
    "the order of operands": [lambda x: x[0] - x[1], lambda x: x[1] - x[0], lambda x: x[0] - x[2]],
    "the order of results": [lambda x: (x[0], x[1]), lambda x: (x[1], x[0]), lambda x: (x[0], x[0])],
    "an operation more": [lambda x: jnp.sin(x), lambda x: jnp.sin(jnp.sin(x)), lambda x: (jnp.sin(x), x)],
    "places": [lambda x: x[:2], lambda x: x[1:], lambda x: x[::2], lambda x: x[::-1], lambda x: jnp.roll(x, 1)],
    "entries at places": [lambda x: x.at[0].set(1.0), lambda x: x.at[1].set(1.0), lambda x: x.at[0].add(1.0)],
    "numbers within whole powers": [lambda x: x**2, lambda x: x**3, lambda x: x**-2],
    "kinds of rounding": [
        lambda x: jax.lax.round(x, jax.lax.RoundingMethod.AWAY_FROM_ZERO),
        lambda x: jax.lax.round(x, jax.lax.RoundingMethod.TO_NEAREST_EVEN),
    ],
    "padding": [padded(1, 0, 0), padded(0, 1, 0), padded(0, 0, 1)],
    "axes": [lambda x: jnp.outer(x, x).sum(0), lambda x: jnp.outer(x, x + 1).sum(1), lambda x: jnp.outer(x, x).max(0)],
    "products": [
        lambda x: jax.lax.dot_general(MATRIX, x, (((1,), (0,)), ((), ()))),
        lambda x: jax.lax.dot_general(MATRIX, x, (((0,), (0,)), ((), ()))),
    ],
    "deep inside": [nested(1.0), nested(LAST_BIT)],
    "how often a loop turns": [turns(3, 2.0), turns(4, 2.0), turns(3, LAST_BIT), turns(3, 2.0, reverse=True)],
    "until when a loop turns": [until(10.0), until(10.0 * LAST_BIT), until(10.0, 3.0)],
    "branches": [
        lambda x: jax.lax.cond(x[0] > 0, jnp.sin, jnp.cos, x),
        lambda x: jax.lax.cond(x[0] > 0, jnp.cos, jnp.sin, x),
        lambda x: jax.lax.cond(x[0] >= 0, jnp.sin, jnp.cos, x),
    ],
    "the derivative of a function with a rule": [jax.jacfwd(smooth), jax.jacfwd(sharp)],
    "the same variable or another": [lambda x: (x + 1) * (x + 1), lambda x: (lambda a, b: a * b)(x + 1, x + 2)],
    "nothing of the argument": [lambda x: jnp.zeros(3), lambda x: jnp.zeros(3) + 0 * x, lambda x: -jnp.zeros(3)],
}


@pytest.mark.parametrize("functions", DIFFERENT.values(), ids=DIFFERENT)
def test_different_functions_have_different_keys(functions):
    keys = [key(function) for function in functions]
    assert None not in keys
    assert len(set(keys)) == len(functions)


def test_arguments_of_other_types_and_shapes_have_other_keys():
    arguments = (X, X.astype(np.float32), X[:2], X[None], 1.0)  # a number of Python is of weak type
    keys = [key(jnp.negative, argument) for argument in arguments]
    assert len(set(keys)) == len(keys)
    weak, strong = (jax.ShapeDtypeStruct((), float, weak_type=weak) for weak in (True, False))
    assert key(jnp.negative, weak) != key(jnp.negative, strong)


def test_equal_functions_have_equal_keys():
    for functions in DIFFERENT.values():
        for function in functions:
            jax.clear_caches()
            first = key(function)
            jax.clear_caches()
            assert key(lambda x, function=function: function(x)) == first
    assert key(smooth) == key(sharp)  # the derivatives of these are not taken


def test_what_a_jaxpr_does_not_say_has_no_key():
    other = core.Primitive("sin")  # by the name of another
    other.def_impl(jnp.cos)
    other.def_abstract_eval(lambda x: x)
    spec = jax.ShapeDtypeStruct((3,), float)
    for function in (
        lambda x: jax.pure_callback(np.sin, spec, x),
        lambda x: jax.experimental.io_callback(np.sin, spec, x),
        lambda x: (jax.debug.print("{}", x), x)[1],
        lambda x: jax.lax.cond(x[0] > 0, lambda x: jax.pure_callback(np.sin, spec, x), jnp.cos, x),
        lambda x: jax.ffi.ffi_call("any", spec)(x),
        lambda x: other.bind(x),
        jax.jit(lambda x: other.bind(x)),
        lambda x: jax.random.normal(jax.random.key(0), (3,)) + x,
    ):
        assert key(function) is None


def test_what_goes_with_a_function_is_a_part_of_the_key():
    traced = trace(jnp.sin, X).jaxpr
    others = [
        (), ("a",), ("a", "b"), ("ab",), (("a", "b"),), (1,), (1.0,), (True,), ("1",), (None,), (b"a",), (1j,),
        (np.float64(1),), (np.float32(1),), (np.dtype(float),), ((),), ({"a": 1},), (np.ones(1),), (np.ones((1, 1)),),
    ]  # fmt: skip
    keys = [fingerprint(traced, *each) for each in others]
    assert None not in keys
    assert len(set(keys)) == len(keys)
    assert fingerprint(traced, object()) is None
    assert fingerprint(np.array([None])) is None
