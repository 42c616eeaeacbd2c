"""What takes long of `test_acting_inputs.py`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_acting_inputs import RATES, STEP, acted, log_of

from covariant.engine import Stream, run_log
from covariant.observers import ActingInputs, run
from covariant.signals import StepCode


@pytest.mark.exhaustive
@pytest.mark.parametrize("between", ["held", "linear"])
def test_runs_streams_and_compiled_code_are_those_of_the_acting_inputs(between):
    log = log_of("irregular")
    times = (0.013, 0.004), 0.02, 0.01
    observer = ActingInputs(RATES, 1 / (0.7 * STEP), *times, between, 2)
    expected = run(RATES, log._replace(u=acted(log, between, *times)))
    for found in (run(observer, log), run_log(observer, log, engine="c")[0]):
        np.testing.assert_allclose(found.estimate, expected.estimate, rtol=1e-10, atol=1e-10)
        assert np.array_equal(found.info.result, expected.info.result)
    for engine in ("jax", "c"):
        stream = Stream(observer, log.y[0], 1 / STEP, 2, engine)
        inputs = log.u if between == "linear" else np.concatenate([log.u[:1], log.u[:-1]])
        found = [stream.step(float(t), y, u) for t, y, u in zip(log.t, log.y, inputs, strict=True)]
        np.testing.assert_allclose(found, expected.estimate, rtol=1e-10, atol=1e-10)


def test_a_step_that_is_refused_stores_no_input():
    observer = ActingInputs(RATES, 100.0, 0.015, inputs=2)
    state, _ = observer.step(observer.init(jnp.zeros(2)), jnp.ones(2), jnp.zeros(2), 0.01)
    for dt, code in ((-0.01, StepCode.STEP_REFUSED), (np.nan, StepCode.STEP_REFUSED), (0.0, StepCode.REPEATED)):
        after, info = observer.step(state, jnp.full(2, 9.0), jnp.zeros(2), dt)
        assert int(info.result) == code
        for new, old in zip(jax.tree.leaves(after), jax.tree.leaves(state), strict=True):
            np.testing.assert_array_equal(new, old)


def test_the_halves_of_a_step_are_the_step():
    observer = ActingInputs(RATES, 100.0, 0.015, inputs=2)
    state = halves = observer.init(jnp.array([0.1, 0.2]))
    for k in range(4):
        u, y = jnp.array([1.0 * k, -2.0]), jnp.array([0.1, 0.2 + 0.01 * k])
        state, info = observer.step(state, u, y, 0.01)
        predicted = observer.predict(halves, u, jnp.asarray(0.01))
        np.testing.assert_allclose(observer.innovation(predicted, u, y), info.innovation, atol=1e-15)
        halves, _ = observer.correct(predicted, u, y)
        np.testing.assert_allclose(observer.estimate(halves), observer.estimate(state), atol=1e-15)
