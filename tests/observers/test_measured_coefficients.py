"""The observer with measured coefficients: its step in numbers, its clip, lost rows, and its C with gains by joint."""

import shutil

import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.engine import run_log
from covariant.geometry import Euclidean
from covariant.models import Lagrangian, free_body, pendulum_chain
from covariant.observers import MeasuredCoefficients, run
from covariant.signals import Record, StepCode

ARM = pendulum_chain((1.0, 0.7), (0.5, 0.4), viscous=(0.1, 0.05))


def test_a_step_in_numbers():
    """A unit mass under a force: the acceleration is held, then 1 − p² and (1 − p)²/h of the error are taken away."""
    free = Lagrangian(Euclidean(), inputs=1)
    observer = MeasuredCoefficients(free, 4.0, 4.0)  # two poles at −2
    state = observer.init(jnp.zeros(1))._replace(v=jnp.ones(1))
    state, info = observer.step(state, jnp.array([6.0]), jnp.zeros(1), 0.5)
    p, e, v = np.exp(-1.0), 0.5 + 6.0 / 8, 1.0 + 3.0
    assert info.innovation.tolist() == [-e]
    np.testing.assert_allclose([state.q.item(), state.v.item()], [p**2 * e, v - (1 - p) ** 2 / 0.5 * e], rtol=1e-14)


def test_the_model_is_evaluated_at_the_measurement_and_at_clipped_speeds():
    observer = MeasuredCoefficients(ARM, 40.0, 800.0, jnp.array([1.0, 2.0]))
    state = observer.init(jnp.array([0.3, -0.4]))._replace(held=jnp.array([0.5, -0.2]), q=jnp.array([9.0, 9.0]))
    expected = models.acceleration(
        observer.model, jnp.zeros(()), jnp.array([0.3, -0.4]), jnp.array([0.5, -0.2]), jnp.zeros(2)
    )
    after = observer.predict(state, jnp.zeros(2), jnp.asarray(0.01))
    np.testing.assert_allclose(after.v, 0.01 * expected, rtol=1e-12)
    fast = after._replace(q=after.seen, v=jnp.array([-7.0, 1.5]))
    corrected, info = observer.correct(fast, jnp.zeros(2), fast.seen)
    assert corrected.held.tolist() == [-1.0, 1.5]
    assert info.result == StepCode.ASTRAY


def test_lost_rows_are_one_long_step():
    """Rows without a measurement hold what was last seen, as one prediction over all of them does."""
    observer = MeasuredCoefficients(ARM, 40.0, 800.0, 3.0)
    start = observer.init(jnp.array([0.3, -0.4]))._replace(v=jnp.array([0.7, 0.1]), held=jnp.array([0.7, 0.1]))
    u, y = jnp.array([0.2, -0.1]), jnp.array([0.31, -0.39])
    lost, info = observer.step(start, u, jnp.full(2, jnp.nan), 0.004)
    assert info.result == StepCode.COASTED
    by_rows, _ = observer.step(lost, u, y, 0.006)
    at_once, _ = observer.step(start, u, y, 0.01)
    for a, b in zip(by_rows[:5], at_once[:5], strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


def test_a_joint_that_is_not_measured_corrects_nothing():
    observer = MeasuredCoefficients(ARM, 40.0, 800.0, 3.0)
    state = observer.predict(observer.init(jnp.array([0.3, -0.4])), jnp.zeros(2), jnp.asarray(0.01))
    after, _ = observer.correct(state, jnp.zeros(2), jnp.array([0.5, jnp.nan]))
    assert after.q[1] == state.q[1]
    assert after.v[1] == state.v[1]
    assert after.v[0] != state.v[0]


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler, `cc`")
def test_c_with_gains_and_speeds_by_joint_does_the_same():
    """While speeds are clipped, and over a gap."""
    observer = MeasuredCoefficients(ARM, jnp.array([40.0, 55.0]), jnp.array([800.0, 1500.0]), jnp.array([0.4, 5.0]))
    t = 0.002 * np.arange(300)
    y = np.stack([np.sin(3 * t), 0.5 * np.cos(2 * t)], axis=1)
    y[100:110] = np.nan
    record = Record(t, np.tile([0.3, -0.2], (300, 1)), y)
    expected = run(observer, record)
    done, engine = run_log(observer, record, None, "c")
    assert engine == "c"
    np.testing.assert_allclose(done.estimate, expected.estimate, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(done.info.result, expected.info.result)
    assert {int(StepCode.ASTRAY), int(StepCode.COASTED)} <= set(np.asarray(done.info.result).tolist())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: MeasuredCoefficients(ARM, -1.0, 4.0), "alpha"),
        (lambda: MeasuredCoefficients(ARM, 1.0, 4.0, 0.0), "speed"),
        (lambda: MeasuredCoefficients(free_body(), 1.0, 4.0), "group"),
    ],
)
def test_what_does_not_fit_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
