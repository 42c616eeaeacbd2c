"""Time of a right-hand side and of a step, alone and a thousand at a time, and of their compilation.

Each group holds one size and one kind of work, so that the observers stand next to each other as ratios of `copy`.
"""

import jax
import jax.numpy as jnp
import pytest
from moments import BATCH, OBSERVERS, SIZES, Moment, moment


def flow(case: Moment):
    """The right-hand side, as a function of state, input and measurement."""
    return lambda state, u, y, dt: case.observer.flow(state.t, state, u, y)


def step(case: Moment):
    """Prediction and correction. A function of its own: `jax.jit` takes no bound method of an object with arrays."""
    return lambda *moment: case.observer.step(*moment)


KINDS = {"flow": flow, "step": step}
CASES = [(kind, name) for kind in KINDS for name in OBSERVERS if (kind, name) != ("flow", "ekf")]  # it has no flow
each = pytest.mark.parametrize(("kind", "name"), CASES)
briefly = pytest.mark.benchmark(max_time=0.5, warmup=False)
sized = pytest.mark.parametrize("n", SIZES)


@briefly
@sized
@each
def test_single(benchmark, kind, name, n):
    """One call at a time: what a controller in Python would see, dispatch included."""
    benchmark.group = f"{kind}, one at a time, n = {n}"
    case = moment(name, n)
    compiled = jax.jit(KINDS[kind](case))
    jax.block_until_ready(compiled(*case[1:]))
    benchmark(lambda: jax.block_until_ready(compiled(*case[1:])))


@briefly
@sized
@each
def test_batched(benchmark, kind, name, n):
    """A thousand at once: divide by a thousand for the time of one."""
    benchmark.group = f"{kind}, {BATCH} at once, n = {n}"
    case = moment(name, n)
    many = jax.tree.map(lambda x: jnp.broadcast_to(x, (BATCH, *x.shape)), case[1:])
    compiled = jax.jit(jax.vmap(KINDS[kind](case)))
    jax.block_until_ready(compiled(*many))
    benchmark(lambda: jax.block_until_ready(compiled(*many)))


@sized
@each
def test_compilation(benchmark, kind, name, n):
    """From the Python function to machine code, tracing included."""
    benchmark.group = f"compiling {kind}, n = {n}"
    case = moment(name, n)

    def compile_afresh():
        jax.clear_caches()
        return jax.jit(KINDS[kind](case)).lower(*case[1:]).compile()

    benchmark.pedantic(compile_afresh, rounds=1)
