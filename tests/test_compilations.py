"""Numbers are leaves: another gain, the same model again or one with other parameters compiles nothing."""

import inspect
import tempfile
from collections.abc import Iterator
from pathlib import Path

import equinox as eqx
import jax
import jax.monitoring
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models, simulation
from covariant.models import marine
from covariant.models.files._source import system
from covariant.models.files._systems import SYSTEMS
from covariant.observers import EKF, FilteredDerivative, Geodesic, Intrinsic, ModelCopy, run

FACTORIES = {name: system(name) for name in SYSTEMS} | {
    name: getattr(marine, name) for name in ("cybership", "odin", "odin_on_group", "supply_vessel")
}
FACTORIES["manoeuvring_ship"] = marine.manoeuvring_ship


def scara(mass: float = 4.2):
    """The robot `scara` with another mass of its first link [kg]."""
    text = models.robots.located("scara").read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "scara.urdf")
        path.write_text(text.replace('<mass value="4.2"/>', f'<mass value="{mass}"/>'), encoding="utf-8")
        return models.robots.load(path)


def legged_base(radius: float = 0.02, slip: float = 1e-3):
    """The base of the robot `quadruped` on two feet."""
    feet = {"FL_FOOT": (0.0, 0.0, 0.0), "HR_FOOT": (0.0, 0.0, 0.0)}
    return system("legged_base")("quadruped", feet, radius, slip=slip).model


FACTORIES["robot"], FACTORIES["legged_base"] = scara, legged_base
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


def changed(factory) -> dict:
    """Other numbers for a factory's parameters, a little larger."""
    usual = {name: p.default for name, p in inspect.signature(factory).parameters.items()}
    kept = ("n", "pole_pairs", "axis", "axes")  # which say how many there are, or are directions
    return {name: larger(value) for name, value in usual.items() if name not in kept and numeric(value)}


def numeric(value) -> bool:
    return isinstance(value, float | tuple) and np.issubdtype(np.asarray(value).dtype, np.floating)


def larger(value):
    return (1.01 * np.asarray(value)).tolist()


def static_part(model):
    return eqx.partition(model, eqx.is_array)[1]


@pytest.mark.long("robot")
@pytest.mark.parametrize("name", FACTORIES)
def test_a_model_is_made_inside_a_compiled_function(name):
    outside = eqx.filter(FACTORIES[name](), eqx.is_array)
    inside = jax.eval_shape(lambda: eqx.filter(FACTORIES[name](), eqx.is_array))
    assert [x.shape for x in jax.tree.leaves(inside)] == [x.shape for x in jax.tree.leaves(outside)]


@pytest.mark.parametrize("name", FACTORIES)
def test_a_system_built_again_differs_in_its_arrays_alone(name):
    """Then no program that was compiled for one is compiled again for the other."""
    factory = FACTORIES[name]
    first, second, other = factory(), factory(), factory(**changed(factory))
    assert jax.tree.structure(first) == jax.tree.structure(second) == jax.tree.structure(other)
    assert eqx.tree_equal(*map(static_part, (first, second, other)))
    assert hash(jax.tree.structure(first)) == hash(jax.tree.structure(other))
    if name != "unknown_frequency":  # which has no parameters
        pairs = zip(
            jax.tree.leaves(eqx.filter(first, eqx.is_array)),
            jax.tree.leaves(eqx.filter(other, eqx.is_array)),
            strict=True,
        )
        assert any(not np.array_equal(a, b) for a, b in pairs)


def beam(gravity: float):
    return models.ball_and_beam(gravity), jnp.array([0.3, 0.1, 0.0, 0.2])


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


@pytest.mark.long
def test_the_observer_in_continuous_time_compiles_once(count):
    t = np.linspace(0.0, 0.1, 5)
    for round_ in range(3):
        model, start = beam(9.81 - 0.1 * round_)
        observer = Intrinsic(model, 8 + round_, 60.0)
        simulation.observe(model, observer, start, observer.init(start[:2]), t)
        if round_ == 0:
            before = count.programs
    assert count.programs == before


@pytest.mark.long
def test_state_space_systems_compile_once(count):
    t = np.linspace(0.0, 0.1, 5)
    for damping in (1.0, 1.0, 1.1):
        simulation.simulate(models.van_der_pol(damping), jnp.array([1.0, 0.0]), t)
        if damping == 1.0:
            before = count.programs
    assert count.programs == before


@pytest.mark.long
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


def height(q, weight):
    return weight * q[0]


def test_the_numbers_of_a_function_take_its_precision():
    held = models.Parametric(height, weight=2.0)
    assert held(jnp.ones(1, jnp.float32)).dtype == jnp.float32
    assert held(jnp.ones(1)).dtype == jnp.float64
    grouped = models.Parametric(lambda q, gains: q * gains["a"] + gains["b"], gains={"a": 1, "b": (1.0, 2.0)})
    np.testing.assert_array_equal(grouped(jnp.ones(2)), [2.0, 3.0])


def test_a_model_is_differentiable_in_its_parameters():
    """Energy of the beam by its mass: what calibration asks for."""

    def at_rest(model):
        return models.energy(model, jnp.array([0.3, 0.5]), jnp.zeros(2))

    slopes = eqx.filter_grad(at_rest)(models.ball_and_beam(9.81))
    assert float(slopes.potential.parameters["mass"]) == pytest.approx(9.81 * 0.3 * np.sin(0.5))


@pytest.mark.long
def test_what_has_numbers_in_it_may_be_given_to_jax_as_a_function():
    model = models.ball_and_beam()
    observer, u, y = Intrinsic(model, 8.0, 30.0), jnp.zeros(1), jnp.array([0.3, 0.1])
    state = observer.init(y)
    after, _ = jax.jit(observer.step)(state, u, y, jnp.asarray(0.01))
    assert after.q.shape == (2,)
    for function in (model.potential, model.space.matrix, model.space):
        assert np.isfinite(jax.jit(function)(y)).all()
    assert np.isfinite(jax.jit(models.van_der_pol().f)(jnp.zeros(()), y, jnp.zeros(0))).all()
    metric = models.heavy_top().space
    assert jax.jit(metric.connection)(jnp.eye(3), jnp.ones(3), jnp.ones(3)).shape == (3,)


def test_the_geometry_of_a_robot_is_measured_without_a_program(monkeypatch):
    """Its graph in NumPy has the few numbers sooner than JAX compiles the function."""
    robot = scara()
    monkeypatch.setattr(jax, "jit", None)
    assert models.survey(robot, samples=3).samples == 3
