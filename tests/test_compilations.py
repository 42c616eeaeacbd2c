"""Numbers are leaves: another gain, the same model again or one with other parameters compiles nothing."""

import inspect
import tempfile
from pathlib import Path

import equinox as eqx
import jax
import jax.monitoring
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.models import marine
from covariant.models.files._source import system
from covariant.models.files._systems import SYSTEMS

FACTORIES = {name: system(name) for name in SYSTEMS} | {
    name: getattr(marine, name) for name in ("cybership", "odin", "supply_vessel")
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


@pytest.mark.exhaustive("legged_base")
@pytest.mark.core(5)
@pytest.mark.long("robot")
@pytest.mark.parametrize("name", FACTORIES)
def test_a_model_is_made_inside_a_compiled_function(name):
    outside = eqx.filter(FACTORIES[name](), eqx.is_array)
    inside = jax.eval_shape(lambda: eqx.filter(FACTORIES[name](), eqx.is_array))
    assert [x.shape for x in jax.tree.leaves(inside)] == [x.shape for x in jax.tree.leaves(outside)]


@pytest.mark.core(5)
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
