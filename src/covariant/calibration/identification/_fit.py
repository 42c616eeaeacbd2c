"""Parameters with which a model predicts a log best: multiple shooting with free initial states, robust to outliers.

Over each window of the log the model predicts from an initial state that is free, and the innovations of the position
errors decide: those of a filter that follows the errors, of the bandwidth that makes them least. They are weighed by
the pseudo-Huber loss in units of their scale, which is estimated along with the parameters. In each step of Levenberg
and Marquardt the initial states are eliminated window by window, so that the system to be solved is as small as the
number of parameters; and one program is compiled, for errors and derivatives together.

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

from covariant.calibration.identification._innovations import Weighing, frequencies, innovations, weighing
from covariant.calibration.identification._predict import differences, follow, lagged, needed_substeps
from covariant.calibration.identification._windows import Windows
from covariant.models import Family, Motion

ROUNDS = 4
"""Searches: without a filter, with one, twice with undetermined combinations fixed; scales are estimated after each."""
MOST_STEPS = 25
"""Largest number of Levenberg–Marquardt steps in a round."""
TOLERANCE = 3e-3
"""A step that is predicted to lower half the sum of squares, in units of the errors' variance, by less ends a round: it
changes no parameter by more than a hundredth of its standard error."""
HUBER = 3.0
"""Size of an error, in units of its scale, beyond which its influence is constant: it is an outlier."""
BROAD = 3.0
"""Standard deviation of the prior: a first value is right within a factor of e³. It decides only where the log says
nothing; a parameter that the log determines to 10 % it changes by a thousandth of that standard error."""
UNKNOWN = 1.0
"""A combination of relative changes with a larger standard error is not determined: not even within a factor e."""
HELD = 1e3
"""Weight that fixes an undetermined combination at its first value, in scales of the errors."""
PURE = 0.2
"""A parameter is determined by itself where all undetermined combinations, changed by all of their size, change it by a
smaller fraction; its standard error grows by that change."""
ROUGH = 0.2
"""A parameter with a larger relative standard error may be zero: its influence need not be linear down to there."""
CONFIDENCE = 2.0
"""Standard errors within which a parameter cannot be distinguished from zero."""
SMALL = 0.01
"""Entries of an undetermined combination below this fraction of the largest are set to zero."""
ROUNDING = 1e-11
"""Information about a combination, relative to the greatest, that is nothing but rounding."""

NumpyArray = np.ndarray


class Fit(NamedTuple):
    """Result of a fit of p parameters to windows of logs.

    Attributes:
        names: Names of the parameters.
        first: Values (p,) before the fit.
        values: Values (p,) after it.
        standard_errors: Standard errors (p,), robust to errors that are alike within a window; NaN for a parameter that
            is not determined.
        undetermined: Combinations of which the log shows nothing: relative changes of the parameters as rows (d, p);
            each row has an entry of 1 in a parameter that is in no other row. Along them the parameters stay at their
            first values; but one that was reduced until the log could not distinguish it from zero keeps the reduced
            value.
        scale: Robust standard deviation (n,) of the innovations of the position errors [units of the frame].
        frequency: Natural frequency [rad/s] of the filter that follows these errors; far below one in a window where
            they are white.
        steps: Number of steps of the search.

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import Fit
        >>> values, none = np.array([0.7, 0.1]), np.eye(2)[1:]
        >>> result = Fit(("mass", "viscous"), values, values, np.array([0.01, np.nan]), none, np.array([1e-3]), 10.0, 9)
        >>> dict(zip(result.names, result.determined.tolist()))
        {'mass': True, 'viscous': False}
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
        """Whether the log determines each parameter (p,) by itself."""
        return np.isfinite(self.standard_errors)


def fit(
    family: Family,
    windows: Windows,
    progress: Callable[[int, int], object] = lambda *_: None,
    start: Float[NumpyArray, "p"] | None = None,
) -> Fit:
    """Fit the open parameters of a model to windows of logs.

    Positive parameters are searched by their logarithms. What the log does not determine keeps its first value, and is
    listed in `Fit.undetermined`.

    Args:
        family: The model as a function of its p open parameters, from `models.family`.
        windows: Windows of one log or several, from `windows`.
        progress: Called with the index of the round and of its step before each step, from 0.
        start: Values (p,) from which the search starts, such as those of a fit to other inputs; by default the first
            values of the family. The prior, and what is not determined, stay at the first values.

    Returns:
        Values, standard errors, and undetermined combinations.

    Raises:
        ValueError: The model's first prediction is not finite.

    Example:
        >>> import numpy as np
        >>> from covariant import models
        >>> from covariant.calibration import fit, cut_windows
        >>> from covariant.signals import Record
        >>> t = np.arange(500) * 0.02
        >>> record = Record(t, np.zeros((500, 1)), np.cos(t)[:, None])  # a unit mass on a spring of 1 N/m
        >>> family = models.family("oscillator", ["stiffness"], ["parameters.stiffness=2.0"])
        >>> result = fit(family, cut_windows([record], [-np.sin(t)[:, None]], length=1.0))
        >>> result.names, result.values.round(6).tolist()
        (('stiffness',), [1.0])
    """
    windows = jax.tree.map(jnp.asarray, windows)
    model = family.file.need_mechanical(family.file.name, "numbers are fitted for")
    problem = _Problem(family.make, jnp.asarray(family.first), family.positive, needed_substeps(model, windows))
    offered = frequencies(windows)
    point = _begin(
        problem, windows, offered[:1], np.zeros(len(family.first)) if start is None else problem.relative(start)
    )
    fixed, step_count = _Fixed(np.zeros((len(family.first),) * 2), np.zeros(len(family.first))), 0
    for k in range(ROUNDS):
        point, steps = _descend(problem, windows, point, fixed, functools.partial(progress, k))
        step_count += steps
        point = _weighed(problem, windows, point, offered if k == 0 else np.atleast_1d(point.weighing.frequency))
        if 0 < k < ROUNDS - 1:  # with a new filter the parameters have not converged yet
            fixed = _Fixed(_undetermined(point.blocks), problem.kept(point.z))
    covariance = _sandwich(point.blocks, fixed.directions)
    # A large but finite weight fixes the undetermined combinations: remove the trace of motion that it leaves.
    z = point.z - fixed.directions @ (point.z - fixed.at)
    values, slopes = map(np.asarray, _values_and_slopes(problem, jnp.asarray(z)))
    # Relative to the value, or for a value of zero to the unit.
    rows = _rows(fixed.directions, slopes / np.where(values == 0, 1.0, values))
    part = np.sqrt(np.sum(rows**2, axis=0))
    variance = slopes**2 * np.diagonal(covariance) + (values * part * UNKNOWN) ** 2
    # The last search may have reduced a parameter so far that it has lost its influence.
    separate = np.asarray(problem.positive) & (part < PURE)
    small = separate & (np.diagonal(covariance) > UNKNOWN**2)
    small |= separate & ~small & _perhaps_zero(problem, windows, point, fixed, covariance)
    rows = np.concatenate([rows, np.eye(len(small))[small]])
    errors = np.where((part < PURE) & ~small, np.sqrt(np.maximum(variance, 0.0)), np.nan)
    frequency, scale = point.weighing
    return Fit(family.names, family.first, values, errors, rows, np.asarray(scale), float(frequency), step_count)


def window_losses(family: Family, windows: Windows, fit: Fit, weighed_as: Fit) -> Float[NumpyArray, "W"]:
    """Negative log-likelihood of each window at the values of a fit, up to a constant.

    The constant is the same for all fits whose errors are weighed as those of `weighed_as`, so that two fits to the
    same rows under other inputs can be compared (Vuong 1989, Likelihood ratio tests for model selection).
    """
    windows = jax.tree.map(jnp.asarray, windows)
    model = family.file.need_mechanical(family.file.name, "numbers are fitted for")
    problem = _Problem(family.make, jnp.asarray(family.first), family.positive, needed_substeps(model, windows))
    z = problem.relative(fit.values)
    point = _begin(problem, windows, np.atleast_1d(weighed_as.frequency), z)
    point = point._replace(weighing=Weighing(np.asarray(weighed_as.frequency), weighed_as.scale))
    point, _ = _descend(problem, windows, point, _Fixed(np.eye(len(z)), z), lambda _: None)
    return np.asarray(point.blocks.loss)


class _Problem(NamedTuple):
    """The fitted function `make (p,) -> (model, lag)`, first values (p,), which are positive, and the substeps."""

    make: Callable[[Array], tuple[Any, Any]]
    first: Float[Array, "p"]
    positive: tuple[bool, ...]
    substeps: int

    @property
    def size(self) -> Float[Array, "p"]:
        """Size of a relative change of one: the first value, or one unit where that is zero."""
        return jnp.abs(self.first) + jnp.equal(self.first, 0).astype(self.first.dtype)

    def values(self, z) -> Float[Array, "p"]:
        """Parameters at relative changes z (p,): logarithms of ratios for positive ones, for others the inverse
        hyperbolic sine of the change in units of `size`, which is as broad far away."""
        ratio = jnp.asarray(self.first * jnp.exp(z))
        return jnp.where(jnp.asarray(self.positive), ratio, jnp.asarray(self.first + self.size * jnp.sinh(z)))

    def relative(self, values: Float[NumpyArray, "p"]) -> Float[NumpyArray, "p"]:
        """Relative changes z (p,) that give these parameters."""
        ratio = np.where(np.asarray(self.positive), values / np.asarray(self.first), 1.0)
        change = np.arcsinh((values - self.first) / np.asarray(self.size))
        return np.where(np.asarray(self.positive), np.log(ratio), change)

    def moved(self, z: NumpyArray, dz: NumpyArray) -> NumpyArray:
        """Relative changes (p,) after a linearised step: it moves the values, or of a positive parameter that falls the
        inverse, since forces are linear in friction and accelerations in inverse masses."""
        positive = z + np.sign(dz) * np.log1p(np.abs(dz))
        return np.where(np.asarray(self.positive), positive, np.arcsinh(np.sinh(z) + np.cosh(z) * dz))

    def kept(self, z: NumpyArray) -> NumpyArray:
        """Values (p,) of z that undetermined combinations keep: first values, or that of a vanishing parameter."""
        return np.where(np.asarray(self.positive) & (z < -BROAD), z, 0.0)

    def slopes(self, z) -> Float[Array, "p"]:
        """Derivative of each parameter in its relative change."""
        return jnp.where(jnp.asarray(self.positive), self.first * jnp.exp(z), self.size * jnp.cosh(z))


@eqx.filter_jit  # one program in place of a dozen small ones
def _values_and_slopes(problem: _Problem, z: Array) -> tuple[Float[Array, "p"], Float[Array, "p"]]:
    return problem.values(z), problem.slopes(z)


class _Fixed(NamedTuple):
    """Undetermined combinations as a projection `directions` (p, p) of z, fixed where z is `at` (p,)."""

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
    """A point of the search: z (p,), s (W, 2n), the weights of the errors, and the loss with its derivatives."""

    z: Float[NumpyArray, "p"]
    s: Float[NumpyArray, "W k"]
    weighing: Weighing
    blocks: _Blocks

    def loss(self, held: _Fixed) -> float:
        """Loss with the prior, and with the penalty that fixes undetermined combinations."""
        deviation = self.z - held.at
        prior = np.sum(self.z**2) / (2 * BROAD**2) + HELD**2 * deviation @ held.directions @ deviation / 2
        return float(np.sum(self.blocks.loss) + prior)


def _at(problem: _Problem, windows: Windows, z: NumpyArray, s: NumpyArray, weighed: Weighing) -> _Point:
    blocks = _evaluate(problem, windows, jnp.asarray(z), jnp.asarray(s), jax.tree.map(jnp.asarray, weighed))
    return _Point(z, s, weighed, jax.tree.map(np.asarray, blocks))


def _weighed(problem: _Problem, windows: Windows, point: _Point, among: NumpyArray) -> _Point:
    """The same point with its errors weighed anew, by the best filter among some frequencies [rad/s]."""
    return _at(
        problem,
        windows,
        point.z,
        point.s,
        weighing(windows, np.asarray(point.blocks.errors), np.asarray(point.blocks.seen), among),
    )


def _begin(problem: _Problem, windows: Windows, frequency: Float[NumpyArray, "1"], z: Float[NumpyArray, "p"]) -> _Point:
    """First point of the search: relative changes z of the parameters, measured positions and reference velocities."""
    count, n = windows.v.shape[0], windows.v.shape[-1]
    s = np.zeros((count, 2 * n))
    point = _at(problem, windows, z, s, Weighing(frequency[0], np.ones(n)))
    if not np.isfinite(point.blocks.errors[point.blocks.seen]).all():
        raise ValueError("the model predicts no finite motion with its first values; mend these")
    return _weighed(problem, windows, point, frequency)


@eqx.filter_jit
def _evaluate(problem: _Problem, windows: Windows, z: Array, s: Array, weighed: Weighing) -> _Blocks:
    p = z.shape[0]

    def window(s, rows, t, y, v):
        def errors(x):
            n = v.shape[-1]
            model, inputs = _model_at(problem, x[:p], windows)
            start = Motion(model.manifold.retract(y[0], x[p : p + n]), v[0] + x[p + n :])
            raw, seen = differences(model, follow(model, t, inputs[rows], start, problem.substeps).q, y)
            new = innovations(raw, seen, t, jnp.asarray(weighed.frequency)) / weighed.scale[None]
            return new, (new, raw, seen)

        slope, (new, raw, seen) = jax.jacfwd(errors, has_aux=True)(jnp.concatenate([z, s]))
        slope, e = slope.reshape(-1, p + s.shape[0]), new.ravel()
        # The slope of the pseudo-Huber loss is weight · e; its curvature weight³ is below the weight, which majorises
        # it.
        weight = 1 / jnp.sqrt(1 + (e / HUBER) ** 2)
        # As a quotient, since the difference would cancel for small e.
        loss = jnp.sum(e**2 / (1 + 1 / weight))  # δ² (√(1 + (e/δ)²) − 1)
        second, curved = (slope.T @ (w[:, None] * slope) for w in (weight, weight**3))
        return loss, slope.T @ (weight * e), second, curved, raw, seen

    loss, gradient, second, curved, errors, seen = jax.vmap(window)(s, windows.rows, windows.t, windows.y, windows.v)

    def parts(full):
        return full[:, p:, p:], full[:, p:, :p], full[:, :p, :p]

    return _Blocks(loss, gradient[:, p:], gradient[:, :p], *parts(second), parts(curved), errors, seen)


def _model_at(problem: _Problem, z: Array, windows: Windows) -> tuple[Any, Float[Array, "S m"]]:
    """The model at z, and the inputs that act in each step."""
    model, lag = problem.make(problem.values(z))
    return model, lagged(jnp.asarray(windows.inputs), jnp.asarray(windows.steps), lag)


def _descend(
    problem: _Problem, windows: Windows, point: _Point, fixed: _Fixed, progress: Callable[[int], object]
) -> tuple[_Point, int]:
    """Minimise the loss from a point by Levenberg–Marquardt steps; returns the last point and their number."""
    point = _at(problem, windows, point.z, point.s, point.weighing)
    # Relative to the diagonal: the first step is nearly the full one of Gauss and Newton (Madsen et al., 3.2).
    damping, growth = 1e-3, 2.0
    for k in range(MOST_STEPS):
        progress(k)
        dz, ds, promised = _step(point, fixed, damping)
        if promised < TOLERANCE:
            return point, k
        tried = _at(problem, windows, problem.moved(point.z, dz), point.s + ds, point.weighing)
        gain = (point.loss(fixed) - tried.loss(fixed)) / promised
        if gain > 0:  # False where the trial is not finite
            point, growth = tried, 2.0
            # Nielsen's rule: the better the prediction of the fall was, the smaller the damping (Madsen et al., 3.2).
            damping *= max(1 / 10, 1 - (2 * min(gain, 1.0) - 1) ** 3)
        else:
            damping, growth = damping * growth, 2 * growth
    return point, MOST_STEPS


def _perhaps_zero(
    problem: _Problem, windows: Windows, point: _Point, fixed: _Fixed, covariance: Float[NumpyArray, "p p"]
) -> Bool[NumpyArray, "p"]:
    """Parameters (p,) that may be zero: with one nearly zero and the rest refitted, the loss hardly rises."""
    possible = np.asarray(problem.positive) & (point.z < 0) & (np.diagonal(covariance) > ROUGH**2)
    alone = np.diagonal(_inverse_information(point.blocks, fixed.directions))
    for j in np.flatnonzero(possible):
        unit = np.zeros(len(point.z))
        unit[j] = 1.0
        directions = fixed.directions + np.outer(unit, unit)
        # Fixed at e^−BROAD times its value the parameter is all but zero.
        goal = fixed.directions @ fixed.at + unit * (point.z[j] - BROAD)
        # `at` acts only through directions @ at, so that any point with this goal will do: the pseudoinverse gives one.
        without, _ = _descend(
            problem, windows, point, _Fixed(directions, np.linalg.pinv(directions) @ goal), lambda _: None
        )
        rise = float(np.sum(without.blocks.loss) - np.sum(point.blocks.loss))
        # Errors alike within a window enlarge the variance, and by as much the rise that is still chance.
        possible[j] = rise < CONFIDENCE**2 / 2 * covariance[j, j] / alone[j]
    return possible


def _step(point: _Point, fixed: _Fixed, damping: float) -> tuple[NumpyArray, NumpyArray, float]:
    """A damped Gauss–Newton step of z and of all initial states, and the predicted fall of the loss."""
    b = point.blocks
    k, p = b.s.shape[1], len(point.z)
    stretched = 1 + damping
    ss = b.ss * np.where(np.eye(k, dtype=bool), stretched, 1.0) + _ridge(b.ss)
    # Schur complement: the initial state of each window is eliminated before the parameters are solved for.
    back = np.linalg.solve(ss, np.concatenate([b.sz, b.s[:, :, None]], axis=2))
    zz = np.sum(b.zz, axis=0)
    fixing = HELD**2 * fixed.directions
    prior = np.eye(p) / BROAD**2 + fixing
    reduced = zz + damping * np.diag(np.diagonal(zz)) + prior - np.einsum("wkp,wkq->pq", b.sz, back[:, :, :p])
    slope = np.sum(b.z, axis=0) + prior @ point.z - fixing @ fixed.at
    size = np.sqrt(np.diagonal(reduced))
    right = slope - np.einsum("wkp,wk->p", b.sz, back[:, :, p])
    # Scaled to a unit diagonal, since the sensitivities differ by orders of magnitude.
    dz = -np.linalg.solve(reduced / np.outer(size, size), right / size) / size
    ds = -back[:, :, p] - back[:, :, :p] @ dz
    # Without the damping, which only limits the step: the ratio to the actual fall then measures the model itself.
    quadratic = dz @ (zz + prior) @ dz + 2 * np.einsum("wkp,wk,p->", b.sz, ds, dz)
    quadratic += np.einsum("wkl,wk,wl->", b.ss, ds, ds)
    return dz, ds, float(-(slope @ dz + np.sum(b.s * ds) + quadratic / 2))


def _ridge(matrices: Any) -> NumpyArray:
    """A small multiple of the identity for each matrix (W, k, k), for windows in which too little is measured."""
    largest = np.max(np.diagonal(matrices, axis1=1, axis2=2), axis=1) + 1e-300
    # Far above the rounding errors of the elimination, far below what one measurement tells.
    return 1e-12 * largest[:, None, None] * np.eye(matrices.shape[1])


def _information(b: _Blocks) -> Float[NumpyArray, "p p"]:
    """Second derivatives (p, p) of the loss in z with the best initial states: the Schur complement of these."""
    ss, sz, zz = b.curved
    return np.sum(zz - np.swapaxes(sz, 1, 2) @ np.linalg.solve(ss + _ridge(ss), sz), axis=0)


def _undetermined(b: _Blocks) -> Float[NumpyArray, "p p"]:
    """Projection of z on the combinations that the log does not determine.

    First those for which even independent errors would leave a standard error above `UNKNOWN`, then those for which the
    actual errors, alike within each window, do.
    """
    eigenvalues, vectors = np.linalg.eigh(_information(b))
    # Information below 1/UNKNOWN² is a standard error above UNKNOWN; the other bound is for what is rounding.
    basis = vectors[:, eigenvalues < max(UNKNOWN**-2, ROUNDING * eigenvalues[-1])]
    eigenvalues, vectors = np.linalg.eigh(_sandwich(b, basis @ basis.T))
    basis = np.linalg.qr(np.concatenate([basis, vectors[:, eigenvalues > UNKNOWN**2]], axis=1))[0]
    return basis @ basis.T


def _sandwich(b: _Blocks, fixed: NumpyArray) -> Float[NumpyArray, "p p"]:
    """Covariance `H⁻¹ (Σ g gᵀ) H⁻¹` of z with combinations fixed; g is the score of a window."""
    count, p = b.z.shape
    half = np.asarray(b.z) @ _inverse_information(b, fixed)
    # The trace of a projection is its rank.
    free = p - round(float(np.trace(fixed)))
    return half.T @ half * count / max(count - free, 1)


def _inverse_information(b: _Blocks, fixed: NumpyArray) -> Float[NumpyArray, "p p"]:
    """Covariance of z for independent errors with combinations fixed; zero along these."""
    # A projection has the eigenvalues 0 and 1 but for rounding.
    values, vectors = np.linalg.eigh(fixed)
    free = vectors[:, values < 0.5]
    if not free.shape[1]:
        return np.zeros_like(fixed)
    information = free.T @ _information(b) @ free
    size = np.sqrt(np.diagonal(information))
    return free @ (np.linalg.inv(information / np.outer(size, size)) / np.outer(size, size)) @ free.T


def _rows(fixed: NumpyArray, ratio: NumpyArray) -> Float[NumpyArray, "d p"]:
    """Undetermined combinations as rows of relative changes of the values, reduced so that each has few entries."""
    values, vectors = np.linalg.eigh(fixed)
    rows = vectors[:, values > 0.5].T * ratio
    available = np.ones(rows.shape, bool)
    # Gauss–Jordan elimination with the largest entry among the rows and columns still available as pivot.
    for _ in range(len(rows)):
        k, pivot = np.unravel_index(np.argmax(np.abs(rows) * available), rows.shape)
        available[k], available[:, pivot] = False, False
        rows[k] /= rows[k, pivot]
        others = np.arange(len(rows)) != k
        rows[others] -= np.outer(rows[others, pivot], rows[k])
    rows[np.abs(rows) < SMALL] = 0.0
    return rows
