"""Splitting a function into what its first inputs decide, and the rest: together they compute the same."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scalargraph import Lowered, lower, numbers, split


def count(lowered: Lowered) -> int:
    """Operations, each of a turn of a loop once."""
    inner = [loop for node in lowered.graph.nodes if node.op == "loop" for loop in node.value.graphs]
    work = [node for node in lowered.graph.nodes if node.op not in ("input", "constant", "loop", "part")]
    return len(work) + sum(map(count, inner))


def known_length(a, x):
    """A turn of 400 operations, of which half are of `a` alone."""

    def turn(x, _):
        w = a
        for k in range(100):
            w = jnp.sin(w) + k
        for k in range(70):
            x = jnp.cos(x) * w + jnp.where(a > 0.5, x, 0.1) + k
        return x, None

    return jax.lax.scan(turn, x, None, length=3)[0]


def unknown_length(a, x):
    return jax.lax.while_loop(
        lambda s: s < jnp.sqrt(a) * jnp.exp(a), lambda s: s + jnp.log(1 + a) * jnp.where(a > 0.3, 0.2, 0.1), x
    )


def nested(a, x):
    return unknown_length(a, known_length(a, x) * 0.0 + jnp.minimum(x, jnp.square(a)))


FUNCTIONS = {
    "results of both": lambda a, x: (jnp.sqrt(a), a * x, x, jnp.ones(2)),
    "a truth value": lambda a, x: jnp.where((a > 0.4) & (x < a), jnp.exp(a) * x, -x),
    "a quotient": lambda a, x: x / jnp.square(a) + jnp.sin(x) / jnp.square(a),
    "nothing of the rest": lambda a, x: jnp.sqrt(a),
    "nothing of the first": lambda a, x: jnp.sin(x),
    "a loop of known length": known_length,
    "a loop of unknown length": unknown_length,
    "nested": nested,
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_both_parts_together_compute_the_function(name):
    function = FUNCTIONS[name]
    whole = lower(function, jnp.array(0.0), jnp.array(0.0), loops="any")
    first, rest = split(whole, 1)
    for a, x in ((0.35, 0.2), (0.45, -0.3), (0.7, 0.6)):
        d = numbers(first, np.array([a])) if first.outputs else np.zeros(0)
        found = numbers(rest, np.concatenate([np.atleast_1d(d), [x]]))
        for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(numbers(whole, a, x)), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-13)
    assert count(rest) <= count(whole)


def test_what_the_first_inputs_decide_is_computed_once():
    first, rest = split(lower(known_length, jnp.array(0.0), jnp.array(0.0), loops="any"), 1)
    assert not any(node.op == "sin" for node in rest.graph.nodes)
    [loop] = [node.value for node in rest.graph.nodes if node.op == "loop"]
    assert not any(node.op == "sin" for node in loop.body.graph.nodes)
    assert sum(node.op == "sin" for node in first.graph.nodes) == 100
