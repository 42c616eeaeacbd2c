"""Kinks: friction that drives on one side of a kink is never proved, and friction that brakes on both sides is."""

import jax
import jax.numpy as jnp
import pytest
from systems import Case, falsehood, line, on_any_circle, verdict, wheel

DRIVING = {
    "abs": Case(lambda xp, x, v: 50 * xp.abs(v), speed=0.01, held=True, input=60.0),
    "max with zero": Case(lambda xp, x, v: 50 * xp.maximum(v, 0.0)),
    "min with zero": Case(lambda xp, x, v: 50 * xp.minimum(v, 0.0)),
    "clip": Case(lambda xp, x, v: 50 * xp.clip(v, -0.5, 0.5)),
    "relu": Case(lambda xp, x, v: 50 * jax.nn.relu(v), lambda xp, x, v: 50 * xp.maximum(v, 0.0)),
    "leaky": Case(lambda xp, x, v: xp.where(v > 0, 50 * v, -v)),
    "where with branches that meet": Case(lambda xp, x, v: xp.where(v < 0, 0.0, 50 * v)),
    "where, elsewhere": Case(lambda xp, x, v: xp.where(v < 0.3, 0.0, 50 * (v - 0.3)), speed=0.3, held=True),
    "root of a square": Case(lambda xp, x, v: 50 * xp.sqrt(v * v), speed=0.01, held=True),
    "even power": Case(lambda xp, x, v: 50 * (v**4) ** 0.25, speed=0.01, held=True),
    "larger of two": Case(lambda xp, x, v: 50 * xp.max(xp.stack([v, -v]), axis=0), speed=0.01, held=True),
    "dead zone": Case(lambda xp, x, v: 50 * (v - xp.clip(v, -0.1, 0.1)), speed=0.1, held=True),
    "narrow dead zone": Case(lambda xp, x, v: 50 * (v - xp.clip(v, -1e-9, 1e-9))),
    "ramp as steep as a step": Case(lambda xp, x, v: 50 * xp.clip(1e8 * v, -1.0, 1.0), size=1e-10),
    "ramp of a thousandth": Case(
        lambda xp, x, v: 2 * xp.clip(1e5 * (v - 0.41234), -1.0, 1.0), speed=0.41234, held=True, size=1e-9
    ),
    "hat that no sample falls into": Case(
        lambda xp, x, v: 0.02 * xp.maximum(0.0, 1 - xp.abs(v - 0.31234567) * 1e5), speed=0.312341, held=True, size=1e-9
    ),
    "kinked in the place": Case(lambda xp, x, v: 400 * xp.abs(x), place=0.001, held=True, size=1e-6),
    "kinked in a combination": Case(lambda xp, x, v: 200 * xp.maximum(v - x, 0.0)),
    "beyond the bound of the velocity": Case(lambda xp, x, v: 200 * xp.maximum(v - 1.0, 0.0), speed=1.0, held=True),
    "beyond the bound of the place": Case(lambda xp, x, v: 2e3 * xp.maximum(x - 1.0, 0.0), place=1.0, held=True),
    "times what it multiplies": Case(lambda xp, x, v: 50 * v * xp.abs(v), speed=0.7, held=True),
    "one side of quadratic": Case(lambda xp, x, v: 80 * v * xp.maximum(v, 0.0), speed=0.7, held=True),
    "weight by the place": Case(lambda xp, x, v: (200 * xp.abs(x) - 1) * v, place=0.5, speed=0.1, held=True),
    "two kinks that cancel on one side": Case(lambda xp, x, v: 30 * (xp.abs(v) + v), speed=0.01, held=True),
    "smooth, and nearly a kink": Case(lambda xp, x, v: 25 * (v + xp.sqrt(v * v + 1e-16)), speed=0.01, held=True),
    "kink of a kink": Case(lambda xp, x, v: 80 * xp.abs(xp.abs(v) - 0.5), speed=0.51, held=True),
    "median of three": Case(lambda xp, x, v: 50 * xp.maximum(xp.minimum(v, 0.2), xp.minimum(xp.maximum(v, 0.2), -0.2))),
}


@pytest.mark.core(2)
@pytest.mark.parametrize("name", DRIVING)
def test_friction_that_drives_on_one_side_is_never_proved(name):
    case = DRIVING[name]
    assert falsehood(case) > 1.5
    assert verdict(line(case.law), **case.bounds()) != "holds"


ON_THE_GROUP = {
    "place, kinked at the identity": lambda xp, g, v: 300 * xp.abs(g[1, 0]) - v,
    "place, larger of two": lambda xp, g, v: 300 * xp.maximum(g[1, 0], 0.0) - v,
    "velocity": lambda xp, g, v: 50 * xp.maximum(v, 0.0) + 0 * g[0, 0],
}


@pytest.mark.parametrize("name", ON_THE_GROUP)
def test_a_kink_at_the_identity_of_a_group_is_never_proved(name):
    case = on_any_circle(Case(ON_THE_GROUP[name], place=1e-5, held=True, input=5.0))
    assert falsehood(case, on_group=True, seconds=0.2) > 1.5
    assert verdict(wheel(case.law), velocity=1.0, error=0.5, input=5.0) != "holds"


@pytest.mark.parametrize("inertia", [lambda q: 1 + 30 * jnp.abs(q), lambda q: 1 + 30 * jnp.maximum(q, 0.0)])
def test_inertia_with_a_kink_is_never_proved(inertia):
    """Its connection jumps, by 15 v² and more here."""
    observer = line(lambda xp, x, v: 0 * v, lambda q: inertia(q)[None])
    assert verdict(observer, velocity=5.0, error=0.05, position=(-0.5, 0.5), input=0.1, rate=0.5) != "holds"


BRAKING = {
    "quadratic": lambda xp, x, v: -v * xp.abs(v),
    "quadratic, written backwards": lambda xp, x, v: -3 * xp.abs(v) * v - v,
    "saturated": lambda xp, x, v: -2 * xp.clip(v / 0.4, -1.0, 1.0),
    "saturated by min and max": lambda xp, x, v: -xp.maximum(-0.5, xp.minimum(0.5, 2 * v)),
    "on one side": lambda xp, x, v: -2 * xp.maximum(v, 0.0),
    "on the other side": lambda xp, x, v: -2 * xp.minimum(v, 0.0),
    "more on one side": lambda xp, x, v: -v - xp.maximum(v, 0.0),
    "dead zone": lambda xp, x, v: -3 * (v - xp.clip(v, -0.1, 0.1)),
    "more at one place": lambda xp, x, v: -(1 + xp.abs(x)) * v,
    "more beyond a place": lambda xp, x, v: -(1 + xp.maximum(x - 0.2, 0.0)) * v,
    "kink at the bound of the velocity": lambda xp, x, v: -v - xp.maximum(v - 1.0, 0.0),
    "kink at the bound of the place": lambda xp, x, v: -v * (1 + xp.maximum(x - 1.0, 0.0)),
    "weakly driving": lambda xp, x, v: 0.3 * xp.abs(v) - 0.1 * v,
    "arc tangent of a clip": lambda xp, x, v: -xp.arctan(xp.clip(3 * v, -1.0, 1.0)),
    "quadratic, chosen by its sign": lambda xp, x, v: -v * xp.where(v < 0, -v, v),
    "smaller of two by where": lambda xp, x, v: -xp.where(v < 0.5, v, 0.5 + 0 * v),
}


@pytest.mark.core(1)
@pytest.mark.long("quadratic")
@pytest.mark.parametrize("name", BRAKING)
def test_friction_that_brakes_on_both_sides_is_proved(name):
    case = Case(BRAKING[name], speed=1e-9, size=1e-3)
    assert falsehood(case) < 1.01
    assert verdict(line(case.law), **case.bounds()) == "holds"
