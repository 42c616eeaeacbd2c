"""Forces that depend on velocity, time and input together: a brake that an input closes, a rudder, a changing wind."""

import jax.numpy as jnp
import numpy as np
import pytest

from covariant import certificates, models
from covariant.geometry.lie import SE2
from covariant.models import GroupSystem, Lagrangian, acceleration, friction, resistance
from covariant.observers import Intrinsic

ZERO = jnp.zeros(())


def braked(t, q, v, u):
    """A brake that the second input closes, and oil that warms up."""
    return -(0.05 + 0.2 / (1 + t) + u[1]) * v


def pendulum(dissipation=braked):
    return Lagrangian(
        lambda q: jnp.eye(1, dtype=q.dtype) * 0.5,
        lambda q: -3.0 * jnp.cos(q[0]),
        lambda t, q, u: u[:1],
        dissipation,
        coordinates=("angle",),
        units=("rad",),
        inputs=2,
    )


def steered(t, g, v, u):
    """Drag of a hull, and a rudder whose lift grows with the square of the speed."""
    lift = u[1] * v[0] * jnp.abs(v[0])
    return jnp.stack([-0.3 * v[0], -0.8 * v[1] + 0.4 * lift, -0.1 * v[2] - 0.2 * lift])


def boat(dissipation=steered):
    return GroupSystem(
        SE2,
        np.diag([3.0, 4.0, 0.5]),
        None,
        lambda t, g, u: jnp.stack([u[0], 0 * u[0], 0 * u[0]]),
        dissipation,
        inputs=2,
    )


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


@pytest.mark.parametrize(("make", "named"), [(pendulum, "time, u2"), (boat, "u2")])
def test_no_proof_where_it_depends_on_time_or_input(make, named):
    observer = Intrinsic(make(), 4.0, 8.0)
    with pytest.raises(ValueError, match=f"the dissipation of this model depends on {named};"):
        certificates.error_system(observer, certificates.lyapunov(4.0, 8.0))
