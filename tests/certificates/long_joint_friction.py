"""What takes long of `test_joint_friction.py`."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from forging import forged, put
from test_joint_friction import two_links

from covariant import models
from covariant.certificates import certify, check, error_system, optimal_lyapunov
from covariant.certificates.base._inequalities import contraction
from covariant.certificates.checking import _check
from covariant.certificates.proving import _certify
from covariant.certificates.proving._joint_bounds import friction_bounds
from covariant.models import MechanicalSystem
from covariant.observers import Intrinsic
from scalargraph import numbers
from scalargraph.errors import InputError

Q = optimal_lyapunov(10.0, 50.0, 3.0)


DRY = {
    "system": "pendulum_chain",
    "parameters": {"mass": [1.0], "length": [0.5], "coulomb": [0.05], "viscous": [0.01]},
}


BOUNDS = {"velocity": 2.0, "error": 0.05, "position": (-3.0, 3.0), "input": 0.1, "q": Q, "rate": 1.0}


def pendulum():
    model = models.from_recipe(DRY)
    assert isinstance(model, MechanicalSystem)
    return Intrinsic(model, 10.0, 50.0)


@pytest.fixture(scope="module")
def proved():
    return certify(pendulum(), **BOUNDS, recipe=DRY)


def test_the_matrix_is_that_of_friction_as_a_function_where_value_and_slope_are_its_own():
    model = two_links(viscous=(0.01, 0.02), coulomb=(0.09, 0.05))
    observer, rng = Intrinsic(model, 60.0, 1800.0), np.random.default_rng(0)
    q = optimal_lyapunov(60.0, 1800.0, 18.0)
    place, force = rng.uniform(-2, 2, 2), rng.uniform(-1, 1, 2)
    found = []
    for joint in (False, True):
        system = error_system(observer, q, joint)
        graph = contraction(system, 4.0).graph(jnp.zeros(len(system.names))).entries
        found.append(functools.partial(numbers, graph))
    function, variables = found
    for speed in (0.004, 1.0):
        v = rng.uniform(-speed, speed, 2)
        value = np.asarray(model.dissipation(jnp.zeros(2), v))
        slope = -np.diag(np.asarray(jax.jacfwd(lambda v: model.dissipation(jnp.zeros(2), v))(v)))
        z = np.concatenate([place, v, rng.uniform(-0.1, 0.1, 2), force])
        expected = function(z)
        size = np.sqrt(np.outer(*[np.abs(np.diag(expected.reshape(4, 4)))] * 2)).ravel()
        for wrong, (r, d) in enumerate(((value, slope), (-value, slope), (value, 1.1 * slope))):
            away = (np.abs(variables(np.concatenate([z, r, d])).ravel() - expected.ravel()) / size).max()
            assert away > 1e-6 if wrong else away < 1e-11


@pytest.mark.exhaustive
def test_a_pendulum_with_dry_friction_needs_few_boxes(proved):
    assert proved.statement.proved
    assert proved.kinds[-2:] == ("friction", "friction slope")
    assert proved.boxes < 100
    assert any("slopes of friction stay within" in premise.text for premise in proved.statement.hypotheses)


def unbounded(model, speed):
    raise InputError("no bound")


@pytest.mark.parametrize(
    "bounds",
    [unbounded, lambda model, speed: (np.array([[-1.0], [1.0]]), np.array([[-100.0], [100.0]]))],
    ids=["no bounds", "slopes of any sign"],
)
def test_friction_without_bounds_of_its_own_is_a_function_of_the_velocity(bounds, monkeypatch):
    """Slopes that are none of the model refute nothing."""
    monkeypatch.setattr(_certify, "friction_bounds", bounds)
    found = certify(pendulum(), **BOUNDS, boxes=200, checker="off")
    assert found.statement.verdict != "fails"
    assert found.kinds[-1] == "force"


FRICTION = "the bound of the friction"


FORGERIES = {
    "friction": (put("box.high[4]", 0.07), f"{FRICTION} is not shown"),
    "slope": (put("box.high[5]", 1.0), f"{FRICTION}'s slopes is not shown"),
    "least slope": (put("box.low[5]", 0.1), f"{FRICTION}'s slopes is not shown"),
    "no friction": (put("box", lambda box: {side: box[side][:4] for side in box}), r"graph: it must be|levels|letters"),
    "one variable": (put("box", lambda box: {side: box[side][:5] for side in box}), "bounds of 4 or 6 variables"),
    "coulomb": (put("recipe.parameters.coulomb", [0.06]), f"{FRICTION} is not shown"),
    "rate": (put("rate", 6.0), r"claims\[0\] is not shown"),
}


@pytest.mark.exhaustive("slope", "least slope", "friction", "rate")
@pytest.mark.parametrize("name", FORGERIES)
def test_a_forged_file_is_refused(proved, tmp_path, monkeypatch, name):
    change, reason = FORGERIES[name]
    monkeypatch.setattr(_check, "DEPTH", 6 if "claims" in reason else 1)
    with pytest.raises(ValueError, match=reason):
        check(forged(proved.save(tmp_path / "proved.json"), tmp_path, change))


@pytest.mark.exhaustive
def test_its_file_is_checked_and_read(proved, tmp_path):
    path = proved.save(tmp_path / "proved.json")
    assert check(path).statement.proved
    loaded = type(proved).load(path)
    assert loaded.kinds == proved.kinds
    assert loaded.document() == proved.document()
