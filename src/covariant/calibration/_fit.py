"""Numbers of a model for which it predicts a log best: multiple shooting with free initial states, robust to outliers.

Over each window of the log the model predicts from an initial state that is free, and what is new in the errors of the
positions decides: the innovations of a filter that follows them, as fast as makes these least. They are weighed by the
pseudo-Huber loss in units of their own scale, which is estimated along with the numbers. In each step of Levenberg and
Marquardt the initial states are eliminated window by window, so that the system to be solved is as small as the numbers
are few; and one program is compiled, for errors and derivatives together.

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

from covariant.calibration._innovations import Weighing, frequencies, innovations, weighing
from covariant.calibration._predict import differences, follow, lagged, needed_substeps
from covariant.calibration._windows import Windows
from covariant.models import Family, Motion

ROUNDS = 4
"""Searches: without a filter, with one, and twice with what is undetermined then held; scales are found after each."""
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
ROUGH = 0.2
"""A number with a larger relative standard error may be zero: its influence need not be linear down to there."""
CONFIDENCE = 2.0
"""Standard errors within which a number is not told from zero."""
SMALL = 0.01
"""Parts of an undetermined combination below this fraction of the largest are taken for none."""
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
    - `scale` (n,): robust standard deviation of what is new in the errors of the positions [units of the frame].
    - `frequency` [rad/s]: of the filter that follows these errors; far below one in a window where they are white.
    - `steps`: number of steps taken.
    """

    names: tuple[str, ...]
    first: Float[NumpyArray, "p"]
    values: Float[NumpyArray, "p"]
    standard_errors: Float[NumpyArray, "p"]
    undetermined: Float[NumpyArray, "d p"]
    scale: Float[NumpyArray, "n"]
    frequency: float
    steps: int

    @property
    def determined(self) -> Bool[NumpyArray, "p"]:
        """Whether the log determines each number by itself."""
        return np.isfinite(self.standard_errors)


def fit(
    family: Family,
    windows: Windows,
    progress: Callable[[int, int], object] = lambda *_: None,
    start: Float[NumpyArray, "p"] | None = None,
) -> Fit:
    """The numbers of a family for which its model predicts the windows best.

    - `windows`: of one log or several, from `windows`.
    - `progress`: called with the numbers of the round and of its step before each step, from 0.
    - `start` (p,): where the search starts, such as the values of a fit to other inputs; the family's first values by
      default. The prior, and what is not determined, stay at the first values.

    Positive numbers are sought by their logarithms. What the log does not determine keeps its first value, and is named
    by `Fit.undetermined`. Raises `ValueError` where the model's first prediction is not finite.
    """
    windows = jax.tree.map(jnp.asarray, windows)
    model = family.file.need_mechanical(family.file.name, "numbers are fitted for")
    problem = _Problem(family.make, jnp.asarray(family.first), family.positive, needed_substeps(model, windows))
    offered = frequencies(windows)
    now = _begin(
        problem, windows, offered[:1], np.zeros(len(family.first)) if start is None else problem.relative(start)
    )
    held, taken = _Held(np.zeros((len(family.first),) * 2), np.zeros(len(family.first))), 0
    for k in range(ROUNDS):
        now, steps = _descend(problem, windows, now, held, functools.partial(progress, k))
        taken += steps
        now = _weighed(problem, windows, now, offered if k == 0 else np.atleast_1d(now.weighing.frequency))
        if 0 < k < ROUNDS - 1:  # where the filter is new the numbers are not yet those that it finds
            held = _Held(_silent(now.blocks), problem.kept(now.z))
    covariance = _sandwich(now.blocks, held.directions)
    z = now.z - held.directions @ (now.z - held.at)  # what is held is held by a large weight, which leaves a trace
    slopes = np.asarray(problem.slopes(z))
    values = np.asarray(problem.values(z))
    rows = _rows(held.directions, slopes / np.where(values == 0, 1.0, values))
    part = np.sqrt(np.sum(rows**2, axis=0))
    variance = slopes**2 * np.diagonal(covariance) + (values * part * UNKNOWN) ** 2
    # The last search may have made a number so small that it has lost its influence on the way.
    own = np.asarray(problem.positive) & (part < PURE)
    small = own & (np.diagonal(covariance) > UNKNOWN**2)
    small |= own & ~small & _perhaps_zero(problem, windows, now, held, covariance)
    rows = np.concatenate([rows, np.eye(len(small))[small]])
    errors = np.where((part < PURE) & ~small, np.sqrt(np.maximum(variance, 0.0)), np.nan)
    frequency, scale = now.weighing
    return Fit(family.names, family.first, values, errors, rows, np.asarray(scale), float(frequency), taken)


def losses(family: Family, windows: Windows, fit: Fit, weighed_as: Fit) -> Float[NumpyArray, "W"]:
    """The loss of each window at the numbers of a fit: the negative logarithm of its likelihood, up to a constant.

    The constant is the same for all fits whose errors are weighed alike, so that two fits to the same rows under other
    inputs can be compared, window by window (Vuong 1989, Likelihood ratio tests for model selection).

    - `weighed_as`: the fit whose filter and scales weigh the errors.
    """
    windows = jax.tree.map(jnp.asarray, windows)
    model = family.file.need_mechanical(family.file.name, "numbers are fitted for")
    problem = _Problem(family.make, jnp.asarray(family.first), family.positive, needed_substeps(model, windows))
    z = problem.relative(fit.values)
    now = _begin(problem, windows, np.atleast_1d(weighed_as.frequency), z)
    now = now._replace(weighing=Weighing(np.asarray(weighed_as.frequency), weighed_as.scale))
    now, _ = _descend(problem, windows, now, _Held(np.eye(len(z)), z), lambda _: None)
    return np.asarray(now.blocks.loss)


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

    def relative(self, values: Float[NumpyArray, "p"]) -> Float[NumpyArray, "p"]:
        """The relative changes z (p,) at which the numbers are these."""
        ratio = np.where(np.asarray(self.positive), values / np.asarray(self.first), 1.0)
        return np.where(np.asarray(self.positive), np.log(ratio), (values - self.first) / np.asarray(self.size))

    def kept(self, z: NumpyArray) -> NumpyArray:
        """Where what is undetermined is held (p,): at first values, or what a number is that all but vanished."""
        return np.where(np.asarray(self.positive) & (z < -BROAD), z, 0.0)

    def slopes(self, z) -> Float[Array, "p"]:
        """The derivative of each number in its own relative change."""
        return jnp.where(jnp.asarray(self.positive), self.first * jnp.exp(z), self.size)


class _Held(NamedTuple):
    """Undetermined combinations as a projection `directions` (p, p) of z, which are held where z is `at` (p,)."""

    directions: Float[NumpyArray, "p p"]
    at: Float[NumpyArray, "p"]


class _Blocks(NamedTuple):
    """The loss of each window, its derivatives in the initial state s (2n,) and in z (p,), and the errors.

    `ss`, `sz`, `zz` majorise the second derivatives, and are used for steps; `curved` are those of the loss itself.
    `errors` are those of the positions, where they are `seen`.
    """

    loss: Float[Array, "W"]
    s: Float[Array, "W k"]
    z: Float[Array, "W p"]
    ss: Float[Array, "W k k"]
    sz: Float[Array, "W k p"]
    zz: Float[Array, "W p p"]
    curved: tuple[Float[Array, "W k k"], Float[Array, "W k p"], Float[Array, "W p p"]]
    errors: Float[Array, "W L1 n"]
    seen: Bool[Array, "W L1 n"]


class _Point(NamedTuple):
    """Where a search is: z (p,), s (W, 2n), and the loss there with its derivatives, the errors weighed in some way."""

    z: Float[NumpyArray, "p"]
    s: Float[NumpyArray, "W k"]
    weighing: Weighing
    blocks: _Blocks

    def loss(self, held: _Held) -> float:
        """Loss with the prior, and with what holds undetermined combinations."""
        away = self.z - held.at
        prior = np.sum(self.z**2) / (2 * BROAD**2) + HELD**2 * away @ held.directions @ away / 2
        return float(np.sum(self.blocks.loss) + prior)


def _at(problem: _Problem, windows: Windows, z: NumpyArray, s: NumpyArray, weighed: Weighing) -> _Point:
    blocks = _evaluate(problem, windows, jnp.asarray(z), jnp.asarray(s), jax.tree.map(jnp.asarray, weighed))
    return _Point(z, s, weighed, jax.tree.map(np.asarray, blocks))


def _weighed(problem: _Problem, windows: Windows, now: _Point, among: NumpyArray) -> _Point:
    """The same point, its errors weighed as they are there, by a filter of one of some frequencies [rad/s]."""
    return _at(
        problem,
        windows,
        now.z,
        now.s,
        weighing(windows, np.asarray(now.blocks.errors), np.asarray(now.blocks.seen), among),
    )


def _begin(problem: _Problem, windows: Windows, frequency: Float[NumpyArray, "1"], z: Float[NumpyArray, "p"]) -> _Point:
    """Where a search begins: relative changes z of the numbers, and measured positions with reference velocities."""
    count, n = windows.v.shape[0], windows.v.shape[-1]
    s = np.zeros((count, 2 * n))
    now = _at(problem, windows, z, s, Weighing(frequency[0], np.ones(n)))
    if not np.isfinite(now.blocks.errors[now.blocks.seen]).all():
        raise ValueError("the model predicts no finite motion with its first values; mend these")
    return _weighed(problem, windows, now, frequency)


@eqx.filter_jit
def _evaluate(problem: _Problem, windows: Windows, z: Array, s: Array, weighed: Weighing) -> _Blocks:
    p = z.shape[0]

    def window(s, rows, t, y, v):
        def errors(x):
            n = v.shape[-1]
            model, inputs = _made(problem, x[:p], windows)
            start = Motion(model.manifold.retract(y[0], x[p : p + n]), v[0] + x[p + n :])
            found, seen = differences(model, follow(model, t, inputs[rows], start, problem.substeps).q, y)
            new = innovations(found, seen, t, jnp.asarray(weighed.frequency)) / weighed.scale[None]
            return new, (new, found, seen)

        slope, (new, found, seen) = jax.jacfwd(errors, has_aux=True)(jnp.concatenate([z, s]))
        slope, e = slope.reshape(-1, p + s.shape[0]), new.ravel()
        weight = 1 / jnp.sqrt(1 + (e / HUBER) ** 2)
        loss = jnp.sum(e**2 / (1 + 1 / weight))  # δ² (√(1 + (e/δ)²) − 1)
        second, curved = (slope.T @ (w[:, None] * slope) for w in (weight, weight**3))
        return loss, slope.T @ (weight * e), second, curved, found, seen

    loss, gradient, second, curved, errors, seen = jax.vmap(window)(s, windows.rows, windows.t, windows.y, windows.v)

    def parts(full):
        return full[:, p:, p:], full[:, p:, :p], full[:, :p, :p]

    return _Blocks(loss, gradient[:, p:], gradient[:, :p], *parts(second), parts(curved), errors, seen)


def _made(problem: _Problem, z: Array, windows: Windows) -> tuple[Any, Float[Array, "S m"]]:
    """The model at z, and the inputs that act in each step."""
    model, lag = problem.make(problem.values(z))
    return model, lagged(jnp.asarray(windows.inputs), jnp.asarray(windows.steps), lag)


def _descend(
    problem: _Problem, windows: Windows, now: _Point, held: _Held, progress: Callable[[int], object]
) -> tuple[_Point, int]:
    """The least loss from a point on, by steps of Levenberg and Marquardt, and their number."""
    now = _at(problem, windows, now.z, now.s, now.weighing)
    damping, growth = 1e-3, 2.0
    for k in range(MOST_STEPS):
        progress(k)
        dz, ds, promised = _step(now, held, damping)
        if promised < TOLERANCE:
            return now, k
        tried = _at(problem, windows, now.z + dz, now.s + ds, now.weighing)
        gain = (now.loss(held) - tried.loss(held)) / promised
        if gain > 0:  # False where the trial is not finite
            now, growth = tried, 2.0
            damping *= max(1 / 10, 1 - (2 * min(gain, 1.0) - 1) ** 3)
        else:
            damping, growth = damping * growth, 2 * growth
    return now, MOST_STEPS


def _perhaps_zero(
    problem: _Problem, windows: Windows, now: _Point, held: _Held, covariance: Float[NumpyArray, "p p"]
) -> Bool[NumpyArray, "p"]:
    """Numbers of which all but nothing may be left: all others searched anew, the loss rises by no more than chance."""
    possible = np.asarray(problem.positive) & (now.z < 0) & (np.diagonal(covariance) > ROUGH**2)
    alone = np.diagonal(_inverse_information(now.blocks, held.directions))
    for j in np.flatnonzero(possible):
        one = np.zeros(len(now.z))
        one[j] = 1.0
        directions = held.directions + np.outer(one, one)
        goal = held.directions @ held.at + one * (now.z[j] - BROAD)
        without, _ = _descend(
            problem, windows, now, _Held(directions, np.linalg.pinv(directions) @ goal), lambda _: None
        )
        rise = float(np.sum(without.blocks.loss) - np.sum(now.blocks.loss))
        possible[j] = rise < CONFIDENCE**2 / 2 * covariance[j, j] / alone[j]
    return possible


def _step(now: _Point, held: _Held, damping: float) -> tuple[NumpyArray, NumpyArray, float]:
    """A damped Gauss–Newton step of z and of all initial states, and by how much it should lower the loss."""
    b = now.blocks
    k, p = b.s.shape[1], len(now.z)
    stretched = 1 + damping
    ss = b.ss * np.where(np.eye(k, dtype=bool), stretched, 1.0) + _ridge(b.ss)
    back = np.linalg.solve(ss, np.concatenate([b.sz, b.s[:, :, None]], axis=2))
    zz = np.sum(b.zz, axis=0)
    held_back = HELD**2 * held.directions
    prior = np.eye(p) / BROAD**2 + held_back
    reduced = zz + damping * np.diag(np.diagonal(zz)) + prior - np.einsum("wkp,wkq->pq", b.sz, back[:, :, :p])
    slope = np.sum(b.z, axis=0) + prior @ now.z - held_back @ held.at
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
    half = np.asarray(b.z) @ _inverse_information(b, held)
    free = p - round(float(np.trace(held)))
    return half.T @ half * count / max(count - free, 1)


def _inverse_information(b: _Blocks, held: NumpyArray) -> Float[NumpyArray, "p p"]:
    """Covariance of z if all errors were independent, where combinations are held; zero along these."""
    values, vectors = np.linalg.eigh(held)
    free = vectors[:, values < 0.5]
    if not free.shape[1]:
        return np.zeros_like(held)
    information = free.T @ _information(b) @ free
    size = np.sqrt(np.diagonal(information))
    return free @ (np.linalg.inv(information / np.outer(size, size)) / np.outer(size, size)) @ free.T


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
