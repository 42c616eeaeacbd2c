"""What is not defined somewhere in the region proves nothing there, however much it cancels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import Case, line, proved, verdict

from scalargraph.proofs import box

LINE = box(x=(-1.0, 1.0))

# Each operation by itself is tried in `tests/scalargraph/test_conditions.py`.
UNDEFINED = {
    "zero times a root": lambda xp, x: 1 + 0 * xp.sqrt(x),
    "a root less itself": lambda xp, x: 1 + xp.sqrt(x) - xp.sqrt(x),
    "a root to the power nought": lambda xp, x: xp.sqrt(x) ** 0,
    "zero times an inverse": lambda xp, x: 1 + 0 * (1 / x),
    "zero over itself": lambda xp, x: 1 + 0 * (x / x),
    "a quotient with itself": lambda xp, x: x / x,
    "sum taken back": lambda xp, x: 1 + ((1 / x + 3) - 3) * 0,
    "difference taken back": lambda xp, x: 1 + (1 / x - (1 / x - 1)) * 0 + (xp.log(x) + 1) - xp.log(x),
    "zero times a logarithm": lambda xp, x: 1 + 0 * xp.log(x),
    "zero times a tangent": lambda xp, x: 1 + 0 * xp.tan(2 * x),
    "zero times a negative root": lambda xp, x: 1 + 0 * (x * x) ** -0.5,
    "a chosen half": lambda xp, x: xp.where(x * x >= 0, 1.0, 2.0) + 0 * xp.sqrt(x),
    "not a number, chosen never but once": lambda xp, x: xp.where(x == 0.25, xp.nan, 1.0),
    "a constant that is no number": lambda xp, x: 1 + 0 * xp.array(xp.nan) * x,
    "a constant without bound": lambda xp, x: 1 + 0 * xp.array(xp.inf) + 0 * x,
    "zero times an infinite": lambda xp, x: 1 + 0 * (xp.array(xp.inf) * (x + 3)),
    "infinite less infinite": lambda xp, x: 1 + xp.minimum(0 * x, xp.array(xp.inf) - xp.array(xp.inf)),
    "a root in both branches": lambda xp, x: xp.where(x > 5, xp.sqrt(x), xp.sqrt(x)) * 0 + 1,
    "a root of what is all but positive": lambda xp, x: 1 + 0 * xp.sqrt(x * x - 1e-9),
    "an inverse of what is all but positive": lambda xp, x: 1 + 0 / (x * x - 1e-9),
    "a root below zero at one end": lambda xp, x: 1 + 0 * xp.sqrt(1 - x * (1 + 1e-9)),
    "a logarithm of nought at one end": lambda xp, x: 1 + 0 * xp.log(1 - x),
    "an inverse at one end": lambda xp, x: 1 + 0 / (x + 1),
}


UNDEFINED |= {
    "zero times a chosen infinity": lambda xp, x: 1 + 0 * xp.where(x > -5, xp.inf, 1.0),
    "zero times a chosen no number": lambda xp, x: 1 + 0 * xp.where(x > -5, xp.nan, 1.0),
    "a chosen infinity less itself": lambda xp, x: 1 + xp.where(x > -5, xp.inf, x) - xp.where(x > -5, xp.inf, x),
    "zero times the smaller": lambda xp, x: 1 + 0 * xp.minimum(x, -xp.inf),
    "zero times the larger": lambda xp, x: 1 + 0 * xp.maximum(x, xp.inf),
    "the larger less itself": lambda xp, x: 1 + xp.maximum(x, xp.inf) - xp.maximum(x, xp.inf),
    "zero times a clip": lambda xp, x: 1 + 0 * xp.clip(x, xp.inf, xp.inf),
    "zero times a sum with an infinity": lambda xp, x: 1 + 0 * (xp.minimum(x, -xp.inf) + x),
    "an inverse of an infinity": lambda xp, x: 1 + 0 * (x / xp.maximum(x, xp.inf)) * xp.maximum(x, xp.inf),
}
"""An infinity that is chosen, not computed."""
UNSEEN = {"a root to the power nought", "zero times a tangent", "an inverse of what is all but positive"}
"""Where NumPy lets it pass, or no double is where it happens."""


def at(function, x: float) -> float:
    with np.errstate(all="ignore"):
        return float(function(np, np.array(x)))


def everywhere(function) -> np.ndarray:
    """Values at the ends, at places with short digits, and at many others of ±1."""
    places = np.concatenate([[-1.0, 1.0, 0.0, 0.25, -0.5], np.linspace(-1, 1, 201), 10.0 ** -np.arange(1, 9)])
    return np.array([at(function, x) for x in places])


@pytest.mark.parametrize("name", UNDEFINED)
def test_what_is_not_defined_everywhere_is_never_proved(name):
    function = UNDEFINED[name]
    values = everywhere(function)
    assert name in UNSEEN or not np.isfinite(values).all()
    assert proved(lambda z: jnp.reshape(function(jnp, z[0]), (1, 1)), LINE) != "holds"


LIES = {
    "finite, is it": lambda xp, x: xp.where(xp.isfinite(xp.maximum(x, xp.inf)), 1.0, -1.0),
    "a number, is it": lambda xp, x: xp.where(xp.isnan(xp.where(x > -5, xp.nan, 1.0)), -1.0, 1.0),
    "a number made of none": lambda xp, x: xp.nan_to_num(xp.where(x > -5, xp.nan, 1.0), nan=-1.0),
    "the root, is it a number": lambda xp, x: xp.where(xp.isnan(xp.sqrt(x - 9)), -1.0, 1.0),
    "the quotient, is it finite": lambda xp, x: xp.where(xp.isfinite(1 / (x - x)), 1.0, -1.0),
    "the overflow, is it finite": lambda xp, x: xp.where(xp.isfinite(xp.array(1e308) * 10 + x), 1.0, -1.0),
}


@pytest.mark.parametrize("name", LIES)
def test_asking_whether_a_number_is_one_is_no_proof_that_it_is(name):
    function = LIES[name]
    assert (everywhere(function) == -1).all()
    assert proved(lambda z: jnp.reshape(function(jnp, z[0]), (1, 1)), LINE) != "holds"


def without_rule(x):
    return jax.lax.stop_gradient(jnp.sqrt(x)) * 0 + 1


OF_JAX = {
    "behind stop_gradient": without_rule,
    "in a loop": lambda x: jax.lax.fori_loop(0, 2, lambda i, s: s + 0 * jnp.sqrt(x), 1.0),
    "in a scan": lambda x: jax.lax.scan(lambda s, w: (s + 0 * w / x, s), 1.0, jnp.ones(2))[0],
    "in a branch": lambda x: jax.lax.cond(True, lambda: 1 + 0 * jnp.log(x), lambda: 2.0),
    "in a jitted part": lambda x: 1 + 0 * jax.jit(jnp.arccosh)(x),
    "rsqrt": lambda x: 1 + 0 * jax.lax.rsqrt(x),
    "cube root at nought": lambda x: 1 + jax.grad(jnp.cbrt)(x) * 0,
    "a derivative of a root": lambda x: 1 + jax.grad(jnp.sqrt)(x) * 0,
    "an angle at the origin": lambda x: 1 + jax.grad(lambda y: jnp.arctan2(y, y))(x) * 0,
    "a length at nought": lambda x: 1 + jax.grad(lambda y: jnp.linalg.norm(y))(x[None])[0] * 0,
    "past the end of a table": lambda x: (1 + 0 * x) * jnp.array([1.0, 1.0]).at[7].get(mode="fill"),
    "logsumexp of nothing": lambda x: 1 + 0 * jnp.max(jnp.array([-jnp.inf, -jnp.inf])) + 0 * x,
}


@pytest.mark.core(7)
@pytest.mark.parametrize("name", OF_JAX)
def test_what_jax_does_not_define_is_never_proved(name):
    function = OF_JAX[name]
    with np.errstate(all="ignore"):
        assert not all(np.isfinite(float(function(jnp.asarray(x)))) for x in (-1.0, 0.0, 0.5))
    assert proved(lambda z: jnp.reshape(function(z[0]), (1, 1)), LINE) != "holds"


OVERFLOWING = {
    "exp of much": lambda xp, x: 1 + 0 * xp.exp(800 * x),
    "exp of much, cancelled": lambda xp, x: 1 + xp.exp(800 * x) - xp.exp(800 * x),
    "product of much": lambda xp, x: 1 + 0 * (1e200 * x * 1e200 * x),
    "sinh": lambda xp, x: 1 + 0 * xp.sinh(1000 * x),
    "inverse of little": lambda xp, x: 1 + 0 / (5e-324 * (x + 2)),
}


@pytest.mark.parametrize("name", OVERFLOWING)
def test_what_overflows_is_no_accident(name):
    """As real numbers these are one; as numbers of the machine they are none. Either answer is right, but no error."""
    function = OVERFLOWING[name]
    assert proved(lambda z: jnp.reshape(function(jnp, z[0]), (1, 1)), LINE) != "fails"


FALSE_BY_OVERFLOW = {
    "less than nothing": lambda xp, x: 1e-300 * x - 1e-310,
    "denormals": lambda xp, x: -5e-324 + 0 * x,
    "a quotient of denormals": lambda xp, x: -(5e-324 / (1e-310 * (x + 3))),
    "minus a product that underflows": lambda xp, x: -((1e-200 * (x + 3)) * 1e-200),
    "zero by underflow": lambda xp, x: (1e-200 * (x + 3)) * 1e-200 * 0,
    "minus infinity": lambda xp, x: -xp.exp(800 * (x + 2)),
}


@pytest.mark.parametrize("name", FALSE_BY_OVERFLOW)
def test_numbers_that_are_not_positive_are_never_proved(name):
    function = FALSE_BY_OVERFLOW[name]
    assert proved(lambda z: jnp.reshape(function(jnp, z[0]), (1, 1)), LINE) != "holds"


FRICTION = {
    "zero times a chosen infinity": lambda xp, x, v: -v + 0 * xp.where(x > -5, xp.inf, 1.0),
    "zero times a root": lambda xp, x, v: -v + 0 * xp.sqrt(v),
    "zero times a root of the place": lambda xp, x, v: -v + 0 * xp.sqrt(x),
    "an inverse less itself": lambda xp, x, v: -v + 1 / v - 1 / v,
    "a quotient with itself": lambda xp, x, v: -v * (v / v),
    "a root beyond the estimates": lambda xp, x, v: -v + 0 * xp.sqrt(1.05 - x),
    "a logarithm of the speed": lambda xp, x, v: -v + 0 * xp.log(xp.abs(v)),
    "a pole of the tangent": lambda xp, x, v: -v - 0.01 * xp.tan(2 * x),
    "square root friction": lambda xp, x, v: -v - xp.sqrt(v),
    "cube root friction": lambda xp, x, v: -v - 0 * xp.abs(v) ** (-1 / 3),
}


@pytest.mark.core(3)
@pytest.mark.parametrize("name", FRICTION)
def test_friction_that_is_not_defined_everywhere_is_never_proved(name):
    """Where an estimate may be, within the error of the bounds, the friction is not a number, or has no bound."""
    law = FRICTION[name]
    x, v = np.meshgrid([-1.0, 0.0, np.pi / 4, 1.1], [-1.0, 0.0])
    with np.errstate(all="ignore"):
        assert np.abs(np.nan_to_num(law(np, x, v), nan=1e20)).max() > 1e10
    assert verdict(line(law), **Case(law).bounds()) != "holds"


@pytest.mark.parametrize(
    "force",
    [
        lambda t, q, u: u + 0 * jnp.sqrt(q),
        lambda t, q, u: u + 0 / q,
        lambda t, q, u: u + 0 * jnp.log(u),
        lambda t, q, u: u + 0 * jnp.sqrt(t - 1),
        lambda t, q, u: u / jnp.where(q > 2, 1.0, 0.0),
        lambda t, q, u: u + jnp.nan * 0,
    ],
    ids=["root of the place", "inverse of the place", "logarithm of the input", "time", "constant", "no number"],
)
def test_forces_that_are_not_defined_everywhere_are_never_proved(force):
    observer = line(lambda xp, x, v: -v, force=force)
    assert verdict(observer, velocity=1.0, error=0.1, position=(-1, 1), input=1.0, times=(0.0, 2.0)) != "holds"


@pytest.mark.parametrize(
    "potential",
    [lambda q: 0 * jnp.sqrt(q[0]), lambda q: 0 / q[0], lambda q: jnp.sqrt(q[0] ** 2), lambda q: jnp.log(q[0]) * 0],
    ids=["root", "inverse", "root of a square", "logarithm"],
)
def test_potentials_that_are_not_defined_everywhere_are_never_proved(potential):
    observer = line(lambda xp, x, v: -v, potential=potential)
    assert verdict(observer, velocity=1.0, error=0.1, position=(-1, 1), input=1.0) != "holds"


@pytest.mark.core(2)
@pytest.mark.parametrize(
    "inertia",
    [lambda q: 1 + 0 * jnp.sqrt(q), lambda q: 1 + 0 / q, lambda q: q * 2, lambda q: 0 * q, lambda q: jnp.abs(q)],
    ids=["root", "inverse", "negative", "nought", "nought at one place"],
)
def test_inertia_that_is_none_somewhere_is_never_proved(inertia):
    observer = line(lambda xp, x, v: -v, lambda q: inertia(q)[None])
    assert verdict(observer, velocity=1.0, error=0.1, position=(-1, 1), input=1.0) != "holds"


DEFINED = {
    "root of what is positive": lambda xp, x: 1 + 0 * xp.sqrt(x + 1.5),
    "root of nought at one end": lambda xp, x: 1 + 0 * xp.log(x + 1.001),
    "inverse of what is positive": lambda xp, x: 1 + 0 / (x + 1.01),
    "root of a square and more": lambda xp, x: xp.sqrt(x * x + 1e-3),
    "angle off its cut": lambda xp, x: 4 + xp.arctan2(x, 1.0 + 0 * x),
    "tangent between poles": lambda xp, x: 2 + xp.tan(x),
    "whole negative power": lambda xp, x: (x + 3) ** -3,
    "choice that is decided": lambda xp, x: xp.where(x > -2, 1.0, xp.sqrt(x + 1.5)),
    "safe twice": lambda xp, x: xp.where(x > -2, xp.sqrt(xp.where(x > -2, x + 3, 1.0)), 1.0),
    "asin of less": lambda xp, x: 2 + xp.arcsin(0.9 * x),
    "cosh": lambda xp, x: xp.cosh(x),
}


@pytest.mark.parametrize("name", DEFINED)
def test_what_is_defined_everywhere_is_proved(name):
    function = DEFINED[name]
    assert np.isfinite(everywhere(function)).all()
    assert proved(lambda z: jnp.reshape(function(jnp, z[0]), (1, 1)), LINE) == "holds"
