"""What takes long of `test_operations.py`."""

import json
from importlib.metadata import version

import jax
import pytest
from test_operations import TABLE, counts

from scalargraph import operations

COUNTED_WITH = "0.9"
"""Release of JAX with which operations are counted; others write the same functions as other primitives."""


@pytest.mark.exhaustive(
    "SCARA, right-hand side-.",
    "Panda, right-hand side-.",
    "double pendulum, step, delayed-.",
    "quadruped, right-hand side-.",
    "SCARA, step, intrinsic-.",
    "SCARA, step, gated-.",
    "Panda, step, intrinsic-.",
    "top, step, delayed-.",
    "top, step, geodesic-.",
    "top, step, kalman-.",
    "SCARA, step, ekf-.",
    "SCARA, step, delayed-.",
    "SCARA, step, kalman-.",
    "SCARA, step, geodesic-.",
    "Panda, step, gated-.",
    "SCARA, step, kalman with a gyro-.",
    "quadruped, step, intrinsic-.",
    "Panda, step, ekf-.",
)
@pytest.mark.skipif(not version("jax").startswith(COUNTED_WITH), reason=f"operations are counted with {COUNTED_WITH}")
@pytest.mark.parametrize(("name", "count"), counts(), ids=lambda value: value if isinstance(value, str) else ".")
def test_operations_are_those_of_the_table(name, count):
    assert count() == json.loads(TABLE.read_text(encoding="utf-8"))[name]
