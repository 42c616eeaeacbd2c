"""Slow states: offsets of sensors, payloads and friction are found where the motion shows them, and not where not."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.models import pendulum_chain
from covariant.observers import IntrinsicKalman, SlowVariables, external_force, sensor_bias, uncertain_parameters

STEP, ROWS, NOISE = 0.01, 500, 1e-3


def kalman(model, n: int, *slow: SlowVariables, **named) -> IntrinsicKalman:
    return IntrinsicKalman(model, 1e-4, NOISE**2 * jnp.eye(n), 4 * jnp.eye(n), slow, substeps=1, **named)


# A mass on a spring: the textbook's Kalman filter of position, velocity and offset.


# Encoders of an arm that are off: gravity shows it.

CHAIN = pendulum_chain((1.0, 0.7), (0.5, 0.4), viscous=(0.05, 0.05))


def wrong_shape(s):
    return jnp.zeros(3)


ONE = jnp.eye(1)
# Forces that are forgotten.


FAMILY_ARGUMENTS = ("pendulum_chain", ["mass"], ["parameters.mass=[1.0]", "parameters.length=[1.0]"])
REFUSED = [
    (lambda: sensor_bias((-0.1,)), "sensor_bias: std must be one number or several, numbers ≥ 0"),
    (lambda: sensor_bias((0.1, np.nan)), "sensor_bias: std must be one number or several, numbers ≥ 0"),
    (lambda: sensor_bias((0.0, 0.0)), "all of std are zero"),
    (lambda: sensor_bias((0.1,), np.inf), "sensor_bias: drift must be one number, numbers ≥ 0"),
    (lambda: sensor_bias((0.1, 0.1), (0.1, 0.1, 0.1)), "sensor_bias: drift must be one number or 2"),
    (lambda: external_force(-ONE), "external_force: density must have variances that are zero or more"),
    (lambda: external_force(2.0), r"external_force: density must be a matrix \(n, n\)"),
    (lambda: external_force(ONE, time=1.0), "give a density, or both std and time"),
    (lambda: external_force(std=1.0), "give a density, or both std and time"),
    (lambda: external_force(std=1.0, time=0.0), "time must be a positive, finite number; got 0"),
    (lambda: external_force(std=-1.0, time=1.0), "external_force: std must be one number or several, numbers ≥ 0"),
    (
        lambda: SlowVariables(("a",), jnp.zeros(1), ONE, ONE, offset=wrong_shape, time=-1.0),
        "SlowVariables: time must be a positive",
    ),
    (lambda: uncertain_parameters(models.family(*FAMILY_ARGUMENTS), (0.1, 0.2)), "std must be one number, numbers ≥ 0"),
    (lambda: SlowVariables((), jnp.zeros(0), ONE, ONE, offset=wrong_shape), "names must be different names"),
    (lambda: SlowVariables(("a",), jnp.zeros(2), ONE, ONE, offset=wrong_shape), "first must be 1 finite numbers"),
    (
        lambda: SlowVariables(("a",), jnp.zeros(1), jnp.eye(2), ONE, offset=wrong_shape),
        r"first_cov must be a matrix \(1, 1\)",
    ),
    (
        lambda: kalman(CHAIN, 2, SlowVariables(("a",), jnp.zeros(1), ONE, ONE)),
        "give a force, a model or an offset .* states a$",
    ),
    (lambda: kalman(CHAIN, 2, sensor_bias((0.1,))), r"offset of the slow states bias1 must return shape \(2,\)"),
    (lambda: kalman(CHAIN, 2, external_force(jnp.eye(3))), "force of the slow states external_force1, external_force2"),
    (lambda: kalman(CHAIN, 2, *(external_force(jnp.eye(2)),) * 2), "two slow states are called 'external_force1'"),
    (lambda: kalman(CHAIN, 2, "bias"), "slow must be one SlowVariables or several"),
    (lambda: dataclasses.replace(kalman(CHAIN, 2), slow="bias"), "slow must be one SlowVariables or several"),
]


@pytest.mark.core(10)
@pytest.mark.parametrize(("make", "words"), REFUSED)
def test_what_makes_no_sense_is_named(make, words):
    with pytest.raises(ValueError, match=words):
        make()
