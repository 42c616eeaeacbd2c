"""Parameters with which a model predicts a log best: multiple shooting with free initial states, robust to outliers.

Over each window of the log, the model predicts the motion from a free initial state. A filter follows the position
errors, and the fit makes its innovations small; the filter has the bandwidth at which they are smallest. Their scale is
estimated along with the parameters. The search is least squares with one block for each window. One compiled program
gives errors and derivatives together.

Source: Bock 1983 for multiple shooting; Huber 1981, Robust Statistics, sections 6.3 and 7.6, for the scale.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from covariant.calibration._least_squares import (
    MOST_STEPS,
    PRIOR,
    UNKNOWN,
    Blocks,
    Fixed,
    Point,
    combination_rows,
    minimise,
)
from covariant.calibration.identification._contradictions import Evidence, contradictions
from covariant.calibration.identification._innovations import Weighing, frequencies, innovations, weighing
from covariant.calibration.identification._predict import differences, follow, lagged, needed_substeps
from covariant.calibration.identification._regression import starts
from covariant.calibration.identification._unknowns import Unknowns
from covariant.calibration.identification._windows import Windows
from covariant.models import Family, Motion
from scalargraph.errors import InputError

ROUNDS = 4
"""Number of searches: without a filter, with one, and two with undetermined combinations fixed; scales follow each."""
PURE = 0.2
"""A parameter is determined by itself if the undetermined combinations, changed by their full size, change it by a
smaller fraction; its standard error includes that change."""
ROUGH = 0.2
"""A parameter with a larger relative standard error may be zero: its influence need not be linear down to zero."""
CONFIDENCE = 2.0
"""Standard errors within which a parameter cannot be distinguished from zero."""
POLISHED = 2
"""Number of places to start from, the best ones, from which predictions are fitted."""
FAR, PROFILE_STEPS = 8.0, 10
"""Factor by which a profile of the likelihood moves a parameter, and the most steps of the others."""
RESTARTS = 2
"""How often a search begins anew from a better place that a profile has found."""
MARGIN = 1.5
"""Factor by which friction may come to need more substeps than a search has: the method is stable to 2.8."""

SHOWN = 0.03
"""Weights of a combination below this fraction of the largest are not shown."""
MOVED = 0.01
"""Relative change from its first value by which a parameter counts as changed."""
ALIKE = 0.05
"""An exponent that is this close, relatively, to a whole number or a half is rounded to it."""

NumpyArray = np.ndarray


class Fit(NamedTuple):
    """Result of a fit of p parameters to windows of logs.

    Read `determined` before you use `values`: a parameter that the logs do not determine has its first value there, and
    no standard error. The standard errors allow for errors that persist within a window, but not for an effect that the
    model lacks in all windows.

    Attributes:
        names: Names of the parameters.
        first: Values (p,) before the fit.
        values: Values (p,) after it.
        standard_errors: Standard errors (p,), robust to errors that are alike within a window; NaN for a parameter that
            is not determined.
        undetermined: Combinations that the log does not determine: relative changes of the parameters as rows (d, p);
            each row has an entry of 1 in a parameter that is in no other row. Along them the parameters stay at their
            first values; but one that was reduced until the log could not distinguish it from zero keeps the reduced
            value.
        scale: Robust standard deviation (n,), or (M, n) of M machines, of the innovations of the position errors [units
            of the frame].
        frequency: Natural frequency [rad/s] of the filter that follows these errors; far below one in a window where
            they are white.
        steps: Number of steps of the search.
        starts: Places from which it was searched, by name, and by how much larger the negative log-likelihood was where
            the first search from each ended; the first one won.
        unlike: Sentences on machines whose logs contradict a number that all machines share.

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
    scale: Float[NumpyArray, "*M n"]
    frequency: float
    steps: int
    starts: tuple[tuple[str, float], ...] = ()
    unlike: tuple[str, ...] = ()

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

    Positive parameters are searched by their logarithms. Combinations that the log does not determine keep their first
    values, and are listed in `Fit.undetermined`.

    Use it where you have cut the windows yourself. The verb `covariant.fit` starts from files, holds out rows, and
    tries both held and linear inputs where the model file does not say which. `fit_robot` is faster for many numbers of
    a robot. Every step simulates all windows, so start with a few parameters.

    Args:
        family: The model as a function of its p open parameters, from `models.family`.
        windows: Windows of one log or several, from `cut_windows`.
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
    return profile(family, windows, search(family, windows, progress, start))


def search(
    family: Family,
    windows: Windows,
    progress: Callable[[int, int], object] = lambda *_: None,
    start: Float[NumpyArray, "p"] | None = None,
) -> Fit:
    """The search of a fit, from the best of several places or from given values, without the profiles after it."""
    candidates = frequencies(windows)
    problem, point, tried = _first_round(family, windows, candidates, progress, start)
    fixed, step_count = Fixed.nothing(len(family.first)), 0
    for k in range(1, ROUNDS):
        problem, point = problem.stable(family, point)
        point, steps = minimise(problem, point, fixed, functools.partial(progress, k))
        step_count += steps
        problem, point = problem.weighed(point, np.atleast_1d(problem.weighing.frequency))
        if k < ROUNDS - 1:
            fixed = Fixed(point.blocks.undetermined, problem.unknowns.fixed_at(point.z))
    return _conclude(family, problem, point, fixed, step_count, tried)


def _first_round(
    family: Family,
    windows: Windows,
    candidates: Float[NumpyArray, "f"],
    progress: Callable[[int, int], object],
    start: Float[NumpyArray, "p"] | None,
) -> tuple["_Predictions", Point, tuple[tuple[str, float], ...]]:
    """Searches without a filter from the best places to start from: the best end, and by how much it was the best."""
    unknowns = Unknowns.of(family)
    if start is None:
        places = starts(unknowns, jax.tree.map(np.asarray, windows), family.numbers)
    else:
        places = {"other inputs": unknowns.relative(start)}
    begun = [(name, *_begin(family, windows, candidates[:1], z)) for name, z in places.items()]
    begun = [each for each in begun if np.isfinite(each[2].blocks.loss).all()]
    if not begun:
        raise InputError("the model predicts no finite motion with its first values; mend these")
    begun = sorted(begun, key=lambda each: each[1].cost)[:POLISHED]
    ends = []
    for i, (name, problem, point) in enumerate(begun):

        def report(step: int, i: int = i) -> None:
            progress(0, (MOST_STEPS * i + step) // len(begun))

        problem, point = problem.stable(family, point)
        point, _ = minimise(problem, point, Fixed.nothing(len(point.z)), report)
        # With a new filter the parameters have not converged yet.
        ends.append((name, *problem.weighed(point, candidates)))
    best = min(ends, key=lambda each: each[1].cost)[1]
    losses = {name: best.loss_at(point) for name, _, point in ends}
    ends.sort(key=lambda each: losses[each[0]])
    name, problem, point = ends[0]
    tried = tuple((each[0], losses[each[0]] - losses[name]) for each in ends)
    return problem, point, tried


def _conclude(
    family: Family,
    problem: "_Predictions",
    point: Point,
    fixed: Fixed,
    step_count: int,
    tried: tuple[tuple[str, float], ...],
) -> Fit:
    """The fit at the end of a search: values, standard errors and undetermined combinations."""
    covariance = point.blocks.covariance(fixed.directions)
    # The undetermined combinations are fixed by a large but finite weight: remove the small change that it permits.
    z = point.z - fixed.directions @ (point.z - fixed.at)
    values, slopes = map(np.asarray, _values_and_slopes(problem.unknowns, jnp.asarray(z)))
    # Relative to the value, or for a value of zero to the unit.
    rows = combination_rows(fixed.directions, slopes / np.where(values == 0, 1.0, values))
    combined_change = np.sqrt(np.sum(rows**2, axis=0))
    variance = slopes**2 * np.diagonal(covariance) + (values * combined_change * UNKNOWN) ** 2
    # The last search may have reduced a parameter so far that it has lost its influence.
    separate = np.asarray(family.positive) & (combined_change < PURE)
    small = separate & (np.diagonal(covariance) > UNKNOWN**2)
    small |= separate & ~small & _perhaps_zero(problem, point, fixed, covariance)
    rows = np.concatenate([rows, np.eye(len(small))[small]])
    errors = np.where((combined_change < PURE) & ~small, np.sqrt(np.maximum(variance, 0.0)), np.nan)
    frequency, scale = problem.weighing
    scale = np.asarray(scale[0] if len(scale) == 1 else scale)
    machine, blocks = np.asarray(problem.windows.machine), point.blocks
    theirs, each = family.parts[machine], np.arange(len(machine))[:, None]
    information = blocks.informations[each[:, :, None], theirs[:, :, None], theirs[:, None, :]]
    evidence = Evidence(machine, np.asarray(blocks.z)[each, theirs], information)
    inverse = blocks.inverse(fixed.directions)
    unlike = contradictions(family.names, family.parts, values, np.diag(slopes), evidence, inverse)
    return Fit(family.names, family.first, values, errors, rows, scale, float(frequency), step_count, tried, unlike)


def profile(family: Family, windows: Windows, fit: Fit, again: int = RESTARTS) -> Fit:
    """Judge by profiles of the likelihood what a fit calls undetermined.

    A parameter of each undetermined combination is moved far up and down, and the others are fitted again. Where the
    loss falls, the search had ended in a wrong place and begins anew from there. Where it rises on both sides, the log
    does determine the parameter. Where it does not rise, the other parameters are known no better than it moves them;
    and one that has vanished, though its first value explains the log as well, keeps that.
    """
    if not len(fit.undetermined):
        return fit
    unknowns = Unknowns.of(family)
    problem, point = _weighed_as(family, windows, fit, fit)
    judge = _Profiles(unknowns, problem, point, CONFIDENCE**2 / 2 * point.blocks.overdispersion)
    rows, z = np.array(fit.undetermined), point.z
    leading = [int(np.argmax((row == 1) & (np.sum(rows != 0, axis=0) == 1))) for row in rows]
    kept, at, moved_by = [], z.copy(), np.zeros(len(z))
    for k, j in enumerate(leading):
        ends = judge.moved(j)
        if again and min(rise for _, rise in ends) < -judge.chance:
            lowest = min(ends, key=lambda each: each[1])[0]
            values = np.asarray(unknowns.values(jnp.asarray(lowest.z)))
            better = search(family, windows, start=values)._replace(starts=((f"a profile of {fit.names[j]}", 0.0),))
            return profile(family, windows, better, again - 1)
        flat = [end.z - z for end, rise in ends if rise < judge.chance]
        if not flat:
            continue
        kept.append(k)
        alone = np.sum(rows[k] != 0) == 1
        if alone and abs(z[j]) > MOVED and judge.rise(np.where(np.arange(len(z)) == j, 0.0, z), j)[1] < judge.chance:
            at[j] = 0.0
        change = max(flat, key=lambda each: np.abs(each).max(where=np.arange(len(z)) != j, initial=0.0))
        moved_by = np.maximum(moved_by, np.where(np.arange(len(z)) == j, 0.0, np.abs(change)))
        entangled = ~np.isnan(fit.standard_errors) & (np.abs(change) >= PURE)
        rows[k] = np.where(entangled, change / change[j], rows[k])
    released = [j for k, j in enumerate(leading) if k not in kept]
    for held in (kept, list(range(len(rows)))):
        if len(held) == len(rows) and (at == z).all():
            kept = held
            break
        ratio = np.asarray(unknowns.slopes(jnp.asarray(z))) / np.where(fit.values == 0, 1.0, fit.values)
        basis = np.linalg.qr((fit.undetermined[held] / ratio).T)[0]
        fixed = Fixed(basis @ basis.T, at)
        end, steps = minimise(problem, Point.at(problem, at, point.s), fixed)
        free = _conclude(family, problem, end, fixed, fit.steps + steps, fit.starts)
        # A loss that rises a little, and a standard error above a factor e: it stays at its first value.
        if free.determined[released].all() or len(held) == len(rows):
            fit, kept = free, held
            break
    slopes = np.asarray(unknowns.slopes(jnp.asarray(unknowns.relative(fit.values))))
    errors = np.where(moved_by < PURE, np.sqrt(fit.standard_errors**2 + (slopes * moved_by) ** 2), np.nan)
    rows = rows[kept] if len(fit.undetermined) == len(kept) else fit.undetermined
    return fit._replace(standard_errors=errors, undetermined=rows)


class _Profiles(NamedTuple):
    """Where the loss goes with one parameter moved and the others fitted again, and how far it rises by chance."""

    unknowns: Unknowns
    problem: "_Predictions"
    point: Point
    chance: float

    def moved(self, j: int) -> list[tuple[Point, float]]:
        """Points with parameter j far above and below, and the rise of the loss at each."""
        return [self.rise(self.unknowns.multiplied(self.point.z, j, by), j) for by in (FAR, 1 / FAR)]

    def rise(self, z: NumpyArray, j: int) -> tuple[Point, float]:
        begin = Point.at(self.problem, z, self.point.s)
        fixed = Fixed.nothing(len(z)).beside(j, float(z[j]))
        end, _ = minimise(self.problem, begin, fixed, most=PROFILE_STEPS)
        rise = float(np.sum(end.blocks.loss) - np.sum(self.point.blocks.loss))
        return end, rise if np.isfinite(rise) else np.inf


def window_losses(family: Family, windows: Windows, fit: Fit, weighed_as: Fit) -> Float[NumpyArray, "W"]:
    """Negative log-likelihood of each window at the values of a fit, up to a constant.

    The constant is the same for all fits whose errors are weighed as those of `weighed_as`, so that two fits to the
    same rows under other inputs can be compared (Vuong 1989, Likelihood ratio tests for model selection).
    """
    return np.asarray(_weighed_as(family, windows, fit, weighed_as)[1].blocks.loss)


def _weighed_as(family: Family, windows: Windows, fit: Fit, weighed_as: Fit) -> tuple["_Predictions", Point]:
    """The values of a fit with the best initial motions, errors weighed as those of another fit."""
    z = Unknowns.of(family).relative(fit.values)
    problem, point = _begin(family, windows, np.atleast_1d(weighed_as.frequency), z)
    problem = problem._replace(weighing=Weighing(np.asarray(weighed_as.frequency), np.atleast_2d(weighed_as.scale)))
    return problem, minimise(problem, Point.at(problem, point.z, point.s), Fixed(np.eye(len(z)), z))[0]


def relations(fit: Fit) -> tuple[str, ...]:
    """Sentences on the combinations of parameters that the log does not determine.

    Args:
        fit: The result of a fit.

    Returns:
        One sentence for each row of `fit.undetermined`, with the weights.

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import Fit, relations
        >>> first, row = np.array([1.0, 2.0]), np.array([[1.0, -1.0]])
        >>> print(*relations(Fit(("mass", "length"), first, first, np.full(2, np.nan), row, np.array([1e-3]), 10.0, 5)))
        only the product mass · length is determined: mass and length cannot be told apart
    """
    changed = np.abs(fit.values - fit.first) > MOVED * np.abs(fit.first)
    return tuple(_sentence(fit.names, row, changed) for row in fit.undetermined)


def _sentence(names: tuple[str, ...], row: Float[np.ndarray, "p"], changed: Bool[np.ndarray, "p"]) -> str:
    row = row / row[np.argmax(np.abs(row))]
    parts = [(name, weight) for name, weight in zip(names, row, strict=True) if abs(weight) > SHOWN]
    parts.sort(key=lambda part: -abs(part[1]))
    if len(parts) == 1 and changed[names.index(parts[0][0])]:
        return f"{parts[0][0]} cannot be told from zero by this log; leave it out, or log a motion that shows it"
    if len(parts) == 1:
        return f"{parts[0][0]} cannot be told from this log; it keeps its first value"
    if len(parts) == 2:
        (first, _), (second, weight) = parts
        # A change e^s of the first goes with e^(s·weight) of the second, so that 1 + power · weight must vanish.
        power = -1 / weight  # the invariant is first · second^power
        expression = f"{first} · {_power(second, power)}" if power > 0 else f"{first} / {_power(second, -power)}"
        what = "product" if power > 0 else "ratio"
        return f"only the {what} {expression} is determined: {first} and {second} cannot be told apart"
    changes = ", ".join(f"{name} by {weight:+.2g} %" for name, weight in parts)
    return f"cannot be told apart: changing {changes} together changes nothing that this log shows"


def _power(name: str, power: float) -> str:
    whole = round(2 * power) / 2
    power = whole if abs(power - whole) < ALIKE * max(whole, 0.5) else power
    return name if power == 1 else f"{name}^{power:.3g}"


@eqx.filter_jit  # one program in place of a dozen small ones
def _values_and_slopes(unknowns: Unknowns, z: Array) -> tuple[Float[Array, "p"], Float[Array, "p"]]:
    return unknowns.values(z), unknowns.slopes(z)


class _Predictions(NamedTuple):
    """Residuals of a fit: innovations over W windows, from initial motions s (W, 2n), in units of their scale."""

    unknowns: Unknowns
    substeps: int
    windows: Windows
    weighing: Weighing

    def blocks(self, z: NumpyArray, s: NumpyArray) -> Blocks:
        weights = jax.tree.map(jnp.asarray, self.weighing)
        blocks = _evaluate(self.unknowns, self.substeps, self.windows, jnp.asarray(z), jnp.asarray(s), weights)
        return jax.tree.map(np.asarray, blocks)

    def moved(self, z: NumpyArray, dz: NumpyArray) -> NumpyArray:
        return self.unknowns.moved(z, dz)

    def stable(self, family: Family, point: Point) -> tuple["_Predictions", Point]:
        """The same with enough substeps for the friction at a point, which may have grown far."""
        needed = _needed_substeps(family, self.unknowns, self.windows, point.z)
        if needed <= MARGIN * self.substeps:
            return self, point
        problem = self._replace(substeps=needed)
        return problem, Point.at(problem, point.z, point.s)

    @property
    def cost(self) -> float:
        """Mean of the logarithm of the errors over all coordinates."""
        return float(np.mean(np.log(self.weighing.scale)))

    def loss_at(self, point: Point) -> float:
        """Loss at a point, errors weighed as here."""
        return float(np.sum(Point.at(self, point.z, point.s).blocks.loss))

    def weighed(self, point: Point, trial_frequencies: Float[NumpyArray, "f"]) -> tuple["_Predictions", Point]:
        """Weigh the errors again, by the filter with the best of some frequencies [rad/s]."""
        errors, seen = point.blocks.rest
        problem = self._replace(
            weighing=weighing(self.windows, errors, seen, trial_frequencies, len(self.unknowns.parts))
        )
        return problem, Point.at(problem, point.z, point.s)


def _begin(
    family: Family, windows: Windows, frequency: Float[NumpyArray, "1"], z: Float[NumpyArray, "p"]
) -> tuple[_Predictions, Point]:
    """First point of a search: relative changes z of the parameters, measured positions and reference velocities."""
    windows = jax.tree.map(jnp.asarray, windows)
    family.file.need_mechanical(family.file.name, "numbers are fitted for")
    count, n = windows.v.shape[0], windows.v.shape[-1]
    weights = Weighing(frequency[0], np.ones((len(family.parts), n)))
    unknowns = Unknowns.of(family)
    problem = _Predictions(unknowns, _needed_substeps(family, unknowns, windows, z), windows, weights)
    return problem.weighed(Point.at(problem, z, np.zeros((count, 2 * n))), frequency)


def _needed_substeps(family: Family, unknowns: Unknowns, windows: Windows, z: Float[NumpyArray, "p"]) -> int:
    """Substeps that the stiffest of the machines needs."""
    values = np.asarray(unknowns.values(jnp.asarray(z)))
    return max(needed_substeps(family.make(own)[0], windows) for own in values[family.parts])


@eqx.filter_jit
def _evaluate(unknowns: Unknowns, substeps: int, windows: Windows, z: Array, s: Array, weighed: Weighing) -> Blocks:
    """Blocks of the windows; `rest` are the errors of the positions, and where these are measured."""
    p = z.shape[0]

    def window(s, rows, t, y, v, machine):
        own, own_z, part = unknowns.of_machine(machine, z)
        k, scale = len(own_z), jnp.asarray(weighed.scale)[machine][None]

        def errors(x):
            n = v.shape[-1]
            model, lag = own.make(own.values(x[:k]))
            inputs = lagged(jnp.asarray(windows.inputs), jnp.asarray(windows.steps), lag)
            start = Motion(model.manifold.retract(y[0], x[k : k + n]), v[0] + x[k + n :])
            raw, seen = differences(model, follow(model, t, inputs[rows], start, substeps).q, y)
            new = innovations(raw, seen, t, jnp.asarray(weighed.frequency)) / scale
            return new, (new, raw, seen)

        slope, (new, raw, seen) = jax.jacfwd(errors, has_aux=True)(jnp.concatenate([own_z, s]))
        slope = slope.reshape(-1, k + s.shape[0])
        slope = jnp.concatenate([unknowns.of_all(part, slope[:, :k]), slope[:, k:]], axis=1)
        return Blocks.one(new.ravel(), slope, p, (raw, seen))

    return jax.vmap(window)(s, windows.rows, windows.t, windows.y, windows.v, windows.machine)


def _perhaps_zero(
    problem: _Predictions, point: Point, fixed: Fixed, covariance: Float[NumpyArray, "p p"]
) -> Bool[NumpyArray, "p"]:
    """Parameters (p,) that may be zero: with one nearly zero and the rest refitted, the loss hardly rises."""
    possible = np.asarray(problem.unknowns.positive) & (point.z < 0) & (np.diagonal(covariance) > ROUGH**2)
    uncorrelated_variance = np.diagonal(point.blocks.inverse(fixed.directions))
    for j in np.flatnonzero(possible):
        # Fixed at e^−PRIOR times its value the parameter is all but zero.
        without, _ = minimise(problem, point, fixed.beside(int(j), float(point.z[j]) - PRIOR))
        rise = float(np.sum(without.blocks.loss) - np.sum(point.blocks.loss))
        # Errors that are correlated within a window enlarge the variance, and by the same factor the rise due to
        # chance.
        possible[j] = rise < CONFIDENCE**2 / 2 * covariance[j, j] / uncorrelated_variance[j]
    return possible
