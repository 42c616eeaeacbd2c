"""What takes long of `test_all_doubles.py`."""

import math
import shutil

import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from test_all_doubles import cases, engines

from covariant.engine import Stream, run_log
from covariant.signals import Record, StepCode

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler, `cc`")

SPECIAL = (math.nan, math.inf, -math.inf, 5e-324, -1e-323, 1e-310, -0.0, 0.0, 3e9, 7e9, 1e22, -1e22, 1e154, -1.7e308)


RESOLVED = 1e6
"""States beyond it turn so far in a step that the roundings of one decide what the next is."""


doubles = st.one_of(st.sampled_from(SPECIAL), st.floats(-1.0, 1.0), st.floats())


steps = st.one_of(st.floats(1e-3, 0.05), st.sampled_from(SPECIAL), st.floats())


@st.composite
def samples(draw):
    """A few samples: noise to be added to a measurement or entries in place of it, three inputs, and a time step."""
    places = st.lists(st.tuples(st.integers(0, 8), doubles), max_size=2)
    return draw(st.lists(st.tuples(places, st.lists(doubles, min_size=3, max_size=3), steps), min_size=1, max_size=4))


@pytest.mark.exhaustive("ekf", "gated", "on a group")
@pytest.mark.parametrize("name", ["gated", "ekf", "pll", "on a group"])
@settings(max_examples=150)
@given(log=samples())
@example(log=[([(0, 1e22)], [0.0, 0.0, 0.0], 0.01), ([], [0.0, 0.0, 0.0], 0.01)])
@example(log=[([(0, 1e308)], [0.0, 0.0, 0.0], 0.01)])
@example(log=[([], [0.0, 0.0, 0.0], 5e-324), ([], [0.0, 0.0, 0.0], -5e-324)])
@example(log=[([], [-1.7e308, 0.0, 0.0], -1.0)])
def test_a_step_by_either_engine_is_the_same(name, log):
    observer, complete = cases()[name]
    both, largest = engines(name), 0.0
    for work in both:
        work.y[:] = complete.ravel()
        work.start(0.0)
    for places, inputs, dt in log:
        y = complete.ravel().copy()
        for k, value in places:
            y[k % y.size] = value
        codes = []
        for work in both:
            work.y[:], work.u[:] = y, inputs[: len(complete)]
            codes.append(StepCode(work.advance(dt)))
        measured = np.abs(y[np.abs(y) <= observer.largest(complete).ravel()])
        largest = max(largest, *measured, 0.0)
        if not all((np.abs(work.x) < RESOLVED).all() for work in both):
            return
        assert codes[0] == codes[1]
        assert np.isfinite(both[0].x).all()
        # An angle of many turns has that many digits fewer.
        np.testing.assert_allclose(both[0].x, both[1].x, rtol=1e-6, atol=1e-9 + 1e-12 * largest)


@pytest.mark.exhaustive("-1e+22-jax", "inf-jax", "7000000000.0-jax")
@pytest.mark.parametrize("engine", ["c", "jax"])
@pytest.mark.parametrize("far", [7e9, -1e22, 1e308, math.inf])
def test_an_angle_of_too_many_turns_is_missing_and_spoils_nothing(engine, far):
    """As a first measurement and later."""
    observer, y = cases()["gated"]
    stream = Stream(observer, y, 100.0, engine=engine)
    assert np.isnan(stream.step(0.0, [far, 0.2])).all()
    assert stream.result == StepCode.COASTED
    for k in range(1, 30):
        x = stream.step(0.01 * k, [far, 0.2] if k == 10 else y, [0.0, 0.0])
        assert stream.result == (StepCode.COASTED if k == 10 else StepCode.OK)
        assert np.abs(x[:2] - y).max() < 0.1


@pytest.mark.exhaustive("jax")
@pytest.mark.parametrize("engine", ["c", "jax"])
def test_a_log_with_angles_of_too_many_turns(engine):
    observer, y = cases()["gated"]
    t, u, rows = np.arange(20) / 100, np.zeros((20, 2)), np.tile(y, (20, 1))
    rows[5, 0] = 1e22
    done, _ = run_log(observer, Record(t, u, rows), engine=engine)
    assert done.info.result.tolist() == [int(StepCode.COASTED) if k == 5 else int(StepCode.OK) for k in range(20)]
    rows[0, 0] = 1e22
    with pytest.raises(ValueError, match="row 1: the measurement is too large"):
        run_log(observer, Record(t, u, rows), engine=engine)


@pytest.mark.exhaustive("False-0.01")
@pytest.mark.parametrize("dt", [0.01, 5e-324])
@pytest.mark.parametrize("jitted", [False, True])
def test_a_step_in_time_may_be_a_number_of_pythons_own(jitted, dt):
    observer, y = cases()["pll"]
    state = observer.init(jnp.asarray(y))
    step = jax.jit(lambda state, y: observer.step(state, jnp.zeros(2), y, dt))
    by_number = step(state, jnp.asarray(y)) if jitted else observer.step(state, jnp.zeros(2), jnp.asarray(y), dt)
    by_array = observer.step(state, jnp.zeros(2), jnp.asarray(y), jnp.asarray(dt, float))
    for one, other in zip(jax.tree.leaves(by_number), jax.tree.leaves(by_array), strict=True):
        np.testing.assert_array_equal(one, other)
