"""Friction in joints as variables of a proof in continuous time: its force and its slope, beside the velocity."""

import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant._errors import InputError
from covariant.certificates import certify, check, error_system, optimal_lyapunov
from covariant.certificates.base._inequalities import contraction
from covariant.certificates.checking import _check
from covariant.certificates.proving import _certify
from covariant.certificates.proving._joint_bounds import friction_bounds, has_dry_friction
from covariant.lowering import numbers
from covariant.models import Lagrangian, MechanicalSystem
from covariant.observers import Intrinsic
from covariant.proofs import digest

Q = optimal_lyapunov(10.0, 50.0, 3.0)
DRY = {
    "system": "pendulum_chain",
    "parameters": {"mass": [1.0], "length": [0.5], "coulomb": [0.05], "viscous": [0.01]},
}


def two_links(**friction):
    return models.pendulum_chain(mass=(0.6, 0.4), length=(0.3, 0.2), inertia=(0.05, 0.02), **friction)


def pendulum():
    model = models.from_recipe(DRY)
    assert isinstance(model, MechanicalSystem)
    return Intrinsic(model, 10.0, 50.0)


@pytest.fixture(scope="module")
def proved():
    observer = pendulum()
    return certify(observer, velocity=2.0, error=0.05, position=(-3.0, 3.0), input=0.1, q=Q, rate=1.0, recipe=DRY)


@pytest.mark.long
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


def test_bounds_contain_the_friction_and_its_slopes():
    model = two_links(viscous=(0.01, 0.02), coulomb=(0.09, 0.05))
    speed = np.array([0.5, 2.0])
    (low, high), (least, largest) = friction_bounds(model, speed)
    friction = functools.partial(model.dissipation, jnp.zeros(2))
    for share in np.linspace(-1, 1, 41):
        v = share * speed
        assert ((low <= friction(v)) & (friction(v) <= high)).all()
        slopes = -np.diag(np.asarray(jax.jacfwd(friction)(v)))
        assert ((least <= slopes) & (slopes <= largest)).all()


@pytest.mark.parametrize(
    ("friction", "dry"),
    [
        (lambda q, v: -jnp.arctan(100 * v), True),
        (lambda q, v: -2 * v, False),
        (lambda q, v: -v * jnp.abs(v) - v, False),
        (lambda q, v: -(1 + q**2) * jnp.arctan(100 * v), False),
        (lambda q, v: -jnp.arctan(100 * v[::-1]), False),
        (lambda q, v: -jnp.sign(v), True),  # that it has no slope is for `friction_bounds` to say
    ],
)
def test_dry_friction_is_recognised(friction, dry):
    model = Lagrangian(lambda q: jnp.eye(2), lambda q: 0.0 * q[0], None, friction, coordinates=("a", "b"))
    assert has_dry_friction(model, np.ones(2)) == dry


@pytest.mark.exhaustive
def test_a_pendulum_with_dry_friction_needs_few_boxes(proved):
    assert proved.statement.proved
    assert proved.kinds[-2:] == ("friction", "friction slope")
    assert proved.boxes < 100
    assert any("slopes of friction stay within" in premise.text for premise in proved.statement.hypotheses)


def test_friction_without_bounds_is_a_function_of_the_velocity(monkeypatch):
    def unbounded(model, speed):
        raise InputError("no bound")

    monkeypatch.setattr(_certify, "friction_bounds", unbounded)
    observer = pendulum()
    found = certify(
        observer, velocity=2.0, error=0.05, position=(-3.0, 3.0), input=0.1, q=Q, rate=1.0, boxes=200, checker="off"
    )
    assert found.kinds[-1] == "force"
    assert found.statement.verdict != "fails"


@pytest.mark.long
def test_friction_that_is_none_of_the_model_refutes_nothing(monkeypatch):
    """Slopes of any sign refute contraction; those of the model do not."""
    wide = np.array([[-1.0], [1.0]]), np.array([[-100.0], [100.0]])
    monkeypatch.setattr(_certify, "friction_bounds", lambda model, speed: wide)
    observer = pendulum()
    found = certify(
        observer, velocity=2.0, error=0.05, position=(-3.0, 3.0), input=0.1, q=Q, rate=1.0, boxes=200, checker="off"
    )
    assert found.statement.verdict != "fails"
    assert found.kinds[-1] == "force"


def end(side, index, number):
    def change(document):
        document["box"][side][index] = number

    return change


def shorter(document):
    for side in ("low", "high"):
        document["box"][side] = document["box"][side][:4]


FORGERIES = {
    "friction": (end("high", 4, 0.07), "the bound of the friction is not shown"),
    "slope": (end("high", 5, 1.0), "the bound of the friction's slopes is not shown"),
    "least slope": (end("low", 5, 0.1), "the bound of the friction's slopes is not shown"),
    "no friction": (shorter, r"graph: it must be|levels|letters"),
    "one variable": (lambda d: [d["box"][side].pop() for side in ("low", "high")], "bounds of 4 or 6 variables"),
    "coulomb": (lambda d: d["recipe"]["parameters"].update(coulomb=[0.06]), "the bound of the friction is not shown"),
    "rate": (lambda d: d.update(rate=6.0), r"claims\[0\] is not shown"),
}


@pytest.mark.long("coulomb", "least slope", "no friction", "slope")
@pytest.mark.exhaustive("friction", "rate")
@pytest.mark.parametrize("name", FORGERIES)
def test_a_forged_file_is_refused(proved, tmp_path, monkeypatch, name):
    change, reason = FORGERIES[name]
    monkeypatch.setattr(_check, "DEPTH", 6 if "claims" in reason else 1)
    document = json.loads(proved.save(tmp_path / "proved.json").read_text(encoding="utf-8"))
    change(document)
    document["digest"] = digest({key: value for key, value in document.items() if key != "digest"})
    (tmp_path / "forged.json").write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(ValueError, match=reason):
        check(tmp_path / "forged.json")


@pytest.mark.exhaustive
def test_its_file_is_checked_and_read(proved, tmp_path):
    path = proved.save(tmp_path / "proved.json")
    assert check(path).statement.proved
    loaded = type(proved).load(path)
    assert loaded.kinds == proved.kinds
    assert loaded.document() == proved.document()
