"""The smoother in a stream is the smoother of a log with the same lag, and compiles to C: what takes long."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models, observers
from covariant.observers import FixedLag, Gate, IntrinsicKalman, JointKalman, smooth
from covariant.signals import Record, StepCode

ROWS, LAG, TICK = 60, 7, 0.02


@functools.cache
def log() -> Record:
    """Irregular stamps, a gap, outliers, and a slip after which the filter starts anew."""
    rng = np.random.default_rng(0)
    t = 3.0 + np.cumsum(rng.uniform(0.005, 0.03, ROWS))
    y = 0.4 * np.sin(3 * t) + 0.01 * rng.normal(size=ROWS)
    y[15:20] = np.nan
    y[22] += 2.0
    y[40:] += 3.0
    return Record(t, rng.normal(size=(ROWS, 1)), np.round(y / TICK)[:, None] * TICK)


def of_a_pendulum() -> IntrinsicKalman:
    """With ticks and a force, so that its state has all fields."""
    pendulum = models.pendulum_chain((1.0,), (0.5,), viscous=(0.05,))
    force = observers.external_force(std=0.5, time=0.2)
    return IntrinsicKalman(pendulum, 1.0, 1e-6, 4.0, force, (TICK,), Gate(patience=4), substeps=1)


FILTERS = {"pendulum": of_a_pendulum, "no model": lambda: JointKalman(5.0, 0.1, 0.01, gate=Gate(patience=4))}


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["pendulum", "no model"])
def test_it_is_the_smoother_of_a_log_with_this_lag(name):
    observer = FILTERS[name]()
    expected, late = smooth(observer, log(), lag=LAG), FixedLag(observer, LAG)
    results = np.asarray(expected.filtered.info.result)
    assert {StepCode.COASTED, StepCode.OUTLIER, StepCode.RESTARTED} <= set(results.tolist())

    @jax.jit
    def streamed(record):
        def step(state, row):
            state, info = late.step(state, *row)
            return state, (late.estimate(state), info, state.t[0])

        rows = record.u[:-1], record.y[1:], jnp.diff(record.t)
        state, out = jax.lax.scan(step, late.init(record.y[0], record.t[0]), rows)
        return out, late.window(state)

    (x, info, t), window = streamed(jax.tree.map(jnp.asarray, log()._replace(x=None)))
    close = functools.partial(np.testing.assert_allclose, rtol=1e-11, atol=1e-11)
    done = slice(LAG - 1, None)
    close(x[done], expected.run.estimate[:-LAG])
    close(t[done], log().t[:-LAG])
    # Before that it is the first row, by all rows so far: those that are missing would tell nothing.
    y = np.array(log().y)
    y[5:] = np.nan
    close(t[:LAG], log().t[0])
    close(x[3], smooth(observer, log()._replace(y=y), lag=LAG).run.estimate[0])
    for field in ("velocity_std", "slow", "slow_std"):
        if hasattr(info, field):
            close(getattr(info, field)[done], getattr(expected.run.info, field)[:-LAG])
    for field in ("innovation", "result"):  # of the last sample
        close(getattr(info, field), getattr(expected.filtered.info, field)[1:])
    close(window.t, log().t[-LAG - 1 :])
    close(window.estimate, expected.run.estimate[-LAG - 1 :])
    close(window.std, expected.std[-LAG - 1 :])
