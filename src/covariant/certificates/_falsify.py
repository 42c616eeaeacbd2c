"""The attempt to refute a statement: the slowest point of a region, by sampling and by descent from many starts."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from covariant.certificates._inequalities import length_change
from covariant.certificates._statement import Hypothesis, Statement
from covariant.certificates._subject import Subject, need_steady
from covariant.lowering import Lowered, expand, numbers
from covariant.proofs import Box, check_box

BATCH = 4096
STEPS = 60
"""Number of steps of a descent; the first is a tenth of the region, and each further one shorter by a twentieth."""


def falsify(
    subject: Subject, domain: Box, rate: float, *, attempts: int = 20_000, starts: int = 64, seed: int = 0
) -> Statement:
    """Search for a point of the region that contracts more slowly than `rate` [1/s]; returns the slowest one found.

    - `attempts`: number of random points, half of them on faces of the region.
    - `starts`: number of the slowest of these from which a descent starts.

    The evidence is "sampled": where no slower point was found, nothing is proved. Raises `ValueError` for bounds that
    are not in order, and where the rate is not a number.
    """
    check_box(domain)
    need_steady("falsify", subject, domain)
    both = length_change(subject, lambda coframe, gram, change: jnp.stack([gram, change]).ravel(), lambda z: z)
    value = both.graph(jnp.asarray(domain.low)).entries
    least, point = slowest(pencil(value, domain), domain, attempts, starts, seed)
    held = Hypothesis(
        f"no slower point among {attempts}, nor where a descent from the {starts} slowest ends",
        "sampled",
        "holds" if least >= rate else "fails",
        least - rate,
    )
    return Statement(
        f"squared lengths shrink at no less than {rate:.4g} 1/s; the margin is the least rate found [1/s]",
        (),
        (held,),
        least,
        str(domain),
        tuple(point.tolist()),
    )


class _Rates(NamedTuple):
    """Rates (B,), and the unit vectors (B, 2n) that decrease most slowly."""

    rate: Float[np.ndarray, "B"]
    vector: Float[np.ndarray, "B k"]


def _rates(entries: Float[np.ndarray, "B e"]) -> _Rates:
    gram, change = _two(entries)
    half = np.linalg.inv(np.linalg.cholesky(gram))
    values, vectors = np.linalg.eigh(half @ change @ np.swapaxes(half, 1, 2))
    vector = (np.swapaxes(half, 1, 2) @ vectors[:, :, -1:])[:, :, 0]
    if np.isnan(values).any():
        raise ValueError("falsify: the rate is not a number somewhere in the region; make it smaller")
    return _Rates(-values[:, -1], vector)


def _two(entries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    size = int(np.sqrt(entries.shape[-1] // 2))
    both = entries.reshape(*entries.shape[:-1], 2, size, size)
    return both[..., 0, :, :], both[..., 1, :, :]


class Pencil(NamedTuple):
    """Entries of N and of K (2 k²,) as a graph; and a graph with their derivatives in the `free` variables."""

    value: Lowered
    slopes: Lowered
    free: list[int]


def pencil(value: Lowered, domain: Box) -> Pencil:
    """The graph of N and K (2 k²,), for searches over boxes with the same free variables as the domain."""
    free = np.flatnonzero(domain.high > domain.low).tolist()
    return Pencil(value, expand(value, free, 1), free)


def slowest(form: Pencil, domain: Box, attempts: int, starts: int, seed: int) -> tuple[float, Float[np.ndarray, "d"]]:
    """The least value of −λmax(N⁻¹K) over a box, and its point."""
    rng, d = np.random.default_rng(seed), len(domain.low)
    width = domain.high - domain.low
    least, kept = np.zeros(0), np.zeros((0, d))
    for begin in range(0, attempts, BATCH):
        count = min(BATCH, attempts - begin)
        share = rng.uniform(size=(count, d))
        face = rng.integers(d, size=count)
        share[np.arange(count)[::2], face[::2]] = rng.integers(2, size=len(face[::2]))
        if not begin:
            share[0] = 0.5  # the middle, which often is at rest
        points = np.clip(domain.low + share * width, domain.low, domain.high)
        least = np.concatenate([least, _rates(numbers(form.value, points)).rate])
        kept = np.concatenate([kept, points])
        order = np.argsort(least)[: max(starts, 1)]
        least, kept = least[order], kept[order]
    if starts:
        free = form.free
        z = kept.copy()
        for step in range(STEPS):
            entries, slopes = numbers(form.slopes, z)
            now = _rates(entries)
            better = now.rate < least
            least, kept[better] = np.where(better, now.rate, least), z[better]
            gram, change = _two(slopes)  # (B, f, k, k): of K x = −λ N x, dλ = −xᵀ(dK + λ dN) x
            x = now.vector
            slope = -np.einsum("bi,bfij,bj->bf", x, change + now.rate[:, None, None, None] * gram, x) * width[free]
            size = np.abs(slope).max(axis=1, keepdims=True)
            slope = np.where(size > 0, slope / np.where(size > 0, size, 1.0), 0.0)
            z[:, free] -= 0.1 * 0.95**step * slope * width[free]
            z = np.clip(z, domain.low, domain.high)
    best = int(np.argmin(least))
    return float(least[best]), kept[best]
