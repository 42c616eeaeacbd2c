"""Selects the independent rows of a constraint, and finds a configuration that satisfies it, before a leaf is used."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._functional import Functional
from covariant.geometry._manifold import Configuration
from scalargraph import on_batches
from scalargraph.errors import InputError

SINGULAR = 1e-6
"""Smallest pivot at which a matrix with a unit diagonal counts as regular."""
SAMPLES = 24
"""Random configurations of the leaf at which the rows of the constraint are compared."""
CLOSED = 1e-6
"""Value of the constraint below which a loop counts as closed."""


def rows_of(space: Any, constraint: Callable, x: Configuration) -> Float[Array, "m n"]:
    """Differentials of a constraint at a configuration, with respect to the components of a displacement."""
    manifold = space.manifold
    return jax.jacrev(lambda a: constraint(manifold.nudged(x, a)))(manifold.zero(x))


class Look(NamedTuple):
    """Functions of configurations that NumPy evaluates, so that a few evaluations need no compilation."""

    rows: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    retract: Callable[[np.ndarray, np.ndarray], np.ndarray]

    @classmethod
    def of(cls, space: Any, constraint: Callable, x: Configuration) -> "Look":
        rows = on_batches(lambda x: (constraint(x), rows_of(space, constraint, x)), x)
        retract = on_batches(space.manifold.retract, x, space.manifold.zero(x))
        return cls(
            lambda x: tuple(part[0] for part in rows(x[None])),
            lambda x, s: retract(x[None], s[None])[0],
        )


def closed(look: Look, near: np.ndarray) -> np.ndarray:
    """A configuration on the leaf, by Newton steps of least length, which also work if rows are dependent."""
    x, left = near, np.inf
    for _ in range(50):
        c, rows = look.rows(x)
        last, left = left, float(np.max(np.abs(c)))
        if left < CLOSED and left >= last / 2:  # the remaining value is rounding
            break
        x = look.retract(x, -np.linalg.pinv(rows, rcond=SINGULAR) @ c)
    if not left < CLOSED:
        raise InputError(
            f"the loop does not close near the given configuration: a gap of {left:.3g} is left; give the assembly, "
            "a configuration in which it is closed as it is built"
        )
    return x


def independent(look: Look, constraint: Callable, start: np.ndarray) -> Callable:
    """The constraint without rows that depend on others in the same way everywhere on the leaf."""
    rows = [look.rows(x)[1] for x in _samples(look, start)]
    ranks = [np.linalg.matrix_rank(a, tol=SINGULAR * np.linalg.norm(a, 2)) for a in rows]
    least, most, count = min(ranks), max(ranks), len(rows[0])
    if least < most:
        raise InputError(
            f"the rows of the loop have rank {least} and {most} along its motion: at such a change point it can go on "
            "in two ways; keep away from it, or couple the links otherwise"
        )
    if most == count:
        return constraint
    # A combination that is zero at all samples is an eigenvector of this sum with the eigenvalue zero.
    values, vectors = np.linalg.eigh(sum(a @ a.T / np.linalg.norm(a, 2) ** 2 for a in rows) / len(rows))
    if np.sum(values > SINGULAR**2) > most:
        raise InputError(
            f"the {count} rows of the loop have rank {most}, and depend on each other differently from place to place: "
            "an overconstrained linkage, which closes by its exact lengths alone; open it at another joint, or give "
            "the independent rows"
        )
    # Whole rows are selected, not combinations of rows, so that their loads have a physical meaning.
    import scipy.linalg

    order = scipy.linalg.qr(vectors[:, values > SINGULAR**2].T, pivoting=True)[-1]
    return _Rows(constraint, tuple(sorted(order[:most].tolist())))


class _Rows(Functional):
    """Some rows of a constraint."""

    constraint: Callable[[Configuration], Array]
    kept: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, x: Configuration) -> Float[Array, "k"]:
        c = self.constraint(x)
        return jnp.stack([c[i] for i in self.kept])


def _samples(look: Look, start: np.ndarray) -> list[np.ndarray]:
    """Configurations of a random walk along the leaf."""
    random, samples, x = np.random.default_rng(0), [start], start
    for _ in range(SAMPLES):
        rows = look.rows(x)[1]
        step = random.normal(size=rows.shape[1])
        step = step - np.linalg.pinv(rows, rcond=SINGULAR) @ (rows @ step)
        try:
            x = closed(look, look.retract(x, 0.3 * step / np.linalg.norm(step)))
        except InputError:  # beyond the end of the motion; the walk continues from the previous configuration
            continue
        samples.append(x)
    return samples
