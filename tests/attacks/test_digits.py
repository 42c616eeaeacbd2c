"""Numbers of the machine that are no real numbers: integers that wrap around, and single precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import Case, falsehood, line, proved, verdict

from covariant import models, observers
from covariant.certificates import Hypothesis, certify, certify_globally
from scalargraph.proofs import box

LINE = box(x=(-1.0, 1.0))


def whole(x, about: float, kind=int):
    """A whole number that does not change over the region, as an integer of some width."""
    return jnp.floor(x / 10 + about + 0.5).astype(kind)


def two(x, kind):
    return jnp.stack([whole(x, 100, kind), whole(x, 100, kind)])


WRAPPED = {
    "sum of eight bits": lambda x: (whole(x, 100, jnp.int8) + whole(x, 100, jnp.int8)).astype(float),
    "product of eight bits": lambda x: (whole(x, 12, jnp.int8) * whole(x, 12, jnp.int8)).astype(float),
    "square of eight bits": lambda x: (whole(x, 12, jnp.int8) ** 2).astype(float),
    "square of 32 bits": lambda x: (whole(x, 50_000, jnp.int32) * whole(x, 50_000, jnp.int32)).astype(float),
    "power of 32 bits": lambda x: (whole(x, 10, jnp.int32) ** 10).astype(float) - 1.5e9,
    "difference without sign": lambda x: 1.5 - (whole(x, 1, jnp.uint8) - jnp.uint8(2)).astype(float) / 100,
    "sum of a stack": lambda x: jnp.sum(two(x, jnp.int8), dtype=jnp.int8).astype(float),
    "product of a stack": lambda x: jnp.prod(two(x, jnp.int8), dtype=jnp.int8).astype(float) - 100,
    "running sum": lambda x: jnp.cumsum(two(x, jnp.int8), dtype=jnp.int8)[1].astype(float),
    "inner product": lambda x: (two(x, jnp.int8) @ jnp.array([1, 1], jnp.int8)).astype(float),
    "integers made shorter": lambda x: whole(x, 200).astype(jnp.int8).astype(float),
    "integers that lose their sign": lambda x: 1.0 - whole(x, -3).astype(jnp.uint8).astype(float),
    "bits of a stack": lambda x: jnp.bitwise_and.reduce(jnp.stack([whole(x, 6), whole(x, 1)])).astype(float),
    "size of the least": lambda x: jnp.abs(whole(x, -128, jnp.int8)).astype(float),
    "the least turned over": lambda x: (-whole(x, -128, jnp.int8)).astype(float),
    "sum of 64 bits": lambda x: (whole(x, 0) + 2**62 + 2**62).astype(float),
    "more than 53 bits": lambda x: 0.5 - ((whole(x, 0) + (2**53 + 1)) - 2**53).astype(float),
    "to single precision": lambda x: (whole(x, 0) + (2**24 + 1)).astype(jnp.float32).astype(float) - 2**24 - 0.5,
    "too large for its kind": lambda x: jnp.floor(x / 10 + 300.5).astype(jnp.int8).astype(float) - 200,
    "too large for any kind": lambda x: jnp.floor(x / 10 + 3e9).astype(jnp.int32).astype(float) - 2.5e9,
}


@pytest.mark.core(7)
@pytest.mark.parametrize("name", WRAPPED)
def test_integers_that_wrap_around_are_not_real_numbers(name):
    """As real numbers all of these are positive; as the machine has them none is."""
    function = WRAPPED[name]
    with np.errstate(all="ignore"):
        assert max(float(function(jnp.asarray(x))) for x in (-0.9, 0.0, 0.9)) <= 0
    assert proved(lambda z: jnp.reshape(function(z[0]), (1, 1)), LINE) != "holds"


SHORTENED = {
    "inner product": lambda x: jax.lax.dot_general(
        x[None], jnp.ones(1), (((0,), (0,)), ((), ())), preferred_element_type=jnp.float32
    ).astype(float),
    "sum": lambda x: jnp.sum(x[None], dtype=jnp.float32).astype(float),
    "matrix product": lambda x: jnp.matmul(x[None, None], jnp.ones((1, 1)), preferred_element_type=jnp.float32).astype(
        float
    )[0, 0],
    "conversion": lambda x: x.astype(jnp.float32).astype(float),
    "half of it": lambda x: x.astype(jnp.float16).astype(float),
    "a short float of brains": lambda x: x.astype(jnp.bfloat16).astype(float),
}


@pytest.mark.parametrize("name", SHORTENED)
def test_results_in_fewer_digits_are_not_real_numbers(name):
    """x less itself in fewer digits is up to 1e-8, and below zero at some places."""
    short = SHORTENED[name]
    places = np.linspace(-1, 1, 201)
    assert min(float(jnp.asarray(x) - short(jnp.asarray(x))) for x in places) < -1e-9
    assert proved(lambda z: jnp.reshape(z[0] - short(z[0]) + 1e-10, (1, 1)), LINE) != "holds"


FRICTION = {
    "a weight of eight bits": lambda xp, x, v: -v * _eight(xp, x).astype(float) / 5,
    "a weight of 32 bits": lambda xp, x, v: -v * _squared(xp, x).astype(float) / 1e8,
}


def _eight(xp, x):
    number = xp.floor(x / 10 + 100.5).astype(xp.int8)
    return number + number


def _squared(xp, x):
    number = xp.floor(x / 10 + 50_000.5).astype(xp.int32)
    return number * number


@pytest.mark.parametrize("name", FRICTION)
def test_friction_whose_weight_wraps_around_is_never_proved(name):
    """The weight would brake; wrapped around it drives."""
    case = Case(FRICTION[name], speed=0.1, held=True)
    assert falsehood(case) > 1.2
    assert verdict(line(case.law), **case.bounds()) != "holds"


NONE = {
    "complex numbers": lambda x: jax.lax.complex(x, x).real + 2,
    "sizes of complex numbers": lambda x: jnp.abs(jax.lax.complex(x + 1, x)),
    "keys of random numbers": lambda x: x + jax.random.uniform(jax.random.key(0)) + 2,
    "bits": lambda x: jnp.bitwise_and.reduce(jnp.stack([whole(x, 6), whole(x, 3)])).astype(float),
    "what Python computes": lambda x: jax.pure_callback(
        lambda a: np.float64(1.0), jax.ShapeDtypeStruct((), jnp.float64), x
    ),
}


@pytest.mark.parametrize("name", NONE)
def test_what_is_no_real_number_is_refused_by_name(name):
    assert proved(lambda z: jnp.reshape(NONE[name](z[0]), (1, 1)), LINE) == "refused"


def test_integers_that_do_not_wrap_are_proved():
    for function in (
        lambda x: (whole(x, 3) * whole(x, 4)).astype(float),
        lambda x: (whole(x, 100, jnp.int32) + whole(x, 100, jnp.int32)).astype(float),
    ):
        assert proved(lambda z, f=function: jnp.reshape(f(z[0]), (1, 1)), LINE) == "holds"


def test_nothing_is_proved_in_single_precision():
    """A flow (1 + 1e-9) x − x is traced as 0 there."""
    with jax.enable_x64(False):
        model = models.oscillator()
        with pytest.raises(ValueError, match="certify needs doubles, and jax_enable_x64 is off"):
            certify(observers.Intrinsic(model, 10.0, 50.0), position=(-1.0, 1.0), velocity=1.0, error=0.1)
        with pytest.raises(ValueError, match="certify_globally needs doubles"):
            certify_globally(models.ball_and_beam(), velocity=0.1, position=(-0.1, 0.1), interval=(0.01, 0.01))
        with pytest.raises(ValueError, match="a proof needs doubles"):
            Hypothesis("it contracts", "proved")
        assert Hypothesis("it contracts", "sampled").verdict == "holds"
