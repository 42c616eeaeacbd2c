"""An observer that holds the inputs of the past gets what `acting_inputs` and `lag_inputs` make of a whole log."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant.observers import AbstractObserver, ActingInputs, Info
from covariant.signals import MOST_MISSING, Record, StepCode, acting_inputs, lag_inputs
from covariant.verbs.base.inputs import _around_missing

ROWS, STEP = 120, 0.01


class Place(NamedTuple):
    """Two positions, and the last input."""

    q: jax.Array
    last_input: jax.Array | None


class Moved(AbstractObserver):
    """An observer whose inputs are rates: quick to compile, and wrong for good by any input that is off."""

    def init(self, y, t=0.0):
        return Place(y, jnp.zeros(2))

    def predict(self, state, u, dt):
        return state._replace(q=state.q + u * dt)

    def correct(self, state, u, y):
        missing = jnp.isnan(y)
        innovation: Any = jnp.where(missing, 0.0, y - state.q)
        result = jnp.where(missing.any(), int(StepCode.COASTED), int(StepCode.OK))
        return state._replace(q=state.q + innovation / 64), Info(innovation, jnp.sum(innovation), result)

    def estimate(self, state):
        return jnp.concatenate([state.q, -state.q])


RATES = Moved()


def log_of(fault: str) -> Record:
    """Inputs that change with every row, between irregular stamps with a hole, or with inputs missing."""
    rng = np.random.default_rng(3)
    dt, u = np.full(ROWS, STEP), rng.normal(size=(ROWS, 2))
    if fault != "regular":
        dt *= 1 + 0.3 * rng.uniform(-1, 1, ROWS)
        dt[50] = 0.27
    if fault == "missing":
        u[30:33, 0] = u[70, 1] = np.nan
        u[0] = np.nan
    return Record(5 + np.cumsum(dt), u, 0.01 * rng.normal(size=(ROWS, 2)))


def acted(log: Record, between: str, delay, lag, lead=0.0) -> np.ndarray:
    """The inputs that act in a whole log, each after its own delay and lag."""
    lagged = [
        _around_missing(lambda each, c=c: lag_inputs(each, c), log, MOST_MISSING) for c in np.broadcast_to(lag, 2)
    ]
    whole = log._replace(u=np.stack([each.u[:, i] for i, each in enumerate(lagged)], axis=1))
    return np.asarray(_around_missing(lambda each: acting_inputs(each, between, delay, lead=lead), whole).u)


def told(observer: ActingInputs, log: Record) -> np.ndarray:
    """The inputs that acted in each step of an observer."""
    at_end = observer.input_at_end
    t, u, y = (jnp.asarray(part) for part in log[:3])

    @jax.jit
    def states(t, u, y):
        state = observer.init(y[0], t[0])
        if at_end:
            state, _ = observer.step(state, u[0], y[0], 0.0)

        def step(state, row):
            state, _ = observer.step(state, *row)
            return state, state.acting

        return jax.lax.scan(step, state, (u[1:] if at_end else u[:-1], y[1:], jnp.diff(t)))[1]

    return np.asarray(states(t, u, y))


@pytest.mark.core(1)
@pytest.mark.parametrize("fault", ["regular", "irregular", "missing"])
@pytest.mark.parametrize(
    ("between", "delay", "lag", "lead"),
    [
        ("held", 0.02, 0.0, 0.015),  # whole rows, where rounding decides which row an edge belongs to
        ("held", 0.0, 0.0, 0.02),
        ("held", (0.037, 0.004), (0.0, 0.02), 0.0),
        ("held", (0.02, 0.0371), 0.01, (0.0, -0.05)),
        ("linear", 0.0, 0.0, 0.0),
        ("linear", (0.037, 0.004), 0.01, (0.03, 0.0)),
        ("linear", (0.01, 0.0), (0.0, 0.01), 0.02),
    ],
)
def test_a_step_gets_what_acts_in_the_log(between, delay, lag, lead, fault):
    log = log_of(fault)
    observer = ActingInputs(RATES, 1 / (0.7 * STEP), delay, lag, lead, between, 2)
    expected = acted(log, between, delay, lag, lead)[:-1]  # no step follows the last row
    np.testing.assert_allclose(told(observer, log), expected, rtol=0, atol=1e-11)
    assert np.isnan(expected).any() == (fault == "missing")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"rate": 0.0}, "rate must be a positive number"),
        ({"delay": -0.1}, "delay must be one number or 2, numbers ≥ 0; got -0.1"),
        ({"delay": (0.1, 0.2, 0.3)}, "delay must be one number or 2"),
        ({"lag": np.nan}, "lag must be one number or 2"),
        ({"between": "spline"}, "between must be 'held' or 'linear'; got 'spline'"),
    ],
)
def test_times_that_mean_nothing_are_refused(given, message):
    with pytest.raises(ValueError, match=f"ActingInputs: {message}"):
        ActingInputs(RATES, **({"rate": 100.0, "inputs": 2} | given))
