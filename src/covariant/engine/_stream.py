"""Runs an observer as a stream: samples in, estimates out, even if samples are invalid."""

import math
from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from covariant._typing import Numbers
from covariant.engine._backends import backend
from covariant.engine._choice import EngineName
from covariant.models import Motion
from covariant.observers import AbstractObserver
from covariant.signals import StepCode
from scalargraph.errors import InputError

LONGEST_GAP = 1.0
"""Longest gap [s] between samples that the model bridges; after a longer one the estimate starts anew."""
LEAST_RATE = 1.25 / LONGEST_GAP
"""Lowest accepted sampling rate [Hz]: a sample may then come a quarter of a step late."""
SET_BACK = 5
"""Number of consecutive samples with stamps before the last used one that mean that the clock was set back."""

CODES = tuple(StepCode)
NOT_FINITE = int(StepCode.NOT_FINITE)
NUMBERS = "iufO"
"""Kinds of NumPy arrays of real numbers, or of objects that may be numbers, such as None for a missing one."""
DOUBLE, ndarray = np.dtype(float), np.ndarray


class Health(NamedTuple):
    """Counts of samples and faults since a stream was started or reset.

    Attributes:
        samples: Calls of `step`.
        results: Number of samples with each result, by its name in lower case.
        late: Samples with a stamp before the last one; they are left out.
        unstamped: Samples whose stamp is not a finite number.
        misshapen: Measurements or inputs that are not the right number of real numbers; they count as missing.
        restarts: Number of times the estimate started anew from a measurement: after a gap, after the clock was set, or
            after an estimate that was not finite.

    Example:
        >>> import numpy as np
        >>> from covariant import engine, observers
        >>> stream = engine.Stream(observers.FilteredDerivative(50.0), np.zeros(1), 100.0, engine="jax")
        >>> for t in (0.0, 0.01, 0.005):
        ...     x = stream.step(t, [0.3])
        >>> stream.health.samples, stream.health.late
        (3, 1)
    """

    samples: int
    results: dict[str, int]
    late: int
    unstamped: int
    misshapen: int
    restarts: int


class Stream:
    """An observer that is fed sample by sample: `x = stream.step(t, y, u)`.

    It is compiled on construction. `step` itself never raises an error. The first measurement that is complete and a
    valid configuration starts the estimate; until then the estimate is NaN. Entries of y that are NaN or infinite count
    as missing. A sample with the same stamp as the one before, or an earlier one, changes nothing, unless `SET_BACK`
    earlier ones come in a row. `health` counts all faults.

    Args:
        observer: Any observer.
        y: A measurement, of which only the shape matters: a configuration (n,) or (N, N), or the readings of the
            observer's sensors.
        rate: Usual sampling rate [Hz]; one step at this rate is tried before the first sample.
        inputs: Number of inputs m; by default that of the observer's model.
        engine: "auto" and "c" compile the observer in C if that is possible, "jax" in JAX.
        sink: Called as `sink(t, estimate, result)` after each sample, for a live picture or a file. `result` is a
            `StepCode`. Errors that it raises are raised by `step`.

    Attributes:
        engine: "c", or "jax: " with the reason.

    Raises:
        ValueError: The rate is not finite or below `LEAST_RATE`, or the engine is unknown.

    Example:
        >>> import numpy as np
        >>> from covariant import engine, observers
        >>> stream = engine.Stream(observers.FilteredDerivative(50.0), np.zeros(1), 100.0, engine="jax")
        >>> for k in range(101):
        ...     x = stream.step(0.01 * k, [0.02 * k])
        >>> x.round(2).tolist(), stream.result.name
        ([2.0, 2.0], 'OK')
    """

    def __init__(
        self,
        observer: AbstractObserver,
        y: Numbers,
        rate: float,
        inputs: int | None = None,
        engine: EngineName = "auto",
        sink: Callable[[float, Any, StepCode], None] | None = None,
    ):
        if not 0 < rate < math.inf:
            raise InputError(f"Stream: rate must be a positive, finite number; got {rate}")
        if rate < LEAST_RATE:
            raise InputError(
                f"Stream: rate must be at least {LEAST_RATE:g} Hz, as an estimate starts anew after {LONGEST_GAP:g} s "
                f"without a sample; got {rate:g} Hz"
            )
        y = np.asarray(y, float)
        model: Any = getattr(observer, "model", None)
        stated = None if model is None else model.inputs
        configuration = observer.configuration(np.arange(y.size).reshape(y.shape))
        n = len(configuration) if stated is None else stated
        m = inputs if inputs is not None else 0 if model is None else n
        self.observer = observer
        self._sink = sink
        self.engine, self._backend = backend(self.observer, y, m, engine)
        self._y, self._u = self._backend.y, self._backend.u
        self._y_place, self._u_place = self._backend.places
        self._advance, self._copy = self._backend.advance, self._backend.x.copy
        self._largest = self.observer.largest(y).ravel()
        self._first = configuration.ravel()  # indices of the entries that must be measured at the start
        self._shape = configuration.shape if configuration.ndim == 2 else None
        # One step compiles the observer before the first sample.
        self._backend.y[:], self._backend.u[:] = y.ravel(), 0.0
        self._backend.start(0.0)
        self._backend.advance(1 / rate)
        self.reset()

    @property
    def health(self) -> Health:
        """Counts of samples, results and faults so far."""
        named = {StepCode(code).name.lower(): count for code, count in enumerate(self._results) if count}
        c = self._counts
        return Health(sum(self._results), named, c["late"], c["unstamped"], c["misshapen"], c["restarts"])

    @property
    def result(self) -> StepCode:
        """Result of the last sample."""
        return CODES[self._last]

    def reset(self) -> None:
        """Discard all samples and counts, so that the next complete measurement starts the estimate."""
        self._started, self._t, self._back = False, math.nan, 0
        self._counts, self._results = Counter[str](), [0] * len(CODES)
        self._last = StepCode.OK
        self._backend.x[:] = math.nan

    def step(self, t: float, y: Numbers | None, u: Numbers | None = None) -> Any:
        """Advance to a stamp, correct by its measurement, and return the estimate.

        Args:
            t: Stamp [s].
            y: Measurement, n numbers or an (N, N) matrix; a number, list or array. None counts as missing.
            u: Input (m,) that acted since the last stamp; a number, list or array. None counts as unknown.

        Returns:
            The estimate (q, v) (2n,) as a new array, or a `Motion` of arrays for a system that is not in coordinates;
            NaN until the estimate has started.
        """
        # The common case is written out here, since a function call takes as long as the observer's computation.
        try:
            if type(y) is not ndarray or y.dtype is not DOUBLE:
                raise InputError
            self._y_place[:] = y
        except ValueError:  # of another size, or not contiguous
            self._read(self._y, y)
        try:
            if type(u) is not ndarray or u.dtype is not DOUBLE:
                raise InputError
            self._u_place[:] = u
        except ValueError:
            self._read(self._u, u)
        if type(t) is not float:
            t = _stamp(t)
        dt = t - self._t
        # Both comparisons are false for NaN, which stands for a missing stamp.
        if not (self._started and 0.0 <= dt <= LONGEST_GAP):
            return self._give(t, self._out_of_turn(t, dt))
        self._t, self._back = t, 0
        code = self._advance(dt)
        self._counts["restarts"] += code == NOT_FINITE
        self._results[code] += 1
        self._last = code
        x = self._copy() if self._shape is None else self._motion()
        return x if self._sink is None else self._give(t, x)

    def _give(self, t: float, x: np.ndarray | Motion) -> np.ndarray | Motion:
        """Pass an estimate to the sink, if there is one, and return it."""
        if self._sink is not None:
            self._sink(t, x, self.result)
        return x

    def _out_of_turn(self, t: float, dt: float) -> Any:
        """Handle the first sample, a sample without a stamp, a late one, and one after a gap."""
        if not math.isfinite(t):
            self._counts["unstamped"] += 1
            return self._outcome(StepCode.STEP_REFUSED)
        if not self._started or self._anew(dt):
            return self._begin(t)
        self._counts["late"] += 1
        return self._outcome(StepCode.STEP_REFUSED)

    def _anew(self, dt: float) -> bool:
        """Whether the estimate must start anew, after a gap or a clock set back; otherwise the sample is late."""
        self._back = self._back + 1 if dt < 0 else 0
        jumped = dt > LONGEST_GAP or self._back >= SET_BACK
        self._counts["restarts"] += jumped
        return jumped

    def _begin(self, t: float) -> Any:
        """Start at this measurement if it is complete and a valid configuration; otherwise wait for the next."""
        self._t, self._back = t, 0
        result = StepCode.COASTED
        # NaN compares as false, so a measurement with a missing entry does not start the estimate.
        if (np.abs(self._backend.y) <= self._largest)[self._first].all():
            self._backend.start(t)
            result = StepCode.OK if np.isfinite(self._backend.x).all() else StepCode.NOT_FINITE
        self._started = result == StepCode.OK
        if not self._started:
            self._backend.x[:] = math.nan
        return self._outcome(result)

    def _read(self, into: np.ndarray, values: Numbers | None) -> None:
        """Write a measurement or input to a buffer, or NaN if it is not the right number of real numbers."""
        try:
            if values is None:
                into.fill(math.nan)
            else:
                if isinstance(values, np.ma.MaskedArray):
                    values = np.ma.filled(values.astype(float), math.nan)
                array = np.asarray(values)
                if array.size != into.size or array.dtype.kind not in NUMBERS:
                    raise InputError
                into[:] = array.ravel()
        except (TypeError, ValueError):
            into.fill(math.nan)
            self._counts["misshapen"] += 1

    def _outcome(self, result: int) -> Any:
        self._results[result] += 1
        self._last = result
        return self._copy() if self._shape is None else self._motion()

    def _motion(self) -> Motion:
        x: Any = self._copy()
        return Motion(x[: self._first.size].reshape(self._shape), x[self._first.size :])


def _stamp(t: float) -> float:
    """A stamp as a number; NaN if it is not a number."""
    try:
        return float(t)
    except (TypeError, ValueError):
        return math.nan
