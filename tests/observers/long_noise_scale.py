"""Filters that learn the size of what they do not know: sensitivities, bands on wrong models, and the limit."""

import jax.numpy as jnp
import numpy as np
import pytest

from covariant import Record, models, observers
from covariant._linalg import triangular
from covariant.observers.filters._noise_scale import HELD, NoiseScale

DT, NOISE = 0.005, 2e-4


def unit_mass(force, seed=0):
    """Log of a unit mass that the force (T,) moves, and its velocity."""
    rng = np.random.default_rng(seed)
    v = DT * np.concatenate([[0.0], np.cumsum(force)[:-1]])
    q = np.concatenate([[0.0], np.cumsum(DT * v + DT**2 / 2 * force)[:-1]])
    y = q + NOISE * rng.normal(size=len(q))
    return Record(DT * np.arange(len(q)), np.zeros((len(q), 1)), y[:, None]), v


def gauss_markov_force(std, time, count, seed=1):
    rng, decay = np.random.default_rng(seed), np.exp(-DT / time)
    force = np.zeros(count)
    for k in range(1, count):
        force[k] = decay * force[k - 1] + std * np.sqrt(1 - decay**2) * rng.normal()
    return force


def shaken(count=6000):
    t = DT * np.arange(count)
    return 0.3 * np.sin(np.pi * t) * (1 + np.sin(0.4 * t))


def held(run, v, std_factor=1.96, rows=slice(400, None)):
    error, std = run.estimate[rows, 1] - v[rows], run.info.velocity_std[rows, 0]
    return np.asarray(np.abs(error) < std_factor * std), float(np.sqrt(np.mean(error**2)))


FREE = models.oscillator(stiffness=1e-9)
COVS = jnp.array([[1e-4]]), jnp.array([[NOISE**2]])
FILTERS = {
    "intrinsic-kalman": lambda adaptive: observers.IntrinsicKalman(
        FREE, *COVS, np.eye(1), substeps=1, adaptive=adaptive
    ),
    "ekf": lambda adaptive: observers.EKF(FREE, *COVS, 1.0, substeps=1, adaptive=adaptive),
    "ukf": lambda adaptive: observers.UKF(FREE, *COVS, 1.0, substeps=1, adaptive=adaptive),
    "force": lambda adaptive: observers.IntrinsicKalman(
        FREE, *COVS, np.eye(1), observers.external_force(std=[0.02], time=0.3), substeps=1, adaptive=adaptive
    ),
}


def test_sensitivities_are_the_derivatives_in_the_logarithm_of_the_noise():
    rng = np.random.default_rng(0)
    transition, noise = np.eye(3) + 0.3 * rng.normal(size=(3, 3)), 0.1 * np.tril(rng.normal(size=(3, 3)))
    readings = rng.normal(size=12)

    def textbook(log):
        p, x = np.eye(3), np.zeros(3)
        for y in readings:
            x, p = transition @ x, transition @ p @ transition.T + np.exp(log) * noise @ noise.T
            gain = p[:, 0] / (p[0, 0] + 0.5)
            x, p = x + gain * (y - x[0]), p - np.outer(gain, p[0])
        return x, p

    scale, p, x = NoiseScale.at_start(jnp.eye(3)), np.eye(3), np.zeros(3)
    for y in readings:
        x, p = transition @ x, transition @ p @ transition.T + noise @ noise.T
        scale = scale.advanced(jnp.asarray(transition), jnp.asarray(noise))
        gain = p[:, 0] / (p[0, 0] + 0.5)
        correction = gain * (y - x[0])
        root, after = triangular(jnp.linalg.cholesky(p)), jnp.linalg.cholesky(p - np.outer(gain, p[0]))
        scale = scale.corrected(root, after, jnp.asarray(correction), jnp.eye(3), jnp.zeros((), bool), jnp.ones(()))
        x, p = x + correction, p - np.outer(gain, p[0])
    step = 1e-5
    (x1, p1), (x0, p0) = textbook(step), textbook(-step)
    assert np.allclose(scale.cov, (p1 - p0) / (2 * step), atol=1e-8)
    assert np.allclose(scale.estimates.sum(1), (x1 - x0) / (2 * step), atol=1e-8)
    assert scale.estimates.shape == (3, HELD + 1)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", FILTERS)
def test_the_band_holds_where_an_unknown_force_moves_the_machine(name):
    record, v = unit_mass(shaken())
    fixed, adaptive = (held(observers.run(FILTERS[name](on), record), v) for on in (False, True))
    fast = np.argsort(np.abs(v[400:]))[-560:]
    assert fixed[0].mean() < 0.6  # the force is 30 times what the filter is built with
    assert adaptive[0].mean() > 0.93
    assert adaptive[0][fast].mean() > 0.9
    assert adaptive[1] < 0.6 * fixed[1]


@pytest.mark.exhaustive
def test_a_right_filter_loses_nothing():
    record, v = unit_mass(gauss_markov_force(0.2, 0.3, 12000))
    force = observers.external_force(std=[0.2], time=0.3)
    runs = [
        held(
            observers.run(
                observers.IntrinsicKalman(FREE, *COVS, np.eye(1), force, substeps=1, adaptive=adaptive), record
            ),
            v,
        )
        for adaptive in (False, True)
    ]
    (_, fixed), (inside, error) = runs
    assert error < 1.01 * fixed
    # Some 200 independent errors in a minute: 3 deviations of their share are .046.
    assert abs(inside.mean() - 0.95) < 0.03


@pytest.mark.exhaustive
def test_the_scale_stays_where_the_log_is_ordinary_and_a_single_outlier_passes():
    record, _ = unit_mass(np.zeros(2000))
    record.y[1000] += 5 * NOISE
    scale = observers.run(FILTERS["intrinsic-kalman"](True), record).info.noise_scale
    assert float(scale.max()) < 3.0


@pytest.mark.exhaustive
def test_with_growing_forces_the_filter_becomes_one_without_a_model():
    record, v = unit_mass(shaken(3000))
    kalman = observers.JointKalman(motion_std=5.0, motion_time=0.3, measurement_std=NOISE, gate=None)
    without = observers.run(kalman, record).estimate[:, 1]
    error, force = np.sqrt(np.mean((without - v) ** 2)), observers.external_force(std=[5.0], time=0.3)

    def apart(substeps, stiffness):
        model = models.oscillator(stiffness=stiffness)
        filtered = observers.IntrinsicKalman(model, 0.0, COVS[1], 2.25 * np.eye(1), force, substeps=substeps, gate=None)
        return np.sqrt(np.mean((observers.run(filtered, record).estimate[:, 1] - without) ** 2)) / error

    # What the noise of a force does within the substep in which it comes is left out: an error of the first order.
    distances = [apart(substeps, 1e-9) for substeps in (1, 2)]
    assert distances[0] < 0.01
    assert 1.8 < distances[0] / distances[1] < 2.2
    assert apart(1, 1.0) < 0.05  # no spring pulls: of a model that is wrong altogether hardly anything is left
