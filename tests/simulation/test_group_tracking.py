"""The tracking controller on Lie groups: its error equations, by differences of simulated motions and plain algebra."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from plain import rk4
from scipy.linalg import expm

from covariant import models
from covariant.geometry.lie import SE3, SO3
from covariant.models import Motion, acceleration
from covariant.simulation import GroupTracking, follow

RANDOM = np.random.default_rng(4)
BODIES = {
    "SO(3)": (SO3, lambda: models.heavy_top((1.0, 2.0, 2.5), 2.0, viscous=0.3)),
    "SE(3)": (SE3, models.underwater_vehicle),
}


def symmetric(n):
    a = RANDOM.normal(size=(n, n))
    return 5.0 * np.eye(n) + 0.5 * a @ a.T


def path(group, n):
    """A reference whose velocity and acceleration do not vanish, and do not commute."""
    first, second = RANDOM.normal(size=(2, n))
    return follow(lambda t: group.exp(0.5 * first * jnp.sin(t)) @ group.exp(0.4 * second * t))


def cross(a):
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


def bracket(x):
    """Matrix of y ↦ [x, y], on so(3) or on twists (v, ω)."""
    if len(x) == 3:
        return cross(x)
    return np.block([[cross(x[3:]), cross(x[:3])], [np.zeros((3, 3)), cross(x[3:])]])


def body_jacobian(e):
    """J_r(e) = ∫₀¹ exp(−s ad_e) ds, as a block of an exponential."""
    n = len(e)
    return expm(np.block([[-bracket(e), np.eye(n)], [np.zeros((n, 2 * n))]]))[:n, n:]


def connection(inertia, a, b):
    return (bracket(a) @ b - np.linalg.solve(inertia, bracket(a).T @ inertia @ b + bracket(b).T @ inertia @ a)) / 2


@pytest.mark.exhaustive("SE(3)")
@pytest.mark.parametrize("name", BODIES)
def test_errors_obey_the_equations_of_the_class_with_any_error_of_the_estimated_velocity(name):
    group, make = BODIES[name]
    model, n, h = make(), group.dimension, 1e-4
    c = GroupTracking(model, path(group, n), symmetric(n), symmetric(n))
    off = 0.5 * RANDOM.normal(size=n)
    t = jnp.asarray(0.7)
    g = c.path(t).position @ group.exp(jnp.asarray(0.7 * RANDOM.normal(size=n)))
    v = jnp.asarray(RANDOM.normal(size=n))

    start, unpacked = ravel_pytree((t, g, v))

    @jax.jit  # not the whole step, which would compile the slope four times
    def slope(x):
        s, g, v = unpacked(x)
        force = c(s, g, Motion(g, v + off))
        return ravel_pytree((jnp.ones(()), g @ group.hat(v), acceleration(model, s, g, v, force)))[0]

    @jax.jit
    def errors(x):
        s, g, v = unpacked(x)
        e, w, _ = c.reference(s, g)
        return e, v - w, w

    (e, s, w), ahead, behind = (tuple(map(np.asarray, errors(rk4(slope, start, dt)))) for dt in (0.0, h, -h))
    e_rate, s_rate = ((a - b) / (2 * h) for a, b in zip(ahead[:2], behind[:2], strict=True))
    jacobian, inertia = body_jacobian(e), np.asarray(model.space.inertia.matrix)
    kp, kd = np.asarray(c.kp), np.asarray(c.kd)
    np.testing.assert_allclose(e_rate, np.linalg.solve(jacobian, s), atol=1e-5)

    drag = np.asarray(model.dissipation(g, v) - model.dissipation(g, jnp.asarray(w)))
    spring = np.linalg.solve(jacobian.T, kp @ e)
    through = inertia @ connection(inertia, w, off) - kd @ off
    left = inertia @ (s_rate + connection(inertia, np.asarray(v), s))
    np.testing.assert_allclose(left, -spring - kd @ s + drag + through, atol=1e-4)
    fall = s @ inertia @ s_rate + e @ kp @ e_rate
    assert fall == pytest.approx(s @ (-kd @ s + drag + through), rel=1e-5)
    assert s @ drag < 0
    assert np.abs(through).min() > 1e-2


BAD = {
    "kp": (models.free_body, {"kp": -1.0, "kd": 1.0}, "kp must be symmetric positive definite"),
    "two fans": (models.hovercraft, {"kp": 1.0, "kd": 1.0}, "a force on each velocity; got"),
    "coordinates": (models.oscillator, {"kp": 1.0, "kd": 1.0}, "needs a system on a group"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_it_cannot_control_is_refused(case):
    make, gains, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        GroupTracking(make(), path(SO3, 3), **gains)
