"""What takes long of `test_lifted_metric.py`: geodesics and simulations."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from test_lifted_metric import BEAM, NEAR, SIGMA, M, Q

from covariant import observers
from covariant.certificates import least_gain, tangent_metric
from covariant.geometry import Budget, distance, exp, log
from covariant.simulation import observe


def lifted(x):
    """The metric m|ξ|² + |w|² on the states of the ball on the beam."""
    return 2 * tangent_metric(BEAM.space, Q)(jnp.zeros(()), x)


def norm(q, a):
    return math.sqrt(a[0] ** 2 + (1 + q[0] ** 2) * a[1] ** 2)


def test_geodesics_of_the_lift_turn_by_no_more_than_the_curvature_allows():
    """Geodesics by Christoffel symbols of the metric on states, which know nothing of X, p and curvature."""
    rng = np.random.default_rng(1)
    moved = jax.jit(jax.vmap(lambda x, u, s: jax.jvp(lambda s: exp(lifted, x, s * u), (s,), (1.0,)), (None, None, 0)))
    bent = 0.0
    for _ in range(8):
        x, u = rng.uniform(-1, 1, 4), rng.normal(size=4)
        u *= 3 * rng.uniform() / math.sqrt(u @ np.asarray(lifted(jnp.asarray(x))) @ u)
        states, rates = (np.asarray(a) for a in moved(x, u, np.linspace(0.0, 1.0, 41)))
        q, v, speed = states[:, :2], states[:, 2:], rates[:, :2]
        changes = rates[:, 2:] + np.array(
            [
                [-a[0] * b[1] * c[1], a[0] / (1 + a[0] ** 2) * (b[0] * c[1] + b[1] * c[0])]
                for a, b, c in zip(q, v, speed, strict=True)
            ]
        )
        p = changes - SIGMA * speed
        sizes = np.array([norm(*each) for each in zip(q, speed, strict=True)])
        pushes = np.array([norm(*each) for each in zip(q, p, strict=True)])
        np.testing.assert_allclose(sizes, sizes[0], rtol=1e-5)
        np.testing.assert_allclose(M * sizes**2 + pushes**2, u @ np.asarray(lifted(jnp.asarray(x))) @ u, rtol=1e-5)
        area = np.abs(v[:, 0] * p[:, 1] - v[:, 1] * p[:, 0]) * np.sqrt(1 + q[:, 0] ** 2)
        turning = np.trapezoid(area / (1 + q[:, 0] ** 2) ** 2, dx=1 / 40) / M
        end = jnp.asarray(q[-1])
        away = -np.asarray(log(BEAM.space, end, jnp.asarray(q[0])))
        cosine = float(BEAM.space.lower(end, away) @ speed[-1]) / norm(q[-1], away) / sizes[-1]
        assert math.acos(min(cosine, 1.0)) <= turning + 1e-4
        assert norm(q[-1], away) >= sizes[0] * math.sin(turning) / turning * (1 - 1e-6)
        bent = max(bent, turning)
    assert bent > 0.1


def test_no_start_within_the_set_converges_more_slowly_than_claimed():
    """Distances in the metric on states, by shooting, of an observer at the least gain."""
    gain = least_gain(SIGMA, SIGMA / 2, NEAR)
    m, rng = gain.decay.before, np.random.default_rng(2)
    q = np.array([[m + SIGMA**2, -SIGMA], [-SIGMA, 1.0]])
    metric = tangent_metric(BEAM.space, 2 * q)
    observer = observers.LagrangianMetric(BEAM, gain.alpha, gain.beta, Budget())
    t = jnp.linspace(0.0, 0.6, 4)
    apart = jax.jit(jax.vmap(lambda a, b: distance(lambda x: metric(jnp.zeros(()), x), a, b)))
    for _ in range(3):
        x = jnp.asarray([*rng.uniform(-0.5, 0.5, 2), *(0.2 * rng.uniform(-1, 1, 2))])
        off = rng.normal(size=4)
        off[:2] *= 0.35 / norm(x[:2], off[:2])
        off[2:] *= 0.25 / norm(x[:2], off[2:])
        state = observer.init(x[:2] + off[:2])._replace(v=x[2:] + off[2:])
        truth, states = observe(BEAM, observer, x, state, t, lambda t, x: jnp.array([3.0 * jnp.sin(4 * t)]))
        d = np.asarray(apart(truth, jnp.concatenate([states.q, states.v], axis=1)))
        assert d[0] < gain.decay.radius
        assert (np.diff(np.log(d)) <= -gain.decay.rate * np.diff(t) + 1e-4).all(), d
        assert np.log(d[-1] / d[0]) > -40 * gain.decay.rate  # and not for want of a difference
