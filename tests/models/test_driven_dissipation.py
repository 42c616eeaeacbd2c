"""Forces that depend on velocity, time and input together: a brake that an input closes, a rudder, a changing wind."""

import jax.numpy as jnp
import numpy as np
import pytest
from driven import pendulum

from covariant import models
from covariant.models import acceleration, friction, resistance
from covariant.observers import Intrinsic

ZERO = jnp.zeros(())


def test_it_acts_as_written():
    t, q, v, u = jnp.asarray(1.0), jnp.array([0.3]), jnp.array([2.0]), jnp.array([0.7, 0.4])
    model = pendulum()
    drag = -(0.05 + 0.1 + 0.4) * 2.0
    assert float(resistance(model, t, q, v, u)[0]) == pytest.approx(drag)
    assert float(friction(model, t, q, v, u)[0]) == pytest.approx(drag / 0.5)
    expected = (0.7 + drag - 3.0 * np.sin(0.3)) / 0.5
    assert float(acceleration(model, t, q, v, u)[0]) == pytest.approx(expected)


def test_friction_alone_may_be_written_either_way():
    short, long = pendulum(lambda q, v: -0.3 * v), pendulum(lambda t, q, v, u: -0.3 * v)
    for model in (short, long):
        assert float(resistance(model, ZERO, jnp.zeros(1), jnp.ones(1), jnp.zeros(2))[0]) == -0.3
    held = models.Parametric(scaled, scale=2.0), models.Parametric(driven, scale=2.0)
    for dissipation in held:
        found = resistance(pendulum(dissipation), ZERO, jnp.zeros(1), jnp.ones(1), jnp.ones(2))
        assert float(found[0]) == -2.0


def scaled(q, v, scale):
    return -scale * v


def driven(t, q, v, u, scale):
    return -scale * u[0] * v


def test_any_other_number_of_arguments_is_refused():
    with pytest.raises(ValueError, match="dissipation cannot be evaluated with 1 coordinates"):
        pendulum(lambda q, v, u: -v)


def test_without_an_error_the_observer_moves_as_the_plant():
    observer, y, v, u = Intrinsic(pendulum(), 4.0, 8.0), jnp.array([0.4]), jnp.array([2.0]), jnp.array([0.3, 0.5])
    slope = observer.flow(jnp.array(0.7), observer.init(y)._replace(v=v), u, y)
    np.testing.assert_allclose(slope.v, acceleration(observer.model, jnp.array(0.7), y, v, u), rtol=1e-12)
