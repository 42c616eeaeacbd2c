"""An observer as a stream: samples in, estimates out, whatever the samples are."""

import math
from collections import Counter
from typing import Any, NamedTuple

import numpy as np

from covariant.engine._backends import backend
from covariant.engine._choice import EngineName
from covariant.models import Motion
from covariant.observers import AbstractObserver
from covariant.signals import Result

LONGEST_GAP = 1.0
"""Longest time [s] without a sample that the model predicts over; after a longer one the estimate starts anew."""
LEAST_RATE = 1.25 / LONGEST_GAP
"""Slowest usual rate [Hz]: a sample may come a quarter of a step late."""
SET_BACK = 5
"""After so many samples in a row with stamps before the last one used, the clock was set back."""

CODES = tuple(Result)
NOT_FINITE = int(Result.NOT_FINITE)
NUMBERS = "iufO"
"""Kinds of arrays that hold real numbers, or objects that may be some, as None for a missing one."""
DOUBLE, ndarray = np.dtype(float), np.ndarray


class Health(NamedTuple):
    """What a stream has seen.

    - `samples`: calls of `step`; `results`: how many ended with each result, by its name in lower case.
    - `late`: samples with a stamp before the last one, left out; `unstamped`: those whose stamp is no finite number.
    - `misshapen`: measurements or inputs that are not the right count of real numbers, taken as missing.
    - `restarts`: how often the estimate started anew from a measurement, after a gap, a clock that was set, or an
      estimate that was not finite.
    """

    samples: int
    results: dict[str, int]
    late: int
    unstamped: int
    misshapen: int
    restarts: int


class Stream:
    """An observer that is fed sample by sample: `x = stream.step(t, y, u)`.

    - `observer`: any observer.
    - `y`: a configuration, of which the shape counts.
    - `rate` [Hz]: the usual sampling rate, at which it is tried before the first sample.
    - `inputs`: number of inputs m; by default that of the observer's model.
    - `engine`: "auto" and "c" compile it in C where that is possible, "jax" in JAX.

    It is compiled when it is made; its attribute `engine` says by what, with the reason where that is JAX.
    `step` never raises an error. The first complete measurement that is a configuration starts the estimate; until then
    it is NaN. NaN and infinite entries of y are missing. A sample with the stamp of the one before changes nothing, nor
    does one with an earlier stamp, unless `SET_BACK` of them come in a row. `health` counts what was wrong.

    Raises `ValueError` for a rate that is not finite or below `LEAST_RATE`, and for an unknown engine.
    """

    def __init__(
        self, observer: AbstractObserver, y: Any, rate: float, inputs: int | None = None, engine: EngineName = "auto"
    ):
        if not 0 < rate < math.inf:
            raise ValueError(f"Stream: rate must be a positive, finite number; got {rate}")
        if rate < LEAST_RATE:
            raise ValueError(
                f"Stream: rate must be at least {LEAST_RATE:g} Hz, as an estimate starts anew after {LONGEST_GAP:g} s "
                f"without a sample; got {rate:g} Hz"
            )
        y = np.asarray(y, float)
        model: Any = getattr(observer, "model", None)
        stated = getattr(model, "inputs", None)
        m = inputs if inputs is not None else 0 if model is None else len(y) if stated is None else stated
        self.observer: Any = observer
        self.engine, self._backend = backend(self.observer, y, m, engine)
        self._y, self._u = self._backend.y, self._backend.u
        self._y_place, self._u_place = self._backend.places
        self._advance, self._copy = self._backend.advance, self._backend.x.copy
        self._largest = self.observer.largest(y).ravel()
        self._shape = y.shape if y.ndim == 2 else None
        # Compile before the first sample.
        self._backend.y[:], self._backend.u[:] = y.ravel(), 0.0
        self._backend.start(0.0)
        self._backend.advance(1 / rate)
        self.reset()

    @property
    def health(self) -> Health:
        """What was seen so far."""
        named = {Result(code).name.lower(): count for code, count in enumerate(self._results) if count}
        c = self._counts
        return Health(sum(self._results), named, c["late"], c["unstamped"], c["misshapen"], c["restarts"])

    @property
    def result(self) -> Result:
        """The result of the last sample."""
        return CODES[self._last]

    def reset(self) -> None:
        """Forget all samples and counts: the next complete measurement starts the estimate."""
        self._started, self._t, self._back = False, math.nan, 0
        self._counts, self._results = Counter[str](), [0] * len(CODES)
        self._last = Result.OK
        self._backend.x[:] = math.nan

    def step(self, t: Any, y: Any, u: Any = None) -> Any:
        """The estimate at the stamp t [s], from the measurement y, with the input u that acted since the last stamp.

        y and u are numbers, lists or arrays; u None counts as unknown. Returns (q, v) (2n,) as an array of its own, or
        a `Motion` of arrays for a system that is not in coordinates.
        """
        # The quick way is written out, since a call takes as long as the observer's own work.
        try:
            if type(y) is not ndarray or y.dtype is not DOUBLE:
                raise ValueError
            self._y_place[:] = y
        except ValueError:  # of another size, or not in one piece
            self._read(self._y, y)
        try:
            if type(u) is not ndarray or u.dtype is not DOUBLE:
                raise ValueError
            self._u_place[:] = u
        except ValueError:
            self._read(self._u, u)
        if type(t) is not float:
            t = _stamp(t)
        dt = t - self._t
        if not (self._started and 0.0 <= dt <= LONGEST_GAP):
            return self._out_of_turn(t, dt)
        self._t, self._back = t, 0
        code = self._advance(dt)
        if code == NOT_FINITE:
            self._started = False
            self._counts["restarts"] += 1
        self._results[code] += 1
        self._last = code
        return self._copy() if self._shape is None else self._motion()

    def _out_of_turn(self, t: float, dt: float) -> Any:
        """What is done with the first sample, one without a stamp, a late one, and one after a gap."""
        if not math.isfinite(t):
            self._counts["unstamped"] += 1
            return self._told(Result.STEP_REFUSED)
        if not self._started or self._anew(dt):
            return self._begin(t)
        self._counts["late"] += 1
        return self._told(Result.STEP_REFUSED)

    def _anew(self, dt: float) -> bool:
        """Whether the stamps leave too long a gap, or the clock was set back; one of both is so, or the sample late."""
        self._back = self._back + 1 if dt < 0 else 0
        jumped = dt > LONGEST_GAP or self._back >= SET_BACK
        self._counts["restarts"] += jumped
        return jumped

    def _begin(self, t: float) -> Any:
        """Start at a measurement that is complete, and a configuration; wait for one otherwise."""
        self._t, self._back = t, 0
        result = Result.COASTED
        if (np.abs(self._backend.y) <= self._largest).all():
            self._backend.start(t)
            result = Result.OK if np.isfinite(self._backend.x).all() else Result.NOT_FINITE
        self._started = result == Result.OK
        if not self._started:
            self._backend.x[:] = math.nan
        return self._told(result)

    def _read(self, into: np.ndarray, given: Any) -> None:
        """Numbers as given, or NaN where they are not the right count of numbers."""
        try:
            if given is None:
                into.fill(math.nan)
            else:
                if isinstance(given, np.ma.MaskedArray):
                    given = np.ma.filled(given.astype(float), math.nan)
                array = np.asarray(given)
                if array.size != into.size or array.dtype.kind not in NUMBERS:
                    raise ValueError
                into[:] = array.ravel()
        except (TypeError, ValueError):
            into.fill(math.nan)
            self._counts["misshapen"] += 1

    def _told(self, result: int) -> Any:
        self._results[result] += 1
        self._last = result
        return self._copy() if self._shape is None else self._motion()

    def _motion(self) -> Motion:
        x: Any = self._copy()
        return Motion(x[: self._y.size].reshape(self._shape), x[self._y.size :])


def _stamp(t: Any) -> float:
    """A stamp as a number, NaN where it is none."""
    try:
        return float(t)
    except (TypeError, ValueError):
        return math.nan
