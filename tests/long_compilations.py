"""What takes long of `test_compilations.py`."""

from collections.abc import Iterator

import jax
import jax.monitoring
import jax.numpy as jnp
import numpy as np
import pytest
from test_compilations import beam, height, scara

from covariant import models, simulation
from covariant.models.files._source import system
from covariant.observers import EKF, FilteredDerivative, Geodesic, Intrinsic, ModelCopy, run

COMPILED = "/jax/core/compile/backend_compile_duration"


class Count:
    """How many programs were compiled."""

    def __init__(self):
        self.programs = 0

    def __call__(self, event: str, duration: float, **_) -> None:
        self.programs += event == COMPILED


@pytest.fixture(scope="module")
def count() -> Iterator[Count]:
    counted = Count()
    jax.monitoring.register_event_duration_secs_listener(counted)
    yield counted
    jax.monitoring.unregister_event_duration_listener(counted)


def top(inertia: float):
    body = models.heavy_top((0.2, 0.25, inertia))
    return body, models.Motion(body.manifold.origin(), jnp.array([0.5, 1.0, -0.5]))


OBSERVERS = {
    "intrinsic": lambda model, gain, n: Intrinsic(model, gain, gain**2, substeps=1),
    "geodesic": lambda model, gain, n: Geodesic(model, gain, gain**2, substeps=1),
    "copy": lambda model, gain, n: ModelCopy(model, gain, gain**2, substeps=1),
    "ekf": lambda model, gain, n: EKF(model, gain * jnp.eye(n), 1e-6 * jnp.eye(n), gain, substeps=1),
    "filtered derivative": lambda model, gain, n: FilteredDerivative(gain),
}


@pytest.mark.exhaustive
@pytest.mark.parametrize(("system", "first", "other"), [(beam, 9.81, 9.6), (top, 0.1, 0.15)], ids=["chart", "group"])
def test_other_parameters_and_gains_compile_nothing(count, system, first, other):
    t = np.linspace(0.0, 0.1, 11)
    for round_ in range(3):
        model, start = system(other if round_ == 2 else first)
        record = simulation.simulate(model, start, t, rtol=1e-8 / (1 + round_))
        for name, make in OBSERVERS.items():
            if name not in ("intrinsic", "ekf") and not model.manifold.commuting:
                continue  # one of each kind is enough where programs are large
            n = model.manifold.zero(model.manifold.origin()).size
            run(make(model, 8.0 + round_, n), record)
        if round_ == 0:
            before = count.programs
            assert before > 0  # or it would count nothing
    assert count.programs == before


@pytest.mark.exhaustive
def test_the_observer_in_continuous_time_compiles_once(count):
    t = np.linspace(0.0, 0.1, 5)
    for round_ in range(3):
        model, start = beam(9.81 - 0.1 * round_)
        observer = Intrinsic(model, 8 + round_, 60.0)
        simulation.observe(model, observer, start, observer.init(start[:2]), t)
        if round_ == 0:
            before = count.programs
    assert count.programs == before


def test_state_space_systems_compile_once(count):
    t = np.linspace(0.0, 0.1, 5)
    for damping in (1.0, 1.0, 1.1):
        simulation.simulate(models.duffing(damping), jnp.array([1.0, 0.0]), t)
        if damping == 1.0:
            before = count.programs
    assert count.programs == before


@pytest.mark.exhaustive
def test_a_second_model_of_ones_own_compiles_nothing(count):
    """As the page on models says: functions of a module, and their numbers in a `Parametric`."""
    for mass in (1.0, 2.0):
        model = models.Lagrangian(
            models.Parametric(inertia, mass=mass),
            models.Parametric(height, weight=9.81 * mass),
            coordinates=("z",),
            units=("m",),
        )
        record = simulation.simulate(model, jnp.array([1.0, 0.0]), np.linspace(0.0, 0.1, 5))
        run(Intrinsic(model, mass, mass, substeps=2), record)
        if mass == 1.0:
            before = count.programs
    assert count.programs == before


def inertia(q, mass):
    return mass * jnp.eye(1, dtype=q.dtype)


def test_what_has_numbers_in_it_may_be_given_to_jax_as_a_function():
    model = models.ball_and_beam()
    observer, u, y = Intrinsic(model, 8.0, 30.0), jnp.zeros(1), jnp.array([0.3, 0.1])
    state = observer.init(y)
    after, _ = jax.jit(observer.step)(state, u, y, jnp.asarray(0.01))
    assert after.q.shape == (2,)
    for function in (model.potential, model.space.matrix, model.space):
        assert np.isfinite(jax.jit(function)(y)).all()
    assert np.isfinite(jax.jit(models.duffing().f)(jnp.zeros(()), y, jnp.zeros(1))).all()
    metric = models.heavy_top().space
    assert jax.jit(metric.connection)(jnp.eye(3), jnp.ones(3), jnp.ones(3)).shape == (3,)


def test_the_geometry_of_a_robot_is_measured_without_a_program(monkeypatch):
    """Its graph in NumPy has the few numbers sooner than JAX compiles the function."""
    robot = scara()
    monkeypatch.setattr(jax, "jit", None)
    assert models.survey(robot, samples=3).samples == 3
