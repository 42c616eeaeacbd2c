"""Observers on groups: stated behaviour at the edges, and the Kalman filter against a textbook's: what takes long."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_group import BODY, OBSERVERS

from covariant.engine import Stream, run_log
from covariant.geometry import Budget
from covariant.geometry.lie import SO3, quaternion_from_rotation
from covariant.models import Motion, free_body, heavy_top, underwater_vehicle
from covariant.observers import EKF, Delayed, Geodesic, Intrinsic, run
from covariant.signals import Record, StepCode
from covariant.simulation import simulate

STEP = 0.02


@pytest.fixture(scope="module")
def log():
    """A free tumble, 8 s at 50 Hz."""
    t = STEP * jnp.arange(400.0)
    return eqx.filter_jit(simulate)(BODY, Motion(jnp.eye(3), jnp.array([0.1, 1.0, 0.2])), t)


def velocity_error(result, log):
    return np.linalg.norm(np.asarray(result.estimate.v - log.x.v), axis=1)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", OBSERVERS)
def test_a_missing_frame_is_coasted_as_a_whole(log, name):
    """Even one NaN of nine: what is left of a rotation matrix is not a rotation."""
    y = log.y.at[200:260, 1, 2].set(jnp.nan)
    result = run(OBSERVERS[name], Record(log.t, log.u, y))
    codes = np.asarray(result.info.result)
    assert (codes[200:260] == StepCode.COASTED).all()
    assert (np.delete(codes, np.s_[200:260]) == StepCode.OK).all()
    assert (np.asarray(result.info.innovation)[200:260] == 0).all()
    assert np.isfinite(velocity_error(result, log)).all()
    assert velocity_error(result, log)[-1] < 1e-3
    assert max(float(SO3.defect(g)) for g in result.estimate.q[::50]) < 1e-13


@pytest.mark.parametrize("name", OBSERVERS)
def test_a_start_half_a_turn_away_is_said_and_overcome(log, name):
    """Exactly antipodal: two ways are as short, one is taken, the result says so, and the observer converges."""
    turned = log.y.at[0].set(log.y[0] @ SO3.exp(jnp.array([0.0, 0.0, np.pi]))).at[1].set(log.y[0])
    result = run(OBSERVERS[name], Record(log.t, log.u, turned))
    assert result.info.result[1] == StepCode.CUT_LOCUS
    assert np.isfinite(np.asarray(result.estimate.q)).all()
    assert velocity_error(result, log)[-1] < 0.05


@pytest.mark.exhaustive
def test_where_no_geodesic_is_found_the_group_logarithm_stands_in(log):
    """A turn by almost π with a single Newton correction is beyond what the fixed budget finds."""
    observer = Geodesic(free_body((0.1, 2.0, 20.0)), 2.0, 3.0)
    state = observer.init(log.y[0] @ SO3.exp(jnp.array([1.9, 1.4, 1.6])))._replace(log=jnp.array([40.0, -50.0, 60.0]))
    new, info = eqx.filter_jit(observer.step)(state, jnp.zeros(3), log.y[0], jnp.asarray(STEP))
    assert info.result == StepCode.NOT_CONVERGED
    assert all(np.isfinite(np.asarray(part)).all() for part in new)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["group", "riemannian", "salcudean"])
def test_a_short_step_is_the_flow(name):
    """`step` tends to `flow` as dt does to 0, at first order in dt."""
    observer = OBSERVERS[name]
    y, u = SO3.exp(jnp.array([0.2, -0.1, 0.3])), jnp.array([0.3, -0.2, 0.1])
    state = observer.init(y @ SO3.exp(jnp.array([0.02, 0.03, -0.01])))
    state = state._replace(**{"momentum" if name == "salcudean" else "v": jnp.array([0.5, -0.4, 0.7])})

    @jax.jit
    def gap(dt):
        new, _ = observer.step(state, u, y, dt)
        slope = observer.flow(dt, state, u, y)
        return jnp.concatenate([SO3.between(state.q, new.q) / dt - slope.q, (new[1] - state[1]) / dt - slope[1]])

    gaps = [float(jnp.abs(gap(jnp.asarray(dt))).max()) for dt in (1e-3, 1e-4)]
    assert gaps[1] < 1e-2
    assert np.log10(gaps[0] / gaps[1]) == pytest.approx(1.0, abs=0.15)


@pytest.mark.exhaustive
def test_with_equal_moments_of_inertia_the_exact_flow_has_a_closed_form():
    """Geodesics are then those of the group, and a body that turns at w sees a parallel v turn by −½ w × v."""
    alpha, beta, off, v = 2.0, 3.0, np.array([0.2, -0.1, 0.3]), np.array([0.5, -0.4, 0.7])
    observer = Geodesic(free_body((1.0, 1.0, 1.0)), alpha, beta, Budget(newton=0, steps=1), curvature=False)
    state = observer.init(SO3.exp(jnp.asarray(off)))._replace(v=jnp.asarray(v))
    slope = eqx.filter_jit(observer.flow)(jnp.zeros(()), state, jnp.zeros(3), jnp.eye(3))
    np.testing.assert_allclose(slope.q, v - alpha * off, atol=1e-12)
    np.testing.assert_allclose(slope.v, -beta * off - np.cross(v - alpha * off, v) / 2, atol=1e-12)


def hat(x):
    return np.array([[0, -x[2], x[1]], [x[2], 0, -x[0]], [-x[1], x[0], 0]])


def product(p, q):
    return np.concatenate([[p[0] * q[0] - p[1:] @ q[1:]], p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])])


def textbook_mekf(log, process, measurement, velocity_std):
    """Multiplicative EKF on a quaternion and an angular velocity, in NumPy, with Euler's equations.

    Lefferts, Markley & Shuster 1982: the error is a small rotation in the body, reset into the quaternion.
    """
    inertia = np.diag([1.0, 2.0, 3.5])
    measured = np.asarray(jax.vmap(quaternion_from_rotation)(log.y))
    q, w = measured[0], np.zeros(3)
    cov = np.diag([measurement] * 3 + [velocity_std**2] * 3)
    estimates = [w]
    fine, h = 20, STEP / 20
    for z in measured[1:]:
        transition = np.eye(6)
        for _ in range(fine):
            spin = np.linalg.solve(inertia, np.cross(inertia @ w, w))
            slope = np.linalg.solve(inertia, hat(inertia @ w) - hat(w) @ inertia)
            step = np.eye(6) + h * np.block([[-hat(w), np.eye(3)], [np.zeros((3, 3)), slope]])
            middle = w + h / 2 * spin
            transition = step @ transition
            angle = np.linalg.norm(middle) * h
            turn = np.concatenate(
                [[np.cos(angle / 2)], np.sin(angle / 2) * middle / max(np.linalg.norm(middle), 1e-12)]
            )
            q = product(q, turn)
            w = w + h * np.linalg.solve(inertia, np.cross(inertia @ middle, middle))
        noise = process * np.block(
            [[np.eye(3) * STEP**3 / 3, np.eye(3) * STEP**2 / 2], [np.eye(3) * STEP**2 / 2, np.eye(3) * STEP]]
        )
        cov = transition @ cov @ transition.T + noise
        error = product(q * np.array([1, -1, -1, -1]), z)
        gain = cov[:, :3] @ np.linalg.inv(cov[:3, :3] + measurement * np.eye(3))
        correction = gain @ (2 * np.sign(error[0]) * error[1:])
        cov = (np.eye(6) - gain @ np.eye(3, 6)) @ cov
        q = product(q, np.concatenate([[1.0], correction[:3] / 2]))
        q, w = q / np.linalg.norm(q), w + correction[3:]
        estimates.append(w)
    return np.stack(estimates)


@pytest.mark.exhaustive
def test_invariant_ekf_on_rotations_is_the_multiplicative_ekf_of_the_textbook(log):
    noise = 0.01 * jax.random.normal(jax.random.key(0), (len(log.t), 3))
    noisy = log._replace(y=jax.vmap(lambda g, e: g @ SO3.exp(e))(log.y, noise))
    ours = np.asarray(run(OBSERVERS["invariant EKF"], Record(noisy.t, noisy.u, noisy.y)).estimate.v)
    textbook = textbook_mekf(noisy, 1e-3, 1e-4, 1.0)
    error = np.linalg.norm(ours - np.asarray(log.x.v), axis=1)[100:]
    assert np.abs(ours - textbook)[100:].max() < 0.05 * np.sqrt(np.mean(error**2))


MACHINES = {
    "pose and twist": (underwater_vehicle(), Motion(jnp.eye(4), 0.3 * jnp.ones(6)), [20.0, 0, 0, 0, -1, 0.5]),
    "friction of a top": (heavy_top(viscous=0.05), Motion(jnp.eye(3), jnp.array([0.2, 0.1, 3.0])), [0.0] * 3),
}


@pytest.mark.exhaustive
@pytest.mark.parametrize(("model", "start", "u"), MACHINES.values(), ids=MACHINES)
def test_the_velocity_of_a_machine_is_found(model, start, u):
    t = 0.02 * jnp.arange(300.0)
    log = eqx.filter_jit(simulate)(model, start, t, lambda s, x: jnp.array(u))
    result = run(Intrinsic(model, 4.0, 8.0, substeps=1), Record(t, log.u, log.y))
    error = velocity_error(result, log)
    assert error[-1] < 1e-3 * error[0]
    assert max(float(model.group.defect(g)) for g in result.estimate.q[::20]) < 1e-13


@pytest.mark.exhaustive
@pytest.mark.parametrize("engine", ["c", "jax"])
def test_a_log_or_a_stream_that_starts_with_no_rotation(log, engine):
    observer = OBSERVERS["group"]
    wrong = np.array(log.y[:5])
    wrong[0] *= 2
    with pytest.raises(ValueError, match="row 1: the measurement is no configuration"):
        run_log(observer, Record(log.t[:5], log.u[:5], wrong), engine=engine)
    stream = Stream(observer, wrong[0], 50.0, engine=engine)
    assert stream.engine.startswith(engine)
    found = [stream.step(float(t), y, u) for t, u, y in zip(log.t, log.u, wrong, strict=False)]
    assert np.isnan([*np.ravel(found[0].q), *found[0].v]).all()
    assert stream.health.results == {"not_finite": 1, "ok": 4}
    np.testing.assert_allclose(found[1].q, wrong[1], atol=1e-12)


@pytest.mark.exhaustive
@pytest.mark.parametrize("wrong", [2 * np.eye(3), np.diag([1.0, 1.0, -1.0]), np.eye(3) + 1e-4], ids=str)
@pytest.mark.parametrize("name", ["group", "late"])
def test_a_later_measurement_that_is_no_rotation(name, wrong, log):
    observer = OBSERVERS["group"] if name == "group" else Delayed(OBSERVERS["group"], 0.02, 50.0)
    t, u, y = (np.array(each[:12]) for each in log[:3])
    y[3] = np.nan
    y[5, 0, 1] = np.nan  # the whole is missing
    record = Record(t, u, y.copy())
    expected = run(observer, record)
    y[3] = wrong
    for engine in ("c", "jax"):
        assert run_log(observer, record, engine=engine)[0].info.result.tolist() == expected.info.result.tolist()
        with pytest.raises(ValueError, match="row 4: the measurement is no configuration"):
            run_log(observer, record._replace(y=y), engine=engine)
    # Fed sample by sample it is left out, as if it were missing, and said to be.
    stream = Stream(observer, y[0], 50.0)
    found = [stream.step(float(t), y, u) for t, u, y in zip(t, u, y, strict=True)]
    assert stream.health.results == {"ok": 10, "coasted": 2}
    np.testing.assert_allclose(found[-1].q, expected.estimate.q[-1], atol=1e-12)
    np.testing.assert_allclose(found[-1].v, expected.estimate.v[-1], atol=1e-12)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", OBSERVERS)
def test_observers_work_in_float32(log, name):
    light = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32) if eqx.is_array(a) else a, OBSERVERS[name])
    record = Record(*(a[:200] for a in (log.t, log.u, log.y)))
    result = run(light, Record(*(jnp.asarray(a, jnp.float32) for a in record[:3])))
    assert result.estimate.v.dtype == jnp.float32
    np.testing.assert_allclose(result.estimate.v, run(OBSERVERS[name], record).estimate.v, atol=2e-3)
