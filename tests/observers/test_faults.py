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
from covariant.calibration import DataSheet, tuned_estimators
from covariant.signals import StepCode, lag_inputs

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


@pytest.mark.exhaustive("ekf-dfki_double_pendulum", "copy-multiarm_double", "kalman-dfki_double_pendulum")
@pytest.mark.long("ekf", "joint-kalman", "dfki_double_pendulum")
@pytest.mark.data
def test_a_first_row_that_is_wrong_is_said(tried):
    """And the estimates that it spoils are, but for three rows at most, in which the wrong position is believed."""
    _, (error, code, speed, _) = tried
    said = code["first row"]
    assert (said.max(axis=1) >= StepCode.OUTLIER).all()
    spoiled = error["first row"] > np.maximum(2 * speed, 1.5 * error["clean"].max())
    assert (spoiled & (said < StepCode.OUTLIER)).sum(axis=1).max() <= 3
