"""Declared derivatives: functions whose values are true and whose derivatives, as JAX takes them, are not.

What is said of such a function is what is said of the same one without a lie, or it is refused.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.certificates import feedthrough, observability
from covariant.certificates.everywhere._coupling import compare_connections
from covariant.models import StateSpace, marine
from covariant.simulation import Backstepping, lissajous
from scalargraph import lower, to_jax
from scalargraph.graph import change
from scalargraph.proofs import box, derivative_form, prove


def with_rule(function):
    """The derivative that it declares has the wrong sign, and is five times as large."""
    lying = jax.custom_jvp(function)
    lying.defjvp(lambda x, d: (function(*x), -5.0 * jax.jvp(function, x, d)[1]))
    return lying


def in_reverse(function):
    lying = jax.custom_vjp(function)
    lying.defvjp(lambda x: (function(x), None), lambda _, g: (jnp.zeros_like(g),))
    return lying


LIES = {
    "stop_gradient": lambda f: lambda x: jax.lax.stop_gradient(f(x)),
    "custom_jvp": with_rule,
    "custom_vjp": in_reverse,
    "in a branch": lambda f: lambda x: jax.lax.cond(jnp.sum(x) < 1e3, lambda y: jax.lax.stop_gradient(f(y)), f, x),
    "in a jitted function": lambda f: jax.jit(lambda x: f(jax.lax.stop_gradient(x))),
    "in a loop": lambda f: lambda x: jax.lax.fori_loop(0, 2, lambda i, y: jax.lax.stop_gradient(f(x)), 0 * x),
    "without a graph": lambda f: lambda x: jax.lax.stop_gradient(f(x)) + 0 * jnp.linalg.eigvalsh(jnp.eye(3) + x[0])[0],
}
NO_GRAPH = [LIES["in a branch"], LIES["without a graph"]]
EVERY = pytest.mark.parametrize("lie", LIES.values(), ids=LIES)
X = jnp.array([0.4, -0.7])
POINTS = np.random.default_rng(0).uniform(-0.9, 0.9, (6, 2))


def system(f, h=lambda x: x[:1], **options):
    return StateSpace(lambda t, x, u: f(x), lambda t, x, u: h(x), coordinates=("a", "b"), **options)


def test_a_function_of_its_graph_has_neither_rules_nor_a_state():
    calls = []

    def counting(x):
        calls.append(1)
        return jax.lax.stop_gradient(x) * len(calls)

    plain = to_jax(lower(counting, X))
    assert [plain(X).tolist() for _ in range(3)] == [X.tolist()] * 3
    assert jax.jacfwd(plain)(X).tolist() == np.eye(2).tolist()


@pytest.mark.core(1)
@pytest.mark.parametrize("steep", [1.0, 1e3, 1e5])
def test_a_steep_function_keeps_the_derivative_of_jax(steep):
    _, slope = change(lambda s: jnp.tanh(steep * (s + 0.1 / steep)))
    assert slope == pytest.approx(steep / np.cosh(0.1) ** 2, rel=1e-12)


@pytest.mark.core(1)
@pytest.mark.parametrize("size", [1e-3, 1.0, 1e4])
def test_a_declared_change_is_found_at_any_size(size):
    _, slope = change(lambda s: jnp.stack([1e3 * s, size * jax.lax.stop_gradient(jnp.sin(s + 1.0))]))
    np.testing.assert_allclose(slope, [1e3, size * np.cos(1.0)], rtol=1e-6, atol=2e-6 * size)


STAIRS = {
    "round": lambda x: jnp.round(1e6 * x) / 1e6,
    "floor": lambda x: jnp.floor(1e6 * x) / 1e6,
    "integers": lambda x: (1e6 * x).astype(int).astype(float) / 1e6,
    "sign": lambda x: jnp.sign(x) * 1e-3,
    "steps": lambda x: jnp.where(x < 0.0, x, x + 1e-3),
}


@pytest.mark.core(1)
@pytest.mark.parametrize("stairs", STAIRS.values(), ids=STAIRS)
def test_nothing_holds_between_states_of_a_function_that_jumps(stairs):
    """Its derivative at the states is true, and says nothing of how far the function rises between them."""

    def f(x):
        return jnp.stack([-x[0], 9.0 * stairs(x[1]) - x[1]])

    found = observability(system(f), lambda x: jnp.eye(2), POINTS)
    assert found.condition_1.verdict != "holds"
    assert "any distance" not in found.verdict


def test_what_calls_back_is_refused():
    def called(x):
        return jax.pure_callback(
            lambda a: np.sin(a), jax.ShapeDtypeStruct(x.shape, x.dtype), x, vmap_method="sequential"
        )

    with pytest.raises(ValueError, match="Pure callbacks do not support JVP"):
        observability(system(called), lambda x: jnp.eye(2), POINTS)


def test_a_function_that_counts_its_calls_is_one_function_in_a_proof():
    """From the second trace on it would be another one: what a proof reads is one trace."""
    calls = []

    def flow(t, x, z):
        calls.append(1)
        return (-x if len(calls) < 5 else 5.0 * x,)

    def slopes(derivatives, nodes, k):
        return (derivatives.each(nodes[0], range(1, 1 + k)),)

    form = derivative_form(flow, lambda z: z, slopes, lambda a: -a)
    assert prove(form, box(x=(-1.0, 1.0))).verdict == "holds"
    assert len(calls) == 1


def test_the_coupling_of_a_craft_is_that_of_its_transformation():
    def rotated(eta):
        return jnp.stack([jnp.stack([jnp.cos(eta[0]), 0 * eta[0]]), jnp.stack([eta[0], 1.0 + eta[1] ** 2])])

    def jacobians(transform):
        names = {"coordinates": ("x", "y"), "units": ("m", "m"), "velocities": ("u", "v")}
        craft = marine.Craft(np.eye(2), transform, lambda nu: jnp.eye(2), **names)
        law = Backstepping(craft, lissajous([0.0, 0.0], [0.0, 0.0], 1.0), kp=1.0, kd=1.0, lam=1.0)
        return feedthrough(law)(jnp.array([0.3, 0.2, 0.5, -0.4]))[0]

    np.testing.assert_allclose(jacobians(LIES["custom_jvp"](rotated)), jacobians(rotated), rtol=1e-12)


def beam(metric):
    return models.Lagrangian(metric, lambda q: 0.0 * q[0], None, coordinates=("r", "theta"), units=("m", "rad"))


def polar(q):
    return jnp.diag(jnp.stack([jnp.ones(()), 1.0 + q[0] ** 2]))


PLACES = box(r=(-2.5, 2.5), theta=(-4.0, 4.0))


def test_connections_are_sampled_where_the_metric_chooses():
    """Where no position was drawn, a metric with a choice may be another one."""
    found = compare_connections(beam(lambda q: jnp.where(q[0] > 9.0, 1.0, polar(q))).space, PLACES, 50)
    assert (found.evidence, found.verdict) == ("sampled", "holds")
