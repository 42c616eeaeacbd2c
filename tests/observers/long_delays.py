"""What takes long of `test_delays.py`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_delays import CHAIN, FILTER, IN_C

from covariant.engine import run_log
from covariant.models import MechanicalSystem, Motion, free_body, oscillator, pendulum_chain
from covariant.observers import (
    EKF,
    Delayed,
    FilteredDerivative,
    Intrinsic,
    IntrinsicKalman,
    external_force,
    run,
    tachometer,
)
from covariant.signals import Record, StepCode
from covariant.simulation import hold, simulate
from covariant.verbs import export

WAITING = 12
"""Length of all buffers, so that one program serves all delays."""


def delayed(observer, delay, lateness=0.0):
    return Delayed(observer, delay, (WAITING - 1) / (np.max(delay) + lateness), lateness)


def swing(delays, seed=0, rows=60) -> Record:
    """A double pendulum under inputs held between irregular stamps, each joint read late; its state at the stamps."""
    random = np.random.default_rng(seed)
    t = 1.0 + np.cumsum(random.uniform(0.002, 0.008, rows))
    u = random.normal(0, 0.4, (rows, 2))
    times = np.unique([t - d for d in (0.0, 0.003, 0.005, 0.008, 0.1)])  # one program for all delays
    x = np.asarray(
        simulate(CHAIN, jnp.array([0.5, -0.4, 1.0, 2.0]), jnp.asarray(times), hold(jnp.asarray(t), jnp.asarray(u))).x
    )
    y = np.stack([x[np.searchsorted(times, t - d), i] for i, d in enumerate(delays)], axis=1)
    y += random.normal(0, 1e-4, y.shape)
    y[rows // 3, 1] = np.nan
    return Record(t, u, y, x[np.searchsorted(times, t)])


@pytest.fixture(scope="module")
def step():
    """One compiled step, for observers and filters alike."""
    return eqx.filter_jit(lambda observer, state, u, y, dt: observer.step(state, u, y, dt))


@pytest.fixture(scope="module")
def late():
    return eqx.filter_jit(lambda observer, state, y, t: observer.late(state, y, t))


def along(step, observer, record, held_back=()):
    """The states after every row; the rows `held_back` arrive empty."""
    state = observer.init(jnp.asarray(record.y[0]), record.t[0])
    states, infos = [state], []
    for k in range(1, len(record.t)):
        y = np.where(k in held_back, np.nan, record.y[k])
        state, info = step(observer, state, record.u[k - 1], y, record.t[k] - record.t[k - 1])
        states.append(state)
        infos.append(info)
    return states, infos


def oracle(step, record, delays, k):
    """The filter's state at the stamp k, from all readings up to it, sorted by hand; the mean input acts between."""
    t, y = record.t, record.y
    taken = np.concatenate([[0.0], np.cumsum(np.diff(t))])[:, None]
    whole = np.concatenate([np.zeros((1, 2)), np.cumsum(record.u[:-1] * np.diff(taken, axis=0), axis=0)])

    def gathered(s):
        return [np.interp(s, t, column) for column in whole.T] + record.u[0] * min(s - t[0], 0.0)

    # The first state is made of the readings around the time of which all joints have readings of both sides.
    first = next(j for j in range(len(t)) if t[j] - t[0] >= max(delays) - min(delays) - 1e-6)
    if k < first:
        return FILTER.init(jnp.asarray(y[k]), t[k])
    now = t[first] - max(delays)
    start = [np.interp(now, t[: first + 1] - d, y[: first + 1, i]) for i, d in enumerate(delays)]
    state = FILTER.init(jnp.asarray(start), now)
    events = sorted((t[j] - d, i, y[j, i]) for j in range(k + 1) for i, d in enumerate(delays))
    for at, i, value in (event for event in events if event[0] > now + 1e-6):
        reading = np.full(2, np.nan)
        reading[i] = value
        state, _ = step(FILTER, state, (gathered(at) - gathered(now)) / (at - now), reading, at - now)
        now = at
    for j in range(1, k + 1):
        if t[j] > now:
            state, _ = step(FILTER, state, record.u[j - 1], np.full(2, np.nan), t[j] - now)
            now = t[j]
    return state


@pytest.mark.exhaustive
@pytest.mark.parametrize("delays", [(0.0, 0.005), (0.003, 0.008)])
def test_every_reading_counts_at_the_time_at_which_it_was_true(step, delays):
    record = swing(delays)
    states, infos = along(step, delayed(FILTER, delays), record)
    for k in (1, 2, 30, 59):
        truth, found = oracle(step, record, delays, k), states[k].now
        np.testing.assert_allclose(found.q, truth.q, rtol=0, atol=1e-9)
        np.testing.assert_allclose(found.v, truth.v, rtol=0, atol=1e-9)
        np.testing.assert_allclose(found.root @ found.root.T, truth.root @ truth.root.T, rtol=0, atol=1e-9)
        np.testing.assert_allclose(found.t, record.t[k], rtol=1e-12)
    error = np.abs([state.now.v - x[2:] for state, x in zip(states, record.x, strict=True)])[20:].max()
    untold = np.abs([state.v - x[2:] for state, x in zip(along(step, FILTER, record)[0], record.x, strict=True)])[20:]
    assert error < 0.08 < 0.2 < untold.max()
    codes = [int(info.result) for info in infos]
    assert [k + 1 for k, code in enumerate(codes) if code == StepCode.COASTED] == [20]
    # While the velocity is being found, a late joint may be refused once.
    assert [code for code in codes if code not in (StepCode.OK, StepCode.COASTED)] in ([], [StepCode.OUTLIER])
    np.testing.assert_allclose(infos[40].velocity_std, FILTER.velocity_std(states[41].now), rtol=1e-12)
    assert np.abs([info.innovation for info in infos[20:]]).max() < 2e-3


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("name", "rows"), [(name, rows) for name in IN_C for rows in (0.0, 0.4, 1.0, 2.5, (0.0, 2.5), (0.4, 1.0))]
)
def test_compiled_c_equals_jax(name, rows):
    """At irregular stamps, with measurements missing."""
    record = swing((0.0, 0.005), rows=200)
    record.y[50:53] = np.nan
    observer = Delayed(IN_C[name], np.multiply(0.005, rows).tolist(), 500.0)
    by_jax, (by_c, engine) = run(observer, record), run_log(observer, record, engine="c")
    assert engine == "c"
    np.testing.assert_allclose(by_c.estimate, by_jax.estimate, rtol=0, atol=1e-11)
    np.testing.assert_array_equal(by_c.info.result, by_jax.info.result)
    np.testing.assert_allclose(by_c.info.innovation, by_jax.info.innovation, rtol=0, atol=1e-13)
    # Where the delays are not those of the log, the gate may refuse readings.
    assert {int(code) for code in by_c.info.result} >= {StepCode.OK, StepCode.COASTED}


@pytest.mark.exhaustive
def test_a_sample_that_comes_after_later_ones_counts_as_in_order(step, late):
    delays = (0.0, 0.005)
    kalman = EKF(CHAIN, 0.1 * jnp.eye(2), 1e-8 * jnp.eye(2), substeps=1)
    record, observer = swing(delays), delayed(kalman, delays, 0.02)
    straight = along(step, observer, record)[0][-1]
    gaps, _ = along(step, observer, record, held_back=(57, 58))
    state, info = late(observer, gaps[-1], record.y[58], record.t[58])
    state, info = late(observer, state, record.y[57], record.t[57])
    assert info.result == StepCode.OK
    for found, true in ((state.now.q, straight.now.q), (state.now.v, straight.now.v)):
        np.testing.assert_allclose(found, true, rtol=0, atol=1e-9)
    assert np.abs(gaps[-1].now.v - straight.now.v).max() > 1e-6
    after, info = late(observer, state, record.y[40], record.t[40])
    assert info.result == StepCode.TOO_LATE
    np.testing.assert_array_equal(after.now.v, state.now.v)
    assert late(observer, state, record.y[40], record.t[59] + 1.0)[1].result == StepCode.STEP_REFUSED


@pytest.mark.exhaustive
def test_too_short_a_buffer_says_what_it_leaves_out(step):
    delays = (0.0, 0.1)
    observer = delayed(FILTER, delays)  # twelve samples, and in a tenth of a second come twenty
    results = [int(info.result) for info in along(step, observer, swing(delays))[1]]
    assert results.count(StepCode.TOO_LATE) > 30


@pytest.mark.exhaustive
def test_without_delay_it_is_the_observer_itself(pendulum, regular):
    observer = EKF(pendulum.model, 0.1 * jnp.eye(1), 1e-6 * jnp.eye(1))
    y = np.sin(regular)[:, None]
    y[100:104] = np.nan
    record = Record(regular, np.cos(5 * regular)[:, None], y)
    plain, wrapped = run(observer, record), run(Delayed(observer, 0.0, 250.0), record)
    np.testing.assert_array_equal(wrapped.estimate, plain.estimate)
    np.testing.assert_array_equal(wrapped.info.result, plain.info.result)
    np.testing.assert_array_equal(wrapped.info.innovation, plain.info.innovation)


@pytest.mark.parametrize("delay", [0.0, 0.02])
def test_an_angle_of_too_many_turns_is_missing_to_the_observer_inside_too(delay):
    late, huge = Delayed(FilteredDerivative(50.0, circles=(0,)), delay, 100.0), jnp.array([1e12])
    _, info = late.step(late.init(jnp.zeros(1)), jnp.zeros(0), huge, 0.01)
    assert info.result == StepCode.COASTED


@pytest.mark.exhaustive
def test_batches_and_full_turns():
    """Logs run side by side, one with its angles as they are and one with angles that jump by a turn."""
    t = 0.005 * np.arange(200)
    angle = 3.0 + 12.0 * t
    y = np.stack([angle, np.sin(3 * t)], axis=1)
    logs = jnp.asarray([y, np.where([True, False], (y + np.pi) % (2 * np.pi) - np.pi, y)])
    observer = Delayed(Intrinsic(CHAIN, 60.0, 1800.0, substeps=1), (0.012, 0.002), 200.0)

    def last(y):
        def step(state, y):
            state, info = observer.step(state, jnp.zeros(2), y, jnp.asarray(0.005))
            return state, (state.now.v, info.innovation)

        return jax.lax.scan(step, observer.init(y[0]), y[1:])[1]

    v, innovation = eqx.filter_jit(eqx.filter_vmap(last))(logs)
    np.testing.assert_allclose(v[0], v[1], rtol=0, atol=1e-9)
    np.testing.assert_allclose(innovation[0], innovation[1], rtol=0, atol=1e-9)
    alone = eqx.filter_jit(last)(logs[0])
    np.testing.assert_allclose(v[0], alone[0], rtol=0, atol=1e-12)


@pytest.mark.exhaustive
def test_an_attitude_is_late_as_a_whole(step):
    """The observer runs behind by the delay; the model predicts from there to the stamp."""
    model: MechanicalSystem = free_body((1.0, 2.0, 3.5))
    t = 0.01 * np.arange(120)
    x = simulate(model, Motion(jnp.eye(3), jnp.array([0.5, 2.0, -1.0])), jnp.asarray(t)).x
    behind = 3
    y = np.asarray(x.q)[np.maximum(np.arange(len(t)) - behind, 0)]
    observer = Intrinsic(model, 30.0, 450.0, substeps=2)
    none = np.zeros((len(t), 3))
    found = run(Delayed(observer, behind * 0.01, 100.0), Record(t, none, y)).estimate
    late = run(observer, Record(t - behind * 0.01, none, y))
    state = observer.init(late.estimate.q[-1], late.t[-1])._replace(v=late.estimate.v[-1])
    for _ in range(behind):
        state, _ = step(observer, state, none[0], np.full((3, 3), np.nan), jnp.asarray(0.01))
    np.testing.assert_allclose(found.v[-1], state.v, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.q[-1], state.q, rtol=0, atol=1e-9)
    assert np.abs(found.v[60:] - x.v[60:]).max() < 0.01 < 0.05 < np.abs(late.estimate.v[60:] - x.v[60:]).max()
    with pytest.raises(ValueError, match=r"3 delays do not fit a measurement of shape \(3, 3\)"):
        Delayed(observer, (0.0, 0.01, 0.0), 100.0).init(jnp.eye(3))


@pytest.mark.exhaustive
@pytest.mark.parametrize("delay", ["0.005", "[0.0, 0.005]"])
def test_the_members_of_an_exported_state_have_names_of_their_own(tmp_path, delay):
    late = (f"measurement.delay={delay}",)
    made = export("pendulum_chain", tmp_path / "c", rate=500.0, alpha=30.0, beta=450.0, overrides=late)
    names = [leaf.name for leaf in made.program.state if leaf.size]
    assert len(set(names)) == len(names)
    assert "age_of_known" in names


@pytest.mark.exhaustive
def test_what_is_estimated_along_is_that_of_the_stamp_and_not_of_the_reading():
    """The force, its deviation and the velocity in one row are those of one time."""
    inner = IntrinsicKalman(oscillator(), 0.01, 1e-8, 1.0, slow=(external_force(std=2.0, time=0.3),), substeps=1)
    t = 0.01 * np.arange(120)
    record = Record(t, np.zeros((120, 1)), np.sin(3 * np.maximum(t - 0.05, 0))[:, None])
    observer = Delayed(inner, 0.05, 100.0)
    state = observer.init(jnp.asarray(record.y[0]), 0.0)
    step = eqx.filter_jit(lambda state, y: observer.step(state, jnp.zeros(1), y, 0.01))
    for y in record.y[1:]:
        state, info = step(state, jnp.asarray(y))
    told = inner.deviations(state.now)
    for name, value in told.items():
        np.testing.assert_allclose(getattr(info, name), value, rtol=1e-12)
    assert info.slow_std[0] > 1.02 * inner.deviations(state.known)["slow_std"][0]


@pytest.mark.exhaustive
@pytest.mark.parametrize("delays", [(0.02, 0.05), (0.0, 0.05), (0.05, 0.0)])
def test_a_first_state_is_made_of_readings_of_one_time(delays):
    """At full speed, joints that are late by different times are nowhere together in one sample."""
    t = 1.0 + 0.005 * np.arange(80)
    times = np.unique(np.concatenate([t - d for d in delays] + [t]))
    u = hold(jnp.asarray(times), jnp.zeros((len(times), 2)))
    x = np.asarray(simulate(CHAIN, jnp.array([0.5, -0.4, 2.0, -3.0]), jnp.asarray(times), u).x)
    y = np.stack([x[np.searchsorted(times, t - d), i] for i, d in enumerate(delays)], axis=1)
    y += np.random.default_rng(0).normal(0, 1e-4, y.shape)
    record, truth = Record(t, np.zeros((80, 2)), y), x[np.searchsorted(times, t)]
    run_ = run(Delayed(FILTER, delays, 200.0), record)
    error = np.abs(np.asarray(run_.estimate)[:, 2:] - truth[:, 2:]) / np.asarray(run_.info.velocity_std)
    assert error.max() < 4.5
    assert not np.asarray(run_.info.result).any()
    assert np.abs(np.asarray(run_.estimate)[20:, 2:] - truth[20:, 2:]).max() < 0.1
