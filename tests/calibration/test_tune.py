"""Noise and gains that are found from a log: the truth in simulation, and a filter that runs on the linear errors."""

import contextlib

import jax.numpy as jnp
import numpy as np
import pytest

from covariant.calibration import tune
from covariant.calibration.tuning._tuning_log import TuningLog, prepared, refuse_noise_free, tuning_logs
from covariant.models import Lagrangian, Parametric
from covariant.signals import Record
from scalargraph.errors import InputError

RATE, STD, ACCELERATION = 100.0, 1e-3, 0.3
STIFFNESS = 20.0


def swing(inertia):
    """An inertia on a spring: linear, so that all filters are exact."""
    metric = Parametric(_inertia, inertia=inertia)
    return Lagrangian(metric, lambda q: STIFFNESS * q[0] ** 2 / 2, inputs=1, coordinates=("q",))


def _inertia(q, inertia):
    return inertia * jnp.eye(1, dtype=q.dtype)


MODEL = swing(1.0)


def noisy(seconds: float, seed: int = 0) -> tuple[Record, np.ndarray]:
    """A log of the swing with white acceleration of the density 0.3², exact in each step, and its velocities."""
    rng, h, w = np.random.default_rng(seed), 1 / RATE, STIFFNESS**0.5
    step = np.array([[np.cos(w * h), np.sin(w * h) / w], [-w * np.sin(w * h), np.cos(w * h)]])
    root = ACCELERATION * np.linalg.cholesky([[h**3 / 3, h**2 / 2], [h**2 / 2, h]])
    t, x, path = np.arange(0, seconds, h), np.array([1.0, 0.0]), []
    for _ in t:
        path.append(x)
        x = step @ x + root @ rng.normal(size=2)
    q, v = np.array(path).T
    return Record(t, np.zeros((len(t), 1)), (q + STD * rng.normal(size=len(t)))[:, None]), v[:, None]


@pytest.fixture(scope="module")
def log():
    return noisy(40.0)


def test_a_log_that_is_too_short_is_refused(log):
    record, v = log
    short = Record(*(np.asarray(a[:150]) for a in record[:3]))
    with pytest.raises(ValueError, match="too short to tune on"):
        tune(MODEL, [short], [v[:150]])


STILL = np.zeros((400, 1))
T = np.arange(400) / RATE


@pytest.mark.core(1)
@pytest.mark.parametrize(
    ("positions", "names", "reason"),
    [
        ([STILL + 0.3], ["log.csv"], "nothing moves in the logs"),
        ([np.cos(STIFFNESS**0.5 * T)[:, None]], ["log.csv"], "as in a simulation without noise"),
        ([STILL[:121]] * 2, ["a.csv", "b.csv"], "b.csv of 121 rows has"),
    ],
)
def test_a_log_that_tells_no_noise_is_refused_with_the_reason(positions, names, reason):
    records = [Record(T[: len(q)], np.zeros((len(q), 1)), q) for q in positions]
    with pytest.raises(InputError, match=reason):
        tune(MODEL, records, [np.gradient(q, 1 / RATE, axis=0) for q in positions], names=names)


def test_the_rows_of_all_logs_together_are_enough():
    """121 rows each; a log of 2 rows, which has none that count, is left out."""
    records = [Record(T[:121], np.zeros((121, 1)), np.sin(T[:121])[:, None])] * 5
    records += [Record(T[:2], np.zeros((2, 1)), np.zeros((2, 1)))]
    names = [f"{k}.csv" for k in range(6)]
    kept = tuning_logs(MODEL, records, [np.asarray(record.y) for record in records], names)
    assert len(kept) == 5
    with pytest.raises(InputError, match=r"0\.csv of 121 rows has"):
        tuning_logs(MODEL, records[:2], [np.asarray(record.y) for record in records[:2]], names[:2])


def test_rows_of_logs_that_are_left_out_are_not_counted():
    """One has no rows for tuning, the other none that are held out: none of them can be used."""
    record = Record(T, np.zeros((len(T), 1)), np.sin(T)[:, None])
    first = np.where(np.arange(len(T)) < 266, 1.0, np.nan)[:, None]
    rest = np.where(np.arange(len(T)) < 266, np.nan, 1.0)[:, None]
    with pytest.raises(InputError, match="too short to tune on: of the first two thirds 0 rows count"):
        tuning_logs(MODEL, [record, record], [first, rest], ["a.csv", "b.csv"])


@pytest.mark.parametrize(("size", "refused"), [([5e-3, 1e-3], False), ([1e-9, 1e-3], False), ([1e-9, 1e-12], True)])
def test_noise_is_compared_with_the_motion_of_its_own_coordinate(size, refused):
    """Metres of a map, 6000 km from its origin, beside a heading."""
    y = np.stack([6e6 + 100 * np.sin(T), np.sin(T)], axis=1)
    logs = [TuningLog(Record(T, np.zeros((len(T), 1)), y), np.zeros_like(y), T > 0, T > 0)]
    with pytest.raises(InputError, match="without noise") if refused else contextlib.nullcontext():
        refuse_noise_free(np.array(size), logs)


def test_rows_in_holes_and_soon_after_them_are_not_judged(log):
    """As long as enough others are left."""
    record, v = log
    t, y = np.asarray(record.t), record.y.copy()
    y[3300:3340] = np.nan
    part = prepared(MODEL, record._replace(y=y), v)
    whole = prepared(MODEL, record, v)
    near = (t > 32.99) & (t <= 33.4 + 0.5)
    np.testing.assert_array_equal(part.held_out, whole.held_out & ~near)
    np.testing.assert_array_equal(part.tuned, whole.tuned)
    y[::50] = np.nan
    y[1::50] = np.nan
    y[2::50] = np.nan
    y[0] = record.y[0]
    np.testing.assert_array_equal(prepared(MODEL, record._replace(y=y), v).held_out, whole.held_out)
