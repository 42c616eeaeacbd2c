"""What takes long of `test_gate.py`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant.geometry.lie import SO3
from covariant.models import Lagrangian, Motion, advance, free_body, oscillator, pendulum_chain
from covariant.observers import Gate, Gated, Intrinsic, IntrinsicKalman, ModelCopy, run
from covariant.signals import Record, StepCode

NOISE = 1e-3


ROWS = 500


CHAIN = pendulum_chain((1.0, 0.7), (0.5, 0.4))


def kalman(**named) -> IntrinsicKalman:
    return IntrinsicKalman(CHAIN, 1e-2 * jnp.eye(2), NOISE**2 * jnp.eye(2), 4.0 * jnp.eye(2), substeps=2, **named)


@pytest.fixture(scope="module")
def swing() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stamps, states and noisy positions of a swing, integrated plainly."""
    t = 0.005 * np.arange(ROWS)

    def step(motion, _):
        return advance(CHAIN, 0.0, motion, jnp.zeros(2), 0.005, 4), jnp.concatenate(motion)

    start = Motion(jnp.array([0.8, -0.5]), jnp.array([1.0, 2.0]))
    x = np.asarray(jax.jit(lambda: jax.lax.scan(step, start, None, ROWS)[1])())
    return t, x, x[:, :2] + NOISE * np.random.default_rng(0).normal(size=(ROWS, 2))


def velocity_error(followed, x, rows=slice(150, None)) -> float:
    return float(np.sqrt(np.mean((followed.x[rows, 2:] - x[1:][rows, 2:]) ** 2)))


def codes(followed) -> np.ndarray:
    return np.asarray(followed.info.result)


@pytest.mark.exhaustive
def test_one_outlier_in_a_hundred_costs_less_than_a_tenth(swing, follow):
    t, x, y = swing
    rng = np.random.default_rng(1)
    hit = rng.random(y.shape) < 0.01
    hit[:20] = False
    spoiled = y + 0.5 * hit * rng.choice([-1, 1], y.shape)
    clean, found = follow(kalman(), t, y), follow(kalman(), t, spoiled)
    assert (codes(found) == StepCode.OUTLIER).tolist() == hit.any(axis=1)[1:].tolist()
    assert velocity_error(found, x) < 1.1 * velocity_error(clean, x)
    assert velocity_error(follow(kalman(gate=None), t, spoiled), x) > 10 * velocity_error(clean, x)


@pytest.mark.exhaustive
def test_a_clean_log_is_never_refused(swing, follow):
    t, _, y = swing
    assert set(codes(follow(kalman(), t, y))) == {StepCode.OK}


@pytest.mark.exhaustive
def test_a_jump_that_stays_is_believed_after_a_while(swing, follow):
    t, _, y = swing
    moved = y.copy()
    moved[250:, 0] += 0.4
    found = codes(follow(kalman(gate=Gate(patience=10)), t, moved))
    first = 249
    assert (found[first : first + 10] == StepCode.OUTLIER).all()
    assert found[first + 10] == StepCode.RESTARTED
    assert (found[first + 30 :] == StepCode.OK).all()


@pytest.mark.exhaustive
def test_many_joints_with_an_outlier_each_now_and_then_do_not_start_it_anew(swing, follow):
    """Patience is a joint's own: refusals of different joints in a row are no jump."""
    t, _, y = swing
    spoiled = y.copy()
    spoiled[200:230:2, 0] += 0.5
    spoiled[201:230:2, 1] += 0.5
    found = codes(follow(kalman(gate=Gate(patience=5)), t, spoiled))
    assert (found[199:229] == StepCode.OUTLIER).all()


@pytest.mark.exhaustive
def test_a_joint_that_is_missing_delays_the_new_start(swing, follow):
    t, _, y = swing
    moved = y.copy()
    moved[250:, 0] += 0.4
    moved[255:275, 1] = np.nan
    found = codes(follow(kalman(gate=Gate(patience=10)), t, moved))
    assert StepCode.RESTARTED not in found[249:274]
    assert found[274] == StepCode.RESTARTED


@pytest.mark.exhaustive
def test_noise_told_ten_times_too_small_does_not_shut_the_gate(swing, follow):
    t, x, _ = swing
    y = x[:, :2] + 10 * NOISE * np.random.default_rng(2).normal(size=(ROWS, 2))
    found, free = follow(kalman(), t, y), follow(kalman(gate=None), t, y)
    assert (codes(found)[150:] == StepCode.OK).all()
    assert velocity_error(found, x) < 1.3 * velocity_error(free, x)


@pytest.mark.exhaustive
def test_an_attitude_is_refused_as_a_whole():
    body = free_body((1.0, 2.0, 3.5))
    observer = IntrinsicKalman(body, 1e-4, 1e-6, 1.0, substeps=1)
    y = np.repeat(np.eye(3)[None], 60, axis=0)
    y[40] = np.asarray(SO3.exp(jnp.array([0.4, 0.0, 0.0])))
    found = run(observer, Record(0.01 * np.arange(60), np.zeros((60, 3)), y))
    assert np.flatnonzero(np.asarray(found.info.result)).tolist() == [40]
    np.testing.assert_allclose(found.estimate.q[-1], np.eye(3), atol=1e-6)


@pytest.mark.exhaustive("1.5-False")
@pytest.mark.parametrize(("speed", "astray"), [(1.5, False), (3.0, True)])
def test_a_velocity_that_is_off_by_more_than_twice_the_usual_one_is_said(speed, astray):
    """Of a mass that moves on steadily, by gains so low that its velocity is hardly believed."""
    dt = 0.01
    mass = Lagrangian(lambda q: jnp.eye(1))
    record = Record(dt * np.arange(100), np.zeros((100, 1)), speed * dt * np.arange(100)[:, None])
    observer = Gated(Intrinsic(mass, 0.02, 1e-4, substeps=1), mass, noise=1e-4, speed=1.0)
    found = np.asarray(run(observer, record).info.result)
    assert (found[-20:] == (StepCode.ASTRAY if astray else StepCode.OK)).all()
    assert (found[:5] == StepCode.OK).all()


@pytest.mark.exhaustive("0.3")
@pytest.mark.parametrize("size", [0.3, 5.0])
def test_a_burst_of_outliers_does_not_open_the_gate_for_its_last_ones(size):
    t = 0.01 * np.arange(400)
    y = np.cos(t) + NOISE * np.random.default_rng(0).normal(size=400)
    y[300:310] += size
    observer = Gated(ModelCopy(oscillator(), 20.0, 100.0, substeps=1), oscillator(), noise=NOISE, speed=1.0)
    followed = run(observer, Record(t, np.zeros((400, 1)), y[:, None]))
    assert (codes(followed)[300:310] == StepCode.OUTLIER).all()
    assert (codes(followed)[310:] == StepCode.OK).all()
    assert np.abs(np.asarray(followed.estimate)[300:, 1] + np.sin(t[300:])).max() < 0.05
