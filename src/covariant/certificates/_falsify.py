"""The attempt to break a statement: the worst point of a box, by sampling and by descent from many starts."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._linalg import whiten
from covariant.certificates._certificate import Certificate
from covariant.certificates._contraction import contraction_matrix
from covariant.certificates._prove import Box, check_box
from covariant.certificates._region import Subject

BATCH = 8192
STEPS = 60
"""Steps of a descent; the first goes over a tenth of the box, each further one is shorter by a twentieth."""


def worst(
    score: Callable[[Array], Array], domain: Box, *, attempts: int = 20_000, starts: int = 64, seed: int = 0
) -> tuple[float, Float[np.ndarray, "d"]]:
    """The least value that `score`: `z (d,) -> ()` was seen to take in the domain, and where.

    `attempts` random points, half of them on the faces of the box, then a descent along the gradient from the `starts`
    worst of them. A value that is not a number counts as worst of all.
    """
    check_box(domain)
    low, high = jnp.asarray(domain.low), jnp.asarray(domain.high)

    @jax.jit
    def look(points):
        return jax.lax.map(score, points, batch_size=BATCH)

    def value(z):
        found = score(z)
        return jnp.where(jnp.isnan(found), -jnp.inf, found)

    @jax.jit
    def descend(points):
        slope = jax.vmap(jax.grad(score))

        def step(i, now):
            z, best, at = now
            g = slope(z) * (high - low)
            size = jnp.max(jnp.abs(g), axis=1, keepdims=True)
            g = jnp.nan_to_num(jnp.where(size > 0, g / size, 0.0))
            z = jnp.clip(z - 0.1 * 0.95**i * g * (high - low), low, high)
            found = jax.vmap(value)(z)
            better = found < best
            return z, jnp.where(better, found, best), jnp.where(better[:, None], z, at)

        return jax.lax.fori_loop(0, STEPS, step, (points, jax.vmap(value)(points), points))[1:]

    rng = np.random.default_rng(seed)
    least, kept = np.full(0, np.inf), np.zeros((0, len(domain.low)))
    for begin in range(0, attempts, 16 * BATCH):
        count = min(16 * BATCH, attempts - begin)
        share = rng.uniform(size=(count, len(domain.low)))
        face = rng.integers(len(domain.low), size=count)
        share[np.arange(count)[::2], face[::2]] = rng.integers(2, size=len(face[::2]))
        points = np.clip(domain.low + share * (domain.high - domain.low), domain.low, domain.high)
        found = np.nan_to_num(np.asarray(look(jnp.asarray(points))), nan=-np.inf)
        least, kept = np.concatenate([least, found]), np.concatenate([kept, points])
        order = np.argsort(least)[:starts]
        least, kept = least[order], kept[order]
    if starts and np.isfinite(least[0]):
        least, kept = (np.asarray(a) for a in descend(jnp.asarray(kept)))
    best = int(np.argmin(least))
    return float(least[best]), np.asarray(kept[best])


def rate_at(subject: Subject, z: Array) -> Array:
    """The largest rate at which the flow contracts at the point z of a region [1/s]."""
    point, t = subject.at(z), jnp.zeros((), z.dtype)
    change = contraction_matrix(point.flow, point.metric, t, point.x)
    return -jnp.linalg.eigvalsh(whiten(point.metric.gram(t, point.x), change))[-1]


def falsify(subject: Subject, domain: Box, rate: float, *, attempts: int = 20_000, seed: int = 0) -> Certificate:
    """Does some point of the region contract more slowly than `rate` [1/s]? The slowest point found says.

    The evidence is "sampled": that none was found proves nothing. Raises `ValueError` for bounds that are not in order.
    """
    slowest, z = worst(functools.partial(rate_at, subject), domain, attempts=attempts, seed=seed)
    return Certificate(
        f"squared lengths shrink at no less than {rate:.4g} 1/s; the margin is the least rate found [1/s]",
        "holds" if slowest >= rate else "fails",
        slowest,
        str(domain),
        "sampled",
        tuple(z.tolist()),
    )
