"""The laws of Riemannian geometry, over every space: closed forms, derived forms, and the metrics of machines.

Points include equal ones, ones a hair apart, and the middle of the chart. Pointwise laws hold to rounding, 1e-11 of the
largest number in sight; laws of geodesics to 1e-9, a little more than the numerical ones lose.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant._integrate import rk8
from covariant.geometry import Budget, christoffel, curvature, exp
from covariant.geometry._functions import gradient, inner
from covariant.signals import StepCode

POINTWISE = 1e-11
GEODESIC = 1e-9
STEPS = 12


def each(law, *arrays):
    return jax.jit(jax.vmap(law))(*arrays)


def slope(curve, at=0.0, step=2e-3):
    """The derivative of a curve by central differences of fourth order, good to 1e-9 at this step."""
    near, far = (curve(at + k * step) - curve(at - k * step) for k in (1, 2))
    return (8 * near - far) / (12 * step)


def close(a, b, tolerance, scale=1.0):
    np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * max(scale, np.abs(a).max(), np.abs(b).max()))


# At a point


@pytest.mark.core(5)
def test_metric_is_symmetric_positive_definite(space):
    g = space.matrix(space.p)
    close(g, np.swapaxes(g, 1, 2), POINTWISE)
    assert np.linalg.eigvalsh(g).min() > 0


@pytest.mark.core(2)
def test_gradient_represents_the_covector(space):
    raised = each(lambda *a: gradient(space.metric, *a), space.p, space.x)
    close(space.inner(space.p, raised, space.y), np.sum(space.x * space.y, 1), POINTWISE)


@pytest.mark.core(3)
def test_connection_is_torsion_free(space):
    close(space.christoffel(space.p, space.x, space.y), space.christoffel(space.p, space.y, space.x), POINTWISE)


@pytest.mark.core(2)
def test_connection_is_metric(space):
    def along_x(p, x, y, z):
        return jax.jvp(lambda q: inner(space.metric, q, y, z), (p,), (x,))[1]

    p, x, y, z = space.p, space.x, space.y, space.z
    turned = space.inner(p, space.christoffel(p, x, y), z) + space.inner(p, y, space.christoffel(p, x, z))
    close(each(along_x, p, x, y, z), turned, POINTWISE)


@pytest.mark.core(1)
@pytest.mark.exhaustive("double pendulum", "numeric sphere", "plane, curved chart", "sphere x hyperbolic")
def test_curvature_is_the_commutator_of_covariant_derivatives(space):
    """`R(x, y)w = ∇_x∇_y w − ∇_y∇_x w` for x, y constant, so that their bracket vanishes, and a field w that is not."""

    def both(p, x, y, z, w):
        def field(q):
            return w + jnp.sin(z @ q) * x + jnp.cos(w @ q) * z

        def derivative(a, f):
            return lambda q: jax.jvp(f, (q,), (a,))[1] + christoffel(space.metric, q, a, f(q))

        commutator = derivative(x, derivative(y, field))(p) - derivative(y, derivative(x, field))(p)
        return commutator, curvature(space.metric, p, x, y, field(p))

    close(*each(both, space.p, space.x, space.y, space.z, space.w), POINTWISE)


def riemann(space, x, y, z, w):
    """`<R(x, y)z, w>`."""
    return space.inner(space.p, space.curvature(space.p, x, y, z), w)


@pytest.mark.core(1)
def test_curvature_has_its_symmetries(space):
    x, y, z, w = space.x, space.y, space.z, space.w
    close(riemann(space, x, y, z, w), -riemann(space, y, x, z, w), POINTWISE)
    close(riemann(space, x, y, z, w), -riemann(space, x, y, w, z), POINTWISE)
    close(riemann(space, x, y, z, w), riemann(space, z, w, x, y), POINTWISE)
    terms = [np.asarray(space.curvature(space.p, *a)) for a in ((x, y, z), (y, z, x), (z, x, y))]
    close(terms[0] + terms[1], -terms[2], POINTWISE)


# Along a geodesic


def bundle(space):
    """The velocity of each geodesic, and two more vectors."""
    return np.stack([space.velocity, space.x, space.y], 1)


def carried(space):
    return space.fly(space.p, space.velocity, bundle(space))


@pytest.mark.core(1)
@pytest.mark.exhaustive("double pendulum", "sphere x hyperbolic")
def test_geodesic_moves_with_its_velocity(space):
    def at(t):
        return np.asarray(space.fly(space.p, t * space.velocity, bundle(space)).q)

    close(slope(at, 1.0), carried(space).velocity, 1e-8)


@pytest.mark.core(1)
def test_geodesic_velocity_is_carried_along(space):
    end = carried(space)
    close(end.w[:, 0], end.velocity, GEODESIC)


@pytest.mark.core(2)
def test_transport_is_an_isometry(space):
    end = carried(space)
    before, after = (
        np.einsum("kai,kij,kbj->kab", w, space.matrix(p), w) for w, p in ((bundle(space), space.p), (end.w, end.q))
    )
    close(after, before, GEODESIC)


@pytest.mark.core(1)
def test_transport_is_linear(space):
    _, x, y = np.moveaxis(carried(space).w, 1, 0)
    combined = np.stack([space.x, 2 * space.x - 3 * space.y, 0 * space.y], 1)
    combined = np.moveaxis(space.fly(space.p, space.velocity, combined).w, 1, 0)
    close(combined, np.stack([x, 2 * x - 3 * y, 0 * y]), GEODESIC)


@pytest.mark.core(1)
def test_transport_there_and_back_is_the_identity(space):
    end = carried(space)
    back = space.fly(end.q, -np.asarray(end.velocity), end.w)
    close(back.q, space.p, GEODESIC)
    close(back.velocity, -space.velocity, GEODESIC)
    close(back.w, bundle(space), GEODESIC)


@pytest.mark.core(1)
def test_transport_in_two_halves_is_transport(space):
    half = space.fly(space.p, space.velocity / 2, bundle(space))
    whole = space.fly(half.q, half.velocity, half.w)
    end = carried(space)
    close(whole.q, end.q, GEODESIC)
    close(2 * np.asarray(whole.velocity), end.velocity, GEODESIC)
    close(whole.w, end.w, GEODESIC)


@pytest.mark.core(2)
def test_transport_starts_with_zero_covariant_derivative(space):
    def moved(t):
        return np.asarray(space.fly(space.p, t * space.velocity, bundle(space)).w)[:, 1]

    close(slope(moved), -np.asarray(space.christoffel(space.p, space.velocity, space.x)), 1e-8)


@pytest.mark.exhaustive(
    "double pendulum",
    "hyperbolic",
    "numeric sphere",
    "oscillator in r",
    "plane, curved chart",
    "sphere",
    "sphere x hyperbolic",
)
def test_geodesic_deviation(space):
    """`D²J/dt² = −R(J, γ')γ'` for the field J by which neighbouring geodesics part, integrated beside the geodesic."""
    metric = space.metric

    def equation(t, state):
        q, v, j, dj = state

        def gamma(w):
            return christoffel(metric, q, v, w)

        return v, -gamma(v), dj - gamma(j), -curvature(metric, q, j, v, v) - gamma(dj)

    def both(p, v, j, dj):
        integrated = rk8(equation, 0.0, (p, v, j, dj), 1.0, STEPS)[2]
        family = (j, dj - christoffel(metric, p, j, v))
        return jax.jvp(lambda p, v: exp(metric, p, v, Budget(steps=STEPS)), (p, v), family)[1], integrated

    close(*each(both, space.p, space.velocity, space.x, space.y), GEODESIC)


# Between two points


@pytest.mark.core(1)
@pytest.mark.exhaustive("double pendulum", "numeric sphere", "oscillator in r")
def test_geodesic_is_found(space):
    shot = space.shoot(space.p, space.q)
    np.testing.assert_array_equal(shot.result, StepCode.OK)
    assert shot.residual.max() < 1e-13


@pytest.mark.core(1)
@pytest.mark.exhaustive("double pendulum", "numeric sphere", "oscillator in r")
def test_exp_of_log_arrives(space):
    shot = space.shoot(space.p, space.q)
    end = space.fly(space.p, shot.velocity, bundle(space))
    close(space.shoot(end.q, space.q).velocity, np.zeros_like(space.p), GEODESIC)
    close(end.velocity, shot.arrival, GEODESIC)


@pytest.mark.core(3)
@pytest.mark.exhaustive("double pendulum", "numeric sphere", "oscillator in r")
def test_log_of_exp_returns(space):
    close(space.shoot(space.p, carried(space).q).velocity, space.velocity, GEODESIC)


@pytest.mark.exhaustive("double pendulum", "numeric sphere", "oscillator in r")
def test_arrival_is_minus_the_log_back(space):
    close(space.shoot(space.p, space.q).arrival, -np.asarray(space.shoot(space.q, space.p).velocity), GEODESIC)


def length(space, p, q):
    return space.norm(p, space.shoot(p, q).velocity)


@pytest.mark.exhaustive("numeric sphere", "double pendulum")
@pytest.mark.long("double pendulum", "numeric sphere", "oscillator in r")
def test_length_is_symmetric(space):
    close(length(space, space.p, space.q), length(space, space.q, space.p), GEODESIC)


@pytest.mark.long("double pendulum", "numeric sphere", "oscillator in r")
def test_gradient_of_half_squared_distance_is_minus_log(space):
    def half_square(shift):
        return length(space, space.p + shift, space.q) ** 2 / 2

    slopes = [slope(lambda t, e=e: half_square(t * e)) for e in np.eye(space.p.shape[1])]
    log = space.shoot(space.p, space.q).velocity
    close(np.stack(slopes, 1), -np.einsum("kij,kj->ki", space.matrix(space.p), log), 1e-6)
