"""Time of a step of the observers on SO(3) and SE(3), alone and a thousand at a time.

Each group of the table holds one system and one kind of work; `invariant EKF` is the reference.
"""

import jax
import jax.numpy as jnp
import pytest

from covariant.models import free_body, underwater_vehicle
from covariant.observers import EKF, Geodesic, Intrinsic, Salcudean

BATCH = 1000
SYSTEMS = {"SO(3)": free_body(), "SE(3)": underwater_vehicle()}
OBSERVERS = {
    "invariant EKF": lambda m, n: EKF(m, 0.1 * jnp.eye(n), 1e-6 * jnp.eye(n), substeps=1),
    "group": lambda m, n: Intrinsic(m, 10.0, 50.0, substeps=1),
    "riemannian": lambda m, n: Geodesic(m, 10.0, 50.0, substeps=1),
    "salcudean": lambda m, n: Salcudean(m, 100.0, 10.0, substeps=1),
}
CASES = [(s, o) for s in SYSTEMS for o in OBSERVERS if (s, o) != ("SE(3)", "salcudean")]


def step_and_moment(system, name):
    """A step as a function of state, input, measurement and dt, and such arguments, in motion and a little off."""
    model = SYSTEMS[system]
    group, n = model.group, model.group.dimension
    observer = OBSERVERS[name](model, n)
    y = group.exp(0.3 * jnp.ones(n))
    state = observer.init(y @ group.exp(0.02 * jnp.ones(n)))
    field = "momentum" if name == "salcudean" else "v"
    moving = state._replace(**{field: jnp.linspace(0.3, 1.0, n)})
    return lambda *moment: observer.step(*moment), (moving, jnp.ones(n), y, jnp.asarray(0.002))


@pytest.mark.benchmark(max_time=0.5, warmup=False)
@pytest.mark.parametrize(("system", "name"), CASES)
def test_single(benchmark, system, name):
    benchmark.group = f"step on {system}, one at a time"
    step, moment = step_and_moment(system, name)
    compiled = jax.jit(step)
    jax.block_until_ready(compiled(*moment))
    benchmark(lambda: jax.block_until_ready(compiled(*moment)))


@pytest.mark.benchmark(max_time=0.5, warmup=False)
@pytest.mark.parametrize(("system", "name"), CASES)
def test_batched(benchmark, system, name):
    benchmark.group = f"step on {system}, {BATCH} at once"
    step, moment = step_and_moment(system, name)
    many = jax.tree.map(lambda x: jnp.broadcast_to(x, (BATCH, *x.shape)), moment)
    compiled = jax.jit(jax.vmap(step))
    jax.block_until_ready(compiled(*many))
    benchmark(lambda: jax.block_until_ready(compiled(*many)))
