"""Formulas of Aghannan & Rouchon 2003 by routes that use no geometry of the library."""

import jax
import jax.numpy as jnp
import numpy as np

from covariant import geometry, models
from covariant.geometry import Budget
from covariant.observers import Geodesic
from covariant.simulation import observe

ALPHA, BETA = 1.4, 0.49  # a double pole at −0.7
BEAM = models.ball_and_beam()
RNG = np.random.default_rng(0)


def rates(observer, q, v, y, u):
    """q̂' and v̂' of an observer at the estimate (q̂, v̂)."""
    state = observer.init(q)._replace(v=v)
    flow = observer.flow(state.t, state, u, y)
    return flow.q, flow.v


def test_on_a_free_mass_it_is_the_luenberger_observer_with_a_double_pole():
    """Section I. Errors obey e' = ε − αe, ε' = −βe, of which this is the solution for β = α²/4."""
    free = models.Lagrangian(lambda q: jnp.eye(2, dtype=q.dtype), lambda q: 0.0 * q[0])
    observer = Geodesic(free, ALPHA, BETA)
    q, v, y = RNG.normal(size=(3, 2))
    q_dot, v_dot = rates(observer, q, v, y, jnp.zeros(2))
    np.testing.assert_allclose(q_dot, v - ALPHA * (q - y), atol=1e-12)
    np.testing.assert_allclose(v_dot, -BETA * (q - y), atol=1e-12)
    t, e, eps = np.linspace(0.0, 6.0, 4), np.array([0.8, -0.5]), np.array([-1.0, 2.0])
    x0, state = jnp.array([0.2, 0.1, 0.5, -0.4]), observer.init(jnp.zeros(2))
    state = state._replace(q=x0[:2] + e, v=x0[2:] + eps)
    x, states = observe(free, observer, x0, state, jnp.asarray(t), rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(x[:, :2], np.array([0.2, 0.1]) + np.outer(t, [0.5, -0.4]), atol=1e-9)
    damped, pole = np.exp(-ALPHA / 2 * t)[:, None], ALPHA / 2
    np.testing.assert_allclose(states.q - x[:, :2], damped * (e + np.outer(t, eps - pole * e)), atol=1e-8)
    np.testing.assert_allclose(states.v - x[:, 2:], damped * (eps + np.outer(t, pole * eps - pole**2 * e)), atol=1e-8)


def test_observer_of_the_oscillator_in_q_and_in_r():
    """(3), the printed form of (4), and the one from the other by the chain rule for r = exp q, w = r q'."""
    in_q, in_r = (Geodesic(models.oscillator(chart), ALPHA, BETA, Budget()) for chart in "qr")
    q, v, y = RNG.normal(size=(3, 1))
    q_dot, v_dot = rates(in_q, q, v, y, jnp.zeros(1))
    np.testing.assert_allclose(q_dot, v - ALPHA * (q - y), atol=1e-12)
    np.testing.assert_allclose(v_dot, -y - BETA * (q - y), atol=1e-12)  # the spring at the measurement, not at q̂
    r, w, measured = np.exp(q), np.exp(q) * v, np.exp(y)
    r_dot, w_dot = jax.jit(lambda *a: rates(in_r, *a))(r, w, measured, jnp.zeros(1))
    off = np.log(r) - np.log(measured)
    printed = w - ALPHA * r * off
    np.testing.assert_allclose(r_dot, printed, rtol=1e-9)
    np.testing.assert_allclose(w_dot, w * printed / r - r * np.log(measured) - BETA * r * off, rtol=1e-9)
    np.testing.assert_allclose(r_dot, r * q_dot, rtol=1e-9)
    np.testing.assert_allclose(w_dot, r * (v_dot + v * q_dot), rtol=1e-9)


def test_closed_forms_in_r():
    """Below (4): symbol of Christoffel, geodesic, distance, grad F and transport in the metric 1/r²."""
    space = models.oscillator("r").space
    r, measured = np.array([2.3]), np.array([0.6])
    ratio, one = np.log(r / measured), np.ones(1)

    @jax.jit
    def computed(r, measured):
        towards = geometry.log(space, measured, r)
        return {
            "symbol": geometry.christoffel(space, r, one, one),
            "geodesic": geometry.exp(space, measured, 0.3 * towards),
            "distance": geometry.distance(space, measured, r),
            "gradient": -geometry.log(space, r, measured),
            "source": geometry.transport(space, measured, -measured * jnp.log(measured), r),
        }

    printed = {
        "symbol": -1 / r,
        "geodesic": np.exp(0.3 * ratio + np.log(measured)),
        "distance": abs(ratio[0]),
        "gradient": r * ratio,
        "source": -r * np.log(measured),
    }
    for name, value in computed(r, measured).items():
        np.testing.assert_allclose(value, printed[name], rtol=1e-8, err_msg=name)


# The surface of the ball and beam: g = diag(1, 1 + r²), with Gauss's curvature K = −1/(1 + r²)².


def inner(q, a, b):
    return a[0] * b[0] + (1 + q[0] ** 2) * a[1] * b[1]


def christoffel(q, a, b):
    return np.array([-q[0] * a[1] * b[1], q[0] / (1 + q[0] ** 2) * (a[0] * b[1] + a[1] * b[0])])


def christoffel_change(q, along, a, b):
    by_r = (1 - q[0] ** 2) / (1 + q[0] ** 2) ** 2
    return along[0] * np.array([-a[1] * b[1], by_r * (a[0] * b[1] + a[1] * b[0])])


def gauss(q):
    return -1 / (1 + q[0] ** 2) ** 2


def printed_curvature(k, q, u, w, z):
    """R(u, w)z in the sign of the paper, on a surface with the curvature k at q."""
    return k * (inner(q, u, z) * w - inner(q, w, z) * u)


def turned(q, a):
    """The vector a, turned by a right angle."""
    root = np.sqrt(1 + q[0] ** 2)
    return np.array([-root * a[1], a[0] / root])


def geodesic(q, velocity, steps=200):
    """End and velocity there, and y with y'' = −Kd²y for y(0) = 1, y(1) = 0: y'(0) and the integral of Ky.

    By the classical Runge–Kutta method; y is the normal part of the Jacobi field that is one at q and zero at the end.
    """
    square = inner(q, velocity, velocity)

    def rate(z):
        k = gauss(z[:2])
        bend = -k * square * z[4:6]
        return np.concatenate([z[2:4], -christoffel(z[:2], z[2:4], z[2:4]), z[6:8], bend, k * z[4:6]])

    z, h = np.concatenate([q, velocity, [1.0, 0.0, 0.0, 1.0, 0.0, 0.0]]), 1 / steps
    for _ in range(steps):
        a = rate(z)
        b = rate(z + h / 2 * a)
        c = rate(z + h / 2 * b)
        z = z + h / 6 * (a + 2 * b + 2 * c + rate(z + h * c))
    share = -z[4] / z[5]  # of the solution that starts at zero
    return z[:2], z[2:4], share, z[8] + share * z[9]


def test_the_first_variation_away_from_the_measurement():
    """(7)–(9) with all five curvature terms, Hess F and the variation of the transport, against differences."""
    q, v, u = np.array([0.7, 0.3]), np.array([0.9, -1.1]), np.array([9.0])
    towards = np.array([-0.9, 0.7])  # from q̂ to q
    xi, dv = np.array([0.6, -0.5]), np.array([0.8, 1.2])
    y, arrival, slope, bent = geodesic(q, towards)
    observer = Geodesic(BEAM, ALPHA, BETA, Budget())
    flow = jax.jit(jax.vmap(lambda q, v: rates(observer, q, v, jnp.asarray(y), jnp.asarray(u))))
    h = 1e-4
    q_dots, v_dots = map(np.asarray, flow(q + h * np.outer([1, -1, 0], xi), v + h * np.outer([1, -1, 0], dv)))
    xi_dot, dv_dot = ((a[0] - a[1]) / (2 * h) for a in (q_dots, v_dots))
    w, v_dot = q_dots[2], v_dots[2]
    np.testing.assert_allclose(w, v + ALPHA * towards, atol=1e-8)
    zeta = dv + christoffel(q, xi, v)
    zeta_dot = dv_dot + christoffel_change(q, w, xi, v) + christoffel(q, xi_dot, v) + christoffel(q, xi, v_dot)

    d = np.sqrt(inner(q, towards, towards))
    tangent, end = towards / d, arrival / d
    normal = turned(q, tangent)
    hessian = inner(q, xi, tangent) * tangent - slope * inner(q, xi, normal) * normal
    np.testing.assert_allclose(xi_dot + christoffel(q, w, xi), zeta - ALPHA * hessian, atol=1e-6)

    s = np.array([-np.sin(y[1]), (u[0] - y[0] * np.cos(y[1])) / (1 + y[0] ** 2)])
    across, along = inner(y, s, turned(y, end)), inner(y, s, end)
    k, k_change, gradient = gauss(q), 4 * q[0] * xi[0] / (1 + q[0] ** 2) ** 3, -towards
    terms = {
        "−R(q̂', ξ)v̂": -printed_curvature(k, q, w, xi, v),
        "∇_ξ(T S)": -d * bent * inner(q, xi, normal) * (across * tangent - along * normal),
        "−β∇_ξ grad F": -BETA * hessian,
        "(∇_ξ R)(v̂, grad F)v̂": printed_curvature(k_change, q, v, gradient, v),
        "R(ζ, grad F)v̂": printed_curvature(k, q, zeta, gradient, v),
        "R(v̂, grad F)ζ": printed_curvature(k, q, v, gradient, zeta),
        "R(v̂, ∇_ξ grad F)v̂": printed_curvature(k, q, v, hessian, v),
    }
    np.testing.assert_allclose(zeta_dot + christoffel(q, w, zeta), sum(terms.values()), atol=1e-6)
    assert {name: value for name, value in terms.items() if np.linalg.norm(value) < 0.01} == {}
    # Hess F is no identity at this distance, as it is in (10).
    assert np.linalg.norm(hessian - xi) > 0.005
