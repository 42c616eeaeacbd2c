"""Where a function of real numbers is defined and does not jump, and that its graph forgets neither."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scalargraph import Graph, LoweringError, enclose, evaluate, expand, fulfilled, lower, numbers
from scalargraph.graph import NUMBERS, Derivative, substitute


def everywhere(function, low, high):
    """Whether all conditions of a function of (x, y) are shown over one box."""
    lowered = lower(function, jnp.zeros(2), real=True)
    return bool(fulfilled(lowered.conditions, np.array([low], float), np.array([high], float)).all())


NEEDS = {
    # A function, and of x an interval on which it is not defined, or just so, where y is between ½ and 1½; it is
    # defined where x is between ¼ and 0.45.
    "quotient": (lambda x, y: 1 / x, (0.0, 0.25)),
    "difference of quotients": (lambda x, y: 1 / x - 1 / x, (-0.1, 0.1)),
    "no part of a root": (lambda x, y: 0 * jnp.sqrt(x), (0.0, 0.25)),
    "inverse root": (lambda x, y: jax.lax.rsqrt(x), (0.0, 0.25)),
    "logarithm": (lambda x, y: jnp.log(x), (0.0, 0.25)),
    "log1p": (lambda x, y: jnp.log1p(-x), (0.25, 1.0)),
    "arc sine": (lambda x, y: jnp.arcsin(x), (0.25, 1.0)),
    "arc cosine": (lambda x, y: jnp.arccos(-x), (0.25, 1.0)),
    "area tangent": (lambda x, y: jnp.arctanh(x), (-1.0, 0.0)),
    "area cosine": (lambda x, y: jnp.arccosh(1 + x), (0.0, 0.1)),
    "cubic root": (lambda x, y: jnp.cbrt(x), (-0.1, 0.0)),
    "tangent": (lambda x, y: jnp.tan(x), (1.5, 1.6)),
    "real power": (lambda x, y: x**1.5, (0.0, 0.25)),
    "power of a power": (lambda x, y: x**y, (0.0, 0.25)),
    "inverse square": (lambda x, y: x**-2, (-0.5, 0.0)),
    "angle on its cut": (lambda x, y: jnp.arctan2(x, -y), (0.0, 0.25)),
    "angle at the origin": (lambda x, y: jnp.arctan2(x, y - 0.5), (-0.1, 0.1)),
    "sign": (lambda x, y: jnp.sign(x), (-0.1, 0.0)),
    "floor": (lambda x, y: jnp.floor(x), (0.5, 1.0)),
    "ceiling": (lambda x, y: jnp.ceil(x), (0.0, 0.5)),
    "rounding": (lambda x, y: jnp.round(x - 0.1), (0.5, 0.6)),
    "whole part": (lambda x, y: x.astype(int).astype(float), (0.5, 1.0)),
    "choice": (lambda x, y: jnp.where(x < 0.8, 1.0, 2.0), (0.25, 0.8)),
    "choice from above": (lambda x, y: jnp.where(x >= 0.2, y, 2.0), (0.2, 0.25)),
    "choice without effect": (lambda x, y: 0 * jnp.where(x < 0.8, 1.0, 2.0), (0.25, 0.8)),
    "exact equality": (lambda x, y: jnp.where(x == 0, 1.0, 2.0), (0.0, 0.0)),
    "both of two": (lambda x, y: jnp.where((x > 0.1) & (y > 0.1), 1.0, 2.0), (0.1, 0.2)),
    "largest place": (lambda x, y: jnp.argmax(jnp.stack([x, y])).astype(float), (0.2, 0.5)),
    "place in a table": (lambda x, y: jnp.array([1.0, 5.0, 9.0])[jnp.floor(x).astype(int)], (0.5, 1.0)),
    "inside a loop": (
        lambda x, y: jax.lax.fori_loop(0, 2, lambda i, c: c + jnp.where(x < 0.8, 1.0, 2.0), 0.0),
        (0.25, 0.8),
    ),
    "behind a stopped derivative": (lambda x, y: jax.lax.stop_gradient(jnp.sign(x)), (0.0, 0.25)),
}


@pytest.mark.parametrize("name", NEEDS)
def test_what_is_defined_and_does_not_jump_is_shown_and_nothing_else(name):
    function, bad = NEEDS[name]
    assert everywhere(lambda z: function(*z), (0.25, 0.5), (0.45, 1.5))
    assert not everywhere(lambda z: function(*z), *zip(bad, (0.5, 1.5), strict=True))


ALWAYS = {
    "size": lambda z: jnp.abs(z[0]),
    "minimum and maximum": lambda z: jnp.minimum(z[0], z[1]) + jnp.maximum(z[0], 0.0) + jnp.clip(z[1], -0.1, 0.1),
    "rectified": lambda z: jax.nn.relu(z[0]),
    "size by a choice": lambda z: jnp.where(z[0] < 0, -z[0], z[0]) + jnp.where(z[1] >= 0, z[1], -z[1]),
    "size by the other choice": lambda z: jnp.where(z[0] > 0, z[0], -z[0]) + jnp.where(z[1] <= 0, -z[1], z[1]),
    "smaller by a choice": lambda z: jnp.where(z[0] < z[1], z[0], z[1]) + jnp.where(z[0] > z[1], z[1], z[0]),
    "larger by a choice": lambda z: jnp.where(z[0] > 0, z[0], 0.0) + jnp.where(z[0] <= z[1], z[1], z[0]),
    "missing?": lambda z: jnp.where(jnp.isnan(z[0]), 0.0, z[0]) + jnp.where(jnp.isfinite(z[1]), z[1], 0.0),
    "whole power": lambda z: z[0] ** 3 + z[1] ** 2.0,
    "infinite bound": lambda z: jnp.clip(z[0], -jnp.inf, jnp.inf),
    "slope of a maximum": lambda z: jnp.minimum(z[0], jnp.inf),
}


@pytest.mark.core(4)
@pytest.mark.parametrize("name", ALWAYS)
def test_what_is_continuous_by_construction_owes_nothing(name):
    lowered = lower(ALWAYS[name], jnp.zeros(2), real=True)
    assert lowered.conditions.conditions == ()
    z = np.random.default_rng(0).normal(size=(200, 2))
    np.testing.assert_allclose(numbers(lowered, z), jax.vmap(ALWAYS[name])(z), rtol=1e-15)


@pytest.mark.parametrize(
    "function",
    [
        lambda z: z[0] * jnp.nan * 0,
        lambda z: z[0] + 0 * jnp.inf,
        lambda z: z[0] / (jnp.inf * z[1] + 1),
        lambda z: z[0] * jnp.exp(jnp.float64(800.0)) * 0,
        lambda z: z[0] + jnp.sqrt(jnp.float64(-1.0)) * 0 * z[1],
        lambda z: z[0] * 0 / (z[1] - z[1]),
    ],
)
def test_what_is_no_number_is_never_defined(function):
    assert not everywhere(function, (0.2, 0.2), (0.3, 0.3))


def test_a_condition_names_the_operation_and_its_line():
    def force(z):
        return jnp.where(z[0] > 0, 1.0, -1.0) / z[1]

    because = [c.because for c in lower(force, jnp.zeros(2), real=True).conditions.conditions]
    assert len(because) == 2
    for words, op in zip(sorted(because), ("div", "select"), strict=True):
        assert words.startswith(f"{op} at test_conditions.py:")
        assert "force" in words


def test_numbers_that_are_made_shorter_are_refused_where_they_are_real():
    for function in (
        lambda x: x.astype(jnp.float32).astype(float),
        lambda x: jax.lax.reduce_precision(x, exponent_bits=11, mantissa_bits=20),
    ):
        lower(function, jnp.zeros(()))
        with pytest.raises(LoweringError, match=r"no function of real numbers"):
            lower(function, jnp.zeros(()), real=True)
    lower(lambda x: x.astype(float), jnp.zeros((), jnp.float32), real=True)


def test_slopes_at_kinks_are_those_of_both_sides():
    """Clarke's generalised derivative of |x| x + max(y, 0) + min(x, y), on boxes that touch the kinks or hold them."""

    def function(z):
        return jnp.abs(z[0]) + jnp.maximum(z[1], 0.0)

    slopes = expand(lower(function, jnp.zeros(2), real=True), [0, 1], 1)
    low, high = (
        np.array([[0.0, 0.0], [0.0, -1.0], [-1.0, 0.1], [-1.0, -1.0]]),
        np.array([[0.0, 1], [1, 0], [1, 2], [1, 1]]),
    )
    found = enclose(slopes, low, high)
    assert found.low[:, 1].tolist() == [-1.0, -1.0, -1.0, -1.0]
    assert found.high[:, 1].tolist() == [1.0, 1.0, 1.0, 1.0]
    assert found.low[:, 2].tolist() == [0.0, 0.0, 1.0, 0.0]
    assert found.high[:, 2].tolist() == [1.0, 1.0, 1.0, 1.0]
    assert not found.smooth.any()
    away = enclose(slopes, np.array([[0.1, -2.0]]), np.array([[1.0, -0.1]]))
    assert away.smooth.all()
    assert away.low[0, 1:].tolist() == away.high[0, 1:].tolist() == [1.0, 0.0]


def test_a_kink_at_a_variable_that_became_a_number_keeps_both_slopes():
    lowered = lower(lambda z: jnp.abs(z[0]), jnp.zeros(2), real=True)
    graph = Graph.of(lowered.graph.nodes)
    slope = Derivative(graph, {0: graph.constant(1.0)})(lowered.outputs[0])
    into = Graph()
    (node,) = substitute(graph, [slope], into, {0: into.constant(0.0), 1: into.input(1)})
    assert into.nodes[node].op == "either"
    (node,) = substitute(graph, [slope], into, {0: into.constant(-2.0), 1: into.input(1)})
    assert into.nodes[node].value == -1.0


def test_derivatives_along_a_direction_are_those_of_jax():
    def function(z):
        return jnp.sin(z[0]) * z[1] + z[0] ** 3 / (2 + z[1])

    lowered = lower(function, jnp.zeros(2), real=True)
    graph = Graph.of(lowered.graph.nodes)
    x, y = graph.input(0), graph.input(1)
    along = Derivative(graph, {0: y, 1: graph.apply("mul", x, x)})(lowered.outputs[0])
    z = np.random.default_rng(1).uniform(0.1, 1, (20, 2))
    small, outputs = graph.pruned([along])
    found = evaluate(lowered._replace(graph=small, outputs=tuple(outputs)), NUMBERS, list(z.T))
    wanted = jax.vmap(lambda z: jax.jvp(function, (z,), (jnp.stack([z[1], z[0] ** 2]),))[1])(z)
    np.testing.assert_allclose(found[0], wanted, rtol=1e-13)
