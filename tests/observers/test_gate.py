"""Outliers: refused joint by joint, counted, believed when they stay; and a gate that learns what is usual."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from covariant.geometry import Coordinates, ProductManifold
from covariant.geometry.lie import SE3, SO3
from covariant.models import oscillator
from covariant.observers import Gate, Gated, Intrinsic


@pytest.mark.parametrize("n", [1, 2, 3, 6, 12])
@pytest.mark.parametrize("deviations", [3.0, 6.0])
def test_what_is_measured_together_is_refused_as_seldom(n, deviations):
    exact = stats.chi2.isf(2 * stats.norm.sf(deviations), n)
    assert Gate(deviations).limit(n) == pytest.approx(exact, rel=1e-9)


def test_what_is_measured_together():
    assert Coordinates().measured_together(3) == ((0,), (1,), (2,))
    assert SO3.measured_together(3) == ((0, 1, 2),)
    arm = ProductManifold((SE3, Coordinates(dimension=2)))
    assert arm.measured_together(8) == ((0, 1, 2, 3, 4, 5), (6,), (7,))


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"deviations": 0.0}, "deviations must be a positive, finite number; got 0.0"),
        ({"deviations": np.nan}, "deviations must be a positive"),
        ({"memory": -1.0}, "memory must be a positive"),
        ({"memory": 0.5}, "memory must be a number of samples, 1 or more; got 0.5"),
        ({"patience": -1}, "patience must be a number of samples, 0 or more; got -1"),
    ],
)
def test_gates_that_make_no_sense_are_refused(wrong, words):
    with pytest.raises(ValueError, match=words):
        Gate(**wrong)


def test_a_state_without_the_time_since_its_start_restarts_as_any_other():
    observer = Gated(Intrinsic(oscillator(), 4.0, 8.0, substeps=1), oscillator(), 1e-3, 1.0, fast_start=True)
    state, step = observer.init(jnp.zeros(1))._replace(running=None), jax.jit(observer.step)
    for _ in range(12):
        state, _ = step(state, jnp.zeros(1), jnp.array([5.0]), 0.01)
    assert state.running is None
    assert float(state.inner.q[0]) == pytest.approx(5.0, abs=0.01)
