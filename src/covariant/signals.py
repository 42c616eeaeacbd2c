"""Data that pass between subpackages: a `Record` is the input of an observer, a `Run` its output."""

import enum
from collections.abc import Collection, Sequence
from itertools import accumulate
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Inexact

from scalargraph.errors import InputError

MOST_MISSING = 0.05
"""How much of a lagged input may come from inputs that are missing, before it is missing itself."""
SAME_TIME = 1e-6
"""Times [s] closer than this count as equal, as stamps and delays of whole rows are but for rounding."""
LEAST_MISSING = 1e-6
"""Share of missing inputs in a mean above which it is missing: an interval may touch the next one by rounding."""


class StepCode(enum.IntEnum):
    """Outcome of a numerical step, stored in `info.result`; zero is good, and a larger code is worse.

    The codes stand in arrays, so that a compiled step never raises an error. `StepCode(int(code)).message` is the text
    of one. Codes up to `TOO_LATE` are normal in operation; `NOT_FINITE` means that the estimate was lost.

    Example:
        >>> from covariant import StepCode
        >>> StepCode(1).name, StepCode.COASTED.message
        ('COASTED', 'no measurement: the model ran on alone')
    """

    OK = 0
    COASTED = 1
    INPUT_HELD = 2
    REPEATED = 3
    OUTLIER = 4
    TOO_LATE = 5
    RESTARTED = 6
    ASTRAY = 7
    CUT_LOCUS = 8
    LEFT_DOMAIN = 9
    ESCAPED = 10
    CONJUGATE_POINT = 11
    NOT_CONVERGED = 12
    NOT_SETTLED = 13
    NOT_RECONSTRUCTIBLE = 14
    OUT_OF_DOMAIN = 15
    STEP_REFUSED = 16
    NOT_FINITE = 17

    @property
    def message(self) -> str:
        """One line that says what happened and, where something can be done, the remedy."""
        return _MESSAGES[self]


_MESSAGES = {
    StepCode.OK: "ok",
    StepCode.COASTED: "no measurement: the model ran on alone",
    StepCode.INPUT_HELD: "an input is not finite: the last finite one was held, or the filter estimated it",
    StepCode.REPEATED: "the stamp is that of the sample before: the state was left as it was",
    StepCode.OUTLIER: "a measurement is too far from what is expected: it was refused, as if it were missing",
    StepCode.TOO_LATE: "a measurement came too late, beyond what is kept of the past: it was left out",
    StepCode.RESTARTED: "the estimate started anew: what came before tells too little of the motion now",
    StepCode.ASTRAY: "the estimate does not follow the measurements: its velocity is off by more than the usual speed, "
    "or above the one that the observer is told",
    StepCode.CUT_LOCUS: "two ways to the measurement are equally short, as after half a turn: one of them was taken",
    StepCode.LEFT_DOMAIN: "the past of the point leaves the domain: its metric starts at the border",
    StepCode.ESCAPED: "the past of the point escapes to infinity: its metric starts far away",
    StepCode.NOT_SETTLED: "the metric still depends on how it was started: take a larger rate or more steps",
    StepCode.NOT_RECONSTRUCTIBLE: "not reconstructible: the past output does not determine the state there",
    StepCode.OUT_OF_DOMAIN: "outside the domain: there is no metric",
    StepCode.NOT_CONVERGED: "the geodesic to the measurement was not found: allow more Newton iterations or steps",
    StepCode.CONJUGATE_POINT: "the geodesic found passes a conjugate point and is not the shortest one",
    StepCode.STEP_REFUSED: "the step in time is negative or not finite: the state was left as it was; mend the stamps",
    StepCode.NOT_FINITE: "the state left the finite numbers: the estimate starts anew; mend inputs, gains or steps",
}


AnyArray = Array | np.ndarray
MOST_TURNS = 1e9
"""An angle of more turns than this counts as missing: its remaining digits hardly resolve its place on a circle."""
LEAST_OF_A_TURN = 1e-3
"""Resolution that an angle needs, in turns; in single precision it limits angles to 8 000 turns."""
LATEST_STAMP = 7.26e9
"""The year 2200 in seconds since 1970 [s]: later stamps are in another unit."""
COARSEST = 0.01
"""Largest rounding of stamps, as a fraction of the step between rows: velocities are wrong by the same fraction."""


class StampError(InputError):
    """Error of stamps that repeat or go back.

    Example:
        >>> import numpy as np
        >>> from covariant import Record
        >>> from covariant.signals import StampError
        >>> try:
        ...     Record([0.0, 0.1, 0.1], y=np.zeros((3, 1))).check()
        ... except StampError as error:
        ...     print(error)
        rows 2 and 3 have the same stamp 0.1 s; keep one of them
    """


class _Fields(NamedTuple):
    t: Float[AnyArray, "T"]
    u: Float[AnyArray, "T m"]
    y: Inexact[AnyArray, "T *n"]
    x: Any = None


class Record(_Fields):
    """A log, time first: stamps, inputs, measured positions, and the true state where it is known.

    `covariant.logs.record` reads one from a file, a data frame or a dataset of xarray; `check` tests what a record must
    satisfy.

    Args:
        t: Stamps (T,) [s].
        u: Inputs (T, m); None for a system without inputs, which is completed to (T, 0).
        y: Measured positions: coordinates (T, n), or group elements (T, N, N). NaN marks a missing measurement.
        x: True state (T, 2n), or a `Motion` of the group; None where it is unknown.

    Example:
        >>> import numpy as np
        >>> from covariant import Record
        >>> t = np.linspace(0.0, 2.0, 201)
        >>> Record(t, y=np.sin(t)[:, None])
        <Record: 201 rows over 2 s, 1 position, no input>
    """

    __slots__ = ()

    def __new__(cls, t: Any, u: Any = None, y: Any = None, x: Any = None) -> "Record":
        # Trees of other things than arrays, such as the axes of a vmap, have records with None as well.
        inputs: Any = np.zeros((*np.shape(t), 0)) if u is None and np.ndim(t) > 0 else u
        return super().__new__(cls, t, inputs, y, x)

    def __repr__(self) -> str:
        rows, shape = np.shape(self.t), np.shape(self.y)
        if len(rows) != 1 or len(shape) not in (2, 3) or np.ndim(self.u) != 2:
            return super().__repr__()
        positions = _count(shape[1], "position") if len(shape) == 2 else f"positions {shape[1]} × {shape[2]}"
        return f"<Record: {_span(self.t)}, {positions}, {_count(np.shape(self.u)[1], 'input')}>"

    def check(self, start: np.ndarray | None = None, missing_inputs: bool = False) -> "Record":
        """Check that the record is valid: real numbers of consistent shapes, and rising stamps in seconds.

        Args:
            start: Which places of a measurement, as a flat array, the first row must hold; an index of the flat array,
                all (default) where it is None.
            missing_inputs: Whether inputs may be missing too, NaN; False by default.

        Returns:
            The record itself.

        Raises:
            ValueError: Names the first fault, with its row counted from 1; a `StampError` for stamps that do not rise.

        Example:
            >>> import numpy as np
            >>> from covariant import Record
            >>> Record([0.0, 0.2, 0.1], y=np.zeros((3, 1))).check()
            Traceback (most recent call last):
            covariant.signals.StampError: row 3: time goes back from 0.2 s to 0.1 s; sort or split the log
        """
        t, u, y = (np.asarray(a) for a in (self.t, self.u, self.y))
        if self.y is None:
            raise InputError("a record needs positions y (T, n) or (T, N, N); got none")
        for name, array in (("stamps t (T,)", t), ("inputs u (T, m)", u), ("positions y (T, n)", y)):
            if np.iscomplexobj(array) and array.ndim < 3:  # elements of a group of matrices may be complex
                raise InputError(f"{name} are complex; they must be real numbers")
            if array.dtype == bool:
                raise InputError(f"{name} are true and false; they must be numbers")
            if np.ma.isMaskedArray(getattr(self, name.split()[1])):
                raise InputError(f"{name} are a masked array; fill what is masked, by NaN where it is a measurement")
        if t.ndim != 1 or u.ndim != 2 or y.ndim not in (2, 3) or not len(t) == len(u) == len(y):
            raise InputError(
                f"a record needs t (T,), u (T, m), y (T, n) or (T, N, N); got {t.shape}, {u.shape}, {y.shape}"
            )
        if len(t) < 2:
            raise InputError(f"a record needs at least two rows; this one has {len(t)}")
        for name, array in (("t", t), ("u", u)):
            absent = name == "u" and missing_inputs
            bad = (np.isinf if absent else lambda a: ~np.isfinite(a))(array.reshape(len(t), -1)).any(1)
            if bad.any():
                may = "mark a missing one by NaN" if absent else "only measurements may be missing"
                raise InputError(f"row {bad.argmax() + 1}: {name} is not a finite number; {may}")
        if (latest := np.abs(t).max()) > LATEST_STAMP:
            raise InputError(f"stamps reach {latest:g} s, after the year 2200; they must be in seconds")
        infinite = np.isinf(y.reshape(len(t), -1)).any(1)
        if infinite.any():
            raise InputError(f"row {infinite.argmax() + 1}: a measurement is infinite; mark a missing one by NaN")
        step = np.diff(t.astype(float))  # unsigned numbers would not go back
        if (step < 0).any():
            k = int((step < 0).argmax())
            raise StampError(f"row {k + 2}: time goes back from {t[k]:g} s to {t[k + 1]:g} s; sort or split the log")
        if (step == 0).any():
            k = int((step == 0).argmax())
            raise StampError(f"rows {k + 1} and {k + 2} have the same stamp {t[k]:g} s; keep one of them")
        check_rounding(t)
        if np.isnan(y[0] if start is None else y[0].ravel()[start]).any():
            raise InputError("row 1 lacks a measurement, so no estimate can start there; cut the log to begin later")
        return self


def check_rounding(t: Float[np.ndarray, "T"], precision: np.dtype | None = None) -> None:
    """Check that the rounding of stamps in single precision does not falsify the steps between them.

    Args:
        t: Rising stamps (T,) [s], in any floating-point type.
        precision: Type to which they will be rounded; their own by default.

    Raises:
        ValueError: The rounding exceeds `COARSEST` of the median step.

    Example:
        >>> import numpy as np
        >>> from covariant.signals import check_rounding
        >>> check_rounding(np.float32([0.0, 0.01, 0.02]))
    """
    rounded = np.dtype(t.dtype if precision is None else precision)
    least, step = np.spacing(np.abs(t).max().astype(rounded)), np.median(np.diff(t))
    if rounded.itemsize < 8 and least > COARSEST * step:
        raise InputError(
            f"stamps in {rounded} near {np.abs(t).max():g} s are whole multiples of {least:.2g} s, and rows are "
            f"{step:.2g} s apart; write them in float64, or count them from the first before they are rounded"
        )


def largest_measurement(y: Inexact[AnyArray, "*n"], circles: Collection[int] = ()) -> np.ndarray:
    """Largest magnitude of each entry of a measurement; observers treat what is larger as missing.

    Beyond 1/ε floating-point numbers do not resolve one unit. Angles on a circle have the smaller bound at which their
    place on the circle is still resolved: `MOST_TURNS` turns, or `LEAST_OF_A_TURN`/ε turns where that is less.

    Args:
        y: A measurement, of which only shape and precision count.
        circles: Indices of the entries that are angles on a circle [rad].

    Returns:
        The bounds, in the shape of y.

    Example:
        >>> import numpy as np
        >>> from covariant.signals import largest_measurement
        >>> [f"{bound:.1e}" for bound in largest_measurement(np.zeros(2), circles=[1])]
        ['4.5e+15', '6.3e+09']
    """
    eps = float(jnp.finfo(y.dtype).eps)
    bounds = np.full(y.shape, 1 / eps, jnp.finfo(y.dtype).dtype)
    # 1/ε turns would leave no digit for the angle within a turn.
    bounds[list(circles)] = 2 * np.pi * min(MOST_TURNS, LEAST_OF_A_TURN / eps)
    return bounds


class Run(NamedTuple):
    """Result of an observer's pass over a record, stacked along time.

    Each observer has its own `info`; all of them have `info.result`, whose codes are those of `StepCode`. Look at these
    codes before you trust the estimates: the printed form counts them. The velocities are in the frame of the
    configuration space, which on a group is the body frame.

    Attributes:
        t: Stamps (T,) [s].
        estimate: Estimates (q, v) (T, 2n); on a group a `Motion` of g (T, N, N) and v (T, n).
        info: Diagnostics of the observer's steps, each field with a leading axis T.

    Example:
        >>> import numpy as np
        >>> from covariant import Record, observers
        >>> t = np.linspace(0.0, 1.0, 11)
        >>> run = observers.run(observers.FilteredDerivative(50.0), Record(t, y=2.0 * t[:, None]))
        >>> run
        <Run: 11 rows over 1 s, 11 ok>
        >>> run.estimate[-1].round(1).tolist()
        [2.0, 2.0]
    """

    t: Float[AnyArray, "T"]
    estimate: Any
    info: Any

    def __repr__(self) -> str:
        result = getattr(self.info, "result", None)
        codes = _codes(result) if isinstance(result, np.ndarray | Array) else ""
        return f"<Run: {_span(self.t)}{codes}>"


def _span(t: AnyArray) -> str:
    """How many rows stamps (T,) have, and over which time where they are numbers."""
    rows = np.shape(t)
    text = _count(rows[0], "row") if len(rows) == 1 else f"rows {rows}"
    try:
        return f"{text} over {float(t[-1]) - float(t[0]):.4g} s" if len(rows) == 1 and rows[0] > 1 else text
    except TypeError:  # within a function that JAX traces there are no numbers
        return text


def _codes(result: AnyArray) -> str:
    """Counts of the result codes of a pass, the most frequent first."""
    try:
        codes, counts = np.unique(np.asarray(result), return_counts=True)
    except TypeError:
        return ""
    order = np.argsort(-counts, kind="stable")
    return ", " + ", ".join(f"{counts[k]} {StepCode(int(codes[k])).name.lower()}" for k in order)


def _count(number: int, word: str) -> str:
    return f"{number or 'no'} {word}{'s' if number > 1 else ''}"


def lag_inputs(record: Record, time_constant: float) -> Record:
    """Pass the inputs of a record through a causal first-order lag.

    A motor follows its logged torque with a delay; such a lag, identified with the other parameters, models it.

    Args:
        record: A log with inputs u (T, m).
        time_constant: Time constant of the lag [s]; 0 leaves the record unchanged.

    Returns:
        The record with lagged inputs, which start at the first logged input.

    Example:
        >>> import numpy as np
        >>> from covariant import Record
        >>> from covariant.signals import lag_inputs
        >>> record = Record(np.arange(3.0), u=np.array([[0.0], [1.0], [1.0]]), y=np.zeros((3, 1)))
        >>> lag_inputs(record, 1.0).u.round(3).tolist()
        [[0.0], [0.632], [0.865]]
    """
    if time_constant == 0:
        return record
    decay = np.exp(-np.diff(np.asarray(record.t)) / time_constant).tolist()

    def lagged(column):
        first, *later = column.tolist()  # a recursion, for which Python's floats are quicker than NumPy's
        steps = zip(decay, later, strict=True)
        return list(accumulate(steps, lambda u, k: k[0] * u + (1 - k[0]) * k[1], initial=first))

    u = np.asarray(record.u, float)
    return record._replace(u=np.array([lagged(column) for column in u.T]).T.reshape(u.shape))


def acting_inputs(
    record: Record,
    between: str = "held",
    delay: float | Sequence[float] = 0.0,
    rows: Record | None = None,
    lead: float | Sequence[float] = 0.0,
) -> Record:
    """Replace each input by the mean, over its interval, of the input that acts there after a delay.

    The interval of a row reaches from its stamp to the next. Before the first stamp the first input acts. With "held"
    and without delay the record is unchanged. Of a log that is cut or thinned give the kept rows as well: inputs before
    the first of them still act after a delay, and those between two of them count in the mean.

    Args:
        record: A log with inputs u (T, m), all its rows.
        between: How the input goes from a stamp to the next: "held" at the former value, or "linear" to the latter,
            which is known when the step between them is made.
        delay: Time from the stamp of an input until it acts [s], 0 by default; one number, or one for each input.
        rows: Rows of the record that are used, whose intervals count; by default all of them.
        lead: Time [s] by which the input is ahead: the rate at which it changes, times this, is added. One number, or
            one for each input.

    Returns:
        The used rows with the mean inputs.

    Raises:
        ValueError: For another word, for a delay that is not finite and ≥ 0, and for a lead that is not finite.

    Example:
        >>> import numpy as np
        >>> from covariant import Record
        >>> from covariant.signals import acting_inputs
        >>> record = Record(np.arange(3.0), u=np.array([[0.0], [1.0], [1.0]]), y=np.zeros((3, 1)))
        >>> acting_inputs(record, "linear").u.tolist(), acting_inputs(record, delay=0.5).u.tolist()
        ([[0.5], [1.0], [1.0]], [[0.0], [0.5], [1.0]])
        >>> thinned = Record(record.t[::2], record.u[::2], record.y[::2])
        >>> acting_inputs(record, rows=thinned).u.tolist()
        [[0.5], [1.0]]
    """
    if between not in ("held", "linear"):
        raise InputError(f"acting_inputs: between must be 'held' or 'linear'; got {between!r}")
    late, ahead = (np.broadcast_to(np.asarray(each, float), record.u.shape[1:]) for each in (delay, lead))
    if not ((late >= 0) & np.isfinite(late)).all():
        raise InputError(f"acting_inputs: delay must be a number ≥ 0 [s]; got {delay}")
    if not np.isfinite(ahead).all():
        raise InputError(f"acting_inputs: lead must be a finite number [s]; got {lead}")
    unchanged = between == "held" and not late.any() and not ahead.any()
    if unchanged and rows is None:
        return record
    used = record if rows is None else rows
    t, u, at = np.asarray(record.t, float), np.asarray(record.u, float), np.asarray(used.t, float)
    if unchanged:
        first = int(np.searchsorted(t, at[0]))
        if np.array_equal(at, t[first : first + len(at)]):  # consecutive rows: their inputs to the last bit
            return used._replace(u=record.u[first : first + len(at)])
    step = np.diff(t)
    rise = np.diff(u, axis=0) if between == "linear" else np.zeros_like(u[1:])
    gathered = np.concatenate([np.zeros_like(u[:1]), np.cumsum((u[:-1] + rise / 2) * step[:, None], axis=0)])
    slope = np.concatenate([rise / step[:, None], np.zeros_like(u[:1])])
    # The last input acts as long as the one before it.
    edges = np.append(at, 2 * at[-1] - at[-2])[:, None] - late
    # A mean is the difference of the integral of the input at the edges. Before the first stamp `past` is negative:
    # there the integral continues linearly, with the first input, and the slope does not count.
    k = np.maximum(np.searchsorted(t, edges, side="right") - 1, 0)
    past = edges - t[k]
    value, rate, before = (np.take_along_axis(each, k, axis=0) for each in (u, slope, gathered))
    integral = before + value * past + rate * np.maximum(past, 0.0) ** 2 / 2
    # The mean rate over an interval is the change of the input from edge to edge; a jump at an edge is after it.
    k = np.maximum(np.searchsorted(t, edges - SAME_TIME * (between == "held"), side="left") - 1, 0)
    value, rate = (np.take_along_axis(each, k, axis=0) for each in (u, slope))
    integral = integral + ahead * (value + rate * np.maximum(edges - t[k], 0.0))
    return used._replace(u=np.diff(integral, axis=0) / np.diff(edges, axis=0))


def read_together(record: Record, delay: Float[np.ndarray, "n"]) -> Record:
    """Align coordinates that are measured with different delays, at the stamp less the largest of the delays.

    Coordinate i of a row was true at t − delay[i]. Those that are less late are interpolated between their readings, by
    cubics with the slopes of their neighbours, which takes up to a fifth off their noise.

    Args:
        record: A log with positions (T, n) in coordinates, angles without jumps.
        delay: Delay of each coordinate (n,) [s].

    Returns:
        The record with aligned positions, without a true state. An interpolated position is missing where a reading
        beside it is; rows at the start for which there is no reading yet are left out.

    Example:
        >>> import numpy as np
        >>> from covariant import Record
        >>> from covariant.signals import read_together
        >>> t = np.arange(6.0)
        >>> late = np.array([0.0, 0.5])
        >>> read_together(Record(t, y=t[:, None] - late), late).y[0].tolist()
        [0.5, 0.5]
    """
    t, y = np.asarray(record.t, float), np.array(record.y, float)
    later = np.max(delay) - np.asarray(delay, float)
    for i in np.flatnonzero(later > 0):
        # At the stamp t, y_i is the position at t − delay_i; the sample of t − later_i is that at t − max delay.
        y[:, i] = _interpolate_samples(t, y[:, i], t - later[i])
    begin = int(np.argmax(np.isfinite(y).all(axis=1)))
    return Record(t[begin:], np.asarray(record.u)[begin:], y[begin:])


def _interpolate_samples(t: np.ndarray, y: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Values between samples; NaN before the first."""
    slope = np.gradient(y, t)
    k = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
    step = t[k + 1] - t[k]
    # Cubic Hermite interpolation, with slopes by central differences.
    x = (at - t[k]) / step
    value = (1 + 2 * x) * (1 - x) ** 2 * y[k] + x**2 * (3 - 2 * x) * y[k + 1]
    value += step * x * (1 - x) * ((1 - x) * slope[k] - x * slope[k + 1])
    return np.where(at < t[0], np.nan, value)
