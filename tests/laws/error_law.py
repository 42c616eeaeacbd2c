"""The law that the error of an intrinsic observer obeys, measured along a motion of any mechanical system."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import expm

from covariant._integrate import rk8
from covariant.models import acceleration

ALPHA, BETA = 1.2, 0.9


@eqx.filter_jit
def directions(model, x, key):
    """Unit vectors of the metric at x: a velocity, and an error's two parts."""
    raw = jax.random.normal(jax.random.key(key), (3, model.manifold.zero(x).size))
    return jax.vmap(lambda a: a / model.space.norm(x, a))(raw)


@eqx.filter_jit
def deviation_from_linear_law(observer, model, speed, size):
    """Largest distance, over a unit of path, between the error in a parallel frame and `expm(At)` times its start.

    The frame is carried along the truth. `ξ = local(q, q̂)`, and ζ is v̂ carried back to q, to first order, minus v.
    """
    space, manifold = model.space, model.manifold
    q0 = manifold.retract(manifold.origin(), 0.4 * directions(model, manifold.origin(), 2)[0])
    along, first, second = directions(model, q0, 1)
    v0, n = speed * along, len(along)
    xi0, zeta0 = size * first, size * 0.6 * second
    u = jnp.zeros(n if model.inputs is None else model.inputs)
    estimated = manifold.retract(q0, xi0)
    state0 = observer.init(estimated)._replace(v=v0 + zeta0 - space.connection(q0, xi0, v0 + zeta0))

    def flow(s, centres, joint):
        """Everything in charts around where plant and estimate were, which keeps both on their manifold."""
        moved, (v, frame, state) = joint
        q, estimate = (manifold.retract(c, part) for c, part in zip(centres, moved, strict=True))
        carried = jax.vmap(lambda e: -space.connection(q, v, e))(frame)
        slope = observer.flow(s, state._replace(q=estimate), u, q)
        velocities = v, slope.q
        rates = [manifold.local_rate(*each) for each in zip(centres, moved, velocities, strict=True)]
        return tuple(rates), (acceleration(model, s, q, v, u), carried, slope._replace(q=None))

    duration = 1.0 / (1.0 + speed)

    def interval(carry, k):
        centres, beside = carry
        begin, rest = k * duration / 4, (jnp.zeros(n), jnp.zeros(n))
        moved, beside = rk8(lambda s, x: flow(s, centres, x), begin, (rest, beside), duration / 4, 8)
        after = tuple(manifold.retract(c, part) for c, part in zip(centres, moved, strict=True)), beside
        return after, after

    start = ((q0, estimated), (v0, jnp.eye(n), state0._replace(q=None)))
    after = jax.lax.scan(interval, start, jnp.arange(4.0))[1]

    def error(both, beside):
        (q, estimate), (v, frame, state) = both, beside
        xi = manifold.local(q, estimate)
        zeta = state.v + space.connection(q, xi, state.v) - v
        inner = jnp.stack([frame @ space.lower(q, xi), frame @ space.lower(q, zeta)], axis=1)
        return jnp.linalg.solve(space.gram(q, frame), inner).T

    return jax.vmap(error)(*after), jnp.stack([xi0, zeta0]), duration * jnp.arange(1.0, 5.0) / 4, q0


def worst(observer, model, speed, size=1e-5, alpha=ALPHA):
    found, start, t, q0 = deviation_from_linear_law(observer, model, jnp.asarray(speed), jnp.asarray(size))
    expected = np.stack([expm(np.array([[-alpha, 1.0], [-BETA, 0.0]]) * s) @ np.asarray(start) for s in np.asarray(t)])
    gap = jnp.asarray(np.asarray(found) - expected).reshape(-1, start.shape[1])
    return float(lengths(model.space, q0, gap).max()) / size


@eqx.filter_jit
def lengths(space, x, w):
    return jax.vmap(lambda a: space.norm(x, a))(w)
