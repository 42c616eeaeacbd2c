"""Encoders that count ticks: edges and intervals in the intrinsic Kalman filter, beside the same filter with noise."""

import jax.numpy as jnp
import numpy as np
import pytest

from covariant.calibration import DataSheet, tuned_estimators
from covariant.models import Lagrangian, free_body, pendulum_chain
from covariant.observers import IntrinsicKalman
from covariant.observers.base._ticks import Encoded, take


def plant() -> Lagrangian:
    chain = pendulum_chain((1.0,), (0.5,))
    return Lagrangian(chain.metric, chain.potential, circles=(0,))


MODEL = plant()


def taken(prior, **given):
    """`take` for one joint, its covariance (2, 2) in place of the root."""
    numbers = {"offset": 0.0, "moved": 0.0, "age": 0.01, "speed": 2.0, "step": 0.1, "noise": 1e-6} | given
    rows = jnp.eye(2)[:1], jnp.eye(2)[1:]
    o, m, a, s, step, noise = (jnp.array([numbers[k]]) for k in ("offset", "moved", "age", "speed", "step", "noise"))
    found = take(jnp.linalg.cholesky(jnp.asarray(prior)), rows, Encoded(o, m, a, s, step, noise, jnp.array([True])))
    return np.asarray(found.error), np.asarray(found.root @ found.root.T)


def textbook(prior, row, value, noise):
    gain = prior @ row / (row @ prior @ row + noise)
    return gain * value, prior - np.outer(gain, row @ prior)


PRIOR = np.array([[4e-4, 3e-3], [3e-3, 0.09]])


@pytest.mark.long("1")
@pytest.mark.parametrize("direction", [1, -1])
def test_an_edge_is_where_the_joint_was_between_two_samples(direction):
    """One tick on, the joint passed the middle between the readings, half a step ago on average."""
    speed, age, offset = direction * 2.0, 0.01, direction * 0.03
    spread = (speed**2 + PRIOR[1, 1]) * age**2 / 12 + 1e-6
    passed = offset - direction * 0.05  # from the expected position now to the edge
    expected = textbook(PRIOR, np.array([1.0, -age / 2]), passed + speed * age / 2, spread)
    found = taken(PRIOR, offset=offset, moved=direction * 0.1, speed=speed)
    np.testing.assert_allclose(found[0], expected[0], rtol=1e-12)
    np.testing.assert_allclose(found[1], expected[1], atol=1e-15)


def test_many_ticks_are_a_uniform_error():
    expected = textbook(PRIOR, np.array([1.0, 0.0]), 0.03, 0.1**2 / 12 + 1e-6)
    found = taken(PRIOR, offset=0.03, moved=0.5)
    np.testing.assert_allclose(found[0], expected[0], rtol=1e-12)
    np.testing.assert_allclose(found[1], expected[1], atol=1e-15)


def test_no_edge_says_nothing_to_one_who_knows_better_and_holds_the_mean_inside():
    """The variance is well below that of the interval: only the mean moves, to its end."""
    inside = taken(PRIOR, offset=0.03)
    np.testing.assert_array_equal(inside[0], 0)
    np.testing.assert_allclose(inside[1], PRIOR, rtol=1e-12)
    error, cov = taken(PRIOR, offset=0.08)
    np.testing.assert_allclose(error, PRIOR[:, 0] / PRIOR[0, 0] * (0.08 - 0.05 - 1e-3), rtol=1e-12)
    np.testing.assert_allclose(cov, PRIOR, rtol=1e-12)


def test_no_edge_leaves_the_uniform_variance_to_one_who_knows_less():
    wide = 100 * PRIOR
    cov = taken(wide, offset=0.03)[1]
    np.testing.assert_allclose(cov[0, 0], 0.1**2 / 12 + 1e-6, rtol=1e-3)


def test_each_encoder_may_have_ticks_of_its_own():
    """A filter made of a list of ticks has one for each coordinate; one number is that of all."""
    model = Lagrangian(lambda q: jnp.eye(2))
    sheet = DataSheet(1e-3, 1.0, coordinate_stds=(1e-3, 2e-3), quantum=(4e-3, 8e-3))
    made = tuned_estimators(model, 2, sheet, 100.0, names=("intrinsic-kalman",))["intrinsic-kalman"]
    np.testing.assert_array_equal(made.quantum, [4e-3, 8e-3])
    assert made.measurement_cov[1, 1] == pytest.approx(4 * made.measurement_cov[0, 0])
    one = tuned_estimators(model, 2, sheet._replace(quantum=4e-3), 100.0, names=("intrinsic-kalman",))
    np.testing.assert_array_equal(one["intrinsic-kalman"].quantum, [4e-3, 4e-3])


def test_a_quantum_off_coordinates_or_without_size_is_refused():
    eye = jnp.eye(3)
    with pytest.raises(ValueError, match="quantum is for coordinates"):
        IntrinsicKalman(free_body((1.0, 2.0, 3.5)), eye, eye, eye, quantum=jnp.full(3, 0.1))
    with pytest.raises(ValueError, match="quantum must be a positive, finite number; got"):
        IntrinsicKalman(MODEL, 1.0, 1.0, 1.0, quantum=0.0)
