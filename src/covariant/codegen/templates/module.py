"""xABOUTx

xSENTENCEx

A log, as arrays; NaN marks a missing measurement or input:

    import xNAMEx

    run = xNAMEx.run(t, yxWITH_Ux)
    run.xFIRSTx, run.result

Sample by sample:

    observer = xNAMEx.Observer()
    result = observer.step(y, dtxWITH_Ux)
    observer.estimate().xFIRSTx

xSIGNALSxNeeds NumPy, and the library `libxNAMEx` beside this file; `python -m xNAMEx` builds it from the C beside it.
"""

from __future__ import annotations

import ctypes
import enum
import functools
import math
import os
import shutil
import sys
import warnings
from collections.abc import Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np

__version__ = "xVERSIONx"

RATE = xRATEx
"""Sampling rate [Hz] that the observer is made for."""
REAL = np.dtype("xDTYPEx")
"""Type of all numbers of the observer; others are converted to it."""
MEASUREMENT = xMEASUREMENTx
"""Shape of a measurementxSENSORSx."""
INPUTS = xINPUTSx
"""Number of inputs."""
INPUT_AT_END = bool(xAT_ENDx)
"""Whether the input of a step is that of its end, at the stamp of y, and not the one since the sample before."""

_NAME, _TOKEN = "xNAMEx", "xTOKENx"
_HERE = Path(__file__).parent
_LIBRARY = _HERE / f"lib{_NAME}{'.dll' if os.name == 'nt' else '.dylib' if sys.platform == 'darwin' else '.so'}"
_SOURCES = (f"{_NAME}.c", f"{_NAME}_rows.c")
_FLAGS = xFLAGSx
_FIRST = xSTARTSx  # numbers of a measurement that must be there at the start
_LATEST = 7.26e9  # s, the year 2200
_COARSEST = 0.01  # largest rounding of stamps, as a fraction of a step

# Names and shapes of what the structures of the C hold, in order.
_PARAMS = xPARAMSx
_STATE = xSTATEx
_OUTPUT = xOUTPUTx
_REPORTED = xREPORTED_LEAVESx


class Result(enum.IntEnum):
    """Outcome of a step; zero is good, and a larger code is worse."""

    #: xCODESx

    @property
    def message(self) -> str:
        """One line that says what happened and, where something can be done, the remedy."""
        return _MESSAGES[self]


_MESSAGES = {
    #: xMESSAGESx
}


class Estimate(NamedTuple):
    """An estimate."""

    #: xESTIMATE_FIELDSx


class Run(NamedTuple):
    """A log with its estimates, T rows: stamps, estimates, diagnostics of each step, and its result code."""

    t: np.ndarray  # (T,)
    #: xRUN_FIELDSx
    result: np.ndarray  # (T,)


class Params(Mapping):
    """Numbers that may be changed between two steps, as `params["name"] = value`."""

    def __init__(self, flat: np.ndarray, values: Mapping | None) -> None:
        self._views = _views(flat, _PARAMS)
        for name, value in (values or {}).items():
            self[name] = value

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._views:
            raise KeyError(f"{_NAME} has no number {name!r}; there are: {', '.join(self._views) or 'none'}")
        return self._views[name]

    def __setitem__(self, name: str, value: object) -> None:
        view, array = self[name], _real(value, name)
        if array.shape != view.shape:
            raise ValueError(f"{name} has the shape {array.shape}; it must be {view.shape}")
        view[...] = array

    def __iter__(self) -> Iterator[str]:
        return iter(self._views)

    def __len__(self) -> int:
        return len(self._views)

    def __repr__(self) -> str:
        return f"Params({ {name: value.tolist() for name, value in self.items()} })"


class Observer:
    """The observer with its numbers and its state.

    Args:
        params: Numbers by name in place of the exported ones, as {"name": value}.
    """

    def __init__(self, params: Mapping | None = None) -> None:
        library = _library()
        self._init, self._step, self._estimate = (getattr(library, f"{_NAME}_{f}") for f in _FUNCTIONS)
        self._p = _exported(library)
        self._x, self._out = np.zeros(_size(_STATE), REAL), np.zeros(_size(_OUTPUT), REAL)
        self._y, self._u = np.zeros(math.prod(MEASUREMENT), REAL), np.zeros(max(1, INPUTS), REAL)
        self._at = tuple(a.ctypes.data for a in (self._x, self._p, self._u, self._y, self._out))
        self.params = Params(self._p, params)
        self.started = False

    def start(self, y: object, t: float = 0.0) -> Result:
        """Start at rest at a measurement, at the time t [s]; `COASTED` where it is not complete, and nothing starts."""
        _read(self._y, y, "y", MEASUREMENT)
        return self._begin(t)

    def step(self, y: object, dt: float, u: object = None) -> Result:
        """Advance by dt [s] under the input u, then correct by the measurement y.

        The first complete measurement starts the observer.

        Args:
            y: Measurement, of the shape `MEASUREMENT`; NaN marks what was not measured.
            dt: Time since the sample before [s].
            u: Input (INPUTS,), xSENTx; None counts as zero. One that is not finite is replaced by the last one.

        Raises:
            ValueError: For arrays of another shape or kind. What numbers do is a result code.
        """
        _read(self._y, y, "y", MEASUREMENT)
        if u is not None:
            _read(self._u, u, "u", (INPUTS,))
        x, p, at_u, at_y, _ = self._at
        if not self.started:
            result = self._begin(0.0)
            if self.started and INPUT_AT_END and u is not None:
                self._step(x, p, at_u, at_y, None, 0.0)
            return result
        return _CODES[self._step(x, p, None if u is None else at_u, at_y, None, float(dt))]

    def estimate(self) -> Estimate:
        """The estimate; NaN before the observer has started."""
        if self.started:
            x, p, _, _, out = self._at
            self._estimate(x, p, out)
        else:
            self._out.fill(math.nan)
        return Estimate(*_views(self._out.copy(), _OUTPUT).values())

    @property
    def state(self) -> dict[str, np.ndarray]:
        """A copy of the arrays of the state by name, those named `last_…` being diagnostics of the last step."""
        return _views(self._x.copy(), _STATE)

    def copy(self) -> Observer:
        """A snapshot, which goes on from where this observer is."""
        other = Observer()
        other._p[:], other._x[:], other.started = self._p, self._x, self.started
        return other

    def _begin(self, t: float) -> Result:
        x, p, _, y, _ = self._at
        self.started = self._init(x, p, y, float(t)) == Result.OK
        return Result.OK if self.started else Result.COASTED


def run(t: object, y: object, u: object = None, params: Mapping | None = None) -> Run:
    """The estimates of a log. The first row starts them, at rest.

    Args:
        t: Stamps (T,) [s], which rise; steps between them may differ.
        y: Measurements (T, *MEASUREMENT); NaN marks what was not measured.
        u: Inputs (T, INPUTS), each of which acts from its stamp to the next; None counts as zero.
        params: Numbers by name in place of the exported ones.

    Returns:
        The run.

    Raises:
        ValueError: Names the first fault of the log, with its row counted from 1.
    """
    observer = Observer(params)
    times, measured, inputs = _checked(t, y, u)
    rows = len(times)
    dt = np.diff(times, prepend=times[:1]).astype(REAL)
    if rows > 1 and (step := float(np.median(dt[1:]))) > 2 / RATE:
        warnings.warn(
            f"rows are {step:g} s apart, and {_NAME} is made for {RATE:g} Hz: export it with --rate {1 / step:.3g}",
            stacklevel=2,
        )
    # Usually the input that acted since the stamp before.
    acting = inputs if inputs is None or INPUT_AT_END else np.concatenate([inputs[:1], inputs[:-1]])
    outputs, reported = np.empty((rows, _size(_OUTPUT)), REAL), np.empty((rows, _size(_REPORTED)), REAL)
    results = np.empty(rows, np.intc)
    observer._y[:] = measured[0].ravel()
    x, p, _, at_y, _ = observer._at
    if observer._init(x, p, at_y, float(times[0])) != Result.OK:
        raise ValueError("row 1: the measurement is too large for a start, or no rotation; cut the log to begin later")
    arrays = (acting, measured, dt, outputs, reported, results)
    pointers = (None if a is None else a.ctypes.data for a in arrays)
    getattr(_library(), f"{_NAME}_rows")(x, p, rows, *pointers)
    if results[0] == Result.REPEATED:  # the first row is no step
        results[0] = Result.OK
    columns = {**_views(outputs, _OUTPUT), **_views(reported, _REPORTED)}
    return Run(times, *columns.values(), results.astype(np.int64))


def build() -> Path:
    """Build the library from the C beside this file, and return its path.

    The compiler is the one that the environment variable CC names, `cc`, or that of the package ziglang.

    Raises:
        OSError: There is no compiler, or it refuses the C.
    """
    import subprocess  # of no use where the library is there

    found = shutil.which(os.environ.get("CC") or "cc")
    command = [found] if found else [sys.executable, "-m", "ziglang", "cc"] if find_spec("ziglang") else None
    if command is None:
        raise OSError(f"{_NAME} needs a C compiler: set CC, install `cc`, or `pip install ziglang`")
    fresh = _LIBRARY.with_name(f"{_LIBRARY.name}.{os.getpid()}")
    try:
        done = subprocess.run(
            [*command, *_FLAGS, *_SOURCES, "-lm", "-o", fresh.name],
            cwd=_HERE,
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            raise OSError(f"{' '.join(command)} does not compile {_NAME}: {done.stderr.strip()[:300]}")
        with open(fresh, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(fresh, _LIBRARY)  # the file is complete or absent, after a crash too
    finally:
        fresh.unlink(missing_ok=True)
    _library.cache_clear()
    return _LIBRARY


_CODES = tuple(Result)
_FUNCTIONS = ("init", "step", "estimate")


@functools.cache
def _library() -> ctypes.CDLL:
    """The library, loaded at the first use."""
    remedy = f"build it by `{sys.executable} -m {_NAME}`, which needs a C compiler, or the package ziglang"
    if not _LIBRARY.exists():
        raise OSError(f"{_LIBRARY} is missing; {remedy}")
    try:
        library = ctypes.CDLL(str(_LIBRARY))
        token = (ctypes.c_char * (len(_TOKEN) + 1)).in_dll(library, f"{_NAME}_token").value.decode()
    except (OSError, ValueError) as error:
        raise OSError(f"{_LIBRARY} does not load here ({error}); {remedy}") from error
    if token != _TOKEN:
        raise OSError(f"{_LIBRARY} is of another export; {remedy}")
    real = ctypes.c_double if REAL.itemsize == 8 else ctypes.c_float
    place = ctypes.c_void_p
    arguments = (
        [place, place, place, real],
        [place, place, place, place, place, real],
        [place, place, place],
        [place, place, ctypes.c_size_t, *[place] * 6],
    )
    for function, types in zip((*_FUNCTIONS, "rows"), arguments):
        getattr(library, f"{_NAME}_{function}").argtypes = types
    return library


def _exported(library: ctypes.CDLL) -> np.ndarray:
    """A copy of the exported numbers."""
    real = ctypes.c_double if REAL.itemsize == 8 else ctypes.c_float
    return np.array((real * max(1, _size(_PARAMS))).in_dll(library, f"{_NAME}_default"), REAL)


def _size(fields: tuple) -> int:
    return sum(math.prod(shape) for _, shape in fields)


def _views(flat: np.ndarray, fields: tuple) -> dict[str, np.ndarray]:
    """The arrays by name whose numbers lie one after the other along the last axis."""
    views, first = {}, 0
    for name, shape in fields:
        last = first + math.prod(shape)
        views[name] = flat[..., first:last].reshape(flat.shape[:-1] + shape)
        first = last
    return views


def _real(value: object, name: str) -> np.ndarray:
    """An array of real numbers; what is masked becomes NaN."""
    try:
        array = np.asarray(np.ma.filled(value.astype(float), np.nan) if np.ma.isMaskedArray(value) else value)
    except ValueError as error:
        raise ValueError(f"{name} is no array: {error}") from error
    if array.dtype.kind == "M":
        raise ValueError(f"{name} has dates; give seconds, as (t - t[0]) / np.timedelta64(1, 's')")
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{name} has the type {array.dtype}; it must be real numbers, which become {REAL}")
    return array


def _read(into: np.ndarray, value: object, name: str, shape: tuple) -> None:
    array = _real(value, name)
    if array.shape != shape:
        raise ValueError(f"{name} has the shape {array.shape}; one sample has {shape}")
    with np.errstate(over="ignore"):  # too large for the type of the observer: infinite
        into[:] = array.ravel()


def _rows(value: object, name: str, shape: tuple) -> np.ndarray:
    array = _real(value, name)
    if array.ndim != len(shape) + 1 or array.shape[1:] != shape:
        needed = ", ".join(map(str, ("T", *shape))) + ("," if not shape else "")
        column = f"; {name}[:, None] is a column" if array.ndim == 1 and shape == (1,) else ""
        raise ValueError(f"{name} has the shape {array.shape}; {_NAME} needs ({needed}), time first{column}")
    return array


def _checked(t: object, y: object, u: object) -> tuple:
    """Stamps in double precision, measurements and inputs in that of the observer."""
    times, measured = _rows(t, "t", ()), _rows(y, "y", MEASUREMENT)
    inputs = None if u is None else _rows(u, "u", (INPUTS,))
    lengths = {"t": times, "y": measured, **({} if inputs is None else {"u": inputs})}
    if len({len(a) for a in lengths.values()}) > 1:
        raise ValueError(f"rows differ: {', '.join(f'{len(a)} of {name}' for name, a in lengths.items())}")
    if len(times) < 2:
        raise ValueError(f"a log needs at least two rows; this one has {len(times)}")
    bad = ~np.isfinite(times)
    if bad.any():
        raise ValueError(f"row {bad.argmax() + 1}: t is not a finite number; only measurements may be missing")
    bad = np.isinf(np.zeros((len(times), 0)) if inputs is None else inputs).any(1)
    if bad.any():
        raise ValueError(f"row {bad.argmax() + 1}: u is not a finite number; mark a missing one by NaN")
    with np.errstate(over="ignore"):  # too large for the type of the observer: infinite
        measured = np.require(measured, REAL, "CA")  # C needs contiguous, aligned arrays
    infinite = np.isinf(measured.reshape(len(times), -1)).any(1)
    if infinite.any():
        raise ValueError(f"row {infinite.argmax() + 1}: a measurement is infinite; mark a missing one by NaN")
    if np.isnan(measured[0].ravel()[:_FIRST]).any():
        raise ValueError("row 1 lacks a measurement, so no estimate can start there; cut the log to begin later")
    _check_stamps(times)
    return times.astype(float), measured, None if inputs is None else np.require(inputs, REAL, "CA")


def _check_stamps(times: np.ndarray) -> None:
    latest = float(np.abs(times).max())
    if latest > _LATEST:
        raise ValueError(f"stamps reach {latest:g} s, after the year 2200; they must be in seconds")
    step = np.diff(times.astype(float))
    if (step < 0).any():
        k = int((step < 0).argmax())
        back = f"from {times[k]:g} s to {times[k + 1]:g} s"
        raise ValueError(f"row {k + 2}: time goes back {back}; sort or split the log")
    if (step == 0).any():
        k = int((step == 0).argmax())
        raise ValueError(f"rows {k + 1} and {k + 2} have the same stamp {times[k]:g} s; keep one of them")
    if times.dtype.kind == "f" and times.dtype.itemsize < 8:
        least, usual = float(np.spacing(np.abs(times).max())), float(np.median(step))
        if least > _COARSEST * usual:
            raise ValueError(
                f"stamps in {times.dtype} near {latest:g} s are whole multiples of {least:.2g} s, and rows are "
                f"{usual:.2g} s apart; give them in float64, or count them from the first before they are rounded"
            )
