"""Shooting for geodesics: outcome, conjugate points, derivatives, and the fixed budget of real time."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import geometry
from covariant.geometry import Budget, Metric
from covariant.geometry._numeric import conjugate_points
from covariant.models import ball_and_beam
from covariant.signals import Result

SPHERE = geometry.sphere()
NUMERIC = Metric(SPHERE)
BUDGET = Budget(steps=12)
P, Q = jnp.array([[0.3, -0.4], [-0.2, 0.5]])

shoot = jax.jit(lambda p, q, guess: geometry.shoot(NUMERIC, p, q, guess, BUDGET))
shoot_hyperbolic = jax.jit(lambda p, q: geometry.shoot(Metric(geometry.hyperbolic()), p, q, None, BUDGET))


def close(a, b, tolerance):
    np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * max(1.0, np.abs(b).max()))


def the_long_way(p, q):
    """Velocity of the geodesic that leaves q behind it and reaches it round the sphere."""
    log = geometry.log(SPHERE, p, q)
    return log * (1 - 2 * np.pi / geometry.norm(SPHERE, p, log))


# Outcome


def test_short_geodesic_is_ok():
    shot = shoot(P, Q, jnp.zeros(2))
    assert shot.result == Result.OK
    close(shot.velocity, geometry.log(SPHERE, P, Q), 1e-12)


def test_useless_guess_does_no_harm():
    assert shoot(P, Q, jnp.array([20.0, -7.0])).result == Result.OK
    assert shoot(P, Q, jnp.full(2, jnp.nan)).result == Result.OK


def test_target_outside_the_ball_is_not_converged():
    shot = shoot_hyperbolic(jnp.array([0.1, 0.2]), jnp.array([1.2, 0.1]))
    assert shot.result == Result.NOT_CONVERGED
    assert shot.residual > 1e-3


def test_log_is_nan_where_not_converged():
    p, q = jnp.array([0.1, 0.2]), jnp.array([1.2, 0.1])
    budget = Budget(newton=1, steps=4)
    assert geometry.shoot(Metric(geometry.hyperbolic()), p, q, None, budget).result == Result.NOT_CONVERGED
    assert np.isnan(geometry.log(Metric(geometry.hyperbolic()), p, q, budget)).all()


def test_too_small_a_budget_is_not_converged():
    far = ball_and_beam().metric, jnp.array([-1.0, 0.0]), jnp.array([2.0, 1.5])
    assert geometry.shoot(*far, None, Budget(newton=0, steps=1)).result == Result.NOT_CONVERGED
    assert geometry.shoot(*far, None, Budget(newton=6, steps=8)).result == Result.OK


def test_missing_measurement_is_not_converged():
    shot = shoot(P, jnp.full(2, jnp.nan), jnp.zeros(2))
    assert shot.result == Result.NOT_CONVERGED


def test_geodesic_beyond_a_conjugate_point_is_flagged():
    long = the_long_way(P, Q)
    shot = shoot(P, Q, 1.02 * long)
    assert shot.result == Result.CONJUGATE_POINT
    close(shot.velocity, long, 1e-9)


# Conjugate points


def sphere_crossings(n, lengths):
    """Conjugate points along a great circle, by length."""
    p, direction = jnp.array([[0.3, -0.4, 0.2], [0.6, 0.8, -0.5]])[:, :n]
    unit = direction / geometry.norm(SPHERE, p, direction)
    count = jax.vmap(lambda s: conjugate_points(NUMERIC, p, s * unit, Budget(steps=32)))
    return count(jnp.array(lengths)).tolist()


@pytest.mark.parametrize("n", [2, 3])
def test_conjugate_points_are_counted_with_multiplicity(n):
    """On the n-sphere n − 1 at every half turn."""
    lengths = [0.0, 1.0, np.pi - 0.01, np.pi + 0.01, 2 * np.pi - 0.01, 2 * np.pi + 0.01]
    assert sphere_crossings(n, lengths) == [0, 0, 0, n - 1, n - 1, 2 * (n - 1)]


@pytest.mark.parametrize("metric", [geometry.hyperbolic(), ball_and_beam().metric], ids=["hyperbolic", "ball and beam"])
def test_negative_curvature_has_no_conjugate_points(metric):
    assert conjugate_points(Metric(metric), P, jnp.array([2.0, 1.5]), Budget(steps=32)) == 0


# Derivatives


@jax.jit
def first_derivatives(p, q):
    def numeric(p, q):
        return geometry.log(NUMERIC, p, q, BUDGET)

    def closed(p, q):
        return geometry.log(SPHERE, p, q)

    return tuple((mode(numeric, (0, 1))(p, q), mode(closed, (0, 1))(p, q)) for mode in (jax.jacfwd, jax.jacrev))


def test_log_has_the_derivatives_of_the_closed_form():
    """Forward and reverse, in both points, through the implicit function theorem."""
    for numeric, closed in first_derivatives(P, Q):
        jax.tree.map(lambda a, b: close(a, b, 1e-10), numeric, closed)


def test_log_has_the_derivatives_that_differences_show():
    (in_p, in_q), _ = first_derivatives(P, Q)[0]
    step = 1e-5
    for derivative, moved in ((in_p, lambda e: (P + e, Q)), (in_q, lambda e: (P, Q + e))):
        columns = [
            (shoot(*moved(e), jnp.zeros(2)).velocity - shoot(*moved(-e), jnp.zeros(2)).velocity) / (2 * step)
            for e in step * jnp.eye(2)
        ]
        close(derivative, jnp.stack(columns, 1), 1e-9)


def test_log_has_second_derivatives():
    def half_square(metric):
        return lambda p: geometry.distance(metric, p, Q, BUDGET) ** 2 / 2

    close(jax.jit(jax.hessian(half_square(NUMERIC)))(P), jax.hessian(half_square(SPHERE))(P), 1e-9)


def test_log_is_differentiable_in_the_parameters_of_the_metric():
    def log(k, form):
        return form(lambda q: 4 * jnp.eye(2) / (1 + k * (q @ q)) ** 2)

    def numeric(k):
        return geometry.log(lambda q: 4 * jnp.eye(2) / (1 + k * (q @ q)) ** 2, P, Q, BUDGET)

    step = 1e-5
    differences = (
        geometry.log(geometry.ConstantCurvature(1 + step), P, Q)
        - geometry.log(geometry.ConstantCurvature(1 - step), P, Q)
    ) / (2 * step)
    close(jax.jit(jax.jacfwd(numeric))(jnp.ones(())), differences, 1e-9)


def test_shooting_is_the_same_under_jit_and_vmap():
    points = P + 0.1 * jnp.arange(3.0)[:, None]
    alone = jnp.stack([shoot(p, Q, jnp.zeros(2)).velocity for p in points])
    mapped = jax.vmap(shoot, (0, None, None))(points, Q, jnp.zeros(2))
    close(mapped.velocity, alone, 1e-13)
    assert (mapped.result == Result.OK).all()


# The fixed budget


def slope(scales, errors):
    return np.polyfit(np.log(scales), np.log(errors), 1)[0]


@pytest.mark.parametrize(("budget", "order"), [(Budget(0, 4), 3), (Budget(1, 4), 5), (Budget(2, 4), 5)])
def test_error_of_a_fixed_budget_falls_with_the_distance(budget, order):
    """`d + ½Γ(d, d)` leaves d³; one correction takes that below the d⁵ of four Runge–Kutta steps."""
    scales = np.geomspace(0.1, 0.4, 5)
    targets = P + jnp.asarray(scales)[:, None] * (Q - P)
    log = jax.jit(jax.vmap(lambda q: geometry.shoot(NUMERIC, P, q, None, budget).velocity))
    errors = np.linalg.norm(log(targets) - jax.vmap(lambda q: geometry.log(SPHERE, P, q))(targets), axis=1)
    assert slope(scales, errors) == pytest.approx(order, abs=0.25)


def test_fixed_budget_is_static():
    """No loop of unknown length and no LAPACK: what the exporter asks for."""
    lowered = str(jax.make_jaxpr(lambda p, q: geometry.log(NUMERIC, p, q, Budget(newton=2, steps=4)))(P, Q))
    for word in ("while", "cond[", "custom_root", "cholesky", "lu", "triangular_solve"):
        assert f" {word}" not in lowered


def test_fixed_budget_reports_what_it_left():
    shot = geometry.shoot(NUMERIC, P, Q, None, Budget(newton=1, steps=4))
    end = geometry.exp(NUMERIC, P, shot.velocity, Budget(newton=1, steps=4))
    assert shot.residual == pytest.approx(float(geometry.norm(SPHERE, Q, Q - end)), rel=1e-10)
    assert shot.result == Result.OK
