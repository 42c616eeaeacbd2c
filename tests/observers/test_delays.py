"""Readings that are late: the estimate is that of the filter that got each reading at the time at which it was true."""

import jax.numpy as jnp
import numpy as np
import pytest

from covariant.models import pendulum_chain
from covariant.observers import (
    EKF,
    Delayed,
    Intrinsic,
    IntrinsicKalman,
)

CHAIN = pendulum_chain((0.6, 0.4), (0.3, 0.25), com=(0.16, 0.14), inertia=(0.005, 0.0026), viscous=(0.012, 0.008))
FILTER = IntrinsicKalman(CHAIN, 0.1 * jnp.eye(2), 1e-8 * jnp.eye(2), 4.0 * jnp.eye(2), substeps=1)


IN_C = {
    "intrinsic": Intrinsic(CHAIN, 60.0, 1800.0, substeps=1),
    "ekf": EKF(CHAIN, 0.1 * jnp.eye(2), 1e-8 * jnp.eye(2), substeps=1),
    "intrinsic-kalman": FILTER,
}


def test_a_buffer_holds_what_waits_and_no_more():
    """With one delay nothing waits; where one sensor is later, the readings of the others do."""
    assert [Delayed(IN_C["intrinsic"], d, 1000.0).waiting for d in (0.0, 0.005, (0.0, 0.005), (0.002, 0.005))] == [
        *(0, 0, 6, 4)
    ]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((-0.1, 100.0), "delay must be a number ≥ 0"),
        (((0.1, np.nan), 100.0), "delay must be a number ≥ 0"),
        ((0.1, 0.0), "rate must be a positive number"),
        ((0.1, 100.0, np.inf), "lateness must be a number ≥ 0"),
    ],
)
def test_names_a_number_that_makes_no_sense(arguments, words):
    with pytest.raises(ValueError, match=words):
        Delayed(FILTER, *arguments)
