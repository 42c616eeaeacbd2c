"""Faulty measurements on two recorded logs: what they cost, and that no estimate is wrong without a word.

The logs belong to others and are not in this repository; the folder that holds them is named by `COVARIANT_DATA`.
"""

from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import logs, models, scoring
from covariant.calibration import DataSheet, gated, observer_gains, tuned_estimators, with_gains
from covariant.geometry.lie import SO3
from covariant.models import Motion, free_body
from covariant.observers import Gated, run
from covariant.signals import Record, StepCode, lag_inputs
from covariant.simulation import hold, simulate

EXAMPLES = Path(__file__).parents[2] / "examples"
LOGS = {
    "multiarm_double": ("multiarm_pendulum/double.csv", 5, 20.2),
    "dfki_double_pendulum": ("dfki_double_pendulum/A0_sysid_00.csv", 1, None),
}
BEFORE, LONGEST, AFTER = 1.0, 1.2, 0.3
"""Seconds of every piece of a log: to settle in, of the longest hole, and after it."""
PLACES, PIECES = 20, 8
HOLES = {"hole of .1 s": 0.1, "hole of .4 s": 0.4, "hole of 1.2 s": 1.2}
OFF = 0.5  # rad


class Tried(NamedTuple):
    """Velocity errors (B, K), result codes (B, K) and velocities told (B, K, 2) by the kind of fault, the usual speed,
    and the row of each kind's first sample after its hole."""

    error: dict[str, np.ndarray]
    code: dict[str, np.ndarray]
    speed: float
    first: dict[str, int]


def spoiled(kind: str, y: np.ndarray, settled: int) -> np.ndarray:
    """Pieces of a log (B, K, n) with one kind of fault in them, from the row `settled` on."""
    rng = np.random.default_rng(0)
    late = np.arange(y.shape[1])[:, None] >= settled // 2
    if kind == "outliers":
        return y + OFF * rng.choice([-1, 1], y.shape) * (late & (rng.random(y.shape) < 0.01))
    if kind == "missing cells":
        return np.where(late & (rng.random(y.shape) < 0.05), np.nan, y)
    if kind == "missing rows":
        return np.where(late & (rng.random(y.shape[:2])[..., None] < 0.05), np.nan, y)
    if kind == "first row":
        return np.concatenate([y[:, :1] + [OFF, 0.0], y[:, 1:]], axis=1)
    return y


@eqx.filter_jit
def followed(observer, t, u, y):
    """Velocities and codes of many pieces: one program for every fault."""

    def one(t, u, y):
        def step(state, row):
            state, info = observer.step(state, *row)
            return state, (observer.estimate(state)[2:], info.result)

        return jax.lax.scan(step, observer.init(y[0], t[0]), (u[:-1], y[1:], jnp.diff(t)))[1]

    return jax.vmap(one)(t, u, y)


@pytest.fixture(scope="module", params=LOGS)
def log(request, data_folder) -> Any:
    """Record, velocities to compare with, data sheet, rate and model of a log."""
    file = models.load(str(EXAMPLES / f"{request.param}.toml"))
    name, every, until = LOGS[request.param]
    full = logs.read(data_folder / name, file.columns).record
    record = lag_inputs(logs.read(data_folder / name, file.columns, every, until).record, file.input_lag)
    t = np.asarray(record.t)
    positions = np.asarray(full.t), np.asarray(full.y)
    true = scoring.zero_phase_velocity(*positions, t, file.reference_half, int(file.reference_order))
    named = ("measurement_std", "acceleration_std", "correlation_time", "motion_std", "motion_time", "damping")
    told = {name: getattr(file, name) for name in named}
    sheet = DataSheet(**told, speed=(told["motion_std"] * told["motion_time"],) * 2)
    return record, true, sheet, 1 / float(np.median(np.diff(t))), file.model


@pytest.fixture(scope="module", params=["copy", "ekf", "joint-kalman"])
def tried(request, log) -> tuple[str, Tried]:
    """An estimator on all faults of a log at once."""
    record, true, sheet, rate, model = log
    observer = tuned_estimators(model, 2, sheet, rate, names=(request.param,))[request.param]
    settled, rows = int(BEFORE * rate), int((BEFORE + LONGEST + AFTER) * rate)
    t, u, y = (np.asarray(a) for a in record[:3])

    def pieces(count):
        return np.linspace(0, len(t) - rows, count).astype(int)[:, None] + np.arange(rows)

    lanes, at, first = {}, {}, {}
    for kind in ("clean", "outliers", "missing cells", "missing rows", "first row"):
        at[kind], first[kind] = pieces(PIECES), settled
        lanes[kind] = spoiled(kind, y[at[kind]], settled)
    for kind, seconds in HOLES.items():
        at[kind], first[kind] = pieces(PLACES), settled + int(seconds * rate)
        lanes[kind] = y[at[kind]].copy()
        lanes[kind][:, settled : first[kind]] = np.nan
        alone = f"{kind}, model alone"
        at[alone], first[alone], lanes[alone] = at[kind], first[kind], lanes[kind].copy()
        lanes[alone][:, first[kind]] = np.nan
    index = np.concatenate(list(at.values()))
    v, code = followed(observer, t[index], u[index], np.concatenate(list(lanes.values())))
    error = np.linalg.norm(np.asarray(v) - true[index][:, 1:], axis=2)
    ends = np.cumsum([len(lane) for lane in lanes.values()])[:-1]
    errors, codes = (dict(zip(lanes, np.split(a, ends), strict=True)) for a in (error, np.asarray(code)))
    return request.param, Tried(
        errors, codes, sheet.motion_std * sheet.motion_time, {k: n - 1 for k, n in first.items()}
    )


def rms(a) -> float:
    return float(np.sqrt(np.mean(np.square(a))))


@pytest.mark.exhaustive
@pytest.mark.data
def test_outliers_and_missing_measurements_cost_little(tried):
    """A filter without a model has nothing to bridge a missing measurement with."""
    name, (error, code, _, first) = tried
    allowed = {"outliers": 1.2, "missing cells": 1.1, "missing rows": 1.1}
    if name == "joint-kalman":
        allowed |= {"missing cells": 1.5, "missing rows": 1.5}
    clean = rms(error["clean"][:, first["clean"] :])
    for kind, most in allowed.items():
        assert rms(error[kind][:, first[kind] :]) < most * clean, kind
    assert (code["outliers"] == StepCode.OUTLIER).any()
    assert np.isin(code["clean"][:, first["clean"] :], [StepCode.OK, StepCode.OUTLIER]).all()


@pytest.mark.long("copy", "ekf", "multiarm_double")
@pytest.mark.data
def test_after_a_hole_the_velocity_is_no_worse_than_that_of_the_model_alone(tried):
    """A position tells nothing of the velocity half an oscillation of the error later: at .4 s no linear correction,
    fitted to the errors themselves at 120 places, leaves less than .98 of it on the free pendulum."""
    name, (error, _, _, first) = tried
    if name == "joint-kalman":
        pytest.skip("knows no model")
    for kind, most in zip(HOLES, (0.8, 1.12, 1.1), strict=True):
        k = first[kind]
        alone = error[f"{kind}, model alone"][:, k]
        assert rms(error[kind][:, k]) < most * rms(alone), kind
        if kind == "hole of 1.2 s":
            assert (error[kind][:, k] <= 1.5 * np.maximum(alone, rms(alone))).all()
        settled = slice(k + int(0.2 / 0.3 * (error[kind].shape[1] - first["hole of 1.2 s"])), None)
        assert rms(error[kind][:, settled]) < 1.2 * rms(error["clean"][:, first["clean"] :]), kind


@pytest.mark.long("ekf", "joint-kalman", "dfki_double_pendulum")
@pytest.mark.exhaustive("copy-multiarm_double", "kalman-dfki_double_pendulum")
@pytest.mark.data
def test_a_first_row_that_is_wrong_is_said(tried):
    """And the estimates that it spoils are, but for three rows at most, in which the wrong position is believed."""
    _, (error, code, speed, _) = tried
    said = code["first row"]
    assert (said.max(axis=1) >= StepCode.OUTLIER).all()
    spoiled = error["first row"] > np.maximum(2 * speed, 1.5 * error["clean"].max())
    assert (spoiled & (said < StepCode.OUTLIER)).sum(axis=1).max() <= 3


TURNING = 80.0  # rad/s
BODY = free_body((0.2, 0.2, 0.1))
SHEET = DataSheet(1e-3, 0.5, 0.02, 20.0, 0.5)
RATE = 100.0


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["intrinsic", "salcudean"])
def test_a_body_that_is_lost_is_said(name):
    """Gains that are too low for how fast it turns: the estimate falls behind by whole turns."""
    t = np.arange(400) / RATE
    u = np.zeros((len(t), 3))
    start = Motion(jnp.eye(3), jnp.array([2.0, 3.0, TURNING]))
    true = eqx.filter_jit(simulate)(BODY, start, jnp.asarray(t), hold(jnp.asarray(t), jnp.asarray(u)))
    chosen = observer_gains(SHEET, RATE)
    pure = with_gains(BODY, chosen.alpha / 4, chosen.beta / 16)[name]
    found = run(gated(pure, BODY, SHEET), Record(t, u, np.asarray(true.y)))
    error = np.linalg.norm(np.asarray(found.estimate.v - true.x.v), axis=1)
    usual = SHEET.motion_std * SHEET.motion_time
    assert (error > 2 * usual).sum() > 20
    assert ((np.asarray(found.info.result) == StepCode.OK) & (error > 2 * usual)).sum() < 10


@pytest.mark.exhaustive
def test_a_gate_makes_the_step_of_the_observer_when_nothing_is_wrong():
    """Even from a state that is far off: what the observer's own error does is no fault of the measurement."""
    rng = np.random.default_rng(2)
    y = np.asarray(jax.vmap(SO3.exp)(jnp.asarray(0.02 * np.cumsum(rng.normal(size=(60, 3)), axis=0))))
    pure = with_gains(BODY, 6.0, 20.0)["copy"]
    inside = Gated(pure, BODY, 1e-3, 10.0)

    def far(state):
        return state._replace(q=state.q @ SO3.exp(jnp.array([0.0, 1.2, 0.3])), v=jnp.array([3.0, -2.0, 1.0]))

    @eqx.filter_jit
    def both(a, b, y):
        (a, i), (b, j) = (o.step(s, jnp.zeros(3), y, jnp.asarray(0.01)) for o, s in ((pure, a), (inside, b)))
        return a, b, i, j

    y = jnp.asarray(y)
    a, b = pure.init(y[0]), inside.init(y[0])
    a, b = far(a), b._replace(inner=far(b.inner))
    b = b._replace(gate=b.gate._replace(left=BODY.manifold.towards(a.q, y[0])))
    for each in y[1:]:
        a, b, i, j = both(a, b, each)
        assert int(j.result) == StepCode.OK
        np.testing.assert_allclose(b.inner.v, a.v, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(j.innovation, i.innovation, atol=1e-9)
