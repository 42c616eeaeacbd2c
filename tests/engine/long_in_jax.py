"""What takes long of `test_in_jax.py`."""

import shutil

import jax
import pytest
from test_in_jax import pendulum, rates, same, states

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler, `cc`")


def test_a_batch_of_any_length_is_that_of_jax():
    motion, u = states(1003)
    expected = jax.jit(jax.vmap(rates))(motion, u)
    for count in (1003, 1000, 1):
        some = jax.tree.map(lambda a, count=count: a[:count], (motion, u, expected))
        same(jax.jit(jax.vmap(pendulum()))(*some[:2]), some[2])
    one = jax.tree.map(lambda a: a[0], (motion, u, expected))
    same(pendulum()(*one[:2]), one[2])
    same(jax.jit(pendulum())(*one[:2]), one[2])


@pytest.mark.exhaustive
def test_axes_that_do_not_belong_together_are_each_mapped():
    motion, u = jax.tree.map(lambda a: a[:12], states(1003))
    both = [
        jax.vmap(jax.vmap(each, in_axes=(None, 0)), in_axes=(0, None))(motion, u[:5]) for each in (pendulum(), rates)
    ]
    assert both[0]["v"].shape == (12, 5, 2)
    same(*both)
