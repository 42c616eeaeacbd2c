"""Impacts, a late joint, a start at full speed, and bursts of outliers: the gate refuses what is alone, not motion.

The motions are simulated without this library where it has no model of them: a rod that bounces off a stop by SciPy, a
cube that is tossed onto a floor by MuJoCo.
"""

import jax.numpy as jnp
import pytest

from covariant.models import pendulum_chain
from covariant.observers import Gate
from covariant.observers.base import GateMemory, Sample, Velocity

NOISE = 1e-3
ROD, CHAIN = pendulum_chain((1.0,), (0.5,)), pendulum_chain((1.0, 0.7), (0.5, 0.4))


@pytest.mark.core(1)
@pytest.mark.parametrize(
    ("change", "refused"),
    [
        ([0.01, 0.04], [True, False]),  # faster than usual and still faster: a blow that the model does not know
        ([0.03, -0.03, 0.03, -0.03], [True, True, True, False]),  # noise that is larger than given
        ([0.03, 0.03, 0.03, 0.03], [True] * 4),  # a slip, or outliers that are equal
        ([0.04, 0.03, 0.0, 0.0], [True, True, False, False]),  # outliers, of which the second is smaller
        ([0.2, 0.5, 0.2, 0.5], [True] * 4),  # farther than any motion goes in two rows
    ],
)
def test_readings_that_motion_explains_are_used_where_they_go_on_as_it_does(change, refused):
    gate, memory, eye = Gate(), GateMemory.at_start(jnp.zeros(1)), jnp.eye(1)
    for value, outlying in zip(change, refused, strict=True):
        memory = memory.advanced(jnp.asarray(0.005))
        sample = Sample(jnp.array([value]), 1.5 * NOISE**2 * eye, NOISE**2 * eye, jnp.ones(1, bool))
        verdict = gate.judge(ROD.manifold, sample, memory, Velocity(jnp.zeros(1), eye), 16.0 * eye)
        assert bool(verdict.far[0]) == outlying
        assert not bool(verdict.restart)
        memory = verdict.memory.used(~verdict.far, jnp.zeros(1))
    # What is used teaches the gate, which then lets as much pass; what is refused teaches it little.
    assert bool(memory.scale[0] > 8) if value and not refused[-1] else bool(memory.scale[0] < 2)
