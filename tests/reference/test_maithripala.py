"""Formulas of Maithripala, Berg & Dayawansa 2004 by routes that use no geometry of the library."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.geometry.lie import SO3
from covariant.models import source
from covariant.observers import Intrinsic, Salcudean
from covariant.papers._errata import PrintedGroup

INERTIA = np.array([1.0, 2.0, 3.5])
RNG = np.random.default_rng(0)


def hat(w):
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])


def turn(w):
    """Rotation by the vector w, by Rodrigues' formula."""
    angle = np.linalg.norm(w)
    k = hat(w / angle)
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def rotation_vector(r):
    """Inverse of `turn` below half a turn."""
    axis = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]) / 2
    sine = np.linalg.norm(axis)
    return axis / sine * np.arctan2(sine, (np.trace(r) - 1) / 2)


def free_motion(start, w, steps=100):
    """Attitude after one unit of time of a free body: its motion is a geodesic of the inertia (Euler's equations)."""

    def rate(r, w):
        return r @ hat(w), np.cross(INERTIA * w, w) / INERTIA

    def moved(z, h, *rates):
        return tuple(x + h / len(rates) * sum(parts) for x, *parts in zip(z, *rates, strict=True))

    z, h = (start, w), 1 / steps
    for _ in range(steps):  # Runge–Kutta of order four
        a = rate(*z)
        b = rate(*moved(z, h / 2, a))
        c = rate(*moved(z, h / 2, b))
        z = moved(z, h, a, b, b, c, c, rate(*moved(z, h, c)))
    return z[0]


def test_gradient_of_the_squared_distance_to_second_order():
    """Below (11), unequal inertias: grad F = ζ_e + ½I⁻¹ad*_{ζ_e}Iζ_e up to the third order, where (11) has ζ_e alone.

    The exact grad F at g̃ is minus the velocity of the free motion from g̃ to g.
    """
    estimate, direction = turn(RNG.normal(size=3)), np.array([0.5, -0.6, 0.62])
    sizes = 0.1 * 2.0 ** -np.arange(4)
    first, second, signed, ours = [], [], [], []
    observer = Intrinsic(models.GroupSystem(SO3, jnp.diag(jnp.asarray(INERTIA))), 1.0, 1.0, order=2)
    state = observer.init(jnp.asarray(estimate))
    # At rest and without forces q̂' is −αξ, so that this is the ξ of the observer.
    error = jax.jit(lambda y: -observer.flow(state.t, state, jnp.zeros(3), y).q)
    for size in sizes:
        measured = free_motion(estimate, -size * direction)
        exact, log = size * direction, rotation_vector(measured.T @ estimate)
        bend = np.cross(INERTIA * log, log) / INERTIA / 2  # <ad*_ζ μ, η> = μ·(ζ × η) is (μ × ζ)·η
        first.append(np.linalg.norm(log - exact))
        second.append(np.linalg.norm(log + bend - exact))
        signed.append(np.linalg.norm(log - bend - exact))
        ours.append(np.linalg.norm(np.asarray(error(jnp.asarray(measured))) - exact))
    orders = [np.polyfit(np.log(sizes), np.log(gaps), 1)[0] for gaps in (first, second, signed, ours)]
    np.testing.assert_allclose(orders, [2, 3, 2, 3], atol=0.06)
    assert first[0] / sizes[0] > 0.01


def misprint(model, slip, alpha=3.0):
    """What one misprint adds to ζ̃' and, of the logarithm, what it makes of ζ_e; with ζ_e, ζ̃ and S."""
    g = turn(RNG.normal(size=3))
    error, velocity = 0.3 * RNG.normal(size=3), RNG.normal(size=3)
    y, estimate = jnp.asarray(g), jnp.asarray(g @ turn(error))

    @jax.jit
    def rates(v):
        flows = []
        for slips in ((), (slip,)):
            observer = PrintedGroup(model, alpha, 2.0, slips)
            state = observer.init(estimate)._replace(v=v)
            flows.append(observer.flow(state.t, state, jnp.zeros(3), y))
        return [(flow.q, flow.v) for flow in flows], source(model, jnp.zeros(()), y, jnp.zeros(3))

    (right, wrong), s = rates(jnp.asarray(velocity))
    added = np.asarray(wrong[1]) - np.asarray(right[1])
    return added, error, velocity, np.asarray(s), g, (velocity - np.asarray(wrong[0])) / (2 * alpha)


TOP = models.heavy_top(tuple(INERTIA))
ROUND = models.heavy_top((1.0, 1.0, 1.0))


@pytest.mark.long
def test_a_misprint_adds_to_the_velocity_equation_what_is_said():
    """The effects listed for (19), (21), (8), S and (44), with the bracket of so(3), the vector product."""
    added, error, _, s, *_ = misprint(TOP, "transport")
    np.testing.assert_allclose(added, -np.cross(s, error), atol=1e-10)
    added, error, velocity, *_ = misprint(TOP, "alpha")
    np.testing.assert_allclose(added, (1 - 3.0) * np.cross(error, velocity), atol=1e-10)
    # Of equal inertias R(ζ̃, ζ_e)ζ̃ is −¼[[ζ̃, ζ_e], ζ̃]; the print has four times that, and so adds three times more.
    added, error, velocity, *_ = misprint(ROUND, "curvature count")
    np.testing.assert_allclose(added, 0.75 * np.cross(np.cross(velocity, error), velocity), atol=1e-10)
    added, _, _, s, *_ = misprint(TOP, "source")
    assert np.linalg.norm(added) > 0.1 * np.linalg.norm(s)
    _, error, _, _, g, printed = misprint(TOP, "logarithm")
    np.testing.assert_allclose(
        printed, g @ error, atol=1e-10
    )  # the same vector seen from space, turned by the attitude


def test_with_the_printed_source_the_true_motion_is_no_solution():
    g, velocity = turn(RNG.normal(size=3)), RNG.normal(size=3)
    state = PrintedGroup(TOP, 3.0, 2.0, ()).init(jnp.asarray(g))._replace(v=jnp.asarray(velocity))
    weight = np.cross(g[2], [0.0, 0.0, 1.0])
    true = (np.cross(INERTIA * velocity, velocity) + weight) / INERTIA
    right, wrong = (
        np.asarray(PrintedGroup(TOP, 3.0, 2.0, slips).flow(state.t, state, jnp.zeros(3), jnp.asarray(g)).v)
        for slips in ((), ("source",))
    )
    np.testing.assert_allclose(right, true, atol=1e-10)
    np.testing.assert_allclose(wrong - right, weight - weight / INERTIA, atol=1e-10)


def test_the_lyapunov_function_of_salcudean_falls_from_any_attitude():
    """Reference [18]: V = ½|h̃|² + k_p(1 − e₀) has V' = −½k_p k_v e·I₀⁻¹e, also beyond a quarter turn."""
    kp, kv, h = 9.0, 6.0, 1e-4
    observer = Salcudean(models.free_body(tuple(INERTIA)), kp, kv)
    flow = jax.jit(lambda state, y: observer.flow(state.t, state, jnp.zeros(3), y))
    for angle in (0.3, 2.0, 3.0):
        g, axis = turn(RNG.normal(size=3)), RNG.normal(size=3)
        error = turn(angle * axis / np.linalg.norm(axis))  # in space, R R̂ᵀ
        estimate, velocity, momentum = error.T @ g, RNG.normal(size=3), RNG.normal(size=3)
        true_momentum = g @ (INERTIA * velocity)  # constant, of a free body
        state = observer.init(jnp.asarray(g))._replace(q=jnp.asarray(estimate), momentum=jnp.asarray(momentum))
        rate = flow(state, jnp.asarray(g))

        def value(t, g=g, estimate=estimate, velocity=velocity, momentum=momentum, rate=rate, total=true_momentum):
            attitude = g @ turn(t * velocity) @ (estimate @ turn(t * np.asarray(rate.q))).T
            off = total - momentum - t * np.asarray(rate.momentum)
            return off @ off / 2 + kp * (1 - np.sqrt(1 + np.trace(attitude)) / 2)

        e = np.sin(angle / 2) * rotation_vector(error) / angle
        slope = (value(h) - value(-h)) / (2 * h)
        assert slope == pytest.approx(-kp * kv / 2 * (g.T @ e) @ (g.T @ e / INERTIA), rel=1e-5)
