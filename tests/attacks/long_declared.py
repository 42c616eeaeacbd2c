"""What takes long of `test_declared.py`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_declared import EVERY, LIES, PLACES, POINTS, X, beam, in_reverse, polar, system

from covariant import models, observers
from covariant.certificates import (
    certify_globally,
    contraction,
    contraction_rate,
    observability,
    optimal_lyapunov,
    sampled_system,
)
from covariant.certificates.base import Sampling, correction, corrections, in_coordinates
from scalargraph import along, jacobian


def bent(x):
    return jnp.stack([jnp.sin(x[0]) * x[1], x[1] ** 3 + x[0]])


@pytest.mark.exhaustive("in a branch")
@EVERY
def test_derivatives_are_those_of_the_values(lie):
    lying, direction = lie(bent), jnp.array([0.3, 2.0])
    np.testing.assert_allclose(jacobian(lying, X), jax.jacfwd(bent)(X), rtol=1e-6, atol=1e-8)
    value, slope = along(lying, (X,), (direction,))
    np.testing.assert_allclose(value, bent(X), rtol=1e-12)
    np.testing.assert_allclose(slope, jax.jvp(bent, (X,), (direction,))[1], rtol=1e-6)
    if lie is not in_reverse:  # JAX refuses to differentiate it forwards
        assert not np.allclose(jax.jacfwd(lying)(X), jax.jacfwd(bent)(X), rtol=0.1)


@pytest.mark.parametrize("name", ["stop_gradient", "custom_jvp", "without a graph"])
def test_derivatives_nest_and_read_what_is_traced_outside(name):
    """A second derivative in x and z of a function that reads z from outside, in `jit` and `vmap`."""

    def mixed(differentiate, f):
        return lambda z: differentiate(lambda x: differentiate(lambda y: f(y) * z[0] * x[1], x)[0], z)

    expected = jax.vmap(mixed(lambda f, x: jax.jacfwd(f)(x), bent))(jnp.stack([X, 2 * X]))
    found = jax.jit(jax.vmap(mixed(jacobian, LIES[name](bent))))(jnp.stack([X, 2 * X]))
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


def curved(x):
    return jnp.diag(jnp.stack([1.0 + x[1] ** 2, 2.0 + jnp.sin(x[0])]))


OF_OBSERVABILITY = {
    "f": (lambda x: jnp.stack([-x[0], 3.0 * x[1]]), lambda x: x[:1], lambda x: jnp.eye(2)),
    "h": (lambda x: -2.0 * x, lambda x: x[:1] + 0.3 * x[1:] ** 2, lambda x: jnp.eye(2)),
    "metric": (lambda x: -2.0 * x, lambda x: x[:1], curved),
}


@pytest.mark.exhaustive("without a graph-h", "without a graph-metric")
@pytest.mark.parametrize("where", OF_OBSERVABILITY)
@pytest.mark.parametrize("name", ["stop_gradient", "custom_jvp", "custom_vjp", "without a graph"])
def test_both_conditions_are_those_of_the_values(where, name):
    parts = dict(zip(OF_OBSERVABILITY, OF_OBSERVABILITY[where], strict=True))
    honest = observability(system(parts["f"], parts["h"]), parts["metric"], POINTS)
    parts[where] = LIES[name](parts[where])
    lying = observability(system(parts["f"], parts["h"]), parts["metric"], POINTS)
    for mine, expected in zip(lying[:2], honest[:2], strict=True):
        assert mine.verdict == expected.verdict
        assert mine.margin == pytest.approx(expected.margin, rel=1e-4, abs=1e-5)


@pytest.mark.parametrize("name", ["stop_gradient", "custom_jvp"])
def test_rates_are_those_of_the_values(name):
    flow, metric = LIES[name](bent), LIES[name](curved)
    found = contraction_rate(lambda t, x: flow(x), in_coordinates(lambda t, x: metric(x)), jnp.zeros(()), X)
    p, rate = jax.jvp(curved, (X,), (bent(X),))
    slope = p @ jax.jacfwd(bent)(X)
    half = np.linalg.inv(np.linalg.cholesky(p))
    assert found == pytest.approx(-np.linalg.eigvalsh(half @ (slope + slope.T + rate) @ half.T)[-1], rel=1e-10)


@pytest.mark.parametrize("name", ["none", "stop_gradient", "custom_jvp"])
def test_certificates_of_all_first_errors_need_the_connection_of_the_metric(name):
    """From a metric that declares its slope JAX derives the connection of another metric."""
    model, ends = beam(LIES.get(name, lambda f: f)(polar)), (PLACES.low, PLACES.high)
    statement = certify_globally(model, velocity=0.25, position=ends, interval=(0.01, 0.01)).statement
    assert statement.short == ("holds (proved)" if name == "none" else "undecided")
    assert "the connection of the model's space" in str(statement)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["stop_gradient", "custom_jvp"])
def test_the_shear_is_a_choice_and_its_change_is_not(name):
    """The metric of a sampled step takes a derivative of the potential by JAX. Whatever it is, lengths in this metric
    change as its values and those of the flow and the correction say, here by differences.
    """
    well = LIES[name](lambda q: 4.0 * jnp.cos(q) + q**2)
    model = models.Lagrangian(
        lambda q: jnp.diag(jnp.stack([2.0 + jnp.sin(q[0])])), lambda q: well(q)[0], coordinates=("q",), units=("rad",)
    )
    alpha, beta = 30.0, 300.0
    sampling = Sampling(0.01, 0.02)
    about = sampled_system(observers.Intrinsic(model, alpha, beta), optimal_lyapunov(alpha, beta, 5.0), sampling)
    z, t, width = jnp.asarray(np.linspace(0.05, 0.3, len(about.names))).at[-1].set(0.015), jnp.zeros(()), 1e-5
    point = about.at(z)
    x = point.x

    def differences(function, n):
        return np.stack([(function(width * e) - function(-width * e)) / (2 * width) for e in np.eye(n)], -1)

    rate = np.asarray(point.flow(t, x))
    theta, n = np.asarray(point.metric.coframe(t, x)), np.asarray(point.metric.gram(t, x))
    inverse = np.linalg.inv(theta)
    turn = differences(lambda s: np.asarray(point.metric.coframe(s[0], x + s[0] * rate)), 1)[..., 0]
    grown = differences(lambda s: np.asarray(point.metric.gram(s[0], x + s[0] * rate)), 1)[..., 0]
    slope = differences(lambda e: np.asarray(point.flow(t, x + e)), len(x))
    product = n @ (turn + theta @ slope) @ inverse
    np.testing.assert_allclose(contraction(about, 3.0)(z), -(product + product.T + grown) - 3.0 * n, rtol=1e-6)

    corrected = differences(lambda e: np.asarray(point.sampled[0](x + e)), len(x))
    _, after, new_gram, before, gram = (np.asarray(part) for part in corrections(about)(t, x, z)[:5])
    step = after @ corrected @ before
    np.testing.assert_allclose(correction(about)(z), gram - step.T @ new_gram @ step, rtol=1e-6, atol=1e-6)
