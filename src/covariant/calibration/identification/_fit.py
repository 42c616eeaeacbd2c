"""Parameters with which a model explains logs best: those of the greatest likelihood, with that of the noise.

The search begins with noise that explains the whole motion, where it is a regression of accelerations that cannot lose
its way, and alternates between the parameters and the likeliest noise. Standard errors follow from the information of
the innovations, or from the scatter of its blocks where that is clearly larger.
"""

import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from covariant.calibration._least_squares import PRIOR, UNKNOWN, Fixed, Point, combination_rows, minimise
from covariant.calibration.identification._contradictions import Evidence, contradictions
from covariant.calibration.identification._error_model import NoiseLevels
from covariant.calibration.identification._likelihood import GAINED, Likelihood, first_noise
from covariant.calibration.identification._rows import Rows
from covariant.calibration.identification._states import rows_of, unknowns_of
from covariant.calibration.identification._unknowns import Unknowns
from covariant.models import Family
from covariant.signals import Record
from scalargraph.errors import InputError

ROUNDS = 14
"""Most rounds of a search; each finds the likeliest noise, and then the parameters."""
NOISE_STEPS, ROUND_STEPS = 10, 4
"""Most steps of the two searches of a round."""
EXACT_STEPS, MOST_EXACT = 6, 12
"""Most steps at the end of a search with derivatives by differences, and the most numbers of which these are taken."""
NEAR = 0.1
"""Distance over which they are taken, and size of a step that ends them, in standard errors."""
SCALED = 10.0
"""Factor by which each first value is changed, up and down, to begin a search from."""
FAR_OFF = 50.0
"""Twice the negative log-likelihood above what is worth going on, from which a search is given up."""
ACCURACY = 1e-5
"""Relative accuracy of a number, however little noise there is: that of integration with inputs that are even in a
step."""
DIFFERENT = 1.5
"""Ratio of the standard error from the scatter of blocks to that from the information, above which something is wrong
with the model, and the larger one holds."""
PURE = 0.2
"""A parameter is determined by itself if the undetermined combinations, changed by their full size, change it by a
smaller fraction; its standard error includes that change."""
ROUGH = 0.2
"""A parameter with a larger relative standard error may be zero: its influence need not be linear down to zero."""
CONFIDENCE = 2.0
"""Standard errors within which a parameter cannot be distinguished from zero."""
FAR, PROFILE_STEPS = 8.0, 5
"""Factor by which a profile of the likelihood moves a parameter, and the most steps of the others."""
INFORMED = 1e-3
"""Information below which a combination is not determined, however the loss rises far away."""
RESTARTS = 1
"""How often a search begins anew from a better place that a profile has found."""
SHOWN = 0.03
"""Weights of a combination below this fraction of the largest are not shown."""
MOVED = 0.01
"""Relative change from its first value by which a parameter counts as changed."""
ALIKE = 0.05
"""An exponent that is this close, relatively, to a whole number or a half is rounded to it."""

NumpyArray = np.ndarray


class Fit(NamedTuple):
    """Result of a fit of p parameters to logs.

    Read `determined` before you use `values`: a parameter that the logs do not determine has its first value there, and
    no standard error. The standard errors do not cover a wrong form of the model.

    Attributes:
        names: Names of the parameters.
        first: Values (p,) before the fit.
        values: Values (p,) after it.
        standard_errors: Standard errors (p,); NaN for a parameter that is not determined.
        undetermined: Combinations that the log does not determine: relative changes of the parameters as rows (d, p);
            each row has an entry of 1 in a parameter that is in no other row. Along them the parameters stay at their
            first values; but one that was reduced until the log could not distinguish it from zero keeps the reduced
            value.
        noise: Likeliest noise of readings and model.
        scatter: Standard errors (p,) from the scatter of blocks of the logs over those from the information: far above
            1 where the model is wrong somewhere.
        unlike: Sentences on machines whose logs contradict a number that all machines share.

    Example:
        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> from covariant.calibration import Fit
        >>> from covariant.calibration.identification import NoiseLevels
        >>> values, none = np.array([0.7, 0.1]), np.eye(2)[1:]
        >>> noise = NoiseLevels(jnp.array(0.05), jnp.array([1e-3]), jnp.array(0.0))
        >>> result = Fit(("mass", "viscous"), values, values, np.array([0.01, np.nan]), none, noise, np.ones(2))
        >>> dict(zip(result.names, result.determined.tolist()))
        {'mass': True, 'viscous': False}
    """

    names: tuple[str, ...]
    first: Float[NumpyArray, "p"]
    values: Float[NumpyArray, "p"]
    standard_errors: Float[NumpyArray, "p"]
    undetermined: Float[NumpyArray, "d p"]
    noise: NoiseLevels
    scatter: Float[NumpyArray, "p"]
    unlike: tuple[str, ...] = ()

    @property
    def determined(self) -> Bool[NumpyArray, "p"]:
        """Whether the log determines each parameter (p,) by itself."""
        return np.isfinite(self.standard_errors)


class Solved(NamedTuple):
    """The end of a search: the fit, the point of the likelihood at it, what is fixed, bounds of the logarithms of
    noise, and the kinds of noise that there are not."""

    family: Family
    fit: Fit
    problem: Likelihood
    point: Point
    fixed: Fixed
    bounds: Float[NumpyArray, "k 2"]
    without: tuple[str, ...] = ()

    @property
    def quiet(self) -> bool:
        """Whether readings alone are noisy."""
        return "forces" in self.without

    @property
    def least(self) -> Float[NumpyArray, "n"]:
        """Least noise (n,) of a reading."""
        return np.exp(self.bounds[1 : 1 + self.point.blocks.rest.system.residual.shape[1], 0])


def fit(
    family: Family,
    records: Sequence[Record],
    velocities: Sequence[Float[NumpyArray, "_ n"]],
    progress: Callable[[int, int], object] = lambda *_: None,
) -> Fit:
    """Fit the open parameters of a model to all rows of logs.

    Positive parameters are searched by their logarithms. Combinations that the log does not determine keep their first
    values, and are listed in `Fit.undetermined`.

    Use it where you have the records. The verb `covariant.fit` starts from files, judges on held-out rows, and tries
    both held and linear inputs where the model file does not say which. `fit_robot` is faster for many numbers of a
    robot.

    Args:
        family: The model as a function of its p open parameters, from `models.family`.
        records: The logs.
        velocities: Velocities (T, n) of each near the true ones, as from `scoring.zero_phase_velocity`: the search for
            the motion begins there. Of a `StateSpace` rates (T, p) of its outputs.
        progress: Called with the index of the round and of its step before each step, from 0.

    Returns:
        Values, standard errors, and undetermined combinations.

    Raises:
        ValueError: The model's first prediction is not finite, or the logs are too short.

    Example:
        >>> import numpy as np
        >>> from covariant import models
        >>> from covariant.calibration import fit
        >>> from covariant.signals import Record
        >>> t = np.arange(500) * 0.02
        >>> record = Record(t, np.zeros((500, 1)), np.cos(t)[:, None])  # a unit mass on a spring of 1 N/m
        >>> family = models.family("oscillator", ["stiffness"], ["parameters.stiffness=2.0"])
        >>> result = fit(family, [record], [-np.sin(t)[:, None]])
        >>> result.names, result.values.round(4).tolist()
        (('stiffness',), [1.0])
    """
    return profile(search(family, rows_of(family, records, velocities), progress)).fit


def search(
    family: Family,
    rows: Rows,
    progress: Callable[[int, int], object] = lambda *_: None,
    start: Float[NumpyArray, "p"] | None = None,
    least: Float[NumpyArray, "n"] | None = None,
) -> Solved:
    """The search of a fit, from the best of several places or from given values (p,), without the profiles after it.

    The prior, and what is not determined, stay at the first values. `least` (n,) is the least noise of a reading.
    """
    unknowns = unknowns_of(family, rows)
    free = Fixed.nothing(len(family.first))
    rough, bounds = begun(unknowns, rows, least)
    places = _places(unknowns, family) if start is None else [unknowns.relative(start)]
    begins = [Point.at(rough, z) for z in places]
    begins = [point for point in begins if np.isfinite(point.blocks.loss).all()]
    if not begins:
        raise InputError("the model predicts no finite motion with its first values; mend these")
    # The first place, and the best of the others where that explains more.
    best = min(range(len(begins)), key=lambda k: begins[k].loss(free))
    ends = [minimise(rough, begins[k], free, functools.partial(progress, 0)) for k in sorted({0, best})]
    point = min(ends, key=lambda end: end.loss(free))
    solved = Solved(family, None, rough, point, free, bounds)  # pyright: ignore[reportArgumentType]
    return _conclude(likeliest(solved, progress))


def likeliest(solved: Solved, progress: Callable[[int, int], object]) -> Solved:
    """The end of the search from a point, with forces and wiggles or without, whichever explains the rows better."""
    rounds, n = itertools.count(1), solved.problem.noise.measurement.size
    solved, loss = _alternate(solved, progress, rounds)
    # What a kind of noise explains has to be worth its numbers (Akaike 1974). Readings that are off together pass for
    # forces, without the doubt that these leave about the numbers of the model.
    worth = loss + 2 * (n + 1)
    still, still_loss = _alternate(solved._replace(without=("wiggle",)), progress, rounds, worth)
    solved, loss = _exact(*((still, still_loss) if still_loss < worth else (solved, loss)))
    worth = loss + 2 * (len(solved.bounds) - 1 - (n + 1) * len(solved.without))
    quiet, quiet_loss = _alternate(solved._replace(without=("wiggle", "forces")), progress, rounds, worth)
    return quiet if quiet_loss < worth else solved


def begun(
    unknowns: Any, rows: Rows, least: Float[NumpyArray, "n"] | None
) -> tuple[Likelihood, Float[NumpyArray, "k 2"]]:
    """The likelihood with which a search begins: with the noise that explains the motion under the first values.

    Also bounds of the logarithms of noise.
    """
    first, rows = np.zeros(len(unknowns.first)), jax.tree.map(jnp.asarray, rows)
    speed, steps = unknowns.speed(rows), unknowns.steps(first, rows)
    system = unknowns.linearised(jnp.asarray(first), rows.start, rows, steps)
    noise, bounds = first_noise(unknowns, rows, system, least)
    rough = Likelihood(unknowns, rows, steps, noise, speed, system.input_matrix)
    # With less noise of readings than there is a search would take it for friction.
    return rough.likelier(Point.at(rough, first).blocks.rest, bounds, NOISE_STEPS)[0], bounds


def _alternate(
    solved: Solved, progress: Callable[[int, int], object], rounds: Iterator[int], worth: float = np.inf
) -> tuple[Solved, float]:
    """Rounds of searches for noise and for parameters, until neither gains, or what is reached is not `worth` going on;
    what is not determined is fixed then. Also twice the negative log-likelihood."""
    _, _, problem, point, fixed, bounds, without = solved
    loss, before = np.inf, np.inf
    for k in range(1, ROUNDS):
        problem = problem._replace(substeps=problem.unknowns.steps(point.z, problem.rows))
        problem, loss = problem.likelier(point.blocks.rest, bounds, NOISE_STEPS, without)
        point = Point.at(problem, point.z, point.blocks.rest)
        point = minimise(problem, point, fixed, functools.partial(progress, next(rounds)), ROUND_STEPS)
        if k > 1 and loss > worth + (FAR_OFF if k > 2 else np.isfinite(np.asarray(problem.rows.y)).sum()):
            break
        if before - loss < GAINED:
            if fixed.directions.any() or not (held := point.blocks.undetermined).any():
                break
            fixed = Fixed(held, problem.unknowns.fixed_at(point.z))
        before = loss
    return solved._replace(problem=problem, point=point, fixed=fixed), loss


def _exact(solved: Solved, loss: float) -> tuple[Solved, float]:
    """The same after steps with derivatives of the loss by differences, if there are forces and few numbers, and twice
    the negative log-likelihood.

    Scores take the gains of the filter as given. Where the model drives the gains, as that of a fast state under an
    unknown force, a search by scores ends off the likeliest numbers.
    """
    _, _, problem, point, fixed, bounds, without = solved
    for _ in range(0 if solved.quiet or len(point.z) > MOST_EXACT else EXACT_STEPS):
        inverse, now, rest = point.blocks.inverse(fixed.directions), point.loss(fixed), point.blocks.rest
        off = NEAR * np.sqrt(np.diagonal(inverse))
        places = [[point.z + way * row for way in (1, -1)] for row in np.diag(off)]
        up, down = np.array([[Point.at(problem, z, rest).loss(fixed) for z in ends] for ends in places]).T
        slope = np.divide(up - down, 2 * off, out=np.zeros_like(off), where=off > 0)
        if not slope @ inverse @ slope > NEAR**2:
            break
        steps = (problem.moved(point.z, -fraction * inverse @ slope) for fraction in (1.0, 0.5, 0.25, 0.125))
        better = next((end for z in steps if (end := Point.at(problem, z, rest)).loss(fixed) < now), None)
        if better is None:
            break
        problem, loss = problem.likelier(better.blocks.rest, bounds, NOISE_STEPS, without)
        point = Point.at(problem, better.z, better.blocks.rest)
    return solved._replace(problem=problem, point=point), loss


def _places(unknowns: Unknowns, family: Family) -> list[Float[NumpyArray, "p"]]:
    """Places to start from: the first values, and these with one number scaled, on all machines."""
    first, each = np.zeros(len(unknowns.first)), [np.unique(own).tolist() for own in np.asarray(family.parts).T]

    def scaled(own: list[int], factor: float) -> NumpyArray:
        return functools.reduce(lambda z, j: unknowns.multiplied(z, j, factor), own, first)

    return [first, *(scaled(own, factor) for factor in (SCALED, 1 / SCALED) for own in each)]


def _conclude(solved: Solved) -> Solved:
    """The fit at the end of a search: values, standard errors and undetermined combinations."""
    family, _, problem, point, fixed, *_ = solved
    inverse = point.blocks.inverse(fixed.directions)
    simple, scattered = np.diagonal(inverse), np.diagonal(point.blocks.covariance(fixed.directions))
    scatter = np.sqrt(np.divide(scattered, simple, out=np.ones_like(simple), where=(simple > 0) & (scattered > 0)))
    certain = np.where(scatter > DIFFERENT, scattered, simple)
    # The undetermined combinations are fixed by a large but finite weight: remove the small change that it permits.
    z = point.z - fixed.directions @ (point.z - fixed.at)
    values, slopes = map(np.asarray, _values_and_slopes(problem.unknowns, jnp.asarray(z)))
    # Relative to the value, or for a value of zero to the unit.
    rows = combination_rows(fixed.directions, slopes / np.where(values == 0, 1.0, values))
    combined_change = np.sqrt(np.sum(rows**2, axis=0))
    variance = slopes**2 * certain + (values * combined_change * UNKNOWN) ** 2 + (ACCURACY * values) ** 2
    # The last search may have reduced a parameter so far that it has lost its influence.
    separate = np.asarray(family.positive) & (combined_change < PURE)
    small = separate & (certain > UNKNOWN**2)
    small |= separate & ~small & _perhaps_zero(problem, point, fixed, certain)
    rows = np.concatenate([rows, np.eye(len(small))[small]])
    errors = np.where((combined_change < PURE) & ~small, np.sqrt(np.maximum(variance, 0.0)), np.nan)
    machine, blocks = np.asarray(problem.rows.machine), point.blocks
    theirs, each = family.parts[machine], np.arange(len(machine))[:, None]
    information = blocks.informations[each[:, :, None], theirs[:, :, None], theirs[:, None, :]]
    evidence = Evidence(machine, np.asarray(blocks.z)[each, theirs], information)
    unlike = contradictions(family.names, family.parts, values, np.diag(slopes), evidence, inverse)
    found = Fit(family.names, family.first, values, errors, rows, problem.noise, scatter, unlike)
    return solved._replace(fit=found)


def again(
    solved: Solved, rows: Rows, progress: Callable[[int, int], object] = lambda *_: None, noise: bool = True
) -> Solved:
    """The same numbers fitted once more to other rows, from where the search ended; the `noise` too, or as it was."""
    problem = solved.problem._replace(rows=jax.tree.map(jnp.asarray, rows))
    point = Point.at(problem, solved.point.z)
    begun = solved._replace(problem=problem, point=point, fixed=Fixed.nothing(len(point.z)))
    if not noise:
        return _conclude(begun._replace(point=minimise(problem, point, begun.fixed, functools.partial(progress, 0))))
    return _conclude(_exact(*_alternate(begun, progress, itertools.count()))[0])


def profile(solved: Solved, again: int = RESTARTS) -> Solved:
    """Judge by profiles of the likelihood what a fit calls undetermined.

    A parameter of each undetermined combination is moved far up and down, and the others are fitted again. Where the
    loss falls, the search had ended in a wrong place and begins anew from there. Where it rises on both sides, the log
    does determine the parameter. Where it does not rise, the other parameters are known no better than it moves them;
    and one that has vanished, though its first value explains the log as well, keeps that.
    """
    family, fit, problem, point, *_ = solved
    if not len(fit.undetermined):
        return solved
    unknowns = problem.unknowns
    judge = _Profiles(problem, point, CONFIDENCE**2 / 2 * point.blocks.overdispersion)
    rows, z = np.array(fit.undetermined), point.z
    leading = [int(np.argmax((row == 1) & (np.sum(rows != 0, axis=0) == 1))) for row in rows]
    kept, at, moved_by = [], z.copy(), np.zeros(len(z))
    information, directions = np.linalg.eigh(point.blocks.information)
    blind = directions[:, information < INFORMED]
    for k, j in enumerate(leading):
        ends = [judge.rise(unknowns.multiplied(z, j, by), j) for by in (FAR, 1 / FAR)]
        if again and min(rise for _, rise in ends) < -judge.chance:
            lowest = min(ends, key=lambda each: each[1])[0]
            values = np.asarray(unknowns.values(jnp.asarray(lowest.z)))
            better = search(family, problem.rows, start=values, least=solved.least)
            return profile(better, again - 1)
        flat = [end.z - z for end, rise in ends if rise < judge.chance]
        along = rows[k] * fit.values / np.asarray(unknowns.slopes(jnp.asarray(z)))
        if not flat and np.linalg.norm(blind.T @ along) < 0.9 * np.linalg.norm(along):
            continue
        kept.append(k)
        if not flat:  # so far off that no step leads back, but without any information near the end of the search
            continue
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
        end = minimise(problem, Point.at(problem, at, point.blocks.rest), fixed)
        free = _conclude(solved._replace(point=end, fixed=fixed))
        # A loss that rises a little, and a standard error above a factor e: it stays at its first value.
        if free.fit.determined[released].all() or len(held) == len(rows):
            solved, kept = free, held
            fit = free.fit
            break
    slopes = np.asarray(unknowns.slopes(jnp.asarray(unknowns.relative(fit.values))))
    errors = np.where(moved_by < PURE, np.sqrt(fit.standard_errors**2 + (slopes * moved_by) ** 2), np.nan)
    rows = rows[kept] if len(fit.undetermined) == len(kept) else fit.undetermined
    return solved._replace(fit=fit._replace(standard_errors=errors, undetermined=rows))


class _Profiles(NamedTuple):
    """Where the loss goes with one parameter moved and the others fitted again, and how far it rises by chance."""

    problem: Likelihood
    point: Point
    chance: float

    def rise(self, z: NumpyArray, j: int) -> tuple[Point, float]:
        """The best point with parameter j as in z, and the rise of the loss there."""
        begin = Point.at(self.problem, z, self.point.blocks.rest)
        fixed = Fixed.nothing(len(z)).beside(j, float(z[j]))
        end = minimise(self.problem, begin, fixed, most=PROFILE_STEPS)
        rise = float(np.sum(end.blocks.loss) - np.sum(self.point.blocks.loss))
        return end, rise if np.isfinite(rise) else np.inf


def block_losses(solved: Solved, weighed_as: Solved) -> Float[NumpyArray, "B"]:
    """Negative log-likelihood of each block at the values of a fit, with the noise of another fit.

    Two fits to the same rows under other inputs can be compared by it (Vuong 1989, Likelihood ratio tests for model
    selection).
    """
    problem = solved.problem._replace(noise=weighed_as.problem.noise)
    return problem.blocks(solved.point.z, solved.point.blocks.rest).loss


def relations(fit: Fit) -> tuple[str, ...]:
    """Sentences on the combinations of parameters that the log does not determine.

    Args:
        fit: The result of a fit.

    Returns:
        One sentence for each row of `fit.undetermined`, with the weights.

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import Fit, relations
        >>> from covariant.calibration.identification import NoiseLevels
        >>> noise = NoiseLevels(np.array(0.05), np.array([1e-3]), np.array(0.0))
        >>> first, row = np.array([1.0, 2.0]), np.array([[1.0, -1.0]])
        >>> print(*relations(Fit(("mass", "length"), first, first, np.full(2, np.nan), row, noise, np.ones(2))))
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


def _perhaps_zero(
    problem: Likelihood, point: Point, fixed: Fixed, variance: Float[NumpyArray, "p"]
) -> Bool[NumpyArray, "p"]:
    """Parameters (p,) that may be zero: with one nearly zero and the rest refitted, the loss hardly rises."""
    possible = np.asarray(problem.unknowns.positive) & (point.z < 0) & (variance > ROUGH**2)
    uncorrelated_variance = np.diagonal(point.blocks.inverse(fixed.directions))
    for j in np.flatnonzero(possible):
        # Fixed at e^−PRIOR times its value the parameter is all but zero.
        without = minimise(problem, point, fixed.beside(int(j), float(point.z[j]) - PRIOR), most=PROFILE_STEPS)
        rise = float(np.sum(without.blocks.loss) - np.sum(point.blocks.loss))
        # Errors that are alike within a block enlarge the variance, and by the same factor the rise due to chance.
        possible[j] = rise < CONFIDENCE**2 / 2 * variance[j] / uncorrelated_variance[j]
    return possible
