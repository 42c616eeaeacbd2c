"""What takes long of `test_sensor_readings.py`."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from plants import FIRST_COV, MEASUREMENT, body, kalman, least_squares, masses, masses_steps, sphere_pendulum
from scipy.linalg import block_diag
from test_sensor_readings import GRAVITY, NOISES, arms, on_the_tip

from covariant import models, observers
from covariant.engine import Stream
from covariant.models import Lagrangian, acceleration
from covariant.observers import Delayed, FixedLag, Instant, IntrinsicKalman, Sensor, run, smooth
from covariant.signals import Record, StepCode


@pytest.mark.exhaustive
def test_readings_are_those_of_mujoco(arms):
    model, theirs, axes = arms["fixed"]
    data, rng = mujoco.MjData(theirs), np.random.default_rng(0)
    sensors = on_the_tip(model, axes)
    for _ in range(3):
        data.qpos[:], data.qvel[:] = rng.uniform(-2, 2, (2, 2))
        mujoco.mj_forward(theirs, data)
        read = data.sensordata
        q, v, nothing = jnp.asarray(data.qpos), jnp.asarray(data.qvel), jnp.zeros(0)
        now = Instant(q, v, lambda q=q, v=v: acceleration(model, jnp.zeros(()), q, v, jnp.zeros(2)), jnp.zeros(2), 0.0)
        attitude = np.zeros(9)
        mujoco.mju_quat2Mat(attitude, read[9:13])
        expected = (read[:3], read[3:6], read[6:9], np.concatenate([read[6:9], attitude]))
        for sensor, value in zip(sensors, expected, strict=True):
            np.testing.assert_allclose(sensor.h(now, nothing), value, atol=1e-9, err_msg=sensor.name)


@pytest.mark.exhaustive
def test_on_a_floating_base_they_follow_the_motion(arms):
    """By differences of poses along the motion that the model makes."""
    model, _, axes = arms["floating"]
    gyro, felt, point, pose = on_the_tip(model, axes)
    rng = np.random.default_rng(1)
    q = model.manifold.retract(model.manifold.origin(), jnp.asarray(rng.normal(size=7)))
    start, u, h = models.Motion(q, jnp.asarray(rng.normal(size=7))), jnp.zeros(model.inputs), 1e-3

    def now(motion):
        rate = lambda: acceleration(model, jnp.zeros(()), *motion, u)  # noqa: E731
        return Instant(*motion, rate, u, 0.0)

    def poses(dt):
        return pose.h(now(models.advance(model, 0.0, start, u, dt, 1)), jnp.zeros(0))

    before, here, after = (np.asarray(poses(dt)) for dt in (-h, 0.0, h))
    rotation = here[3:].reshape(3, 3)
    rate = rotation.T @ (after - before)[3:].reshape(3, 3) / (2 * h)
    spin = [rate[2, 1], rate[0, 2], rate[1, 0]]
    np.testing.assert_allclose(gyro.h(now(start), jnp.zeros(0)), spin, atol=1e-4)
    felt_by_hand = rotation.T @ ((after - 2 * here + before)[:3] / h**2 - np.array(GRAVITY))
    np.testing.assert_allclose(felt.h(now(start), jnp.zeros(0)), felt_by_hand, atol=1e-3)
    np.testing.assert_allclose(point.h(now(start), jnp.zeros(0)), here[:3], atol=1e-12)


def spaces(arms):
    north = Sensor("north", lambda now, s: now.q[0] + s, 1e-4 * jnp.ones(3), bias(3))
    return {
        "chart": (sphere_pendulum(), (observers.encoder([1], 0.1, reduction=3.0), observers.tachometer([0, 1], 0.1))),
        "SO(3)": (body(), (north, observers.tachometer([2, 0], 0.1, name="gyro", bias_std=0.2))),
        "fixed": (arms["fixed"][0], on_the_tip(arms["fixed"][0], arms["fixed"][2])),
        "floating": (arms["floating"][0], on_the_tip(arms["floating"][0], arms["floating"][2])),
    }


def bias(k):
    names = tuple(f"b{i}" for i in range(k))
    return observers.SlowVariables(names, jnp.zeros(k), jnp.eye(k), jnp.zeros((k, k)))


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["chart", "SO(3)", "fixed", "floating"])
def test_slopes_are_those_along_corrections(arms, name):
    """Finite differences of the readings where `moved` takes the estimate, in the parallel frame."""
    model, sensors = spaces(arms)[name]
    rng = np.random.default_rng(2)
    n = len(model.manifold.zero(model.manifold.origin())) if name != "chart" else 2
    q = (
        jnp.array([0.9, 0.4])
        if name == "chart"
        else model.manifold.retract(model.manifold.origin(), jnp.asarray(rng.normal(size=n)))
    )
    kalman = IntrinsicKalman(model, 1e-2, 1e-4, 1.0, sensors=sensors, substeps=1)
    y = kalman._sensors.joined(q, jnp.full(kalman._sensors.size, jnp.nan))
    state = kalman.init(y)
    state = state._replace(v=jnp.asarray(rng.normal(size=n)), slow=jnp.asarray(rng.normal(size=state.slow.shape)))
    u = jnp.asarray(rng.normal(size=models.input_count(model, n)))

    def outputs(state):
        now = Instant(state.q, state.v, lambda: acceleration(model, jnp.zeros(()), state.q, state.v, u), u, 0.0)
        ends = np.cumsum([0, *(0 if s.slow is None else len(s.slow.names) for s in sensors)])
        own = [state.slow[a:b] for a, b in itertools.pairwise(ends)]
        return [sensor.h(now, part) for sensor, part in zip(sensors, own, strict=True)]

    expected, h = outputs(state), 1e-6
    slope = np.asarray(jax.jit(kalman._sensed)(state, u, y[-kalman._sensors.size :]).slope)

    @jax.jit
    @jax.vmap
    def moved(error):
        ends = outputs(kalman.moved(state, error).state)
        return jnp.concatenate([s.innovation(was, end) for s, was, end in zip(sensors, expected, ends, strict=True)])

    steps = h * jnp.eye(slope.shape[1])
    differences = (moved(steps) - moved(-steps)).T / (2 * h)
    np.testing.assert_allclose(slope, differences, atol=2e-6 * np.abs(slope).max())


ROWS, STEP = 80, 0.01


BIAS, DRIFT, READ = 0.3, 0.1, 0.02


def fused(**named):
    speed = observers.tachometer([1], READ, reduction=2.0, bias_std=BIAS, bias_drift=DRIFT, name="drum")
    return IntrinsicKalman(masses(), *NOISES, sensors=speed, substeps=1, **named)


def mixed_log(seed=0):
    """Positions in every fourth row, one of them missing now and then, and the speed of the second in two of three."""
    rng = np.random.default_rng(seed)
    y = 0.05 * np.cumsum(rng.normal(size=(ROWS, 2)), 0)
    y[np.arange(ROWS) % 4 > 0] = np.nan
    y[16::16, 0] = np.nan
    drum = 0.1 * rng.normal(size=ROWS)
    drum[::3] = np.nan
    return Record(STEP * np.arange(ROWS), np.zeros((ROWS, 2)), np.column_stack([y, drum]))


@pytest.mark.exhaustive
def test_of_a_linear_system_it_is_the_textbook_filter_and_smoother():
    log, filter_ = mixed_log(), fused(gate=None)
    steps = [
        (block_diag(transition, 1.0), np.zeros(5), block_diag(added, DRIFT**2 * STEP))
        for transition, _, added in masses_steps(log.t, log.u)
    ]
    outputs = np.array([[1.0, 0, 0, 0, 0], [0, 1, 0, 0, 0], [0, 0, 0, 2, 1]])
    system = steps, log.y, outputs, block_diag(MEASUREMENT, READ**2)
    start = np.append(log.y[0, :2], np.zeros(3)), block_diag(FIRST_COV, BIAS**2)
    done, (means, covs) = run(filter_, log), kalman(*start, *system)
    found = np.concatenate([done.estimate, done.info.slow], axis=1)
    np.testing.assert_allclose(found, means, rtol=0, atol=1e-9)
    np.testing.assert_allclose(done.info.slow_std[:, 0], np.sqrt(covs[:, 4, 4]), rtol=1e-8)
    after = smooth(filter_, log).run
    smoothed = np.concatenate([after.estimate, after.info.slow], axis=1)
    np.testing.assert_allclose(smoothed, least_squares(*start, *system)[0], rtol=0, atol=1e-9)
    assert done.info.sensors.used[:, 0].tolist() == (np.isfinite(log.y[:, 2]) & (np.arange(ROWS) > 0)).tolist()


@pytest.mark.exhaustive
def test_a_row_is_missing_only_where_nothing_is_read():
    log = mixed_log()
    log = log._replace(y=1e-3 * log.y)  # nothing of which is refused
    codes = np.asarray(run(fused(), log).info.result)
    y, read = log.y[:, :2], np.isfinite(log.y[:, 2])
    empty = np.isnan(y).all(1)
    partly = np.isnan(y).any(1) & ~empty
    assert (codes == StepCode.COASTED).tolist() == ((empty & ~read) | partly).tolist()


@pytest.mark.exhaustive
def test_outliers_of_a_sensor_are_refused_and_what_lasts_is_used():
    log = mixed_log()
    y = log.y.copy()
    y[:, 2] = 0.0
    y[40, 2] = 100.0
    once = run(fused(), log._replace(y=y))
    assert once.info.result[40] == StepCode.OUTLIER
    assert not once.info.sensors.used[40, 0]
    y[41:, 2] = 100.0
    lasting = run(fused(), log._replace(y=y)).info.sensors.used[40:, 0]
    assert not lasting[:10].any()
    assert lasting[10]


@pytest.mark.exhaustive
def test_compiled_c_and_a_stream_compute_the_same():
    log, kalman = mixed_log(), fused()
    whole = run(kalman, log)
    for engine in ("c", "jax"):
        stream = Stream(kalman, log.y[0], 1 / STEP, engine=engine)
        assert stream.engine == engine or stream.engine.startswith("jax")
        rows = [stream.step(t, y, np.zeros(2)) for t, y in zip(log.t, log.y, strict=True)]
        np.testing.assert_allclose(rows, whole.estimate, rtol=0, atol=1e-12)


@pytest.mark.exhaustive
def test_sensors_of_other_rates_and_late_ones_give_what_all_give_in_order():
    """Positions at 25 Hz, a gyro at 100 Hz, positions by a camera that come 40 ms late: in any order the same."""
    camera = Sensor("camera", lambda now, s: now.q[:1] - now.q[1:], 1e-4, gate=None)
    rate = dataclasses.replace(observers.tachometer([0], READ), gate=None)
    filter_ = IntrinsicKalman(masses(), *NOISES, sensors=(rate, camera), substeps=1, gate=None)
    rng = np.random.default_rng(4)
    t = STEP * np.arange(60)
    true = rng.normal(size=(60, 4))
    true[np.arange(60) % 4 > 0, :2] = np.nan
    true[np.arange(60) % 5 > 0, 3] = np.nan
    late = true.copy()
    late[:, 3] = np.concatenate([np.full(4, np.nan), true[:-4, 3]])  # stamped four samples after it was true
    delayed = Delayed(filter_, [0.0, 0.0, 0.0, 4 * STEP], rate=1 / STEP, lateness=3 * STEP)
    state = delayed.init(jnp.asarray(late[0]))
    step, arrive = jax.jit(delayed.step), jax.jit(delayed.late)
    held: list[int] = []
    for k in range(1, 60):
        # Every seventh sample is held back for two steps, and so arrives after later ones.
        reading = jnp.asarray(late[k])
        if k % 7 == 0 and k < 57:
            held.append(k)
            reading = jnp.full(4, jnp.nan)
        state, _ = step(state, jnp.zeros(2), reading, STEP)
        if held and k - held[0] == 2:
            state, info = arrive(state, jnp.asarray(late[held[0]]), t[held.pop(0)])
            assert info.result < StepCode.OUTLIER
    in_order = run(delayed, Record(t, np.zeros((60, 2)), late))
    np.testing.assert_allclose(delayed.estimate(state), in_order.estimate[-1], rtol=0, atol=1e-12)
    used = np.asarray(in_order.info.sensors.used)
    assert used[1:, 0].all()
    assert used[:, 1].tolist() == (np.isfinite(late[:, 3])).tolist()


@pytest.mark.exhaustive
def test_a_sensor_that_is_late_leaves_the_start_where_the_positions_are():
    """In motion: the first positions are of the first stamp, however late the sensor is, and nothing is too late."""
    model = Lagrangian(lambda q: jnp.eye(1), lambda q: 0.0 * q[0])
    late = Sensor("late", lambda now, s: now.q, 1e-8)
    noises = 1e-6, 1e-8, 100.0
    kalman = IntrinsicKalman(model, *noises, sensors=late, substeps=1)
    t = STEP * np.arange(20)
    y = np.stack([5.0 * t, 5.0 * (t - 0.05)], axis=1)
    done = run(Delayed(kalman, [0.0, 0.05], rate=1 / STEP), Record(t, np.zeros((20, 1)), y))
    assert (np.asarray(done.info.result) == StepCode.OK).all()
    np.testing.assert_allclose(done.estimate[1:, 1], 5.0, rtol=0.01)
    # Until it reads what was true after the start it corrects nothing.
    assert done.info.sensors.used[:, 0].tolist() == [False] * 5 + [True] * 15


@pytest.mark.exhaustive
def test_with_a_lag_sensors_smooth_as_in_the_batch():
    log, kalman = mixed_log(), fused()
    stream = run(FixedLag(kalman, lag=6), log)
    batch = smooth(kalman, log, lag=6).run
    np.testing.assert_allclose(stream.estimate[6:], batch.estimate[:-6], rtol=0, atol=1e-11)
    np.testing.assert_allclose(stream.info.slow_std[6:], batch.info.slow_std[:-6], rtol=1e-9)
