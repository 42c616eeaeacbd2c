"""Numbers of a model for which it predicts a log best: multiple shooting with free initial states, robust to outliers.

Over each window of the log the model predicts from an initial state that is free, and the errors of the positions
decide. They are weighed by the pseudo-Huber loss in units of their own scale, which is estimated along with the
numbers. In each step of Levenberg and Marquardt the initial states are eliminated window by window, so that the system
to be solved is as small as the numbers are few; and one program is compiled, for errors and derivatives together.

Source: Bock 1983 for multiple shooting; Marquardt 1963, and Madsen, Nielsen & Tingleff 2004, section 3.2, for steps;
Huber 1981, Robust Statistics, sections 6.3 and 7.6, for scale and covariance; White 1982 for the sandwich by windows.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from covariant.identification._predict import differences, follow, lagged, needed_substeps
from covariant.identification._windows import Windows
from covariant.models import Family, Motion

ROUNDS = 3
"""How often scales of the errors and undetermined combinations are found anew, after a search each."""
MOST_STEPS = 25
"""Largest number of Levenberg–Marquardt steps in a round."""
TOLERANCE = 3e-3
"""A step that is predicted to lower half the sum of squares, in units of the errors' variance, by less ends a round: it
moves no number by more than a hundredth of its standard error."""
HUBER = 3.0
"""Errors beyond so many of their scales pull with a constant force: they are outliers."""
BROAD = 3.0
"""Standard deviation of the prior: a first value is right within a factor of e³. It decides only where the log is
silent; a number of the log with a standard error of 10 % it moves by a thousandth of that error."""
UNKNOWN = 1.0
"""A combination of relative changes with a larger standard error is not determined: not even within a factor e."""
HELD = 1e3
"""Weight that holds an undetermined combination at its first value, in scales of the errors."""
PURE = 0.2
"""A number is determined by itself where all undetermined combinations, changed by all of their size, change it by a
smaller fraction; its standard error grows by that change."""
SMALL = 0.01
"""Parts of an undetermined combination below this fraction of the largest are taken for none."""
FINEST = 1e-6
"""Least scale of the errors, as a fraction of how far the positions move in a window: below it is rounding."""
ROUNDING = 1e-11
"""Information about a combination, relative to the greatest, that is nothing but rounding."""

NumpyArray = np.ndarray


class Fit(NamedTuple):
    """The result of a fit.

    - `names` (p of them), `first`, `values` (p,): the numbers, before and after.
    - `standard_errors` (p,): robust to errors that are alike within a window; NaN where a number is not determined.
    - `undetermined` (d, p): relative changes of the numbers of which the log shows nothing, as rows; each row has an
      entry of 1 in a number that is in no other row. Along them the numbers stay where they were; but a number that
      was made smaller until the log could not tell it from zero is as small as it was found.
    - `scale` (n,): robust standard deviation of the errors of the positions over the windows [units of the frame].
    - `steps`: number of steps taken.
    """

    names: tuple[str, ...]
    first: Float[NumpyArray, "p"]
    values: Float[NumpyArray, "p"]
    standard_errors: Float[NumpyArray, "p"]
    undetermined: Float[NumpyArray, "d p"]
    scale: Float[NumpyArray, "n"]
    steps: int

    @property
    def determined(self) -> Bool[NumpyArray, "p"]:
        """Whether the log determines each number by itself."""
        return np.isfinite(self.standard_errors)


def fit(family: Family, windows: Windows, told: Callable[[int, int], object] = lambda *_: None) -> Fit:
    """The numbers of a family for which its model predicts the windows best.

    - `windows`: of one log or several, from `windows`.
    - `told`: called with the numbers of the round and of its step before each step, from 0.

    Positive numbers are sought by their logarithms. What the log does not determine keeps its first value, and is named
    by `Fit.undetermined`. Raises `ValueError` where the model's first prediction is not finite.
    """
    windows = jax.tree.map(jnp.asarray, windows)
    model = family.file.need_mechanical(family.file.name, "numbers are fitted for")
    problem = _Problem(family.make, jnp.asarray(family.first), family.positive, needed_substeps(model, windows))
    now = _begin(problem, windows)
    held, taken = np.zeros((len(family.first),) * 2), 0
    for k in range(ROUNDS):
        now, steps = _descend(problem, windows, now, held, functools.partial(told, k))
        now = _at(problem, windows, now.z, now.s, np.asarray(now.blocks.scale))
        taken += steps
        if k < ROUNDS - 1:
            held = _silent(now.blocks)
    covariance = _sandwich(now.blocks, held)
    z = now.z - held @ now.z  # what is held is held by a large weight, which leaves a trace
    slopes = np.asarray(problem.slopes(z))
    values = np.asarray(problem.values(z))
    rows = _rows(held, slopes / np.where(values == 0, 1.0, values))
    part = np.sqrt(np.sum(rows**2, axis=0))
    variance = slopes**2 * np.diagonal(covariance) + (values * part * UNKNOWN) ** 2
    # The last search may have made a number so small that it has lost its influence on the way.
    small = np.asarray(problem.positive) & (part < PURE) & (np.diagonal(covariance) > UNKNOWN**2)
    rows = np.concatenate([rows, np.eye(len(small))[small]])
    errors = np.where((part < PURE) & ~small, np.sqrt(np.maximum(variance, 0.0)), np.nan)
    return Fit(family.names, family.first, values, errors, rows, np.asarray(now.scale), taken)


class _Problem(NamedTuple):
    """What is fitted: `make (p,) -> (model, lag)`, the first values (p,), which are positive, and the substeps."""

    make: Callable[[Array], tuple[Any, Any]]
    first: Float[Array, "p"]
    positive: tuple[bool, ...]
    substeps: int

    @property
    def size(self) -> Float[Array, "p"]:
        """What a relative change of one is: the first value, or one unit where that is zero."""
        return jnp.abs(self.first) + jnp.equal(self.first, 0).astype(self.first.dtype)

    def values(self, z) -> Float[Array, "p"]:
        """The numbers at relative changes z (p,): logarithms of ratios for positive ones."""
        ratio = jnp.asarray(self.first * jnp.exp(z))
        return jnp.where(jnp.asarray(self.positive), ratio, jnp.asarray(self.first + self.size * z))

    def slopes(self, z) -> Float[Array, "p"]:
        """The derivative of each number in its own relative change."""
        return jnp.where(jnp.asarray(self.positive), self.first * jnp.exp(z), self.size)


class _Blocks(NamedTuple):
    """The loss of each window, its derivatives in the initial state s (2n,) and in z (p,), and the errors' scale.

    `ss`, `sz`, `zz` majorise the second derivatives, and are used for steps; `curved` are those of the loss itself.
    """

    loss: Float[Array, "W"]
    s: Float[Array, "W k"]
    z: Float[Array, "W p"]
    ss: Float[Array, "W k k"]
    sz: Float[Array, "W k p"]
    zz: Float[Array, "W p p"]
    curved: tuple[Float[Array, "W k k"], Float[Array, "W k p"], Float[Array, "W p p"]]
    scale: Float[Array, "n"]


class _Point(NamedTuple):
    """Where a search is: z (p,), s (W, 2n), and the loss there with its derivatives at a scale of the errors."""

    z: Float[NumpyArray, "p"]
    s: Float[NumpyArray, "W k"]
    scale: Float[NumpyArray, "n"]
    blocks: _Blocks

    def loss(self, held: NumpyArray) -> float:
        """Loss with the prior, and with what holds undetermined combinations at their first values."""
        prior = np.sum(self.z**2) / (2 * BROAD**2) + HELD**2 * self.z @ held @ self.z / 2
        return float(np.sum(self.blocks.loss) + prior)


def _at(problem: _Problem, windows: Windows, z: NumpyArray, s: NumpyArray, scale: NumpyArray) -> _Point:
    blocks = _evaluate(problem, windows, jnp.asarray(z), jnp.asarray(s), jnp.asarray(scale))
    return _Point(z, s, scale, jax.tree.map(np.asarray, blocks))


def _begin(problem: _Problem, windows: Windows) -> _Point:
    """Where a search begins: the first values, and measured positions with reference velocities."""
    count, n = windows.v.shape[0], windows.v.shape[-1]
    z, s = np.zeros(len(problem.first)), np.zeros((count, 2 * n))
    scale = _at(problem, windows, z, s, np.ones(n)).blocks.scale
    if not np.isfinite(scale).all():
        raise ValueError("the model predicts no finite motion with its first values; mend these")
    return _at(problem, windows, z, s, np.asarray(scale))


@eqx.filter_jit
def _evaluate(problem: _Problem, windows: Windows, z: Array, s: Array, scale: Array) -> _Blocks:
    p = z.shape[0]

    def window(s, rows, t, y, v):
        def errors(x):
            n = v.shape[-1]
            model, inputs = _made(problem, x[:p], windows)
            start = Motion(model.manifold.retract(y[0], x[p : p + n]), v[0] + x[p + n :])
            found, seen = differences(model, follow(model, t, inputs[rows], start, problem.substeps).q, y)
            found = found / scale[None]
            return found, (found, seen)

        slope, (found, seen) = jax.jacfwd(errors, has_aux=True)(jnp.concatenate([z, s]))
        slope, e = slope.reshape(-1, p + s.shape[0]), found.ravel()
        weight = 1 / jnp.sqrt(1 + (e / HUBER) ** 2)
        loss = jnp.sum(e**2 / (1 + 1 / weight))  # δ² (√(1 + (e/δ)²) − 1)
        second, curved = (slope.T @ (w[:, None] * slope) for w in (weight, weight**3))
        return loss, slope.T @ (weight * e), second, curved, found * scale[None], seen

    loss, gradient, second, curved, errors, seen = jax.vmap(window)(s, windows.rows, windows.t, windows.y, windows.v)
    # The median of the sizes is that of noise even where some errors are outliers.
    typical = 1.4826 * jnp.nanmedian(jnp.where(seen, jnp.abs(errors), jnp.nan), axis=(0, 1))
    moved = jnp.sqrt(jnp.mean((windows.v * (windows.t - windows.t[:, :1])[..., None]) ** 2, axis=(0, 1)))

    def parts(full):
        return full[:, p:, p:], full[:, p:, :p], full[:, :p, :p]

    scale = jnp.maximum(typical, FINEST * moved + 1e-300)
    return _Blocks(loss, gradient[:, p:], gradient[:, :p], *parts(second), parts(curved), scale)


def _made(problem: _Problem, z: Array, windows: Windows) -> tuple[Any, Float[Array, "S m"]]:
    """The model at z, and the inputs that act in each step."""
    model, lag = problem.make(problem.values(z))
    return model, lagged(jnp.asarray(windows.inputs), jnp.asarray(windows.steps), lag)


def _descend(
    problem: _Problem, windows: Windows, now: _Point, held: NumpyArray, told: Callable[[int], object]
) -> tuple[_Point, int]:
    """The least loss from a point on, by steps of Levenberg and Marquardt, and their number."""
    now = _at(problem, windows, now.z, now.s, now.scale)
    damping, growth = 1e-3, 2.0
    for k in range(MOST_STEPS):
        told(k)
        dz, ds, promised = _step(now, held, damping)
        if promised < TOLERANCE:
            return now, k
        tried = _at(problem, windows, now.z + dz, now.s + ds, now.scale)
        gain = (now.loss(held) - tried.loss(held)) / promised
        if gain > 0:  # False where the trial is not finite
            now, growth = tried, 2.0
            damping *= max(1 / 10, 1 - (2 * min(gain, 1.0) - 1) ** 3)
        else:
            damping, growth = damping * growth, 2 * growth
    return now, MOST_STEPS


def _step(now: _Point, held: NumpyArray, damping: float) -> tuple[NumpyArray, NumpyArray, float]:
    """A damped Gauss–Newton step of z and of all initial states, and by how much it should lower the loss."""
    b = now.blocks
    k, p = b.s.shape[1], len(now.z)
    stretched = 1 + damping
    ss = b.ss * np.where(np.eye(k, dtype=bool), stretched, 1.0) + _ridge(b.ss)
    back = np.linalg.solve(ss, np.concatenate([b.sz, b.s[:, :, None]], axis=2))
    zz = np.sum(b.zz, axis=0)
    prior = np.eye(p) / BROAD**2 + HELD**2 * held
    reduced = zz + damping * np.diag(np.diagonal(zz)) + prior - np.einsum("wkp,wkq->pq", b.sz, back[:, :, :p])
    slope = np.sum(b.z, axis=0) + prior @ now.z
    size = np.sqrt(np.diagonal(reduced))
    right = slope - np.einsum("wkp,wk->p", b.sz, back[:, :, p])
    dz = -np.linalg.solve(reduced / np.outer(size, size), right / size) / size
    ds = -back[:, :, p] - back[:, :, :p] @ dz
    quadratic = dz @ (zz + prior) @ dz + 2 * np.einsum("wkp,wk,p->", b.sz, ds, dz)
    quadratic += np.einsum("wkl,wk,wl->", b.ss, ds, ds)
    return dz, ds, float(-(slope @ dz + np.sum(b.s * ds) + quadratic / 2))


def _ridge(matrices: Any) -> NumpyArray:
    """A small multiple of the identity for each matrix (W, k, k), for windows in which too little is measured."""
    largest = np.max(np.diagonal(matrices, axis1=1, axis2=2), axis=1) + 1e-300
    return 1e-12 * largest[:, None, None] * np.eye(matrices.shape[1])


def _information(b: _Blocks) -> Float[NumpyArray, "p p"]:
    """Second derivatives of the loss in z with the best initial states."""
    ss, sz, zz = b.curved
    return np.sum(zz - np.swapaxes(sz, 1, 2) @ np.linalg.solve(ss + _ridge(ss), sz), axis=0)


def _silent(b: _Blocks) -> Float[NumpyArray, "p p"]:
    """Projection of z on the combinations that the log does not determine.

    These are, first, those for which even errors that are independent would leave more than `UNKNOWN`, and then those
    for which the errors do as they are, alike within each window.
    """
    found, vectors = np.linalg.eigh(_information(b))
    out = vectors[:, found < max(UNKNOWN**-2, ROUNDING * found[-1])]
    found, vectors = np.linalg.eigh(_sandwich(b, out @ out.T))
    out = np.linalg.qr(np.concatenate([out, vectors[:, found > UNKNOWN**2]], axis=1))[0]
    return out @ out.T


def _sandwich(b: _Blocks, held: NumpyArray) -> Float[NumpyArray, "p p"]:
    """Covariance `H⁻¹ (Σ g gᵀ) H⁻¹` of z, where combinations are held; g is the score of a window."""
    count, p = b.z.shape
    values, vectors = np.linalg.eigh(held)
    free = vectors[:, values < 0.5]
    if not free.shape[1]:
        return np.zeros((p, p))
    information = free.T @ _information(b) @ free
    size = np.sqrt(np.diagonal(information))
    inverse = np.linalg.inv(information / np.outer(size, size)) / np.outer(size, size)
    half = b.z @ free @ inverse @ free.T
    return half.T @ half * count / max(count - free.shape[1], 1)


def _rows(held: NumpyArray, ratio: NumpyArray) -> Float[NumpyArray, "d p"]:
    """Undetermined combinations as rows of relative changes of the values, reduced so that each has few entries."""
    values, vectors = np.linalg.eigh(held)
    rows = vectors[:, values > 0.5].T * ratio
    left = np.ones(rows.shape, bool)
    for _ in range(len(rows)):
        k, pivot = np.unravel_index(np.argmax(np.abs(rows) * left), rows.shape)
        left[k], left[:, pivot] = False, False
        rows[k] /= rows[k, pivot]
        others = np.arange(len(rows)) != k
        rows[others] -= np.outer(rows[others, pivot], rows[k])
    rows[np.abs(rows) < SMALL] = 0.0
    return rows
