"""One system in other units: metres, kilometres and millimetres, seconds and milliseconds, grams and kilograms."""

import jax.numpy as jnp
import numpy as np
import pytest
from systems import ALPHA, BETA, EFFORT, RATE

from covariant import geometry, models
from covariant.certificates import certify, optimal_lyapunov
from covariant.geometry import lie
from covariant.observers import Intrinsic

LAWS = {
    "true": (lambda v: -v * jnp.abs(v), "holds"),
    "false": (lambda v: 40 * jnp.maximum(v, 0.0), "fails"),
    "false by a step": (lambda v: 50 * jnp.sign(v), None),
    "not defined": (lambda v: -v + 0 * jnp.sqrt(v), None),
}
UNITS = {
    "km": (1e-3, 1.0),
    "mm": (1e3, 1.0),
    "ms": (1.0, 1e3),
    "mm and hours": (1e3, 1 / 3600),
    "Ångström": (1e10, 1.0),
}


def on_a_line(law, length: float, second: float):
    """The certificate of a point mass, where a metre is `length` units and a second is `second` of them."""
    speed, pull = length / second, length / second**2
    model = models.Lagrangian(
        geometry.Euclidean(),
        lambda q: 0.0 * q[0],
        None,
        lambda q, v: pull * law(v / speed),
        coordinates=("x",),
    )
    alpha, beta = ALPHA / second, BETA / second**2
    return certify(
        Intrinsic(model, alpha, beta),
        velocity=1.0 * speed,
        error=0.1 * length,
        position=(-1.0 * length, 1.0 * length),
        input=1.0 * pull,
        rate=RATE / second,
        q=optimal_lyapunov(alpha, beta, 6.0 / second),
        **EFFORT,
    )


def found(make) -> str:
    try:
        return make().statement.verdict
    except ValueError:
        return "refused"


@pytest.mark.exhaustive("true")
@pytest.mark.parametrize("name", LAWS)
def test_units_of_length_and_time_do_not_matter(name):
    law, wanted = LAWS[name]
    usual = found(lambda: on_a_line(law, 1.0, 1.0))
    assert usual == wanted or (wanted is None and usual != "holds")
    for length, second in UNITS.values():
        assert found(lambda length=length, second=second: on_a_line(law, length, second)) == usual


def test_the_tree_of_boxes_is_the_same_in_all_units():
    law, _ = LAWS["true"]
    usual, other = on_a_line(law, 1.0, 1.0), on_a_line(law, 1e3, 1e3)
    assert usual.boxes == other.boxes
    assert other.rate == pytest.approx(usual.rate / 1e3)


def on_a_wheel(law, gram: float):
    """The certificate of a wheel, where a kilogram is so many units."""
    model = models.GroupSystem(lie.SO2, np.eye(1) * gram, dissipation=lambda g, v: gram * law(v))
    q = optimal_lyapunov(ALPHA, BETA, 6.0)
    return certify(Intrinsic(model, ALPHA, BETA), velocity=1.0, error=0.5, input=gram, rate=RATE, q=q, **EFFORT)


@pytest.mark.exhaustive("true")
@pytest.mark.parametrize("name", LAWS)
def test_units_of_mass_do_not_matter(name):
    law, wanted = LAWS[name]
    usual = found(lambda: on_a_wheel(law, 1.0))
    assert usual == wanted or (wanted is None and usual != "holds")
    assert found(lambda: on_a_wheel(law, 1e6)) == usual
