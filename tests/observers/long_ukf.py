"""The unscented Kalman filter where nothing is linear: against the EKF, and against Monte Carlo: what takes long."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from plants import MEASUREMENT, body, masses

from covariant import models
from covariant.geometry.lie import SO3
from covariant.models import Lagrangian, Motion
from covariant.observers import EKF, UKF, run
from covariant.signals import Record


def swings(count: int, dt: float):
    """Large swings (count, 21, 2) of a point mass on a rod of half a metre, by a plain midpoint rule, and their angles
    as a poor sensor sees them."""
    rng, h = np.random.default_rng(3), dt / 40
    rows = [np.stack([rng.normal(1.6, 0.3, count), rng.normal(0, 2.0, count)], axis=1)]

    def rate(x):
        return np.stack([x[:, 1], -9.81 / 0.5 * np.sin(x[:, 0]) - 0.2 * x[:, 1]], axis=1)

    for _ in range(20):
        x = rows[-1]
        for _ in range(40):
            x = x + h * rate(x + h / 2 * rate(x))
        rows.append(x)
    x = np.stack(rows, axis=1)
    return x, x[..., :1] + 0.3 * rng.normal(size=(*x.shape[:2], 1))


@pytest.mark.exhaustive
def test_far_from_linear_it_is_nearer_than_the_ekf():
    dt = 0.3
    x, y = swings(400, dt)
    pendulum = models.pendulum_chain((1.0,), (0.5,), viscous=(0.2 * 0.25,))

    def error(kind):
        observer = kind(pendulum, 0.1 * jnp.eye(1), 0.09 * jnp.eye(1), 2.0, 10)

        def step(state, row):
            state, _ = observer.step(state, jnp.zeros(1), row, jnp.asarray(dt))
            return state, state.v[0]

        follow = jax.jit(jax.vmap(lambda rows: jax.lax.scan(step, observer.init(rows[0]), rows[1:])[1]))
        return np.sqrt(np.mean((follow(jnp.asarray(y)) - x[:, 1:, 1]) ** 2))

    assert error(UKF) < min(0.65, 0.8 * error(EKF))


@pytest.mark.exhaustive
def test_on_rotations_mean_and_covariance_are_those_of_a_cloud_of_bodies():
    """A tumbling body of uncertain attitude and velocity, half a second later; the EKF's are further off."""
    rng, rigid = np.random.default_rng(7), body()
    root = np.sqrt(np.diag([0.02] * 3 + [0.5] * 3))
    q0, v0, u, dt = SO3.exp(jnp.array([0.3, -0.2, 0.4])), jnp.array([0.5, 2.0, -0.4]), jnp.zeros(3), jnp.asarray(0.5)
    still = jnp.zeros((3, 3)), 1e-4 * jnp.eye(3), 1.0, 4
    ukf, ekf = UKF(rigid, *still), EKF(rigid, *still)

    @jax.jit
    def both(errors):
        """Both predictions, and the bodies of the cloud as seen from each."""
        found = ukf.predict(ukf.init(q0)._replace(v=v0, root=jnp.asarray(root)), u, dt)
        linear = ekf.predict(ekf.init(q0)._replace(v=v0, root=jnp.asarray(root)), u, dt)

        def seen(error):
            q, v = models.advance(rigid, 0.0, Motion(SO3.retract(q0, error[:3]), v0 + error[3:]), u, dt, 4)
            return [jnp.concatenate([SO3.local(state.q, q), v - state.v]) for state in (found, linear)]

        return (found, linear), jax.vmap(seen)(errors)

    def off(seen, cov):
        """Mean and covariance of an estimate, measured by those of the cloud."""
        whiten = np.linalg.inv(np.linalg.cholesky(np.cov(seen.T)))
        return np.linalg.norm(whiten @ seen.mean(0)), np.linalg.norm(whiten @ np.asarray(cov) @ whiten.T - np.eye(6))

    (found, linear), cloud = both(jnp.asarray(rng.normal(size=(40_000, 6)) @ root))
    unscented, extended = off(np.asarray(cloud[0]), ukf.cov(found)), off(np.asarray(cloud[1]), ekf.cov(linear))
    assert unscented[0] < 0.03 < 0.5 < extended[0]
    assert unscented[1] < min(0.7, 0.8 * extended[1])


@pytest.mark.exhaustive
def test_a_covariance_without_rank_stays_one():
    """Nothing is unknown of the velocity and nothing disturbs it: the model alone moves it, and numbers stay finite."""
    observer = UKF(masses(), np.zeros((2, 2)), MEASUREMENT, 0.0, substeps=16)
    t, y = 0.01 * np.arange(60.0), np.full((60, 2), 0.1)  # as many rows as above, the same program
    y[1:, 1] = np.nan
    done = run(observer, Record(t, np.zeros((60, 2)), y))
    assert np.isfinite(done.estimate).all()
    assert np.linalg.eigvalsh(done.info.innovation_cov)[:, 0].min() > 0


@pytest.mark.exhaustive
def test_angles_go_round():
    """A rod that turns at 9 rad/s, its angle read between ±π."""
    rod = Lagrangian(lambda q: jnp.eye(1), circles=(0,))
    t = 0.02 * np.arange(100.0)
    y = (9 * t[:, None] + np.pi) % (2 * np.pi) - np.pi
    v = run(UKF(rod, np.eye(1), 1e-6 * np.eye(1), 3.0, substeps=1), Record(t, np.zeros((100, 1)), y)).estimate[:, 1]
    np.testing.assert_allclose(v[20:], 9.0, atol=1e-6)
