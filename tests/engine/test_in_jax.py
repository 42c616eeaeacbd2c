"""Compiled C called from programs of JAX: what JAX itself computes, for one state and for batches of any length."""

import functools
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.engine import _in_jax, compiled
from covariant.models import Motion
from scalargraph import LoweringError

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler, `cc`")
PENDULUM = models.pendulum_chain(viscous=(0.1, 0.1), coulomb=(0.05, 0.02))


def rates(motion, u):
    """The rates of a double pendulum, its angle as an observer sees it, and whether it is slow, which is no real."""
    q, v = motion
    a = models.acceleration(PENDULUM, jnp.zeros((), q.dtype), q, v, u)
    return {"v": a, "angle": jnp.arctan2(jnp.sin(q[0]), jnp.cos(q[0])), "slow": jnp.abs(v).max() < 1.0}


@functools.cache
def states(count: int, dtype=np.float64):
    q, v, u = np.random.default_rng(0).uniform(-4, 4, (3, count, 2)).astype(dtype)
    return Motion(jnp.asarray(q), jnp.asarray(v)), jnp.asarray(u)


@functools.cache
def pendulum():
    one = jnp.zeros(2)
    return compiled(rates, Motion(one, one), one)


def same(found, expected, rtol=1e-11):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for ours, theirs in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert ours.dtype == theirs.dtype
        np.testing.assert_allclose(ours, theirs, rtol=rtol, atol=100 * rtol)


def test_what_is_no_number_stays_in_its_lane():
    motion, u = jax.tree.map(lambda a: a[:11], states(1003))
    broken = motion._replace(q=motion.q.at[3].set(jnp.nan))
    whole, found = jax.vmap(pendulum())(motion, u)["v"], jax.vmap(pendulum())(broken, u)["v"]
    assert np.isnan(found[3]).all()
    np.testing.assert_array_equal(np.delete(found, 3, axis=0), np.delete(whole, 3, axis=0))


def test_single_precision_has_twice_the_lanes():
    def swing(q):
        return jnp.sin(q) * q[::-1], q.sum() ** 2

    q = states(1003, np.float32)[0].q
    found = jax.vmap(compiled(swing, q[0]))(q)
    same(found, jax.vmap(swing)(q), 1e-6)


def test_what_cannot_be_done_is_told(monkeypatch):
    one = jnp.zeros(2)
    with pytest.raises(NotImplementedError, match="rates as compiled C has no derivative"):
        jax.grad(lambda u: pendulum()(Motion(one, one), u)["v"].sum())(one)
    with pytest.raises(ValueError, match=r"float64\[3\].*it was compiled for.*float64\[2\]"):
        pendulum()(Motion(one, one), jnp.zeros(3))
    with pytest.raises(ValueError, match=r"all of them one; got float32, float64"):
        compiled(jnp.add, one, one.astype(np.float32))
    with pytest.raises(ValueError, match="at least one number"):
        compiled(jnp.sin, jnp.zeros(0))
    with pytest.raises(LoweringError, match=r"linalg|eigh"):
        compiled(jnp.linalg.eigvalsh, jnp.eye(3))
    monkeypatch.setattr(_in_jax, "compiler", lambda: None)
    with pytest.raises(OSError, match="there is no C compiler `cc`: install one"):
        compiled(jnp.sin, one)
