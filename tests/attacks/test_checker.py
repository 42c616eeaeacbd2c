"""The checker alone: what a prover that was blind, or a liar, would have certified it refuses.

A certificate of a harmless mass on a line is presented as one of another model. What differs in the graph that the file
holds is overlooked on purpose: the refusal has to come from the checker's own reading of the model.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.certificates import certify, check, parse
from covariant.certificates.checking import _check
from covariant.certificates.proving import _certify
from covariant.geometry import lie
from covariant.observers import Intrinsic

RECIPE = {"attribute": "somebody:s", "parameters": {}}


def line(dissipation=None, metric=lambda q: jnp.eye(1), force=None, potential=lambda q: 0 * q[0]):
    return models.Lagrangian(metric, potential, force, dissipation, coordinates=("x",), units=("m",))


def certified(model, **more):
    given = {"velocity": 1.0, "error": 0.1, "position": (-1.0, 1.0), "input": 0.5} | more
    found = certify(Intrinsic(model, 10.0, 50.0), **given, recipe=RECIPE)
    assert found.statement.verdict == "holds"
    return found


@pytest.fixture(scope="module")
def harmless(tmp_path_factory):
    return certified(line(lambda q, v: -v)).save(tmp_path_factory.mktemp("line") / "harmless.json")


def shown_as(path, model, monkeypatch):
    """Check a certificate as one of another model, whose graph is not compared."""
    graph = parse(path).graph
    monkeypatch.setattr(_check, "value_graph", lambda about: graph)
    return check(path, model=model)


@jax.custom_jvp
def braking(v):
    """Says that it brakes, and drives."""
    return 50.0 * v


@braking.defjvp
def _(primals, tangents):
    return braking(*primals), -tangents[0]


@jax.custom_vjp
def secret(v):
    return 50.0 * v


secret.defvjp(lambda v: (secret(v), None), lambda _, g: (-g,))

UNDEFINED, FALSE, SHORT = "definedness of the observer", r"claims\[0\] is not shown", "makes numbers shorter"
LAWS = {
    "a step": (lambda q, v: -v + 50 * jnp.where(v > 0, 1.0, -1.0), UNDEFINED),
    "a step at the border": (lambda q, v: -v + 50 * jnp.where(q >= 1.1, 1.0, -1.0), UNDEFINED),
    "a sign": (lambda q, v: -v + 50 * jnp.sign(v), UNDEFINED),
    "whole numbers": (lambda q, v: -v + 50 * jnp.floor(q), UNDEFINED),
    "rounding": (lambda q, v: -v + 50 * jnp.round(q), UNDEFINED),
    "no part of a root": (lambda q, v: -v + 0 * jnp.sqrt(q), UNDEFINED),
    "no part of an inverse root": (lambda q, v: -v + 0 * jax.lax.rsqrt(q), UNDEFINED),
    "no part of a logarithm": (lambda q, v: -v + 0 * jnp.log(1 + q), UNDEFINED),
    "difference of quotients": (lambda q, v: -v + 1 / q - 1 / q, UNDEFINED),
    "no part of an inverse square": (lambda q, v: -v + 0 * q**-2, UNDEFINED),
    "no part of a real power": (lambda q, v: -v + 0 * q**1.5, UNDEFINED),
    "no part of an angle": (lambda q, v: -v + 0 * jnp.arctan2(q, v - 2), UNDEFINED),
    "no part of a tangent": (lambda q, v: -v + 0 * jnp.tan(q + 1), UNDEFINED),
    "no part of an infinity": (lambda q, v: -v + 0 * jnp.where(q > -5, jnp.inf, 1.0), UNDEFINED),
    "a driving kink": (lambda q, v: -v + 50 * jnp.maximum(v, 0.0), FALSE),
    "a driving size": (lambda q, v: 25 * jnp.abs(v), FALSE),
    "a driving clip": (lambda q, v: 50 * jnp.clip(v, -0.1, 0.1), FALSE),
    "a stopped derivative": (lambda q, v: jax.lax.stop_gradient(51 * v) - v, FALSE),
    "a declared derivative": (lambda q, v: braking(v), FALSE),
    "a declared pullback": (lambda q, v: secret(v), FALSE),
    "declared in a loop": (
        lambda q, v: jax.lax.scan(lambda c, _: (braking(c) / 50, None), 50 * v, None, length=2)[0],
        FALSE,
    ),
    "fewer digits": (lambda q, v: -v.astype(jnp.float32).astype(float), SHORT),
    "fewer bits": (lambda q, v: -jax.lax.reduce_precision(v, exponent_bits=11, mantissa_bits=20), SHORT),
    "driven": (lambda q, v: 50 * v, FALSE),
}


@pytest.mark.core(1)
@pytest.mark.exhaustive("a step")
@pytest.mark.long("a step at the border")
@pytest.mark.parametrize("name", LAWS)
def test_the_checker_sees_for_itself(harmless, monkeypatch, name):
    dissipation, reason = LAWS[name]
    monkeypatch.setattr(_check, "DEPTH", 2)
    monkeypatch.setattr(_check, "DEEPEST", 12)
    every = _check._jobs
    seen = ("the definedness of the observer, without jumps,", 0)  # the others say nothing about friction
    monkeypatch.setattr(_check, "_jobs", lambda document: (job for job in every(document) if job[0] in seen))
    with pytest.raises(ValueError, match=reason):
        shown_as(harmless, line(dissipation), monkeypatch)


def test_a_harmless_certificate_is_found_right(harmless, monkeypatch):
    assert shown_as(harmless, line(lambda q, v: -v), monkeypatch).leaves
    monkeypatch.undo()
    with pytest.raises(ValueError, match="graph: it must be the one that the observer has"):
        check(harmless, model=line(lambda q, v: -2 * v))


@pytest.mark.long("circle")
@pytest.mark.parametrize("kind", ["rotation", "circle"])
def test_errors_of_half_a_turn_are_refused_by_the_checker_too(tmp_path, monkeypatch, kind):
    honest = _certify.check_unique
    monkeypatch.setattr(_certify, "check_unique", lambda observer, error: None)
    if kind == "rotation":
        model = models.GroupSystem(lie.SO2, np.eye(1))
        careless = certify(Intrinsic(model, 10.0, 50.0), velocity=1.0, error=6.0, recipe=RECIPE, checker="off")
        assert careless.statement.verdict == "holds"
        path = careless.save(tmp_path / "careless.json")
    else:
        free = line(lambda q, v: -v)
        path = certified(free, error=4.0).save(tmp_path / "line.json")
        model = models.Lagrangian(
            lambda q: jnp.eye(1), lambda q: 0 * q[0], None, lambda q, v: -v, (0,), coordinates=("x",), units=("m",)
        )
    monkeypatch.setattr(_certify, "check_unique", honest)
    with pytest.raises(ValueError, match="must be below π, at the farthest corner of its box"):
        check(path, model=model)
