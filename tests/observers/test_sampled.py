"""What every observer does with samples: rest on the truth, coast through gaps, converge, wrap, keep its numbers."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import geometry
from covariant.models import Lagrangian
from covariant.observers import (
    EKF,
    FilteredDerivative,
    ModelCopy,
    SavitzkyGolay,
    run,
)
from covariant.observers.base._protocol import outcome
from covariant.signals import Record, StepCode

X0 = np.array([0.7, 4.0])


def codes(info) -> np.ndarray:
    return np.asarray(info.result)


@pytest.mark.core(1)
@pytest.mark.long("geodesic")
def test_coordinates_that_jump_by_a_turn_change_nothing(observer, pendulum, irregular, follow):
    x = pendulum.truth(irregular, np.array([2.5, 14.0]))
    turns = np.floor((x[:, :1] + np.pi) / (2 * np.pi))
    assert turns[-1] - turns[0] >= 2
    plain = follow(observer, irregular, x[:, :1])
    wrapped = follow(observer, irregular, x[:, :1] - 2 * np.pi * turns)
    np.testing.assert_allclose(wrapped.x, plain.x - [2 * np.pi * turns[0, 0], 0.0], rtol=0, atol=1e-10)
    np.testing.assert_allclose(wrapped.info.innovation, plain.info.innovation, rtol=0, atol=1e-10)


@pytest.mark.core(1)
def test_every_second_measurement_is_enough(observer, pendulum, irregular, follow):
    x = pendulum.truth(irregular, X0)
    y = x[:, :1].copy()
    y[1::2] = np.nan
    followed = follow(observer, irregular, y)
    lag = {"FilteredDerivative": 0.4, "SavitzkyGolay": 0.1}.get(type(observer).__name__, 0.01)
    np.testing.assert_allclose(followed.x[250:, 1], x[251:, 1], rtol=0, atol=lag * np.abs(x[:, 1]).max())
    np.testing.assert_array_equal(codes(followed.info)[::2], StepCode.COASTED)
    np.testing.assert_array_equal(codes(followed.info)[1::2], StepCode.OK)


def test_a_state_lost_in_part_is_lost():
    fine, lost = jnp.zeros(2), jnp.array([0.0, jnp.nan])
    assert outcome(fine, fine, fine) == StepCode.OK
    for q, v in ((lost, fine), (fine, lost), (lost, lost)):
        assert outcome(q, v, fine) == outcome(q, v, lost) == StepCode.NOT_FINITE


@pytest.mark.core(1)
@pytest.mark.parametrize(("alpha", "beta"), [(1e6, 1e12), (1e200, 1e200), (1.0, 1e300)])
def test_gains_of_any_size_leave_a_stable_loop(with_gains, pendulum, regular, follow, alpha, beta):
    x = pendulum.truth(regular, X0)
    absurd = eqx.tree_at(lambda o: (o.alpha, o.beta), with_gains, (jnp.array(alpha), jnp.array(beta)))
    followed = follow(absurd, regular, x[:, :1])
    assert set(codes(followed.info)) == {StepCode.OK}
    assert np.isfinite(followed.x).all()


# Sampling refines the flow


# The loop

LENGTH = 120


@pytest.fixture
def record(irregular):
    rng = np.random.default_rng(1)
    t, u = irregular[:LENGTH], rng.normal(0, 0.5, (LENGTH, 1))
    y = np.cumsum(rng.normal(0, 0.1, (LENGTH, 1)), 0)
    y[30:40] = np.nan
    return Record(*map(jnp.asarray, (t, u, y)))


PLAIN = Lagrangian(geometry.Euclidean(), lambda q: -9.0 * jnp.cos(q[0]), circles=(0,))
LOOPS = [
    ModelCopy(PLAIN, 20.0, 150.0),
    EKF(PLAIN, jnp.eye(1), 1e-4 * jnp.eye(1), substeps=2),
    FilteredDerivative(60.0),
    SavitzkyGolay(9, 2),
]


def test_a_run_refuses_a_bad_record(record):
    with pytest.raises(ValueError, match="rows 1 and 2 have the same stamp"):
        run(LOOPS[0], record._replace(t=record.t.at[1].set(record.t[0])))


# Stiff friction
