"""Tries to refute a contraction rate: searches the slowest point of a region by sampling and gradient descent.

Source: Riedmiller & Braun 1993, A direct adaptive method for faster backpropagation learning: the RPROP algorithm, IEEE
International Conference on Neural Networks, for the descent.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from covariant._domains import Count, Finite, Whole, check_numbers
from covariant.certificates.base import ErrorSystem, Hypothesis, Statement, length_change, need_steady
from scalargraph import Lowered, expand, numbers
from scalargraph.errors import InputError
from scalargraph.proofs import Box, check_box

BATCH = 4096
STEPS = 60
"""Number of steps of a descent; the first is a tenth of the region in each variable."""
GROWTH = 1.2
"""Factor on the step of a variable while its slope keeps its sign; if the sign changes, the step is halved."""


@check_numbers
def falsify(
    error_system: ErrorSystem,
    domain: Box,
    rate: Finite,
    *,
    attempts: Count = 20_000,
    starts: Whole = 64,
    seed: Whole = 0,
) -> Statement:
    """Search for a point of the region that contracts more slowly than a rate.

    Args:
        error_system: the system, as from `error_system` or `virtual`.
        domain: the box of its variables.
        rate: rate [1/s] of squared lengths.
        attempts: number of random points, half of them on faces of the region.
        starts: number of descents, from the slowest of these points.
        seed: seed of the random numbers.

    Returns:
        A statement with the slowest point, and its rate as margin. The evidence is "sampled": a search that finds no
        slower point proves nothing.

    Raises:
        ValueError: bounds are not in order or leave a single point, the rate, or the rate at a point of the region, is
            NaN, there are no attempts, or the flow depends on time.

    Example:
        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> from covariant.certificates import falsify, virtual
        >>> from covariant.models import StateSpace
        >>> from covariant.observers import Contracting
        >>> from scalargraph.proofs import box
        >>> model = StateSpace(lambda t, x, u: -x, lambda t, x, u: x, coordinates=("x",))
        >>> system = virtual(Contracting(model, jnp.eye(1), jnp.zeros(1)), np.eye(1))  # x' = −x + (z − x)
        >>> domain = box(x=(-1.0, 1.0), z_y1=(-1.0, 1.0), zdot_y1=(0.0, 0.0))
        >>> result = falsify(system, domain, rate=3.0, attempts=100, starts=4)
        >>> result.short, round(result.margin, 6)
        ('holds (sampled)', 4.0)
    """
    check_box(domain)
    if not (domain.low < domain.high).any():
        raise InputError("falsify: the domain is a single point; give bounds that differ")
    need_steady("falsify", error_system, domain)
    matrices = length_change(error_system, lambda coframe, gram, change: jnp.stack([gram, change]).ravel())
    value = matrices.graph(jnp.asarray(domain.low)).entries
    least, point = slowest(pencil(value, domain), domain, attempts, starts, seed)
    text = f"no slower point among {attempts}, nor where a descent from the {starts} slowest ends"
    premise = Hypothesis(text, "sampled", "holds" if least >= rate else "fails", least - rate)
    claim = f"squared lengths shrink at no less than {rate:.4g} 1/s; the margin is the least rate found [1/s]"
    return Statement(claim, (), (premise,), least, str(domain), tuple(point.tolist()))


class _Rates(NamedTuple):
    """Rates (B,), and the unit vectors (B, 2n) whose length decreases most slowly."""

    rate: Float[np.ndarray, "B"]
    vector: Float[np.ndarray, "B k"]


def _rates(entries: Float[np.ndarray, "B e"]) -> _Rates:
    gram, change = _split(entries)
    # K x = μ N x becomes an ordinary eigenvalue problem for L⁻¹ K L⁻ᵀ, N = LLᵀ; x = L⁻ᵀ y has xᵀNx = 1.
    half = np.linalg.inv(np.linalg.cholesky(gram))
    values, vectors = np.linalg.eigh(half @ change @ np.swapaxes(half, 1, 2))
    # `eigh` sorts in ascending order: the last eigenvalue belongs to the vector that decreases most slowly.
    vector = (np.swapaxes(half, 1, 2) @ vectors[:, :, -1:])[:, :, 0]
    if np.isnan(values).any():
        raise InputError("falsify: the rate is not a number somewhere in the region; make it smaller")
    return _Rates(-values[:, -1], vector)


def _split(entries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    size = int(np.sqrt(entries.shape[-1] // 2))
    both = entries.reshape(*entries.shape[:-1], 2, size, size)
    return both[..., 0, :, :], both[..., 1, :, :]


class Pencil(NamedTuple):
    """The matrices N and K of a generalised eigenvalue problem, as graphs.

    Attributes:
        value: entries (2 k²,) of N and of K.
        slopes: these entries with their derivatives in the free variables.
        free: indices of the variables with a width.
    """

    value: Lowered
    slopes: Lowered
    free: list[int]


def pencil(value: Lowered, domain: Box) -> Pencil:
    """Prepare the graph of N and K for searches over boxes with the same free variables as the domain."""
    free = np.flatnonzero(domain.high > domain.low).tolist()
    return Pencil(value, expand(value, free, 1), free)


def slowest(form: Pencil, domain: Box, attempts: int, starts: int, seed: int) -> tuple[float, Float[np.ndarray, "d"]]:
    """Search for the least value of −λmax(N⁻¹K) over a box."""
    rng, d = np.random.default_rng(seed), len(domain.low)
    width = domain.high - domain.low
    least, best_points = np.zeros(0), np.zeros((0, d))
    for begin in range(0, attempts, BATCH):
        count = min(BATCH, attempts - begin)
        share = rng.uniform(size=(count, d))
        face = rng.integers(d, size=count)
        # Every second point lies on a face, since extremes are more often at a bound of a variable than inside.
        share[np.arange(count)[::2], face[::2]] = rng.integers(2, size=len(face[::2]))
        if not begin:
            share[0] = 0.5  # the middle, which often is at rest
        points = np.clip(domain.low + share * width, domain.low, domain.high)
        least = np.concatenate([least, _rates(numbers(form.value, points)).rate])
        best_points = np.concatenate([best_points, points])
        order = np.argsort(least)[: max(starts, 1)]
        least, best_points = least[order], best_points[order]
    if starts:
        free = form.free
        z = best_points.copy()
        length, before = np.full((len(z), len(free)), 0.1), np.zeros((len(z), len(free)))
        for _ in range(STEPS):
            entries, slopes = numbers(form.slopes, z)
            current = _rates(entries)
            better = current.rate < least
            least, best_points[better] = np.where(better, current.rate, least), z[better]
            gram, change = _split(slopes)  # (B, f, k, k): of K x = −λ N x, dλ = −xᵀ(dK + λ dN) x
            x = current.vector
            slope = -np.einsum("bi,bfij,bj->bf", x, change + current.rate[:, None, None, None] * gram, x) * width[free]
            # Only the signs of slopes count, so that the descent also converges in flat directions. There is no line
            # search, so that the effort is known in advance.
            direction = np.sign(slope)
            turned = direction * before
            length = np.clip(np.where(turned > 0, GROWTH * length, np.where(turned < 0, length / 2, length)), 0, 0.25)
            before = direction
            z[:, free] -= length * direction * width[free]
            z = np.clip(z, domain.low, domain.high)
    best = int(np.argmin(least))
    return float(least[best]), best_points[best]
