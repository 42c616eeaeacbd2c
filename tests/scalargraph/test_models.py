"""Taylor models of the prover hold the numbers of a graph and decide on boxes, and a mistake in them is found out."""

import jax.numpy as jnp
import numpy as np
import pytest

from scalargraph import lower, numbers
from scalargraph.graph import pairs
from scalargraph.proofs import _models, box, prove
from scalargraph.proofs._models import TaylorModel, polynomials

FUNCTIONS = {
    "products": lambda z: z[0] * z[1] * z[2] - (z[0] + z[1]) ** 2 * z[2] ** 2,
    "quotients": lambda z: z[0] / (3 + z[1]) - 1 / (2 + z[2] * z[0]),
    "roots": lambda z: jnp.sqrt(2 + z[0]) * jnp.log(3 + z[1]) + (2.5 + z[2]) ** 1.5,
    "waves": lambda z: jnp.sin(z[0] + 2 * z[1]) * jnp.exp(z[2]) + jnp.cos(z[0] * z[2]),
    "steep": lambda z: jnp.arctan(100 * z[0]) * z[1] + jnp.arctan(100 * z[0]) ** 2,
    "kinks": lambda z: jnp.abs(z[0]) * z[1] + jnp.maximum(z[1], z[2]) - jnp.minimum(z[0], 0.1),
}
LOW, HIGH = np.full(3, -1.0), np.full(3, 1.0)


def distance_outside(function, boxes=30, points=40):
    """By how much values at random points of random boxes lie outside of their polynomials, at most; below 0 within."""
    rng = np.random.default_rng(1)
    lowered = lower(lambda z: jnp.atleast_1d(function(z)), jnp.zeros(3))
    centre, half = rng.uniform(-0.7, 0.7, (boxes, 3)), rng.choice([0.3, 0.03, 1e-4], (boxes, 3))
    found = polynomials(lowered, centre - half, centre + half, np.arange(3))
    s, worst = len(found.owners), -np.inf
    for _ in range(points):
        e = rng.choice([rng.uniform(-1, 1, (boxes, 3)), rng.choice([-1.0, 1.0], (boxes, 3))])
        value = numbers(lowered, centre + half * e)[:, 0]
        at, free = found.centre[0].copy(), found.rest[0].copy()
        for k in range(s):  # symbols of their own may be anything
            at, free = (at + found.terms[k, 0] * e[:, k], free) if k < 3 else (at, free + abs(found.terms[k, 0]))
        for k, (i, j) in enumerate(pairs(s), start=s):
            term = found.terms[k, 0]
            if j < 3:
                at += term * (2 * e[:, i] ** 2 - 1 if i == j else e[:, i] * e[:, j])
            else:
                free += abs(term)
        worst = max(worst, float((abs(value - at) - free).max()))
    return worst


@pytest.mark.parametrize("name", FUNCTIONS)
def test_numbers_lie_within_their_polynomials(name):
    assert distance_outside(FUNCTIONS[name]) <= 1e-13


def without(**parts):
    """A product in which some parts of the remainder are forgotten."""
    right = TaylorModel.__mul__

    def product(a, b):
        found = right(a, b)
        return TaylorModel(
            found.on, found.at, found.line, found.bend, parts.get("rest", 0.0) * found.rest, found.shares
        )

    return product


@pytest.mark.parametrize("name", ["products", "quotients", "waves"])
def test_a_forgotten_remainder_is_found_out(name, monkeypatch):
    if name == "products":
        monkeypatch.setattr(TaylorModel, "__mul__", without(rest=0.0))
    else:
        right = _models._with_derivatives

        def flat(op, given):  # the third derivative taken for zero
            graph, outputs = right(op, given)
            return graph, (*outputs[:3], graph.constant(0.0))

        monkeypatch.setattr(_models, "_with_derivatives", flat)
    assert distance_outside(FUNCTIONS[name]) > 1e-9


def test_a_symbol_that_is_forgotten_is_found_out(monkeypatch):
    right = _models._with_symbol

    def forgetful(found, owners):
        made = right(found, owners)
        return TaylorModel(made.on, made.at, made.line * np.array([[1.0], [0.0]]), made.bend, made.rest, made.shares)

    monkeypatch.setattr(_models, "_with_symbol", forgetful)
    assert distance_outside(FUNCTIONS["steep"]) > 1e-3


def matrix(z):
    """Positive definite but for two corners of the unit box where `z[2]` is above 1."""
    c, s = jnp.cos(z[0]), jnp.sin(z[0])
    turn = jnp.array([[c, -s], [s, c]])
    inner = jnp.array([[1.2, z[1] * z[2]], [z[1] * z[2], 1.2]]) / (2 + z[0])
    return turn @ inner @ turn.T


def test_models_decide_a_matrix_by_few_boxes():
    """Bounds of its first and second derivatives took 295 boxes."""
    right, wrong = (box(a=(-1.0, 1.0), b=(-1.0, 1.0), c=(-1.0, most)) for most in (1.0, 1.3))
    proved = prove(matrix, right)
    assert proved.verdict == "holds"
    assert 1 < proved.boxes < 295
    found = prove(matrix, wrong)
    assert found.verdict == "fails"
    assert found.counterexample is not None


def test_a_box_where_nothing_is_defined_is_halved_across_the_variable_to_blame():
    """The divisor may vanish on boxes that are wide in b alone, whatever else there is."""
    found = prove(
        lambda z: jnp.array([[1 + 0.01 * z[0] * z[2] / (z[1] * z[1] - 2 * z[1] + 1.05)]]),
        box(a=(-1.0, 1.0), b=(-2.0, 2.0), c=(-1.0, 1.0)),
    )
    assert found.verdict == "holds"
    halved = np.concatenate(found.levels)
    assert (halved[halved >= 0] == 1).all()
