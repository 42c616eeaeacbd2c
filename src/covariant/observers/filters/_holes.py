"""Most probable motion through a hole, a stretch without readings, found by relinearising until nothing changes.

A smoother linearises along the filter's estimate, which drifts far away from the motion in a long hole. So the motion
is written as the steps of the filter, each followed by a displacement by its process noise, and the numbers z of unit
variance that make up the start and the noise minimise

    J(z) = |z|² + Σ rᵀR⁻¹r,

with the innovations r of the first readings after the hole. A Gauss–Newton step is one pass of the smoother, linearised
along the last motion; the step is shortened until J itself falls.

If a coordinate is read modulo a turn, the readings after a long hole leave open how many turns there were. J is then
minimised for each number of turns, and exp(−J/2) is its weight. The velocity after the hole decides: a motion with
another turn needs accelerations that the process noise makes improbable. The weights are those of the filter's own
process noise. If that is too small, they are too certain.

Source: Bell 1994, The iterated Kalman smoother as a Gauss–Newton method, SIAM Journal on Optimization 4(3).
"""

import functools
import itertools
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from covariant._linalg import lower_solve, triangular_with_rank, upper_solve
from covariant._typing import Code, Flag, Matrix, Scalar, Vector
from covariant.observers.base import AbstractWrapper, Rows, normalised_square, updated
from covariant.observers.filters._gated_filter import AbstractGatedFilter, State
from covariant.scoring import longest_step

AFTER = 8
"""Number of readings after a hole that decide on the motion through it; they tell position and velocity there."""
MOST_TURNS = 3
"""Number of turns more and less than those of the nearest reading that are tried."""
DOUBTFUL = 1 / 16
"""Standard deviation of a prediction, in turns, above which another turn is as close as 8 deviations."""
UNCERTAIN = 100.0
"""Standard deviation of a prediction, in those of a reading, above which the motion in the hole is relinearised."""
MOST_STEPS = 20
"""Most Gauss–Newton steps."""
HALVINGS = 12
"""Number of lengths of a step that are tried, each half of the one before."""
CONVERGED = 1e-6
"""Relative decrease of J below which the motion is found."""
IMPLAUSIBLE = 100.0
"""J for each reading above which Gauss–Newton steps have failed."""
SMALL = 1e-4
"""Size of the root of a covariance by which the transition is measured, so small that sigma points are tangents."""


class Hole(NamedTuple):
    """What a smoother finds out about one coordinate in a hole.

    Attributes:
        begin: Stamp [s] of the last reading before the hole.
        end: Stamp [s] of the first reading after it.
        coordinate: Index of the coordinate among those measured.
        turns: How far the coordinate moved over the hole, in turns, or in periods of its reading.
        probability: Probability of this number among those tried.
    """

    begin: float
    end: float
    coordinate: int
    turns: float
    probability: float


class Reading(NamedTuple):
    """How a filter took a measurement.

    Attributes:
        used: Which entries (n,) it used.
        std, noise_std: Standard deviations (n,) of the innovation, and of the noise of the measurement.
        restarted: Whether it restarted.
    """

    used: Bool[Array, "n"]
    std: Vector
    noise_std: Vector
    restarted: Flag


class Window(NamedTuple):
    """Rows from the last reading before a hole to the last of the first readings after it.

    Attributes:
        first, last: The first row, and the last one.
        columns: Which entries (n,) of a measurement have a hole.
        begin, end: Rows (n,) of the last reading before, and of the first reading after the hole of each entry.
    """

    first: int
    last: int
    columns: Bool[np.ndarray, "n"]
    begin: Int[np.ndarray, "n"]
    end: Int[np.ndarray, "n"]


def find_windows(
    t: np.ndarray, used: Bool[np.ndarray, "T n"], deviations: Float[np.ndarray, "T n"], started: np.ndarray
) -> Iterator[Window]:
    """Windows of a log in which the filter's linearisation is in doubt.

    These are holes at whose end the prediction is `UNCERTAIN`, or after which the filter `started` (T,) anew.
    """
    holes = []
    for i, column in enumerate(used.T):
        rows = np.flatnonzero(column)
        if len(rows) > 2:
            wide = np.flatnonzero(np.diff(t[rows]) > longest_step(t[rows]))
            holes += [(rows[k], rows[k + 1], i) for k in wide]
    holes.sort()
    groups: list[list[tuple[int, int, int]]] = []
    for hole in holes:
        # A hole that begins before all coordinates are read again belongs to the same window.
        if groups and hole[0] < max(b for _, b, _ in groups[-1]):
            groups[-1].append(hole)
        else:
            groups.append([hole])
    for group, following in itertools.zip_longest(groups, groups[1:]):
        begin, end = np.full(used.shape[1], -1), np.full(used.shape[1], -1)
        for a, b, i in reversed(group):
            begin[i], end[i] = a, max(b, end[i])
        columns, first, back = end >= 0, group[0][0], max(b for _, b, _ in group)
        most = following[0][0] if following else len(t) - 1
        counts = np.cumsum(used[back : most + 1][:, columns], axis=0).min(axis=1)
        last = back + min(int(np.searchsorted(counts, AFTER)), most - back)
        doubtful = any(deviations[b, i] > UNCERTAIN for _, b, i in group) or started[back : last + 1].any()
        if doubtful and last > first:
            yield Window(int(first), int(last), columns, begin, end)


class Inputs(NamedTuple):
    """The rows after the first one of a window, finer where rows are missing, and filled up by steps of length 0.

    Attributes:
        rows: Steps (M,); measurements are filled by the readings closest in time, so that turns can be counted.
        used: Which entries (M, n) are used.
        period: Period (n,) of each entry, 0 for none.
        on_circle: Whether an entry is an angle on a full circle, with innovations within half a turn.
        end: Row (n,) of the first reading after the hole of each entry, 0 if it has none.
    """

    rows: Rows
    used: Array
    period: Array
    on_circle: Array
    end: Array


def fine_rows(
    t: np.ndarray, u: np.ndarray, y: np.ndarray, used: np.ndarray, window: Window, period: np.ndarray, circles: Any
) -> tuple[Inputs, Int[np.ndarray, "K"]]:
    """Inputs of the rows of a window, and the rows of the path, which has one row more, that are those of the log."""
    usual, near = np.median(np.diff(t)), slice(window.first, window.last + 1)
    steps = np.diff(t[near])
    # One long step would be linearised once only.
    parts = np.maximum(np.ceil(steps / usual - 0.5).astype(int), 1)
    places = np.concatenate([[0], np.cumsum(parts)])
    more = rounded_up(places[-1]) - places[-1]
    dt = np.pad(np.repeat(steps / parts, parts), (0, more))
    taken = np.zeros((len(dt), used.shape[1]), bool)
    taken[places[1:] - 1] = used[near][1:]
    # In the place of a missing reading is the next one.
    flat = y[near].reshape(len(steps) + 1, -1)
    known = np.isfinite(flat) & (
        used[near] if flat.shape == used[near].shape else np.all(used[near], axis=1, keepdims=True)
    )
    row = np.minimum.accumulate(np.where(known, np.arange(len(flat))[:, None], len(steps))[:0:-1])[::-1]
    filled = np.take_along_axis(flat, row, axis=0).reshape(-1, *y.shape[1:])
    source = np.repeat(np.arange(len(steps)), np.append(parts[:-1], parts[-1] + more))
    rows = Rows(*map(jnp.asarray, (u[near][source], filled[source], dt)))
    end = np.where(window.columns, places[np.maximum(window.end - window.first, 0)], 0)
    return Inputs(*jax.tree.map(jnp.asarray, (rows, taken, period, circles, end))), places


def rounded_up(count: int) -> int:
    """A number of rows, rounded up such that few programs are needed: four per octave."""
    step = 2 ** max(int(count).bit_length() - 3, 0)
    return -(-count // step) * step


class Stepwise(AbstractWrapper[State, Any]):
    """A filter whose step is another function of its state, an input, a measurement and a time; estimates are states.

    The infos of that function say in a field `lost` whether the state is.
    """

    observer: AbstractGatedFilter
    advanced: Callable[[Any, Array, Array, Scalar], tuple[Any, Any]]

    def correct(self, state: State, u: Array, y: Array) -> tuple[State, Any]:
        return self.observer.correct(state, u, y)

    def advance(self, state: State, u: Array, y: Array, dt: Scalar) -> tuple[State, Any]:
        return self.advanced(state, u, y, dt)

    def lost(self, state: State, info: Any) -> Flag:
        return info.lost

    def estimate(self, state: State) -> State:
        return state


class Displaced(NamedTuple):
    """Info of a prediction that is displaced: transition and noise root, in the frame of the new state."""

    transition: Matrix
    noise: Matrix
    result: Code
    lost: Flag


class Path(NamedTuple):
    """A motion through a window, row by row: M + 1 rows, the first of which is its start.

    Attributes:
        states: States of the filter.
        transition, noise: Transition (M + 1, N, N) of the error of a row, and root of the noise that is added to it.
        residual: Innovations (M + 1, n), on the turn that is assumed.
        slope: Their derivatives (M + 1, n, N) with respect to the error of the row.
        cov: Covariances (M + 1, n, n) of the readings.
    """

    states: Any
    transition: Array
    noise: Array
    residual: Array
    slope: Array
    cov: Array


def _path(observer: AbstractGatedFilter, start: Any, inputs: Inputs, z: Float[Array, "M1 N"]) -> Path:
    root = observer.root(start)
    first, reset = observer.moved(start, root @ z[0])
    eye = jnp.eye(len(root), dtype=root.dtype)
    # Without uncertainty before a step, that after it is the noise. A motion that diverges counts as none.
    roots, code, kept = jnp.stack([0 * eye, SMALL * eye]), jnp.zeros((), jnp.int32), jnp.zeros((), bool)

    def displaced(z, state, u, _, dt):
        both, carried = jax.vmap(lambda root: observer.carried(observer.with_root(state, root), u, dt))(roots)
        predicted = jax.tree.map(lambda a: a[0], both)
        noise = observer.root(predicted)
        new, reset = observer.moved(predicted, noise @ z)
        return new, Displaced(reset @ carried[1] / SMALL, reset @ noise, code, kept)

    def step(state, row):
        z, row = row
        stepwise = Stepwise(observer, functools.partial(displaced, z))
        new, info = stepwise.step(state, row.u, jnp.full_like(row.y, jnp.nan), row.dt)
        return new, (new, info.transition, info.noise)

    states, transition, noise = jax.lax.scan(step, first, (z[1:], inputs.rows))[1]
    states, transition, noise = jax.tree.map(
        lambda a, b: jnp.concatenate([a[None], b]),
        (first, jnp.zeros_like(root), reset @ root),
        (states, transition, noise),
    )
    u, y = (jnp.concatenate([a[:1], a]) for a in inputs.rows[:2])
    u = jnp.where(jnp.isfinite(u), u, 0.0)
    residual, slope, cov = jax.vmap(observer.seen)(states, u, y)
    # Counted from the start, so that its own displacement does not change the count.
    whole = jnp.concatenate([observer.innovation(start, u[0], y[0])[None], residual])
    turned = jnp.unwrap(whole, axis=0, period=2 * np.pi)[1:]
    residual = jnp.where(inputs.on_circle[None], turned, residual)
    return Path(states, transition, noise, residual, slope, cov)


def _cost(path: Path, z: Array, inputs: Inputs, shift: Vector) -> Scalar:
    residual = path.residual[1:] + shift[None]
    cost = jnp.sum(z**2) + jnp.sum(jax.vmap(normalised_square)(path.cov[1:], residual, inputs.used))
    return jnp.where(jnp.isfinite(cost), cost, jnp.inf)


class Pass(NamedTuple):
    """A pass of the smoother along a path, row by row.

    Attributes:
        z: The numbers (M + 1, N) at which J of the linearisation is least.
        mean: Mean (M + 1, N) of the error after the readings up to a row, as seen from the path.
        predicted_mean: The same, without the readings of the row.
        root, predicted: Roots (M + 1, N, N) of its covariance, with and without the readings of the row.
        carried: The product (M + 1, N, N) of the transition with the root before.
    """

    z: Array
    mean: Array
    predicted_mean: Array
    root: Array
    predicted: Array
    carried: Array


def _smoothing_pass(path: Path, z: Array, inputs: Inputs, shift: Vector) -> Pass:
    count = z.shape[1]
    used = jnp.concatenate([jnp.zeros_like(inputs.used[:1]), inputs.used])

    def forward(before, row):
        mean, root = before
        (_, transition, noise, residual, slope, cov), z, used = row
        carried = transition @ root
        predicted = triangular_with_rank(jnp.concatenate([carried, noise], axis=1))
        predicted_mean = transition @ mean - noise @ z
        # The slope of an innovation is minus that of the output.
        gain, root = updated(predicted, -slope @ predicted, cov, used)
        innovation: Any = jnp.where(used, residual + shift + slope @ predicted_mean, 0.0)
        mean = predicted_mean + gain @ innovation
        return (mean, root), (mean, predicted_mean, root, predicted, carried)

    nothing = jnp.zeros(count, z.dtype), jnp.zeros((count, count), z.dtype)
    rows = jax.lax.scan(forward, nothing, (path._replace(states=None), z, used))[1]
    mean, root = rows[0], rows[2]

    def backward(error, row):
        (_, predicted_mean, _, predicted, carried), noise, before, before_mean = row
        # P⁻ λ is the change of a row by the readings from there on: the gain of the smoother, without P⁻ before it.
        costate = upper_solve(predicted, lower_solve(predicted, (error - predicted_mean)[:, None]))[:, 0]
        return before_mean + before @ (carried.T @ costate), noise.T @ costate

    earlier = jax.tree.map(lambda a: jnp.concatenate([jnp.zeros_like(a[:1]), a[:-1]]), (root, mean))
    new = jax.lax.scan(backward, mean[-1], (rows, path.noise, *earlier), reverse=True)[1]
    return Pass(new, *rows)


class Improved(NamedTuple):
    """A path, the pass along it, its cost J, and numbers z with a lower one."""

    path: Path
    along: Pass
    cost: Scalar
    z: Array
    next_cost: Scalar


@eqx.filter_jit
def _improved(observer: AbstractGatedFilter, start: Any, inputs: Inputs, z: Array, shift: Vector) -> Improved:
    """A Gauss–Newton step from z, as long as J falls most."""
    path = _path(observer, start, inputs, z)
    along = _smoothing_pass(path, z, inputs, shift)
    lengths = jnp.append(0.5 ** jnp.arange(HALVINGS, dtype=z.dtype), 0.0)
    candidates = jax.vmap(lambda length: z + length * (along.z - z))(lengths)
    costs = jax.vmap(lambda z: _cost(_path(observer, start, inputs, z), z, inputs, shift))(candidates)
    best = jnp.argmin(costs)
    return Improved(path, along, costs[-1], candidates[best], costs[best])


def _fit(observer: AbstractGatedFilter, start: Any, inputs: Inputs, z: Array, shift: np.ndarray) -> Improved:
    """Minimise J from a first guess z (M + 1, N), with readings shifted by whole turns."""
    step, count = _improved(observer, start, inputs, z, jnp.asarray(shift)), 1
    while step.cost - step.next_cost > CONVERGED * step.cost and count < MOST_STEPS:
        z, count = step.z, count + 1
        step = _improved(observer, start, inputs, z, jnp.asarray(shift))
    return step._replace(z=z)


class Crossing(NamedTuple):
    """The most probable motion across a hole.

    Attributes:
        start: State of the filter before it.
        error: Error (N,) of that state.
        path: The path.
        along: The pass of the smoother along it.
        end: State of the filter at its end.
        window: Its window.
        places: Rows (K,) of the path that are those of the window.
        shift: What is added to the readings (n,) after the hole.
        cost: J.
        holes: Turns of the coordinates of which they were in doubt.
    """

    start: Any
    error: Vector
    path: Path
    along: Pass
    end: Any
    window: Window
    places: Int[np.ndarray, "K"]
    shift: Float[np.ndarray, "n"]
    cost: float
    holes: tuple[Hole, ...]


def cross(
    observer: AbstractGatedFilter,
    start: Any,
    t: np.ndarray,
    window: Window,
    fine: tuple[Inputs, Int[np.ndarray, "K"]],
    std: Float[np.ndarray, "T n"],
) -> Crossing:
    """The most probable motion from a filter's state through a window, over all numbers of turns in doubt.

    The stamps t (T,) and the standard deviations of predictions are those of the log.
    """
    inputs, places = fine
    period, end = np.asarray(inputs.period), np.asarray(inputs.end)
    columns = np.arange(len(end))
    doubtful = np.flatnonzero(window.columns & (std[window.end, columns] > DOUBTFUL * period) & (period > 0))
    nothing = jnp.zeros((len(inputs.rows.dt) + 1, len(observer.root(start))), inputs.rows.dt.dtype)
    coasted = _improved(observer, start, inputs, nothing, jnp.zeros_like(inputs.period)).path.residual
    nearest = -np.round(np.asarray(coasted)[end, columns] / np.where(period > 0, period, np.inf))
    fits: dict[tuple[int, ...], Improved] = {}

    def fit(turns: tuple[int, ...], guess: Array) -> None:
        new = _fit(observer, start, inputs, guess, period * (nearest + turns))
        if turns not in fits or new.cost < fits[turns].cost:
            fits[turns] = new

    def cost(turns: tuple[int, ...]) -> float:
        return float(fits[turns].cost)

    best, before, guess = (0,) * len(end), None, nothing
    fit(best, nothing)
    if cost(best) > IMPLAUSIBLE * int(inputs.used.sum()):
        # Far away, as beyond half a turn of an attitude: lead the motion to the readings bit by bit.
        missed = np.asarray(coasted)[end, columns] + period * nearest
        for share in (0.75, 0.5, 0.25, 0.0):
            guess = _fit(observer, start, inputs, guess, period * nearest - share * missed).z
        fit(best, guess)
    # One coordinate at a time around the best, since all combinations of several would be too many.
    while best != before:
        before = best
        for i in doubtful:
            for sign in (1, -1):
                line = [(*best[:i], best[i] + sign * m, *best[i + 1 :]) for m in range(MOST_TURNS + 1)]
                for known, turns in itertools.pairwise(line):
                    if turns not in fits:
                        fit(turns, fits[known].z)
                # A motion less probable than with a turn more or less was missed from the one side, so try the other.
                for inner, turns, outer in zip(line, line[1:], line[2:], strict=False):
                    if cost(turns) > max(cost(inner), cost(outer)):
                        fit(turns, fits[outer].z)
            best = min(fits, key=cost)
    weights = {turns: np.exp((cost(best) - cost(turns)) / 2) for turns in fits}
    found, holes = fits[best], []
    residual = np.asarray(found.path.residual)
    for i in map(int, doubtful):
        moved = residual[places[window.begin[i] - window.first], i] - residual[end[i], i]
        same = sum(weight for turns, weight in weights.items() if turns[i] == best[i]) / sum(weights.values())
        holes.append(Hole(float(t[window.begin[i]]), float(t[window.end[i]]), i, float(moved / period[i]), float(same)))
    last = observer.with_root(jax.tree.map(lambda a: a[-1], found.path.states), found.along.root[-1])
    error, shift = observer.root(start) @ found.z[0], period * (nearest + best)
    return Crossing(start, error, found.path, found.along, last, window, places, shift, float(found.cost), tuple(holes))
