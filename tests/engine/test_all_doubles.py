"""C and JAX compute the same function on all doubles: the same codes, and states that are equal to rounding."""

import functools
import shutil

import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models, observers
from covariant.engine._backends import backend
from covariant.signals import StepCode

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler, `cc`")


@functools.cache
def pendulum():
    return models.pendulum_chain(viscous=(0.1, 0.1), coulomb=(0.05, 0.02))


@functools.cache
def cases() -> dict[str, tuple]:
    """Observers with a complete measurement of each."""
    chain, top = np.array([0.1, 0.2]), np.eye(3)
    intrinsic = observers.Intrinsic(pendulum(), 20.0, 200.0)
    return {
        "gated": (observers.Gated(intrinsic, pendulum(), jnp.asarray(1e-3), jnp.array([2.0, 2.0])), chain),
        "ekf": (observers.EKF(pendulum(), jnp.eye(2), 1e-4 * jnp.eye(2)), chain),
        "pll": (observers.PLL(20.0, circles=(0, 1)), chain),
        "on a group": (observers.Intrinsic(models.free_body((0.9, 1.0, 1.2)), 10.0, 30.0), top),
    }


@functools.cache
def engines(name: str) -> list:
    observer, y = cases()[name]
    both = [backend(observer, y, len(y), asked) for asked in ("c", "jax")]
    assert [by.partition(":")[0] for by, _ in both] == ["c", "jax"]
    return [work for _, work in both]


def test_an_angle_of_many_turns_is_followed():
    """Within the limit, to the digits that are left."""
    _, y = cases()["pll"]
    in_c, _ = engines("pll")
    turns = 2 * np.pi * 1e8
    in_c.u[:] = 0.0
    in_c.y[:] = y
    in_c.start(0.0)
    for _ in range(5):
        in_c.y[:] = y + turns
        assert in_c.advance(0.01) == StepCode.OK
    np.testing.assert_allclose(in_c.x[:2], y, atol=1e-6)
