"""Regression of changes of velocity: where a fit by predictions starts, and which other reading of the log explains it.

Along the measured positions and reference velocities of a window the model says how the velocity changes. Where forces
are linear in a parameter, as friction and scales are, these changes are too, and no motion has to be predicted: the
search neither diverges nor stops where a poor model's predictions have lost the motion. Noise in the velocities biases
the result, so that it is a place to start from, and no fit.

Source: Ljung 1999, System Identification, section 7.3, for linear regressions from filtered equations.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant.calibration._least_squares import Blocks, Fixed, Point, minimise
from covariant.calibration.identification._innovations import FINEST
from covariant.calibration.identification._predict import lagged, mean_square
from covariant.calibration.identification._unknowns import Unknowns
from covariant.calibration.identification._windows import Windows
from covariant.models import acceleration

PIECES = 4
"""Pieces of a window over which changes of velocity are compared."""
ROUNDS = 3
"""Number of regressions, each with the scale of the errors that the one before left."""
SCALED = 10.0
"""Factor by which each first value is multiplied, and divided, for other places to start from."""

FIRST = "the first values"

NumpyArray = np.ndarray


class Regression(NamedTuple):
    """Relative changes z (p,) of the parameters, and the errors (W, k, n) of changes of velocity that they leave."""

    z: Float[NumpyArray, "p"]
    errors: Float[NumpyArray, "W k n"]

    @property
    def loss(self) -> float:
        """Negative log-likelihood, up to a constant; infinite where the model has no finite accelerations."""
        columns = np.reshape(self.errors, (-1, self.errors.shape[-1])).T
        with np.errstate(divide="ignore"):
            return float(np.sum(np.log(self.sizes) * columns.shape[1]))

    @property
    def sizes(self) -> Float[NumpyArray, "n"]:
        """Robust root mean squares (n,) of the errors."""
        return np.sqrt([mean_square(column) for column in np.reshape(self.errors, (-1, self.errors.shape[-1])).T])


def regress(unknowns: Unknowns, windows: Windows, z: Float[NumpyArray, "p"], rounds: int = ROUNDS) -> Regression:
    """Parameters that explain the changes of velocity best, from a start z; with no rounds the errors at z itself."""
    changes = _Changes.of(unknowns, windows)
    point = Point.at(changes, z, np.zeros((len(windows.t), 0)))
    for _ in range(rounds if np.isfinite(point.blocks.rest).all() else 0):
        changes = changes.scaled(point.blocks.rest)
        point, _ = minimise(changes, Point.at(changes, point.z, point.s), Fixed.nothing(len(z)))
    return Regression(point.z, point.blocks.rest)


def starts(unknowns: Unknowns, windows: Windows, numbers: Sequence[str]) -> dict[str, Float[NumpyArray, "p"]]:
    """Places to start a fit from, by name: the first values, the regression, and the best with one of them scaled, on
    all machines."""
    first = regress(unknowns, windows, np.zeros(len(unknowns.first)), 0)
    tried = [
        (f"the first values with {name} {word} {SCALED:g}", regress(unknowns, windows, z, 0))
        for word, factor in (("times", SCALED), ("over", 1 / SCALED))
        for name, own in zip(numbers, np.asarray(unknowns.parts).T, strict=True)
        for z in [functools.reduce(lambda z, j: unknowns.multiplied(z, j, factor), np.unique(own).tolist(), first.z)]
    ]
    name, scaled = min(tried, key=lambda each: each[1].loss)
    regressions = [regress(unknowns, windows, each.z) for each in (first, scaled) if np.isfinite(each.loss)]
    found = {FIRST: first.z}
    if regressions:
        found["the regression"] = min(regressions, key=lambda each: each.loss).z
    return found | ({name: scaled.z} if scaled.loss < first.loss else {})


class _Changes(NamedTuple):
    """Residuals of a regression: errors of changes of velocity over pieces of W windows, in units of their scale (n,).

    `seen` (W, L + 1) is the last row up to each one in which the whole position is measured.
    """

    unknowns: Unknowns
    windows: Windows
    seen: NumpyArray
    scale: NumpyArray

    @classmethod
    def of(cls, unknowns: Unknowns, windows: Windows) -> "_Changes":
        t, y, v = (np.asarray(part) for part in (windows.t, windows.y, windows.v))
        whole = np.isfinite(y).reshape(*t.shape, -1).all(axis=2) & np.isfinite(v).all(axis=2)
        # A window begins with a whole row, so that each row has one at or before it.
        seen = np.maximum.accumulate(np.where(whole, np.arange(t.shape[1]), 0), axis=1)
        return cls(unknowns, jax.tree.map(jnp.asarray, windows), seen, np.ones(v.shape[-1]))

    def scaled(self, errors: Float[NumpyArray, "W k n"]) -> "_Changes":
        motion = np.sqrt(np.mean(np.asarray(self.windows.v) ** 2, axis=(0, 1)))
        scale = np.sqrt([mean_square(column) for column in errors.reshape(-1, errors.shape[-1]).T])
        return self._replace(scale=np.maximum(scale, FINEST * motion + 1e-300))

    def blocks(self, z: NumpyArray, s: NumpyArray) -> Blocks:
        del s  # the windows have no unknowns to themselves
        parts = self.windows, jnp.asarray(self.seen), jnp.asarray(self.scale)
        return jax.tree.map(np.asarray, _evaluate(self.unknowns, *parts, jnp.asarray(z)))

    def moved(self, z: NumpyArray, dz: NumpyArray) -> NumpyArray:
        return self.unknowns.moved(z, dz)


@eqx.filter_jit
def _evaluate(unknowns: Unknowns, windows: Windows, seen: Array, scale: Array, z: Array) -> Blocks:
    """Blocks of the windows; `rest` are the errors in units of the velocities."""
    # Edges of the pieces, in rows.
    edges = np.linspace(0, windows.t.shape[1] - 1, min(PIECES, windows.t.shape[1] - 1) + 1).round().astype(int)

    def window(rows, seen, t, y, v, machine):
        y, v = y[seen], v[seen]
        own, own_z, part = unknowns.of_machine(machine, z)

        def errors(z):
            model, lag = own.make(own.values(z))
            u = lagged(jnp.asarray(windows.inputs), jnp.asarray(windows.steps), lag)[rows]

            def rate(t, q, v, u):
                return acceleration(model, t, q, v, u)

            def ends(rows):
                return jnp.concatenate([rows[:-1], rows[1:]])

            # The trapezoidal rule, with the input that acts in the step at both of its ends.
            rates = jax.vmap(rate)(ends(t), ends(y), ends(v), jnp.concatenate([u, u]))
            begin, end = jnp.split(rates, 2)
            step = jnp.diff(t)[:, None] * (begin + end) / 2
            total = jnp.concatenate([jnp.zeros_like(step[:1]), jnp.cumsum(step, axis=0)])
            raw = jnp.diff(v[edges], axis=0) - jnp.diff(total[edges], axis=0)
            return (raw / scale[None]).ravel(), raw

        slope, raw = jax.jacfwd(errors, has_aux=True)(own_z)
        return Blocks.one((raw / scale[None]).ravel(), unknowns.of_all(part, slope), len(z), raw)

    return jax.vmap(window)(windows.rows, seen, windows.t, windows.y, windows.v, windows.machine)
