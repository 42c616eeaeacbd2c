"""Computes Taylor coefficients of a JAX function of one number, by recurrences on its jaxpr, to bound remainders."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from scalargraph import LoweringError, stumpff
from scalargraph.errors import InputError
from scalargraph.graph import STUMPFF, Call, ClosedJaxpr, equations
from scalargraph.proofs.checker._plain import plain

Coefficients = list[Array]


def series(function: Callable[[Array], Array], order: int) -> Callable[[Array], Coefficients]:
    """The Taylor coefficients of a function at each point."""

    def coefficients(r: Array) -> Coefficients:
        closed = jax.make_jaxpr(plain(function))(r)
        start = [r, jnp.ones_like(r), *[jnp.zeros_like(r)] * (order - 1)][: order + 1]
        try:
            (result,) = _expand_body(ClosedJaxpr(closed.jaxpr, closed.consts), [start])
        except LoweringError as error:
            raise InputError(f"{error}") from error
        return _all(result, order + 1)

    return coefficients


def _all(x: Any, count: int) -> Coefficients:
    """The coefficients of a series, or of a constant."""
    return x if isinstance(x, list) else [jnp.asarray(x), *[jnp.zeros_like(x)] * (count - 1)]


def _expand_body(body: ClosedJaxpr, arguments: Sequence) -> list:
    known = dict(zip([*body.jaxpr.constvars, *body.jaxpr.invars], [*body.consts, *arguments], strict=True))

    def read(atom):
        return atom.val if hasattr(atom, "val") else known[atom]

    for eqn in equations(body.jaxpr):
        x = [read(atom) for atom in eqn.invars]
        moving = [a for a in x if isinstance(a, list)]
        if isinstance(eqn.form, Call):
            out = _expand_body(eqn.form.body, x)
        elif not moving:
            out = eqn.primitive.bind(*x, **eqn.params)
            out = out if eqn.primitive.multiple_results else [out]
        elif eqn.form is not None:
            raise InputError(f"the operation '{eqn.name}' has no known expansion")
        else:
            out = _apply_primitive(eqn, x, len(moving[0]))
        known |= dict(zip(eqn.outvars, out, strict=True))
    return [read(atom) for atom in body.jaxpr.outvars]


def _apply_primitive(eqn: Any, x: list, count: int) -> list[Coefficients]:
    """The coefficients of the results of a primitive."""
    # Comparisons that depend on the number are refused, so that every choice is the same for all numbers.
    if eqn.name in LINEAR:
        whole = [
            _all(a, count) if isinstance(a, list) or jnp.issubdtype(jnp.result_type(a), jnp.floating) else [a] * count
            for a in x
        ]
        each = [eqn.primitive.bind(*(a[k] for a in whole), **eqn.params) for k in range(count)]
        return [list(result) for result in zip(*each, strict=True)] if eqn.primitive.multiple_results else [each]
    if eqn.name in ("mul", "dot_general"):
        product = functools.partial(eqn.primitive.bind, **eqn.params)
        return [_product(_all(x[0], count), _all(x[1], count), product)]
    if eqn.name == "integer_pow" and eqn.params["y"] > 0:
        return [functools.reduce(_product, [x[0]] * eqn.params["y"])]
    if eqn.primitive is STUMPFF:
        return [_stumpff(eqn.params["k"], x[0])]
    if eqn.name in RULES:
        return [RULES[eqn.name](*(_all(a, count) for a in x))]
    raise InputError(f"the operation '{eqn.name}' has no known expansion")


def _sum(terms: Sequence[Array]) -> Array:
    return functools.reduce(jnp.add, terms)


def _product(a: Coefficients, b: Coefficients, product: Callable = jnp.multiply) -> Coefficients:
    return [_sum([product(a[j], b[k - j]) for j in range(k + 1)]) for k in range(len(a))]


def _quotient(a: Coefficients, b: Coefficients) -> Coefficients:
    c: Coefficients = []
    for k in range(len(a)):
        c.append((a[k] - _sum([b[j] * c[k - j] for j in range(1, k + 1)]) if k else a[0]) / b[0])
    return c


def _integral(start: Array, u: Coefficients, slope: Coefficients) -> Coefficients:
    """The series of y(u), from its first value and the series of dy/du, which is one order shorter."""
    higher = [_sum([j * u[j] * slope[k - j] for j in range(1, k + 1)]) / k for k in range(1, len(u))]
    return [start, *higher]


def _root(u: Coefficients) -> Coefficients:
    y = [jnp.sqrt(u[0])]
    for k in range(1, len(u)):
        inner = _sum([y[j] * y[k - j] for j in range(1, k)]) if k > 1 else 0.0
        y.append((u[k] - inner) / (2.0 * y[0]))
    return y


def _exponential(u: Coefficients) -> Coefficients:
    y = [jnp.exp(u[0])]
    for k in range(1, len(u)):
        y.append(_sum([j * u[j] * y[k - j] for j in range(1, k + 1)]) / k)
    return y


def _circle(u: Coefficients) -> tuple[Coefficients, Coefficients]:
    """The series of sine and cosine."""
    s, c = [jnp.sin(u[0])], [jnp.cos(u[0])]
    for k in range(1, len(u)):
        s.append(_sum([j * u[j] * c[k - j] for j in range(1, k + 1)]) / k)
        c.append(-_sum([j * u[j] * s[k - j] for j in range(1, k + 1)]) / k)
    return s, c


def _one_plus_square(u: Coefficients) -> Coefficients:
    square = _product(u, u)
    return [1.0 + square[0], *square[1:]]


def _stumpff(k: int, u: Coefficients) -> Coefficients:
    """The series of c_k by c_k' = (k c_(k+2) − c_(k+1))/2, one order shorter in each recursion."""
    if len(u) == 1:
        return [stumpff(k, u[0])]
    first, second = (_stumpff(k + i, u[:-1]) for i in (1, 2))
    slope = [(k * b - a) / 2.0 for a, b in zip(first, second, strict=True)]
    return _integral(stumpff(k, u[0]), u, slope)


LINEAR = {
    *("add", "sub", "neg", "add_any", "reduce_sum", "broadcast_in_dim", "reshape", "squeeze", "transpose"),
    *("concatenate", "rev", "slice", "split", "pad", "gather", "dynamic_slice", "expand_dims", "copy", "copy_p"),
    *("convert_element_type", "select_n"),
}
"""Primitives that are linear in all their real arguments together."""
RULES: dict[str, Callable] = {
    "div": _quotient,
    "square": lambda u: _product(u, u),
    "sqrt": _root,
    "rsqrt": lambda u: _quotient(_all(jnp.ones_like(u[0]), len(u)), _root(u)),
    "exp": _exponential,
    "log": lambda u: _integral(jnp.log(u[0]), u, _quotient(_all(jnp.ones_like(u[0]), len(u)), u)),
    "sin": lambda u: _circle(u)[0],
    "cos": lambda u: _circle(u)[1],
    "atan": lambda u: _integral(jnp.arctan(u[0]), u, _quotient(_all(jnp.ones_like(u[0]), len(u)), _one_plus_square(u))),
}
"""Series of the other primitives."""
