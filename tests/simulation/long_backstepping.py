"""What takes long of `test_backstepping.py`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant.certificates import feedthrough, tracking
from covariant.geometry.lie import SO3, quaternion_from_rotation, rotation_from_quaternion
from covariant.models import marine, state_space
from covariant.simulation import Backstepping, follow, lissajous

CRAFT = {"odin": marine.odin, "with coriolis": lambda: marine.odin(coriolis=True), "cybership": marine.cybership}
QUATERNION = {"with a quaternion": lambda: marine.odin(coriolis=True, quaternion=True)}


def controller(craft):
    n = len(craft.velocities)
    path = lissajous(np.zeros(n), 0.3 * np.ones(n), np.linspace(0.1, 0.3, n), np.linspace(0.0, 2.0, n))
    if len(craft.coordinates) > n:
        euler = path
        path = follow(lambda t: with_quaternion(euler(t).position))
    return Backstepping(
        craft, path, np.linspace(50.0, 100.0, n), np.linspace(100.0, 200.0, n), np.linspace(0.3, 0.6, n)
    )


def with_quaternion(eta):
    """(position, Euler angles) as (position, quaternion)."""
    return jnp.concatenate([eta[:3], quaternion_from_rotation(marine.euler_rotation(eta[3:]))])


def drawn(n, seed=0):
    random = np.random.default_rng(seed)
    return [jnp.asarray(0.5 * random.normal(size=n)) for _ in range(4)]


def quaternion_slope(origin, eta):
    """Of the error in ν: R_dᵀR for the position, and wI + hat(ε) for twice the vector part (w, ε) of conj(q_d) q."""
    at, to = rotation_from_quaternion(origin[3:]), rotation_from_quaternion(eta[3:])
    w, *v = quaternion_from_rotation(at.T @ to)
    zero = jnp.zeros((3, 3))
    return jnp.block([[at.T @ to, zero], [zero, w * jnp.eye(3) + SO3.hat(jnp.stack(v))]])


def errors(c, t, eta, nu):
    return jnp.concatenate([c.error(t, eta), nu - c.virtual_velocity(t, eta)])


def along(c, t, eta, nu, tau):
    """d/dt of (η̃, s) along the true plant, J' included."""
    x_dot = state_space(c.craft).f(t, jnp.concatenate([eta, nu]), tau)
    n = eta.shape[0]
    return jax.jvp(lambda *a: errors(c, *a), (t, eta, nu), (jnp.ones(()), x_dot[:n], x_dot[n:]))[1]


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", CRAFT | QUATERNION)
def test_full_state_feedback_gives_the_printed_error_equations(name):
    craft = (CRAFT | QUATERNION)[name]()
    c, t = controller(craft), jnp.asarray(1.3)
    n = len(craft.velocities)
    eta, nu, *_ = drawn(n)
    j = craft.transform(eta) if name in CRAFT else quaternion_slope(c.path(t).position, with_quaternion(eta))
    eta = eta if name in CRAFT else with_quaternion(eta)
    e, s = jnp.split(errors(c, t, eta, nu), 2)
    rate = along(c, t, eta, nu, c.full_state(t, eta, nu))
    np.testing.assert_allclose(rate[:n], -c.lam @ e + j @ s, atol=1e-12)  # (88)
    drag = craft.coriolis(nu) + craft.damping(nu)
    np.testing.assert_allclose(craft.mass @ rate[n:], -(drag + c.kd) @ s - j.T @ c.kp @ e, atol=1e-9)  # (90)
    fall = s @ craft.mass @ rate[n:] + e @ c.kp @ rate[:n]
    np.testing.assert_allclose(fall, -s @ (craft.damping(nu) + c.kd) @ s - e @ c.kp @ c.lam @ e, rtol=1e-10)  # (92)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", CRAFT)
def test_output_feedback_gives_the_error_equations_that_the_cascade_is_judged_by(name):
    """(97)–(99) with J' kept: e' = a(e) + b(x̃), with a from `tracking` and b from `feedthrough`."""
    craft = CRAFT[name]()
    c, t = controller(craft), jnp.asarray(0.7)
    n = len(craft.coordinates)
    eta, nu, off_eta, off_nu = drawn(n, 1)
    tau = c(t, eta, jnp.concatenate([eta - off_eta, nu - off_nu]))
    e = errors(c, t, eta, nu)
    nu_r = c.virtual_velocity(t, eta)
    a = tracking(c).at(jnp.concatenate([eta, nu_r, e[n:]])).flow(t, e)
    asked = c.path(t).velocity - c.lam @ c.error(t, eta)
    b, _ = feedthrough(c)(jnp.concatenate([eta, asked]))
    np.testing.assert_allclose(along(c, t, eta, nu, tau), a + b @ jnp.concatenate([off_eta, off_nu]), atol=1e-9)
