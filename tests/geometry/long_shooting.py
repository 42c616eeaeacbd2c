"""What takes long of `test_shooting.py`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_shooting import BUDGET, NUMERIC, SPHERE, P, Q, close, shoot

from covariant import geometry, models
from covariant.geometry import Budget, Metric, _geodesics
from covariant.geometry._functions import norm
from covariant.geometry._geodesics import conjugate_points
from covariant.geometry.lie import SO3
from covariant.models import ball_and_beam
from covariant.signals import StepCode

shoot_hyperbolic = jax.jit(lambda p, q: geometry.shoot(Metric(geometry.hyperbolic()), p, q, None, BUDGET))


def the_long_way(p, q):
    """Velocity of the geodesic that leaves q behind it and reaches it round the sphere."""
    log = geometry.log(SPHERE, p, q)
    return log * (1 - 2 * np.pi / norm(SPHERE, p, log))


@pytest.mark.exhaustive
def test_far_target_is_found():
    """Too far for Newton's method from the first guess: nearly a half turn, which chart lines do not resemble."""
    p, q = jnp.array([[0.78, -0.01], [-0.97, 0.29]])
    shot = shoot(p, q, jnp.zeros(2))
    assert shot.result == StepCode.OK
    close(shot.velocity, geometry.log(SPHERE, p, q), 1e-6)


def test_useless_guess_does_no_harm():
    assert shoot(P, Q, jnp.array([20.0, -7.0])).result == StepCode.OK
    assert shoot(P, Q, jnp.array([jnp.nan, jnp.nan])).result == StepCode.OK


@pytest.mark.exhaustive
def test_target_outside_the_ball_is_not_converged():
    shot = shoot_hyperbolic(jnp.array([0.1, 0.2]), jnp.array([1.2, 0.1]))
    assert shot.result == StepCode.NOT_CONVERGED
    assert not shot.residual < 1e-3


@pytest.mark.exhaustive
def test_a_search_ends_where_newtons_method_has_converged(monkeypatch):
    """Each step doubles the digits: from the chart's straight line a handful are enough, and none are made beyond."""
    steps, newton_step = [], _geodesics.newton_step

    def counted(*arguments):
        jax.debug.callback(lambda: steps.append(1))
        return newton_step(*arguments)

    monkeypatch.setattr(_geodesics, "newton_step", counted)
    found = jax.jit(
        lambda p, q: _geodesics.damped_newton(NUMERIC, p, _geodesics.aim(NUMERIC, p, q - p), q - p, BUDGET)
    )(P, Q)
    close(found, geometry.log(SPHERE, P, Q), 1e-12)
    jax.effects_barrier()
    assert 2 <= len(steps) <= 6


@pytest.mark.exhaustive
def test_missing_measurement_is_not_converged():
    shot = shoot(P, jnp.array([jnp.nan, jnp.nan]), jnp.zeros(2))
    assert shot.result == StepCode.NOT_CONVERGED


def test_geodesic_beyond_a_conjugate_point_is_flagged():
    p, q = jnp.array([[0.9, 0.1], [0.5, 0.7]])  # on a great circle that stays in the middle of the chart
    long = the_long_way(p, q)
    shot = shoot(p, q, 1.001 * long)
    assert shot.result == StepCode.CONJUGATE_POINT
    close(shot.velocity, long, 1e-6)  # what twelve steps leave of a geodesic this long


def conjugates(metric, p, velocities):
    count = jax.vmap(lambda v: conjugate_points(Metric(metric), p, v, Budget(steps=32)))
    return jax.jit(count)(velocities).tolist()


@pytest.mark.exhaustive
@pytest.mark.parametrize("n", [2, 3])
def test_conjugate_points_are_counted_with_multiplicity(n):
    """On the n-sphere n − 1 at every half turn."""
    p, direction = jnp.array([[0.3, -0.4, 0.2], [0.6, 0.8, -0.5]])[:, :n]
    unit = direction / norm(SPHERE, p, direction)
    lengths = [0.0, 1.0, np.pi - 0.01, np.pi + 0.01, 2 * np.pi - 0.01, 2 * np.pi + 0.01]
    counts = conjugates(SPHERE, p, jnp.stack([length * unit for length in lengths]))
    assert counts == [0, 0, 0, n - 1, n - 1, 2 * (n - 1)]


@pytest.mark.exhaustive
def test_negative_curvature_has_no_conjugate_points():
    velocities = jnp.array([[2.0, 1.5], [-3.0, 0.5], [0.1, -4.0], [0.0, 0.0]])
    assert conjugates(ball_and_beam().metric, P, velocities) == [0, 0, 0, 0]


@pytest.mark.exhaustive
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev], ids=["forward", "reverse"])
def test_log_has_the_derivatives_of_the_closed_form(mode):
    """Through the implicit function theorem, exact where the search has converged."""
    numeric, closed = (
        jax.jit(mode(lambda p, q, metric=metric: geometry.log(metric, p, q, BUDGET), (0, 1)))(P, Q)
        for metric in (NUMERIC, SPHERE)
    )
    jax.tree.map(lambda a, b: close(a, b, 1e-9), numeric, closed)


@pytest.mark.exhaustive
def test_log_has_second_derivatives_also_in_the_parameters_of_the_metric():
    """On the line with metric `exp(2kq)` the logarithm is `(exp(k(q − p)) − 1)/k`; forward over reverse."""

    def numeric(pqk):
        p, q, k = pqk
        return geometry.log(lambda x: jnp.exp(2 * k * x[None]), p[None], q[None], BUDGET)[0]

    def exact(pqk):
        p, q, k = pqk
        return jnp.expm1(k * (q - p)) / k

    def slopes(f):
        """Hessian and gradient, by one program."""
        return jax.jit(jax.jacfwd(lambda x: 2 * (jax.jacrev(f)(x),), has_aux=True))(jnp.array([0.3, 0.9, 0.7]))

    (hessian, gradient), (known_hessian, known_gradient) = slopes(numeric), slopes(exact)
    close(gradient, known_gradient, 1e-10)
    close(hessian, known_hessian, 1e-9)


@pytest.mark.exhaustive
def test_shooting_is_the_same_under_jit_and_vmap():
    points = jnp.stack([P, P + 0.1, P + 0.2])
    alone = jnp.stack([shoot(p, Q, jnp.zeros(2)).velocity for p in points])
    mapped = jax.vmap(shoot, (0, None, None))(points, Q, jnp.zeros(2))
    close(mapped.velocity, alone, 1e-13)
    assert (mapped.result == StepCode.OK).all()


def slope(scales, errors):
    return np.polyfit(np.log(scales), np.log(errors), 1)[0]


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("budget", "order", "farthest"),
    [
        (Budget(0, 4), 3, 0.1),
        (Budget(1, 16), 6, 0.1),
        (Budget(2, 4), 5, 0.1),
        (Budget(0, 4, near=True), 3, 0.1),
        (Budget(1, 16, near=True), 5, 0.1),
        (Budget(2, 32, near=True), 7, 0.05),
    ],
)
def test_error_of_a_fixed_budget_falls_with_the_distance(budget, order, farthest):
    """`d + ½Γ(d, d)` leaves d³, one correction squares that, two leave the d⁵ of the Runge–Kutta steps; a correction by
    the derivative of the expansion gains two orders."""
    scales = np.geomspace(0.3 * farthest, farthest, 5)
    targets = jnp.stack([P + s * (Q - P) for s in scales])
    log = jax.jit(jax.vmap(lambda q: geometry.shoot(NUMERIC, P, q, None, budget).velocity))
    errors = np.linalg.norm(log(targets) - jax.vmap(lambda q: geometry.log(SPHERE, P, q))(targets), axis=1)
    assert slope(scales, errors) == pytest.approx(order, abs=0.25)


@pytest.mark.exhaustive
def test_near_searches_gain_two_orders_a_correction_where_the_frame_is_no_chart():
    """A body of three different inertias: its connection is not symmetric, and its lines are not straight."""
    space = models.free_body(inertia=(0.9, 1.0, 1.6)).space
    p, way = SO3.exp(jnp.array([0.3, -0.2, 0.4])), jnp.array([0.8, -0.5, 0.6])
    scales = np.geomspace(0.05, 0.2, 4)
    budgets = Budget(steps=12, conjugate=False), Budget(0, 16, near=True), Budget(1, 16, near=True)

    @jax.jit
    @jax.vmap
    def found(scale):
        q = space.manifold.retract(p, scale * way)
        return [space.shoot(p, q, None, budget) for budget in budgets]

    exact, *near = found(jnp.asarray(scales))
    assert (exact.result == StepCode.OK).all()
    for shot, order in zip(near, (3, 5), strict=True):
        errors = np.linalg.norm(shot.velocity - exact.velocity, axis=1)
        assert (shot.result == StepCode.OK).all()
        assert slope(scales, errors) == pytest.approx(order, abs=0.3)
        assert (np.abs(shot.residual / errors - 1) < 2).all(), "the residual is the length that is missed"


@pytest.mark.exhaustive
def test_fixed_budget_is_static():
    """No loop of unknown length and no LAPACK: what the exporter asks for."""
    lowered = str(jax.make_jaxpr(lambda p, q: geometry.log(NUMERIC, p, q, Budget(newton=2, steps=4)))(P, Q))
    for primitive in ("while[", "cond[", "custom_root", "cholesky", " lu[", "triangular_solve"):
        assert primitive not in lowered


@pytest.mark.exhaustive
def test_fixed_budget_reports_what_it_left():
    budget, near = Budget(newton=1, steps=4), P + 0.3 * (Q - P)

    @jax.jit
    def there(p, q):
        shot = geometry.shoot(NUMERIC, p, q, None, budget)
        return shot, geometry.exp(NUMERIC, p, shot.velocity, budget)

    shot, end = there(P, near)
    assert shot.result == StepCode.OK
    assert 0 < shot.residual < 1e-3
    close(shot.residual, norm(SPHERE, near, near - end), 1e-12)
