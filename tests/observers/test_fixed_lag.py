"""The smoother in a stream is the smoother of a log with the same lag, and compiles to C."""

import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models, observers
from covariant.codegen import trace_program, with_open_numbers
from covariant.observers import FixedLag, JointKalman


def test_states_of_a_state_space_model_are_one_array_in_code():
    ekf = observers.StateEKF(models.duffing(), jnp.eye(2), 1e-4 * jnp.eye(1), jnp.zeros(2), jnp.eye(2), 1)
    traced = trace_program(with_open_numbers(FixedLag(ekf, 3)), np.zeros(1))
    assert [leaf.name for leaf in traced.x] == ["x"]


@pytest.mark.parametrize(
    ("observer", "lag", "words"),
    [
        (observers.FilteredDerivative(20.0), 3, "FilteredDerivative has no covariance of its own to smooth by"),
        (JointKalman(5.0, 0.1, 0.01), 0, "lag must be a number of samples, 1 or more; got 0"),
    ],
)
def test_what_has_no_lag_is_refused(observer, lag, words):
    with pytest.raises(ValueError, match=words):
        FixedLag(observer, lag)
