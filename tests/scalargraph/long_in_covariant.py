"""What the observers of covariant ask of the graphs; the other tests here need no covariant."""

import jax.numpy as jnp
import numpy as np
import pytest
from test_lowering import compare_with_jax, entries

from covariant import models
from covariant._linalg import solve, triangular, triangular_with_rank
from covariant.geometry import christoffel, curvature, hyperbolic, sphere
from covariant.geometry.lie import SE3, SO3
from covariant.observers import Intrinsic, with_fixed_substeps
from scalargraph import LoweringError, lower, numbers

PENDULUM = models.pendulum_chain((1.0, 0.7), (0.5, 0.4), viscous=(0.1, 0.2))
FUNCTIONS = {
    "solve": lambda x: solve(jnp.outer(x, x) + 2 * jnp.eye(3), jnp.cos(x)),
    "sphere": lambda x: christoffel(sphere(), x[:2], x[1:], x[:2]),
    "hyperbolic plane": lambda x: curvature(hyperbolic(), x[:2] / 4, x[1:], x[:2], x[::2]),
    "inertia": lambda x: PENDULUM.metric(x[:2]) @ x[1:],
    "forward dynamics": lambda x: models.acceleration(PENDULUM, jnp.zeros(()), x[:2], x[1:], jnp.array([0.1, 0.2])),
    "rotation": lambda x: SO3.exp(x) @ x,
    "logarithm of a rotation": lambda x: SO3.log(SO3.exp(x / 2)),
    "pose": lambda x: SE3.exp(jnp.concatenate([x, jnp.sin(x)])),
}


@pytest.mark.exhaustive("forward dynamics", "logarithm of a rotation", "pose", "rotation", "sphere")
@pytest.mark.parametrize("name", FUNCTIONS)
def test_value_and_two_derivatives_are_those_of_jax(name):
    compare_with_jax(FUNCTIONS[name])


@pytest.mark.exhaustive
def test_substeps_that_friction_decides_are_fixed_beforehand():
    """By rubbing as on the given motions; otherwise their number depends on the state and has no graph."""
    rubbing = models.pendulum_chain((1.0,), (1.0,), viscous=(0.2,), coulomb=(3.0,))
    free, u, dt = Intrinsic(rubbing, 2.0, 1.0), jnp.zeros(1), jnp.asarray(0.01)
    q, v = jnp.array([[0.3], [0.5]]), jnp.array([[0.0], [2.0]])
    fixed = with_fixed_substeps(free, 100.0, q, v, jnp.zeros((2, 1)))
    assert fixed.substeps == 4  # (0.2 + 3 · 100) / 1 · 0.01, rounded up
    states = [free.init(a)._replace(v=b) for a, b in zip(q, v, strict=True)]
    with pytest.raises(LoweringError, match="while"):
        lower(lambda s, y: free.step(s, u, y, dt)[0], states[0], q[0])
    graph = lower(lambda s, y: fixed.step(s, u, y, dt)[0], states[0], q[0])
    for state in states:
        ours, theirs = numbers(graph, state, state.q + 0.01), free.step(state, u, state.q + 0.01, dt)[0]
        np.testing.assert_allclose([*ours.q, *ours.v], [*theirs.q, *theirs.v], rtol=1e-12)
    for observer, rate in ((fixed, 100.0), (free, 0.0), (free, np.nan)):
        with pytest.raises(ValueError, match="with_fixed_substeps"):
            with_fixed_substeps(observer, rate, q, v, jnp.zeros((2, 1)))


def block(a, b):
    """A product of which some rows have zeros at the same places, as those of a transition."""
    return jnp.concatenate([a, jnp.eye(15, 20)]) @ b


@pytest.mark.parametrize(
    ("function", "shapes"),
    [
        (jnp.matmul, [(15, 14), (14, 16)]),
        (block, [(9, 20), (20, 16)]),
        (triangular, [(14, 20)]),
        (triangular_with_rank, [(14, 20)]),
    ],
)
def test_large_products_and_factors_stay_loops_in_generated_code(function, shapes):
    random = np.random.default_rng(0)
    arguments = [random.normal(size=shape) for shape in shapes]
    looped, unrolled = (lower(function, *arguments, loops=loops) for loops in ("any", "unrolled"))
    assert entries(looped.graph) < entries(unrolled.graph) / 2
    expected = np.asarray(function(*arguments))
    np.testing.assert_allclose(numbers(looped, *arguments), expected, atol=1e-13)
    np.testing.assert_allclose(numbers(unrolled, *arguments), expected, atol=1e-13)
