"""Friction that jumps upwards makes estimates diverge, however the jump is written down: it must never be proved."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import Case, around, excess, falsehood, line, on_any_circle, simulate, size_of, verdict, wheel

TABLE = (-50.0, 50.0)


def anti(xp, x, v):
    """Fifty newtons along the motion: the law that most cases below are another spelling of."""
    return 50 * xp.sign(v)


def along(x, v):
    return jnp.where(v > 0, 50.0, -50.0)


@jax.custom_jvp
def flattened(v):
    return 50.0 * v


flattened.defjvp(lambda primals, tangents: (flattened(*primals), -tangents[0]))


def in_a_scan(xp, x, v):
    def body(total, weight):
        return total + weight * jnp.where(v > 0, 1.0, -1.0), None

    return jax.lax.scan(body, jnp.zeros_like(v), jnp.array([20.0, 30.0]))[0]


def in_a_branch(xp, x, v):
    return jax.lax.cond(v[0] > 0, lambda v: 0 * v + 50, lambda v: 0 * v - 50, v)


def passed_straight_through(xp, x, v):
    """The trick of quantised networks: the value of one function and the derivative of another."""
    return -v + jax.lax.stop_gradient(v + 20 * jnp.round(4 * v))


def one_hot(xp, x, v):
    return jax.nn.one_hot((v > 0).astype(int), 2) @ jnp.array(TABLE)


def scattered(xp, x, v):
    return jnp.zeros((2,)).at[(v > 0).astype(int)].set(50.0)[1:] - 25.0


# `tests/scalargraph/test_conditions.py` tries operations by themselves, `test_declared.py` declared derivatives.
WRITTEN = {
    "where": Case(lambda xp, x, v: 50 * xp.where(v > 0, 1.0, -1.0)),
    "sign": Case(anti),
    "round": Case(lambda xp, x, v: 50 * xp.round(v), speed=0.5),
    "floor": Case(lambda xp, x, v: 50 * xp.floor(v)),
    "ceil": Case(lambda xp, x, v: 50 * xp.ceil(v / 0.3), speed=0.3),
    "truncation": Case(lambda xp, x, v: 50 * xp.trunc(v / 0.4), speed=0.4),
    "remainder": Case(lambda xp, x, v: 100 * (v - xp.mod(v, 0.3)), speed=0.3),
    "whole numbers": Case(lambda xp, x, v: 50.0 * (v * 3).astype(int).astype(float), speed=1 / 3),
    "table": Case(lambda xp, x, v: xp.array(TABLE)[(v > 0).astype(int)]),
    "table at the larger": Case(lambda xp, x, v: xp.array(TABLE)[xp.argmax(xp.stack([-v, v]), axis=0)]),
    "search in a table": Case(lambda xp, x, v: xp.array([-50.0, 0.0, 50.0])[xp.searchsorted(xp.array([-0.1, 0.0]), v)]),
    "truth as a number": Case(lambda xp, x, v: 50.0 * (v > 0).astype(float)),
    "either truth": Case(lambda xp, x, v: 50.0 * (~((v < 0) | (x > 2))).astype(float)),
    "Heaviside's step": Case(lambda xp, x, v: 50 * xp.heaviside(v, 0.5)),
    "copied sign": Case(lambda xp, x, v: xp.copysign(50.0, v)),
    "sign bit": Case(lambda xp, x, v: xp.where(xp.signbit(v), -50.0, 50.0)),
    "three steps": Case(lambda xp, x, v: xp.select([v < -0.2, v < 0.2], [-50.0 + 0 * v, 0 * v], 50.0), speed=0.2),
    "knots at one place": Case(
        lambda xp, x, v: xp.interp(v, xp.array([-1.0, 0.0, 0.0, 1.0]), xp.array([-50.0, -50.0, 50.0, 50.0]))
    ),
    "cut of an angle": Case(lambda xp, x, v: 20 * xp.arctan2(v, 0 * v - 1.0)),
    "cut behind damping": Case(
        lambda xp, x, v: 20 * xp.arctan2(-v, -1.0 - x**2) - 40 * xp.arctan2(v - 0.2, -1 + 0 * v)
    ),
    "quotient with itself": Case(lambda xp, x, v: 50 * v / xp.abs(v), speed=1e-9),
    "step in a narrow dead zone": Case(
        lambda xp, x, v: xp.where(xp.abs(v) < 1e-6, 0.0, 50 * xp.sign(v)), speed=1e-6, size=1e-8
    ),
    "narrow step": Case(
        lambda xp, x, v: xp.where(xp.abs(v - 0.3123) < 1e-5, 20.0, 0.0), speed=0.3123 - 1e-5, held=True
    ),
    "step between branches that are damped": Case(lambda xp, x, v: xp.where(v > 0.123, 20 - v, -v), speed=0.123),
    "step in the place": Case(lambda xp, x, v: 50 * xp.where(x > 0.2, 1.0, -1.0), place=0.2),
    "step in a combination": Case(lambda xp, x, v: 50 * xp.sign(v - 3 * x), place=0.1, speed=0.3),
    "step at the bound of the velocity": Case(lambda xp, x, v: xp.where(v > 1, 50.0, 0.0), speed=1.0, held=True),
    "step at the bound of the place": Case(lambda xp, x, v: xp.where(x >= 1, 200.0, 0.0), place=1.0, held=True),
    "step at the other bound": Case(lambda xp, x, v: xp.where(x > -1, 200.0, 0.0), place=-1.0, held=True),
    "step in the weight": Case(lambda xp, x, v: -v * xp.where(x > 0, 0.0, 40.0), speed=0.5, held=True),
    "step times zero, but once": Case(lambda xp, x, v: 0.0 * v + 50 * xp.sign(v) * (x * x + 1)),
}


def test_simulations_tell_true_from_false():
    assert falsehood(Case(lambda xp, x, v: -v)) < 1.1
    assert falsehood(Case(lambda xp, x, v: -50 * xp.arctan(9 * v), speed=0.2)) < 5
    assert falsehood(Case(anti)) > 1e4


@pytest.mark.core(3)
@pytest.mark.parametrize("name", WRITTEN)
def test_a_step_along_the_motion_is_never_proved(name):
    case = WRITTEN[name]
    assert falsehood(case) > 30
    assert verdict(line(case.law), **case.bounds()) != "holds"


OF_JAX = {
    "stop_gradient": Case(lambda xp, x, v: 50 * jax.lax.stop_gradient(v), lambda xp, x, v: 50 * v),
    "stop_gradient, in the place": Case(lambda xp, x, v: 400 * jax.lax.stop_gradient(x), lambda xp, x, v: 400 * x),
    "straight through": Case(passed_straight_through, lambda xp, x, v: 20 * xp.round(4 * v), speed=0.125),
    "rule of another function": Case(lambda xp, x, v: flattened(v), lambda xp, x, v: 50 * v),
    "scan": Case(in_a_scan, anti),
    "cond": Case(in_a_branch, anti),
    "jit": Case(lambda xp, x, v: jax.jit(along)(x, v), anti),
    "checkpoint": Case(lambda xp, x, v: jax.checkpoint(along)(x, v), anti),
    "vmap": Case(lambda xp, x, v: jax.vmap(lambda w: jnp.where(w > 0, 50.0, -50.0))(v), anti),
    "a derivative with a step": Case(lambda xp, x, v: jax.vmap(jax.grad(lambda w: 50 * jnp.abs(w)))(v), anti),
    "one-hot": Case(one_hot, anti),
    "scatter": Case(scattered, lambda xp, x, v: 25 * xp.sign(v)),
    "to single precision and back": Case(
        lambda xp, x, v: -v + 1e9 * (v.astype(jnp.float32).astype(float) - v),
        lambda xp, x, v: -v + 1e9 * (v.astype(np.float32).astype(float) - v),
        speed=0.5 + 2.0**-25,
    ),
    "fewer digits": Case(
        lambda xp, x, v: -v + 1e5 * (jax.lax.reduce_precision(v, 11, 10) - v),
        lambda xp, x, v: -v + 1e5 * (v.astype(np.float16).astype(float) - v),
        speed=0.5 + 2.0**-12,
    ),
}


@pytest.mark.core(3)
@pytest.mark.parametrize("name", OF_JAX)
def test_what_jax_calls_the_derivative_is_not_believed(name):
    case = OF_JAX[name]
    assert falsehood(case) > 5
    assert verdict(line(case.law), **case.bounds()) != "holds"


def test_a_step_at_the_identity_of_a_group_is_never_proved():
    """On a group everything is looked at where the estimate is the identity: there the step is exactly touched."""
    case = on_any_circle(Case(lambda xp, g, v: 100 * xp.sign(g[1, 0]) + 0 * v))
    assert falsehood(case, on_group=True) > 30
    assert verdict(wheel(case.law), velocity=1.0, error=0.5, input=1.0) != "holds"


def test_a_step_in_the_velocity_on_a_group_is_never_proved():
    case = on_any_circle(Case(anti))
    assert falsehood(case, on_group=True) > 30
    assert verdict(wheel(case.law), velocity=1.0, error=0.5, input=1.0) != "holds"


@pytest.mark.parametrize("circles", [(), (0,)])
def test_a_metric_that_jumps_is_never_proved(circles):
    """Across the jump of the inertia the velocity stays as it is, says the code, so the speed in the metric doubles."""

    def scale(x):
        return np.where(x > 0, 2.0, 1.0)

    # Truth and estimate on both sides of the jump, equally fast in the metric; then both are on the right of it.
    run = simulate(lambda xp, x, v: 0 * v, -1e-6, 0.5, 2e-6, -0.25, seconds=1e-4, steps=10)
    ends = (
        [scale(x) * x for x in (run.x, run.x + run.xi)],
        [scale(run.x) * run.v, scale(run.x + run.xi) * (run.v + run.zeta)],
    )
    distance = size_of(*(b - a for a, b in ends))
    assert distance[0] < 1e-5 < 1e-2 < distance[-1]

    def metric(q):
        return jnp.where(q > 0, 4.0, 1.0)[None]

    found = verdict(line(lambda xp, x, v: -v, metric, circles=circles), velocity=1.0, error=0.1, position=(-1, 1))
    assert found != "holds"


FORCES = {
    "where": lambda t, q, u: u + jnp.where(q > 0, 0.5, -0.5),
    "sign": lambda t, q, u: u + 0.5 * jnp.sign(q),
    "in the input": lambda t, q, u: jnp.where(u > 0, 1.0, -1.0),
    "in time": lambda t, q, u: u + jnp.where(t > 0.5, 1.0, 0.0),
}


@pytest.mark.core(1)
@pytest.mark.parametrize("name", FORCES)
def test_a_force_may_jump_since_it_is_known(name):
    """The force is taken at the measured position: truth and estimate get the same, jump or not."""
    observer = line(lambda xp, x, v: -v, force=FORCES[name])
    assert verdict(observer, velocity=1.0, error=0.1, position=(-1, 1), input=1.0, times=(0.0, 1.0)) == "holds"


def test_a_known_step_moves_truth_and_estimate_alike():
    case = Case(lambda xp, x, v: -v)
    run = simulate(case.law, 0.0, 0.3, *around(1e-3), push=lambda t, x, v: np.sign(x))
    assert excess(run, case) < 1.01


@pytest.mark.core(1)
@pytest.mark.parametrize(
    "potential",
    [lambda q: jnp.abs(q[0]), lambda q: jnp.where(q[0] > 0, q[0], 0.0), lambda q: jnp.maximum(q[0], 0.2) ** 2],
    ids=["abs", "where", "max"],
)
def test_a_potential_may_have_a_kink(potential):
    observer = line(lambda xp, x, v: -v, potential=potential)
    assert verdict(observer, velocity=1.0, error=0.1, position=(-1, 1), input=1.0) == "holds"


BENIGN = {
    "where on one side only": lambda xp, x, v: -v * xp.where(x > -5, 1.0, -50.0),
    "sign on one side only": lambda xp, x, v: -v * xp.sign(x + 5),
    "floor between its steps": lambda xp, x, v: -v * (1 + xp.floor(x / 9 + 0.5)),
    "table at one place": lambda xp, x, v: -v * xp.array([0.5, 1.0])[(x > -5).astype(int)],
    "known loop": lambda xp, x, v: jax.lax.fori_loop(0, 3, lambda i, s: s - v, 0 * v),
    "jit": lambda xp, x, v: -jax.jit(lambda w: 2 * w)(v),
    "stop_gradient of a constant": lambda xp, x, v: -v * jax.lax.stop_gradient(xp.array(2.0)),
    "honest rule": lambda xp, x, v: -flattened(v) / 50,
}


@pytest.mark.core(1)
@pytest.mark.long("honest rule")
@pytest.mark.parametrize("name", BENIGN)
def test_what_does_not_jump_in_the_region_is_proved(name):
    assert verdict(line(BENIGN[name]), **Case(BENIGN[name]).bounds()) == "holds"
