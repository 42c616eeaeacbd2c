"""Forces that depend on velocity, time and input together: a brake that an input closes, a rudder, a changing wind."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import certificates, models, simulation
from covariant.certificates import certify
from covariant.geometry.lie import SE2
from covariant.models import GroupSystem, Lagrangian, Motion, acceleration, friction, resistance
from covariant.observers import EKF, Geodesic, Intrinsic, ModelCopy, run

ZERO = jnp.zeros(())
STAMPS = np.linspace(0.0, 6.0, 601)


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


def pendulum_inputs(t, x):
    return jnp.stack([jnp.sin(2 * t), 0.3 + 0.3 * jnp.sin(t)])


def boat_inputs(t, x):
    return jnp.stack([2 + jnp.sin(t), 0.5 * jnp.cos(1.3 * t)])


CASES = {
    "pendulum": (pendulum, jnp.array([0.4, 2.0]), pendulum_inputs),
    "boat": (boat, Motion(jnp.eye(3), jnp.array([1.0, 0.2, -0.3])), boat_inputs),
}


@pytest.fixture(scope="module")
def motions():
    """Each machine, and its true motion under inputs that are held from stamp to stamp."""
    found = {}
    for name, (make, start, inputs) in CASES.items():
        held = simulation.hold(
            jnp.asarray(STAMPS), jax.vmap(lambda t, inputs=inputs: inputs(t, None))(jnp.asarray(STAMPS))
        )
        found[name] = make, simulation.simulate(make(), start, STAMPS, held, rtol=1e-9, atol=1e-10)
    return found


def test_it_acts_as_written():
    t, q, v, u = jnp.asarray(1.0), jnp.array([0.3]), jnp.array([2.0]), jnp.array([0.7, 0.4])
    model = pendulum()
    drag = -(0.05 + 0.1 + 0.4) * 2.0
    assert float(resistance(model, t, q, v, u)[0]) == pytest.approx(drag)
    assert float(friction(model, t, q, v, u)[0]) == pytest.approx(drag / 0.5)
    expected = (0.7 + drag - 3.0 * np.sin(0.3)) / 0.5
    assert float(acceleration(model, t, q, v, u)[0]) == pytest.approx(expected)


OBSERVERS = {
    "intrinsic": lambda model, n: Intrinsic(model, 8.0, 32.0, substeps=1),
    "geodesic": lambda model, n: Geodesic(model, 8.0, 32.0, substeps=1),
    "copy": lambda model, n: ModelCopy(model, 8.0, 32.0, substeps=1),
    "ekf": lambda model, n: EKF(model, 1e-2 * jnp.eye(n), 1e-6 * jnp.eye(n), substeps=1),
}


@pytest.mark.exhaustive
@pytest.mark.parametrize(("machine", "name"), [*(("pendulum", name) for name in OBSERVERS), ("boat", "intrinsic")])
def test_observers_evaluate_it_at_the_estimate(motions, machine, name):
    """On a noise-free log the estimate meets the truth; without the dissipation it keeps an error."""
    make, record = motions[machine]

    def velocity_error(dissipation):
        model = make(dissipation)
        n = model.manifold.zero(record.y[0]).size
        estimate = model.motion(run(OBSERVERS[name](model, n), record).estimate).v
        return float(np.abs(estimate - make().motion(record.x).v)[-100:].max())

    known = steered if make is boat else braked
    assert velocity_error(known) < 1e-5
    assert velocity_error(None) > 1e-3


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


@pytest.mark.exhaustive
def test_friction_alone_is_proved_either_way():
    region = {
        "position": (np.array([-0.2]), np.array([0.2])),
        "velocity": 0.2,
        "error": 0.05,
        "rate": 0.5,
        "boxes": 2000,
    }
    forms = (lambda q, v: -0.3 * v, lambda t, q, v, u: -0.3 * v)
    first, second = (certify(Intrinsic(pendulum(form), 4.0, 8.0), **region) for form in forms)
    assert all(claim.proof.verdict == "holds" for claim in first.claims)
    assert [claim.proof.boxes for claim in first.claims] == [claim.proof.boxes for claim in second.claims]
