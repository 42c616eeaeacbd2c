"""An observer with an operation that no graph has runs through JAX by itself, and the reason names the operation."""

import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.core import ShapedArray
from jax.extend import core
from jax.interpreters import ad, batching, mlir

from covariant import models, observers
from covariant.engine import choose, run_log
from covariant.engine._choice import FEWEST_ROWS
from covariant.engine._kernel import KernelForm
from covariant.signals import Record

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler, `cc`")

UNKNOWN = core.Primitive("of_a_later_release")
UNKNOWN.def_abstract_eval(lambda x: ShapedArray(x.shape, x.dtype))
UNKNOWN.def_impl(jax.jit(UNKNOWN.bind))
mlir.register_lowering(UNKNOWN, mlir.lower_fun(jnp.sin, multiple_results=False))
ad.defjvp(UNKNOWN, lambda g, x: g * jnp.cos(x))
batching.primitive_batchers[UNKNOWN] = lambda x, axes: (UNKNOWN.bind(*x), axes[0])


def observer(sine) -> observers.StateEKF:
    model = models.StateSpace(lambda t, x, u: jnp.stack([x[1], -sine(x[0])]), lambda t, x, u: x[:1])
    return observers.StateEKF(model, 1e-2 * jnp.eye(2), 1e-4 * jnp.eye(1), jnp.zeros(2), jnp.eye(2))


@pytest.mark.exhaustive
def test_the_automatic_engine_goes_on_with_jax_and_says_which_primitive_it_was():
    t = np.arange(200) / 100.0
    record = Record(t, np.zeros((200, 0)), np.sin(t)[:, None])
    reason = "jax: the primitive 'of_a_later_release' has no graph of scalars"
    for asked in ("auto", "c"):
        assert str(choose(observer(UNKNOWN.bind), KernelForm((1,), 0), FEWEST_ROWS, asked)).startswith(reason)
    run, name = run_log(observer(UNKNOWN.bind), record, engine="c")
    assert name.startswith(reason)
    known, _ = run_log(observer(jnp.sin), record, engine="jax")
    np.testing.assert_allclose(run.estimate, known.estimate, rtol=1e-9, atol=1e-9)
