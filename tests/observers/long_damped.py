"""What takes long of `test_damped.py`."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from plants import body, sphere_pendulum
from test_damped import measurement, oblique, systems

from covariant import models, observers
from covariant.engine import Stream
from covariant.geometry.lie import SO3
from covariant.models import Motion, Parametric, chart_velocity, in_chart
from covariant.observers import Damped, Delayed, Gated, Instant, Intrinsic, Sensor, run
from covariant.signals import Record, StepCode

STEP = 0.01


def by_hand(observer, q, v, u):
    """Readings at a velocity and their derivative in it, which is exact by differences where they are linear."""

    @jax.jit
    def read(v):
        nothing = jnp.zeros(0)
        return jnp.concatenate([s.h(Instant(q, v, lambda: v, u, 0.0), nothing) for s in observer.sensors])

    rest = jnp.zeros_like(v)
    return read(v), np.stack([read(axis) - read(rest) for axis in jnp.eye(len(v))], 1)


@pytest.mark.exhaustive("SO(3)", "robot")
@pytest.mark.parametrize("name", ["chart", "SO(3)", "robot"])
def test_a_sample_never_expands_and_is_the_damper_where_it_is_short(systems, name):
    """In |δv|² + δb²/γ, for random Γ, γ, dt and missing readings; and to first order in dt by hand."""
    model, q, sensors = systems[name]
    observer = Damped(Intrinsic(model, 4.0, 8.0, substeps=1), sensors, 1.0)
    k, n, rng = observer._sensors.size, len(model.manifold.zero(q)), np.random.default_rng(0)
    state, u = observer.init(measurement(observer, q)), jnp.zeros(models.input_count(model, n))
    metric, nowhere = np.asarray(model.space(q)), jnp.full_like(q, jnp.nan)

    @jax.jit
    def corrected(damping, gain, dt, v, b, readings):
        one = dataclasses.replace(observer, damping=damping, bias_gain=gain)
        start = state._replace(inner=state.inner._replace(v=v), bias=b, waited=jnp.broadcast_to(dt, (k,)))
        new = one.correct(start, u, measurement(one, nowhere, readings))[0]
        return new.inner.v, new.bias

    def apart(a, b, gain):
        v, bias = (np.asarray(x) - np.asarray(y) for x, y in zip(a, b, strict=True))
        return v @ metric @ v + bias @ (bias / gain)

    ratios = []
    for _ in range(40):
        damping, gain, dt = 10 ** rng.uniform(-2, 3, k), 10 ** rng.uniform(-2, 2, k), 10 ** rng.uniform(-4, 2)
        readings = np.where(rng.uniform(size=k) < 0.3, np.nan, rng.normal(size=k))
        starts = [(rng.normal(size=n), rng.normal(size=k)) for _ in range(2)]
        ends = [corrected(damping, gain, dt, *start, readings) for start in starts]
        ratios.append(apart(*ends, gain) / apart(*starts, gain))
    assert max(ratios) <= 1 + 1e-9
    assert min(ratios) < 0.7  # it does something

    v, b, readings = (jnp.asarray(rng.normal(size=size)) for size in (n, k, k))
    damping, gain, dt = rng.uniform(1, 3, k), rng.uniform(1, 3, k), 1e-8
    new_v, new_b = corrected(damping, gain, dt, v, b, readings)
    expected, slope = by_hand(observer, q, v, u)
    force = damping * np.asarray(expected + b - readings)
    np.testing.assert_allclose((new_v - v) / dt, -np.linalg.solve(metric, slope.T @ force), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose((new_b - b) / dt, -gain * force, rtol=1e-4, atol=1e-4)


def warped(z, a):
    return z + a * jnp.stack([jnp.sin(z[1]), jnp.cos(2 * z[0])])


@pytest.mark.exhaustive
def test_in_other_coordinates_it_is_the_same():
    """To rounding; a gain that is no tensor, such as a diagonal matrix in each chart, would show here."""
    model, chart, sensor = sphere_pendulum(), Parametric(warped, a=np.array(0.2)), oblique()

    def there(z, v):
        return chart(z), chart_velocity(model.manifold, chart, z, v)

    seen = Sensor("oblique", lambda now, s: sensor.h(Instant(*there(now.q, now.v), *now[2:]), s), 1.0)
    z, rate, nowhere = jnp.array([0.8, 0.3]), jnp.array([0.7, -1.1]), jnp.full(2, jnp.nan)
    sides = ((in_chart(model, chart), seen, (z, rate)), (model, sensor, there(z, rate)))

    def corrected(model, sensor, q, v):
        observer = Damped(Intrinsic(model, 4.0, 8.0), sensor, 3.0, 0.5)
        state = observer.init(measurement(observer, q))
        state = state._replace(inner=state.inner._replace(v=v), waited=state.waited + 0.1)
        new, info = observer.correct(state, jnp.zeros(2), measurement(observer, nowhere, jnp.ones(1)))
        return new.inner, new.bias, info.sensor_innovation

    (one, *here), (two, *beyond) = jax.jit(lambda: [corrected(*side, *motion) for *side, motion in sides])()
    np.testing.assert_allclose(there(one.q, one.v)[1], two.v, rtol=0, atol=1e-12)
    np.testing.assert_allclose(here, beyond, rtol=0, atol=1e-12)
    assert np.abs(two.v - sides[1][2][1]).max() > 0.1


@pytest.mark.exhaustive
@pytest.mark.parametrize("gated", [False, True])
def test_without_a_reading_it_is_the_inner_observer(gated):
    """To the last bit; readings between two measured configurations are no gap."""
    model, rng = sphere_pendulum(), np.random.default_rng(3)
    inner = Intrinsic(model, 4.0, 8.0, substeps=1)
    inner = Gated(inner, model, noise=1e-3, speed=1.0) if gated else inner
    y = np.array([0.9, 0.4]) + 0.002 * rng.normal(size=(60, 2))
    y[10:14], y[45:48], y[30, 1] = np.nan, np.nan, 3.0
    read = np.where(np.arange(60) < 40, np.nan, 0.5)
    t, u = STEP * np.arange(60), 0.1 * rng.normal(size=(60, 2))
    plain = run(inner, Record(t, u, y))
    damped = run(Damped(inner, oblique(), 3.0, 0.5), Record(t, u, np.column_stack([y, read])))
    np.testing.assert_array_equal(damped.estimate[:40], plain.estimate[:40])
    np.testing.assert_array_equal(damped.info.result[:40], plain.info.result[:40])
    assert (StepCode.OUTLIER in plain.info.result) == gated
    assert np.abs(damped.estimate - plain.estimate)[40:].max() > 1e-3
    assert (np.asarray(damped.info.result)[45:48] == StepCode.OK).all()


def shaken_body(rows=1500):
    """A body turned by unknown torques: its velocity, noisy attitudes, and the readings of a gyro with an offset."""
    rigid, rng = body(), np.random.default_rng(5)

    def advance(motion, k):
        torque = 0.5 * jnp.sin(STEP * k * jnp.array([3.0, 4.0, 2.0]))
        return models.advance(rigid, 0.0, motion, torque, STEP, 1), motion

    true = jax.lax.scan(advance, Motion(jnp.eye(3), jnp.array([0.5, -0.8, 0.3])), jnp.arange(float(rows)))[1]
    q = jax.vmap(lambda q, e: q @ SO3.exp(e))(true.q, jnp.asarray(0.02 * rng.normal(size=(rows, 3))))
    read = np.asarray(true.v) + [0.2, -0.1, 0.15] + 0.01 * rng.normal(size=(rows, 3))
    return rigid, np.asarray(true.v), np.asarray(q), read


@pytest.mark.exhaustive
def test_a_gyro_lowers_the_error_to_a_third_and_its_offset_is_found():
    """At a quarter of the rate each reading counts four times as long, so that much the same is found."""
    rigid, v, q, read = shaken_body()
    t, u = STEP * np.arange(len(v)), np.zeros((len(v), 3))
    inner = Intrinsic(rigid, 4.0, 8.0, substeps=1)
    damped = Damped(inner, observers.tachometer([0, 1, 2], 0.01, name="gyro"), 10.0, 0.2)
    rare = np.where(np.arange(len(v))[:, None] % 4 > 0, np.nan, read)
    plain = run(inner, Record(t, u, q))
    better, rarely = (run(damped, Record(t, u, measurement(damped, q, w))) for w in (read, rare))
    with_none, with_all, with_few = (
        np.sqrt(np.mean((np.asarray(r.estimate.v) - v)[900:] ** 2)) for r in (plain, better, rarely)
    )
    assert with_all < with_few < 0.36 * with_none
    for each in (better, rarely):
        np.testing.assert_allclose(each.info.bias[900:].mean(0), [0.2, -0.1, 0.15], atol=0.01)


def two_sensors():
    """An observer with two sensors, one of which has an offset, and a log with gaps of each entry."""
    rng = np.random.default_rng(6)
    sensors = oblique(), observers.tachometer([1], 0.1)
    y = np.array([0.9, 0.4, 0.0, 0.0]) + 0.1 * rng.normal(size=(40, 4))
    y[rng.uniform(size=y.shape) < 0.3] = np.nan
    y[0] = 0.5
    return Damped(Intrinsic(sphere_pendulum(), 4.0, 8.0, substeps=1), sensors, 3.0, [0.5, 0.0]), y


@pytest.mark.exhaustive
def test_compiled_c_computes_the_same():
    (observer, y), t = two_sensors(), STEP * np.arange(40)
    whole = run(observer, Record(t, np.zeros((40, 2)), y))
    stream = Stream(observer, y[0], 1 / STEP, engine="c")
    assert stream.engine == "c" or stream.engine.startswith("jax")
    rows = [stream.step(*row, np.zeros(2)) for row in zip(t, y, strict=True)]
    np.testing.assert_allclose(rows, whole.estimate, rtol=0, atol=1e-12)


@pytest.mark.exhaustive
def test_late_readings_count_when_they_were_true():
    observer, y = two_sensors()
    late = np.vstack([y[:1], np.full((1, 4), np.nan), y[:-2]])
    delayed = run(Delayed(observer, 2 * STEP, rate=1 / STEP), Record(STEP * np.arange(40), np.zeros((40, 2)), late))
    in_time = np.vstack([late, np.full((2, 4), np.nan)])
    known = run(observer, Record(STEP * np.arange(-2, 40), np.zeros((42, 2)), in_time))
    np.testing.assert_allclose(delayed.estimate[-1], known.estimate[-1], rtol=0, atol=1e-12)
