"""Smooths a log: estimates the state at each row from all rows, not only from the earlier ones.

A filter runs over the log. Then the error that it made at each row is estimated, from the last row backward, from the
effect of each step on the error. With the covariance P, the transition Φ, the predicted covariance P⁻, the correction δ
and the reset 𝒥,

    C = P Φᵀ(P⁻)⁻¹,   d ← C(δ + 𝒥⁻¹d),   Pˢ ← P + C(𝒥⁻¹Pˢ𝒥⁻ᵀ − P⁻)Cᵀ,

from d = 0 and Pˢ = P at the last row. This is an affine map with noise; C is 0 where the filter restarted. The estimate
is moved by d, together with Pˢ, as a correction would move it. All of this happens in the frame of the filter, so the
smoother of a filter that does not depend on coordinates does not depend on them either.

With a lag of L rows, each row is estimated from the L rows after it, by the same recursion, starting there from d = 0.

In a long hole the filter's estimate drifts away from the motion, and the first readings after it may be refused. Such a
hole is crossed by the most probable motion, found by relinearising; see `_holes`. The filter then continues from the
end of that motion, and the recursion goes back along it.

Steps are stored for one block of rows at a time. A first pass stores the filter's state before each block. The blocks
are then run through again, the last one first; only d and Pˢ pass from one to the one before it. With a lag, blocks are
processed in the order of time, in one pass.

Source: Rauch, Tung & Striebel 1965, Maximum likelihood estimates of linear dynamic systems, AIAA Journal 3(8);
Särkkä 2008, Unscented Rauch–Tung–Striebel smoother, IEEE TAC 53(3), for transitions by statistical linearisation;
Kailath, Sayed & Hassibi 2000, Linear Estimation, chapter 10.
"""

import functools
from collections.abc import Collection, Iterable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Inexact, Int

from covariant._linalg import (
    lower_solve,
    semidefinite_root,
    solve_square,
    triangular,
    triangular_with_rank,
    upper_solve,
)
from covariant._typing import Code, Flag, Matrix, Vector
from covariant.observers.base import AbstractObserver, Gate, Report, Rows, checked, in_jax, kept, scan
from covariant.observers.filters._gated_filter import AbstractGatedFilter, State
from covariant.observers.filters._holes import (
    Crossing,
    Hole,
    Pass,
    Path,
    Reading,
    Stepwise,
    cross,
    find_windows,
    fine_rows,
    rounded_up,
)
from covariant.signals import Record, Run, StepCode
from scalargraph.errors import InputError

FARTHEST = 1e3
"""Size of smoothed estimates, relative to the filter's, above which a covariance was singular up to rounding."""
SHORT = 256
"""Number of rows up to which a part of a log is not worth a program of its own."""
BLOCK = 4096
"""Number of rows whose steps are in memory at once; a longer log is run through twice, the second time from its end."""


class Smoothed(NamedTuple):
    """A smoothed log, together with the run of the filter.

    Attributes:
        run: Stamps, smoothed estimates, and the info of the filter with the standard deviations and the slow states of
            the smoother.
        filtered: The run of the filter.
        std: Standard deviations (T, N) of the smoothed estimates, for the error of the filter: positions and velocities
            in the frame, then slow states; for a `JointKalman` positions, velocities, accelerations; for a state-space
            model its states.
        root: Square roots (T, N, N) of the covariances of the same quantities; None if they are not stored.
        holes: For each hole and coordinate whose number of turns the filter could not tell: `begin` and `end` [s], the
            index of the `coordinate`, how many `turns` it moved, and their `probability`.

    Example:
        >>> import numpy as np
        >>> from covariant import Record, models, observers
        >>> t = np.linspace(0.0, 1.0, 101)
        >>> ekf = observers.EKF(models.oscillator(), np.array([[1e-3]]), np.array([[1e-4]]), substeps=1)
        >>> smoothed = observers.smooth(ekf, Record(t, y=np.cos(t)[:, None], u=np.zeros((101, 1))))
        >>> smoothed.run, smoothed.root.shape
        (<Run: 101 rows over 1 s, 101 ok>, (101, 2, 2))
        >>> bool((smoothed.run.info.velocity_std <= smoothed.filtered.info.velocity_std).all())
        True
    """

    run: Run
    filtered: Run
    std: Float[Array, "T N"]
    root: Float[Array, "T N N"] | None
    holes: tuple[Hole, ...] = ()


class Step(NamedTuple):
    """Effect of a filter step on the error (N,) of the filter.

    Attributes:
        root: Square root S (N, N) of the covariance before the step.
        carried: ΦS (N, N).
        predicted: Square root (N, N) of the predicted covariance P⁻.
        error: Correction δ (N,).
        reset: Reset 𝒥 (N, N).
        restarted: Whether later rows contain no information on the error before the step.
        nothing: Whether the step has no length, such as the first row and the rows added at the end.
    """

    root: Matrix
    carried: Matrix
    predicted: Matrix
    error: Vector
    reset: Matrix
    restarted: Flag
    nothing: Flag | bool = False


class StepInfo(NamedTuple):
    """Info of a step: the info of the filter, and the effect of the step on the error."""

    info: Any
    step: Step
    reading: Reading
    result: Code
    lost: Flag

    @property
    def innovation(self) -> Vector:
        """The innovation of the filter."""
        return self.info.innovation


class Backward(NamedTuple):
    """The error before a step, given the error d after it: `shift + gain d`, plus Gaussian noise.

    Attributes:
        shift: Cδ (N,).
        gain: C𝒥⁻¹ (N, N).
        noise: Square root (N, N) of the covariance `P − CP⁻Cᵀ` of the noise.
    """

    shift: Vector
    gain: Matrix
    noise: Matrix


class Smoothing(NamedTuple):
    """The error of a filter's estimate, given later rows: its mean d (N,), and a root (N, N) of its covariance."""

    error: Vector
    root: Matrix


def _recorder(observer: AbstractGatedFilter) -> Stepwise:
    """A filter whose infos describe the effect of each step on the error."""

    def advanced(state, u, y, dt):
        predicted, carried = observer.carried(state, u, dt)
        new, info, step = recorded(observer, observer.root(state), carried, predicted, u, y)
        reading = Reading(*observer.reading(predicted, new, u, y), step.restarted)
        return new, StepInfo(info, step._replace(nothing=dt == 0), reading, info.result, observer.lost(new, info))

    return Stepwise(observer, advanced)


def recorded(
    observer: AbstractGatedFilter[State, Report],
    root: Matrix,
    carried: Matrix,
    predicted: State,
    u: Float[Array, "m"],
    y: Inexact[Array, "*n"],
) -> tuple[State, Report, Step]:
    """Correct a predicted state, and record the effect of prediction and correction on the error."""
    new, info, used, restarted = observer.corrected(predicted, u, y)
    # An estimate that is not finite contains no information on earlier ones.
    restarted = restarted | (info.result == int(StepCode.NOT_FINITE))
    step = Step(
        root, carried, triangular_with_rank(observer.regular_root(predicted)), used.error, used.reset, restarted
    )
    return new, info, step


def smooth(
    observer: AbstractObserver,
    record: Record,
    lag: int | None = None,
    keep: Collection[str] | None = None,
    period: Sequence[float] = (),
) -> Smoothed:
    """Run a filter over a record, and estimate each of its states again with the rows after it.

    Missing measurements, gaps, slow states, encoder ticks and refused outliers need no special treatment. After a long
    hole the number of turns of an angle is the most probable one; see `Smoothed.holes`. That needs all rows, no further
    sensors, and process noise that is not too small, since a model that claims too much is too sure of the turn. If the
    filter restarts for another reason, the rows before are estimated without those after.

    Args:
        observer: A filter with a covariance and a gate: `IntrinsicKalman`, `EKF`, `UKF`, `JointKalman` or `StateEKF`.
        record: A log; the input of a row acts from its stamp to the next.
        lag: Number of later rows from which each row is estimated; None (default) for all, 0 for the filter itself.
        keep: Names of the fields of the infos to store, as for `run`, and `"root"` for the square roots of all
            covariances, which take the most memory; None for all.
        period: Period (n,) after which each reading repeats, 0 for none, if jumps by it were removed from the record;
            angles on a full circle need none.

    Returns:
        The smoothed run, the run of the filter, and the covariances. In addition, memory is needed for the steps of
        `BLOCK` rows and of the lag.

    Raises:
        ValueError: From `Record.check`; or the observer is of another kind, the lag is negative, or a covariance is
            singular up to rounding and this affects the estimates.

    Example:
        >>> import numpy as np
        >>> from covariant import Record, models, observers
        >>> t = np.linspace(0.0, 4.0, 401)
        >>> y = np.cos(t) + 0.01 * np.random.default_rng(0).normal(size=401)
        >>> ekf = observers.EKF(models.oscillator(), np.array([[1e-4]]), np.array([[1e-4]]), substeps=1)
        >>> smoothed = observers.smooth(ekf, Record(t, np.zeros((401, 1)), y[:, None]))
        >>> errors = [np.abs(run.estimate[:, 1] + np.sin(t)).mean() for run in (smoothed.run, smoothed.filtered)]
        >>> bool(errors[0] < 0.5 * errors[1])
        True
    """
    if not isinstance(observer, AbstractGatedFilter):
        raise InputError(
            f"smooth: {type(observer).__name__} has no covariance of its own to smooth by; take an IntrinsicKalman, "
            "EKF, UKF, JointKalman or StateEKF"
        )
    if lag is not None and lag < 0:
        raise InputError(f"smooth: lag must be a number of rows, 0 or more; got {lag}")
    arrays = in_jax(checked(observer, record))
    whole = _smoothed_part(observer, *arrays, lag, keep)
    across = lag is None and not observer.sensors
    result = _with_holes(observer, arrays, whole, keep, period) if across else whole.smoothed
    largest, beside = (
        max(float(np.abs(leaf).max()) for leaf in jax.tree.leaves(run.estimate))
        for run in (result.run, result.filtered)
    )
    if largest > FARTHEST * beside:
        raise InputError(
            "smooth: some of the motion has no uncertainty but for rounding, which spoils the rest; give each "
            "coordinate some uncertainty at the start, or process noise"
        )
    return result


def smoothed(
    observer: AbstractGatedFilter,
    t: Float[Array, "T"],
    u: Float[Array, "T m"],
    y: Inexact[Array, "T *n"],
    lag: int | None = None,
    keep: Collection[str] | None = None,
) -> Smoothed:
    """Smooth arrays without checks, such as those of many runs at once under `jax.vmap`; see `smooth`."""
    return _smoothed_part(observer, t, u, y, lag, keep).smoothed


class Part(NamedTuple):
    """Smoothed rows.

    Attributes:
        smoothed: The rows, and those of the filter.
        readings: How the filter took their measurements.
        first: The knowledge of the error at the first row.
        state: State of the filter at the last row.
    """

    smoothed: Smoothed
    readings: Reading
    first: Smoothing
    state: Any


def _smoothed_part(
    observer: AbstractGatedFilter,
    t: Array,
    u: Array,
    y: Array,
    lag: int | None = None,
    keep: Collection[str] | None = None,
    state: Any = None,
    later: Smoothing | None = None,
    of: int | None = None,
) -> Part:
    """Smooth rows that begin with a state, and whose last error is known from later rows; by default a whole log.

    Part of a log `of` so many rows is padded such that the programs for the whole log serve it too.
    """
    count = len(t)
    lag = None if lag is None or lag >= count - 1 else int(lag)
    ahead = 1 if lag is None else lag + 1
    size = rounded_up(-(-(of or count) // -(-(of or count) // BLOCK)))
    while of is not None and size // 4 >= max(count, SHORT):
        size //= 4
    blocks = -(-count // size)
    # The rows added at the end are not steps, and do not affect any row of the log.
    rows, first = _begin_smoothing(observer, *_lengthened((t, u, y), blocks * size + ahead - count))
    state = first if state is None else state
    known = later is not None
    if later is None:
        root = observer.root(state)
        later = Smoothing(jnp.zeros_like(root[0]), jnp.zeros_like(root))
    fields = None if keep is None else frozenset(keep)

    def block(k, state, later, known=True):
        part = _part(rows, k * size, size + ahead)
        return _block(observer, state, part, later, jnp.asarray(known), lag, fields)

    parts: list[Any] = [None] * blocks
    if lag is None:
        states = [state]
        for k in range(blocks - 1):
            states.append(_last(observer, states[-1], _part(rows, k * size, size)))
        for k in reversed(range(blocks)):
            parts[k], later, end = block(k, states[k], later, known or k < blocks - 1)
            state = end if k == blocks - 1 else state
    else:
        for k in range(blocks):
            parts[k], _, state = block(k, state, later)
    estimate, info, std, root, filtered, filter_info, readings = _join_blocks(parts, count)
    return Part(Smoothed(Run(t, estimate, info), Run(t, filtered, filter_info), std, root), readings, later, state)


def _with_holes(
    observer: AbstractGatedFilter,
    arrays: tuple[Array, Array, Array],
    whole: Part,
    keep: Collection[str] | None,
    period: Sequence[float],
) -> Smoothed:
    """A smoothed log, smoothed again across the holes in which the filter's linearisation is in doubt."""
    t, u, y = (np.array(a) for a in arrays)
    result, (used, std, noise_std, restarted) = whole.smoothed, map(np.asarray, whole.readings)
    gate: Gate | None = observer.gate
    circles = np.isin(np.arange(used.shape[1]), observer.turning)
    given = np.resize([*period, *np.zeros(len(circles))], len(circles))
    periods = np.where(circles & (given == 0), 2 * np.pi, given)

    def smooth_rows(rows: slice, state: Any, later: Smoothing | None = None) -> Part:
        part = jnp.asarray(t[rows]), jnp.asarray(u[rows]), jnp.asarray(y[rows])
        return _smoothed_part(observer, *part, keep=keep, state=state, later=later, of=len(t))

    begun, state, crossed = 0, None, list[tuple[slice, Any, Crossing]]()
    for window in find_windows(t, used, std / noise_std, restarted):
        if window.first < begun:
            continue  # it begins among the readings that decided on the hole before
        rows = slice(begun, window.first + 1)
        start = smooth_rows(rows, state).state
        crossing = cross(observer, start, t, window, fine_rows(t, u, y, used, window, periods, circles), std)
        count = int(used[window.first + 1 : window.last + 1].sum())
        if gate is not None and crossing.cost > gate.limit(count) * max(1.0, float(start.gate.scale.max())):
            continue  # no motion of the model leads across, as after a slip
        for i in np.flatnonzero(window.columns & (given > 0)):
            y[window.end[i] :, i] += crossing.shift[i]
        crossed.append((rows, state, crossing))
        begun, state = window.last, crossing.end
    if not crossed:
        return result
    names = [name for name in observer.deviations(state) if getattr(result.run.info, name) is not None]

    def rows_of(part: Part) -> tuple:
        run = part.smoothed.run
        return run.estimate, {name: getattr(run.info, name) for name in names}, part.smoothed.std, part.smoothed.root

    part = smooth_rows(slice(begun, None), state)
    parts = [rows_of(part)]
    for rows, state, crossing in reversed(crossed):
        (estimate, info, std, root), later = _smooth_across(observer, *crossing[:4], part.first)
        across = estimate, {name: info[name] for name in names}, std, None if result.root is None else root
        # The row of the end is the first of the rows after it.
        parts.append(jax.tree.map(lambda a, places=crossing.places[1:-1]: a[places], across))
        part = smooth_rows(rows, state, later)
        parts.append(rows_of(part))
    estimate, info, std, root = jax.tree.map(lambda *each: jnp.concatenate(each), *reversed(parts))
    run = result.run._replace(estimate=estimate, info=result.run.info._replace(**info))
    holes = tuple(hole for *_, crossing in crossed for hole in crossing.holes)
    return result._replace(run=run, std=std, root=root, holes=holes)


@eqx.filter_jit
def _smooth_across(
    observer: AbstractGatedFilter, start: Any, error: Vector, path: Path, along: Pass, later: Smoothing
) -> tuple[tuple, Smoothing]:
    """Smoothed rows of a crossing, and the knowledge of the error at its start, given that at its end."""
    eye = jnp.broadcast_to(jnp.eye(len(later.error), dtype=later.error.dtype), along.carried[1:].shape)
    no = jnp.zeros(len(eye), bool)
    steps = Step(along.root[:-1], along.carried[1:], along.predicted[1:], -along.predicted_mean[1:], eye, no, no)
    maps = jax.vmap(backward_map)(steps)
    # Errors are counted from the path here, and not from the mean of a filter.
    first, smoothed = _error_at_rows(maps._replace(shift=maps.shift + along.mean[:-1]), later)
    reset = observer.moved(start, error).reset
    states = jax.tree.map(lambda a: a[:-1], path.states)
    rows = jax.vmap(functools.partial(_smoothed_row, observer))(states, smoothed)
    return rows, Smoothing(error + solve_square(reset, first.error), solve_square(reset, first.root))


def _join_blocks(parts: list[Any], count: int) -> Any:
    """The first `count` rows of all blocks; `parts` is emptied on the way, to save memory."""
    tree = jax.tree.structure(parts[0])
    pieces = [list(each) for each in zip(*map(jax.tree.leaves, parts), strict=True)]
    parts.clear()
    joined = []
    for each in pieces:
        joined.append((each[0] if len(each) == 1 else jnp.concatenate(each))[:count])
        each.clear()
    return jax.tree.unflatten(tree, joined)


def _lengthened(arrays: Iterable[Array], more: int) -> tuple[Array, ...]:
    """Arrays extended by this number of copies of their last entry."""
    return tuple(jnp.concatenate([a, jnp.broadcast_to(a[-1:], (more, *a.shape[1:]))]) for a in arrays)


@eqx.filter_jit  # one program instead of about twenty small ones
def _begin_smoothing(observer: AbstractGatedFilter, t: Array, u: Array, y: Array) -> tuple[Rows, Any]:
    """The rows of a record, and the state at the first row."""
    return Rows.of(t, u, y), observer.init(y[0], t[0])


@functools.partial(jax.jit, static_argnames="count")
def _part(rows: Rows, first: int | Int[Array, ""], count: int) -> Rows:
    # The start of the slice is an argument, so that one compilation serves all blocks.
    return Rows(*(jax.lax.dynamic_slice_in_dim(a, first, count) for a in rows))


@eqx.filter_jit
def _last(observer: AbstractObserver, state: State, rows: Rows) -> State:
    return jax.lax.scan(lambda state, row: (observer.step(state, *row)[0], None), state, rows)[0]


@eqx.filter_jit
def _block(
    observer: AbstractGatedFilter,
    state: State,
    rows: Rows,
    later: Smoothing,
    known: Flag,
    lag: int | None,
    keep: frozenset[str] | None,
) -> tuple[tuple, Smoothing, State]:
    """Smoothed rows of a block, the knowledge of the error at its first row, and the state at its last row.

    The rows are those of the block and the later ones on which it depends directly. `later` is the knowledge of the
    error at the first row of the next block, which is `known` unless the log ends; it is not needed with a lag.
    """
    states, recorded = scan(_recorder(observer), state, rows)[1]
    steps = recorded.step
    size = len(rows.dt) - (1 if lag is None else lag + 1)
    following = jax.tree.map(lambda a: a[1:], steps)
    maps = jax.vmap(backward_map)(following)

    if lag is None:
        own = observer.root(jax.tree.map(lambda a: a[-1], states))
        later = later._replace(root=jnp.where(known, later.root, own))
        first, smoothed = _error_at_rows(maps, later)
    else:
        first, smoothed = later, _smooth_with_lag(following.root, maps, size, lag)
    states = jax.tree.map(lambda a: a[:size], states)

    estimate, deviations, std, root = jax.vmap(functools.partial(_smoothed_row, observer))(states, smoothed)
    info = jax.tree.map(lambda a: a[:size], recorded.info)._replace(result=recorded.result[:size])
    info = info._replace(**jax.vmap(observer.deviations)(states))  # also for the first row, which is not a step
    new_info = info._replace(**deviations)
    root = root if keep is None or "root" in keep else None
    readings = jax.tree.map(lambda a: a[:size], recorded.reading)
    part = estimate, kept(new_info, keep), std, root, jax.vmap(observer.estimate)(states), kept(info, keep), readings
    return part, first, jax.tree.map(lambda a: a[-1], states)


def _error_at_rows(maps: Backward, last: Smoothing) -> tuple[Smoothing, Smoothing]:
    """The knowledge of the error at the first row, and at all rows but the last one, given that at the last one."""

    def earlier(now, step):
        before = error_before(now, step)
        return before, before

    return jax.lax.scan(earlier, last, maps, reverse=True)


def _smoothed_row(observer: AbstractGatedFilter, state: Any, smoothing: Smoothing) -> tuple[Any, dict, Vector, Matrix]:
    """Estimate, deviations in the info, standard deviations and root of a smoothed state."""
    new, root = smoothed_state(observer, state, smoothing)
    return observer.estimate(new), observer.deviations(new), jnp.sqrt(jnp.sum(root**2, axis=-1)), root


def _smooth_with_lag(roots: Float[Array, "M N N"], maps: Backward, size: int, lag: int) -> Smoothing:
    """The knowledge of the errors of the first `size` rows, each from the `lag` rows after it.

    Map k leads from row k + 1 to row k, and root k belongs to row k.
    """

    def part(tree, first):
        return jax.tree.map(lambda a: jax.lax.dynamic_slice_in_dim(a, first, size), tree)

    def earlier(i, smoothing):
        return jax.vmap(error_before)(smoothing, part(maps, lag - 1 - i))

    start = part(roots, lag)
    return jax.lax.fori_loop(0, lag, earlier, Smoothing(jnp.zeros(start.shape[:2], start.dtype), start))


def smoothed_state(observer: AbstractGatedFilter, state: State, smoothing: Smoothing) -> tuple[State, Matrix]:
    """The state of a filter, moved to the smoothed estimate as a correction would move it."""
    new, reset = observer.moved(state, smoothing.error)
    root = reset @ smoothing.root
    return observer.with_root(new, root), root


def backward_map(step: Step) -> Backward:
    """The error before a step, given the error after it."""
    n = len(step.error)
    # With P⁻ = L Lᵀ, M = L⁻¹ΦS: C = S Mᵀ L⁻¹ and P − CP⁻Cᵀ = S(I − MᵀM)Sᵀ, which avoids a difference of covariances.
    ratio = lower_solve(step.predicted, step.carried)
    gain = step.root @ upper_solve(step.predicted, ratio).T
    noise = step.root @ semidefinite_root(jnp.eye(n, dtype=ratio.dtype) - ratio.T @ ratio)
    # The columns of the solution of 𝒥ᵀ x = Cᵀ are the rows of C𝒥⁻¹.
    through = Backward(gain @ step.error, solve_square(step.reset.T, gain.T).T, noise)
    zero, eye = jnp.zeros_like(step.error), jnp.eye(n, dtype=ratio.dtype)
    cut, still = Backward(zero, jnp.zeros_like(gain), step.root), Backward(zero, eye, jnp.zeros_like(gain))
    through = jax.tree.map(lambda a, b: jnp.where(step.restarted, a, b), cut, through)
    return jax.tree.map(lambda a, b: jnp.where(step.nothing, a, b), still, through)


def error_before(after: Smoothing, step: Backward) -> Smoothing:
    """The knowledge of the error before a step, from that after it."""
    root = triangular(jnp.concatenate([step.noise, step.gain @ after.root], axis=1))
    return Smoothing(step.shift + step.gain @ after.error, root)
