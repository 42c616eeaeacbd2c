"""What the intrinsic Kalman filter says of its own errors: NEES and NIS over a thousand runs."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant.geometry import Budget
from covariant.geometry.lie import SE2, SO3
from covariant.models import GroupSystem, Lagrangian, Motion, advance, pendulum_chain
from covariant.observers import IntrinsicKalman

RUNS = 1000
STEPS = 24
DT = 0.02
FINE = Budget(newton=1, steps=2)


class Sizes(NamedTuple):
    """Standard deviations in metric units: of white acceleration, of a measurement, and of the first velocity."""

    process: float = 0.3
    measurement: float = 0.01
    speed: float = 1.0


def craft() -> GroupSystem:
    """A ship in the plane, its twist (u, v, r), with linear and quadratic drag."""
    inertia = jnp.array([[1.2, 0.0, 0.0], [0.0, 1.8, 0.1], [0.0, 0.1, 0.9]])
    drag = jnp.array([0.3, 0.8, 0.5])
    return GroupSystem(SE2, inertia, dissipation=lambda g, v: -drag * (1 + jnp.abs(v)) * v)


def double_pendulum() -> Lagrangian:
    chain = pendulum_chain((1.0, 0.7), (0.5, 0.4), viscous=(0.05, 0.05))
    return Lagrangian(chain.metric, chain.potential, dissipation=chain.dissipation, coordinates=chain.coordinates)


MODELS = {
    "double pendulum": (double_pendulum(), jnp.array([0.5, -0.8])),
    "body on SO(3)": (GroupSystem(SO3, jnp.diag(jnp.array([1.0, 2.0, 3.5]))), jnp.eye(3)),
    "ship": (craft(), jnp.eye(3)),
}


def root(space, q):
    """Vectors of unit variance in every direction of the metric."""
    return jnp.linalg.cholesky(jnp.linalg.inv(space(q)))


def moved(space, q, step, v):
    """Along a geodesic, the velocity carried in parallel."""
    end = space.transport_along(q, step, v, FINE)
    return Motion(end.q, end.w)


def seen(space, motion, state):
    """(ε, ν) of the truth as the estimate sees it."""
    shot = space.shoot(state.q, motion.q, None, FINE)
    back = space.transport_along(motion.q, -shot.arrival, motion.v, FINE)
    return jnp.concatenate([shot.velocity, back.w - state.v])


@eqx.filter_jit
def squares(model, observer, q0, sizes, key):
    """NEES at the end and the mean NIS of one run, the truth being drawn as the filter believes it is."""
    space, n = model.space, observer.init(q0).v.shape[0]
    process, measurement, speed = sizes
    first, second, rest = jax.random.split(key, 3)

    def drawn(q, key):
        return root(space, q) @ jax.random.normal(key, (n,))

    true = Motion(q0, speed * drawn(q0, first))
    state = observer.init(moved(space, q0, measurement * drawn(q0, second), true.v).q)

    def step(carry, key):
        motion, state = carry
        a, b, c = jax.random.split(key, 3)
        motion = advance(model, 0.0, motion, jnp.zeros(n), DT, 2)
        w1, w2 = process * DT**0.5 * drawn(motion.q, a), process * DT**0.5 * drawn(motion.q, b)
        motion = moved(space, motion.q, DT * (w1 / 2 + w2 / 12**0.5), motion.v + w1)
        y = moved(space, motion.q, measurement * drawn(motion.q, c), motion.v).q
        state, info = observer.step(state, jnp.zeros(n), y, jnp.asarray(DT))
        return (motion, state), info.nis

    (motion, state), nis = jax.lax.scan(step, (true, state), jax.random.split(rest, STEPS))
    error = seen(space, motion, state)
    return error @ jnp.linalg.solve(observer.cov(state), error), nis


def consistency(name: str, sizes: Sizes) -> tuple[np.ndarray, np.ndarray]:
    """NEES (RUNS,) and NIS (RUNS, STEPS) of a filter that knows these sizes, each over the number of its components."""
    model, q0 = MODELS[name]
    n = model.manifold.zero(q0).shape[0]
    process, measurement, speed = (size**2 for size in sizes)
    observer = IntrinsicKalman(model, process, measurement, speed, gate=None, budget=FINE, substeps=2)
    keys = jax.random.split(jax.random.key(1), RUNS)
    over = eqx.filter_vmap(squares, in_axes=(None, None, None, None, 0))
    nees, nis = map(np.asarray, over(model, observer, q0, jnp.asarray(sizes), keys))
    return nees / (2 * n), nis / n


def bound(components: int) -> float:
    """How far the mean of so many squared standard normals is from 1 in 5 of 100 cases."""
    return 1.96 * (2 / components) ** 0.5


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", MODELS)
def test_errors_are_as_large_as_the_filter_says(name):
    """Within the bounds that 95 of 100 consistent filters stay in, of χ² over all runs."""
    model, q0 = MODELS[name]
    n = model.manifold.zero(q0).shape[0]
    nees, nis = consistency(name, Sizes())
    assert abs(nees.mean() - 1) < bound(2 * n * RUNS)
    late = nis[:, STEPS // 2 :]
    assert abs(late.mean() - 1) < bound(n * late.size)
