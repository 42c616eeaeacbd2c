"""An observer as a function of plain arrays of numbers, compiled from C."""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from covariant.codegen import Recipe, TracedProgram, trace_program
from covariant.engine._cache import cache_key, cached_text, result_index
from covariant.engine._compile import library
from covariant.lowering import CText, Lowered, LoweringError, Signature, c_function, c_helpers
from covariant.observers import AbstractObserver

DECLARED = """
void kernel_init(const double *open, const double *y, const double *t, double *state);
void kernel_run(const double *open, double *state, const long *rows, const double *const *logs,
                const int *kept, int count, double *const *found);
"""
DECLARED_STEP = "int kernel_step(double *numbers, double dt);"


class Kernel(NamedTuple):
    """A compiled observer, which advances as many runs at once as it has lanes.

    The functions of `library` are

    - `kernel_init(open, y, t, state)`: states at rest at a measurement; `open` are the open numbers one after another.
      With several lanes each number is a row, with an entry for each lane.
    - `kernel_run(open, state, rows, logs, kept, count, found)`: advance the states in place, over as many rows as each
      lane has. For each lane `logs` holds the pointers to its inputs, measurements and time steps, and `found` those to
      its estimates and to the `count` columns `kept` of its infos.
    - `kernel_step(numbers, dt)`: one step on an array of state, input, measurement, estimate and info, in this order,
      for an observer without open numbers and with one lane; returns the result code.

    Attributes:
        layout: Sizes and shapes of its numbers.
        ffi: The `cffi.FFI` of the library.
        library: The loaded library.
        lanes: Number of runs done at once.
    """

    layout: "Layout"
    ffi: Any
    library: Any
    lanes: int

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Counts of numbers in a state, an estimate and an info."""
        return self.layout.sizes

    def pointer(self, array: np.ndarray) -> Any:
        """Pointer to a contiguous array of doubles, which must live as long as the pointer is used."""
        return self.ffi.cast("double *", array.ctypes.data)

    def pointers(self, arrays: Sequence[np.ndarray]) -> Any:
        """C array of the pointers to several contiguous arrays of doubles, which must live as long as it is used."""
        return self.ffi.new("double *[]", [self.pointer(array) for array in arrays])


class NoKernelError(Exception):
    """Error that there is no compiled observer; the message says why."""


class KernelForm(NamedTuple):
    """What a compiled observer is compiled for.

    Attributes:
        y: Shape of a measurement, (n,) or (N, N).
        inputs: Number of inputs m.
        opened: Indices of those of the observer's arrays of real numbers, counted as leaves of its pytree, that are
            arguments of the compiled code; none by default.
        lanes: Number of runs done at once, 1 by default.
        real: Whether measurements are real numbers, True by default.

    Example:
        >>> from covariant import engine
        >>> engine.KernelForm((2,), inputs=1).lanes
        1
    """

    y: tuple[int, ...]
    inputs: int
    opened: tuple[int, ...] = ()
    lanes: int = 1
    real: bool = True


def prepared(observer: AbstractObserver, form: KernelForm) -> "Prepared":
    """Trace an observer for compilation, with the numbers of its closed arrays written into the code.

    Args:
        observer: Any observer.
        form: What it is compiled for.

    Returns:
        The traced observer; the same object for an equal observer and form.
    """
    key = _KernelKey(observer, form)
    try:
        return _prepared(key)
    except TypeError:  # something in it has no hash
        return Prepared(key)


class Layout(NamedTuple):
    """Sizes and shapes of the numbers of a compiled observer.

    Attributes:
        sizes: Counts of numbers in a state, an estimate and an info.
        y: Shape of a measurement.
        u: Number of inputs.
        info, estimate: Pytrees of the shapes and types of an info and an estimate.
    """

    sizes: tuple[int, int, int]
    y: tuple[int, ...]
    u: int
    info: Any
    estimate: Any


class _KernelKey:
    """What a kernel is compiled from; equal where the kernels would be equal."""

    def __init__(self, observer: AbstractObserver, form: KernelForm):
        arrays, self.rest = eqx.partition(observer, eqx.is_inexact_array)
        self.leaves, self.tree = jax.tree.flatten(arrays)
        self.form = form
        values = [np.asarray(leaf) for leaf in self.leaves]
        # Open arrays are arguments of the code, so only the values of the others distinguish one kernel from another.
        written = tuple(b"" if i in form.opened else a.tobytes() for i, a in enumerate(values))
        kinds = tuple((a.shape, a.dtype.str) for a in values)
        functions, structure = jax.tree.flatten(self.rest)
        self._key = (self.tree, structure, tuple(functions), written, kinds, form)

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _KernelKey) and self._key == other._key

    def recipe(self) -> Recipe:
        """The observer with its open arrays as arguments, under names that sort in the order of the leaves."""
        names = {i: f"n{i:06d}" for i in self.form.opened}

        def make(values: Any) -> AbstractObserver:
            chosen = [values[names[i]] if i in names else leaf for i, leaf in enumerate(self.leaves)]
            return eqx.combine(jax.tree.unflatten(self.tree, chosen), self.rest)

        return Recipe(make, {name: np.asarray(self.leaves[i]) for i, name in names.items()})


class Prepared:
    """An observer that is traced; its kernel is compiled when it is first asked for.

    Attributes:
        key: Key of its C text in the cache; None where it is not cached.
    """

    def __init__(self, key: _KernelKey):
        self._lanes = key.form.lanes
        self._traced: TracedProgram | None = trace_program(key.recipe(), np.zeros(key.form.y), key.form.inputs)
        self.key = cache_key(self._traced, self._lanes)

    @property
    def kernel(self) -> Kernel:
        """Compiled observer.

        Raises:
            NoKernelError: The observer is no graph of scalars, or the compiler does not accept its text.
        """
        if isinstance(self._outcome, str):
            raise NoKernelError(self._outcome)
        return self._outcome

    @functools.cached_property
    def _outcome(self) -> Kernel | str:
        """The kernel, or the reason why there is none, cached since it takes as long to compute."""
        assert self._traced is not None
        try:
            source = cached_text(self.key, functools.partial(_c_text, self._traced, self._lanes))
            declared = DECLARED + (DECLARED_STEP if self._lanes == 1 else "")
            return Kernel(_layout(self._traced), *library(source, declared), self._lanes)
        except (LoweringError, OSError) as error:
            return str(error)
        finally:
            self._traced = None  # a jaxpr of a robot takes megabytes


_prepared = functools.lru_cache(maxsize=64)(Prepared)


def _layout(traced: TracedProgram) -> Layout:
    state, estimate, info = (sum(leaf.size for leaf in leaves) for leaves in (traced.state, traced.x, traced.info))
    return Layout((state, estimate, info), traced.y, traced.u, traced.told_as, traced.estimated_as)


def _c_text(traced: TracedProgram, lanes: int) -> str:
    """The text of a kernel; raises `LoweringError`."""
    # On a computer a step may take as long as its numbers ask for; code for a controller has fixed loops.
    program = traced.lower(loops=True)
    n_state, n_x, n_info = _layout(traced).sizes
    sizes = {"o": sum(leaf.size for leaf in program.given), "s": n_state, "u": program.u, "y": int(np.prod(program.y))}
    entries = {name: tuple(f"{name}[{i}]" for i in range(size)) for name, size in sizes.items()} | {
        "dt": ("dt",),
        "t": ("t",),
    }

    def function(graph: Lowered, name: str, arguments: str, results: int) -> CText:
        names = arguments.split()
        declared = ", ".join(f"real {n}" if n in ("dt", "t") else f"const real *restrict {n}" for n in names)
        given = tuple(entry for n in names for entry in entries[n])
        outputs = tuple(f"z[{i}]" for i in range(results))
        signature = Signature(f"{declared}, real *restrict z", (*names, "z"), given, outputs)
        return c_function(graph, name, signature, static=True, lanes=lanes)

    texts = [
        function(program.init, "core_init", "o y t", n_state),
        function(program.step, "core_step", "o s u y dt", n_state + n_info),
        function(program.estimate, "core_estimate", "o s", n_x),
    ]
    helpers = c_helpers(frozenset().union(*(text.helpers for text in texts)), lanes=lanes)
    named = {"RESULT": result_index(traced), "STATE": n_state, "INPUTS": program.u, "MEASURED": sizes["y"]}
    named |= {"ESTIMATE": n_x, "INFO": n_info, "OPEN": sizes["o"], "LANES": lanes}
    parts = {
        "SIZES": "\n".join(f"#define {k} {v}" for k, v in named.items()),
        "HELPERS": helpers,
        "REAL": f"typedef {'double' if lanes == 1 else 'lanes'} real;",
        "CORE": "\n".join(text.text for text in texts),
    }
    source = _SOURCE + (_STEP if lanes == 1 else "")
    for key, text in parts.items():
        source = source.replace(f"@{key}@", text)
    return source


# A velocity at rest decays to subnormal numbers, with which processors compute many times as slowly:
# as in compiled JAX they count as zero.
_SOURCE = """#include <math.h>
#include <string.h>
#if defined __SSE2__
#include <xmmintrin.h>
#define TINY_IS_ZERO const unsigned mode = _mm_getcsr(); _mm_setcsr(mode | 0x8040u)
#define AS_BEFORE _mm_setcsr(mode)
#else
#define TINY_IS_ZERO (void)0
#define AS_BEFORE (void)0
#endif

@SIZES@

@HELPERS@
@REAL@
#if LANES > 1
#define LANE(array, k, i) array[k][i]
#else
#define LANE(array, k, i) array[(k) + (i)]
#endif
#define SOME(count) ((count) > 0 ? (count) : 1)

@CORE@

static void load(real *into, const double *from, int count)
{
    int i, k;
    for (k = 0; k < count; ++k)
        for (i = 0; i < LANES; ++i)
            LANE(into, k, i) = from[k * LANES + i];
}

static void store(double *into, const real *from, int count)
{
    int i, k;
    for (k = 0; k < count; ++k)
        for (i = 0; i < LANES; ++i)
            into[k * LANES + i] = LANE(from, k, i);
}

void kernel_init(const double *open, const double *y, const double *t, double *state)
{
    real o[SOME(OPEN)], measured[SOME(MEASURED)], at[1], s[STATE];
    load(o, open, OPEN);
    load(measured, y, MEASURED);
    load(at, t, 1);
    core_init(o, measured, at[0], s);
    store(state, s, STATE);
}

void kernel_run(const double *open, double *state, const long *rows, const double *const *logs,
                const int *kept, int count, double *const *found)
{
    real o[SOME(OPEN)], s[STATE], u[SOME(INPUTS)], y[SOME(MEASURED)], dt[1], next[STATE + INFO], x[SOME(ESTIMATE)];
    long r, longest = 0;
    int i, k;
    TINY_IS_ZERO;
    load(o, open, OPEN);
    load(s, state, STATE);
    for (i = 0; i < LANES; ++i)
        longest = rows[i] > longest ? rows[i] : longest;
    for (r = 0; r < longest; ++r) {
        for (i = 0; i < LANES; ++i) {
            const long at = r < rows[i] ? r : rows[i] - 1; /* a lane at its end does the last row again, for nobody */
            for (k = 0; k < INPUTS; ++k)
                LANE(u, k, i) = logs[3 * i][at * INPUTS + k];
            for (k = 0; k < MEASURED; ++k)
                LANE(y, k, i) = logs[3 * i + 1][at * MEASURED + k];
            LANE(dt, 0, i) = logs[3 * i + 2][at];
        }
        core_step(o, s, u, y, dt[0], next);
        memcpy(s, next, sizeof s);
        core_estimate(o, s, x);
        for (i = 0; i < LANES; ++i)
            if (r < rows[i]) {
                for (k = 0; k < ESTIMATE; ++k)
                    found[2 * i][r * ESTIMATE + k] = LANE(x, k, i);
                for (k = 0; k < count; ++k)
                    found[2 * i + 1][r * count + k] = LANE(next, STATE + kept[k], i);
            }
    }
    store(state, s, STATE);
    AS_BEFORE;
}
"""

_STEP = """
int kernel_step(double *numbers, double dt)
{
    double *u = numbers + STATE, *y = u + INPUTS, *x = y + MEASURED, *info = x + ESTIMATE;
    double next[STATE + INFO];
    TINY_IS_ZERO;
    core_step(0, numbers, u, y, dt, next);
    memcpy(numbers, next, STATE * sizeof(double));
    memcpy(info, next + STATE, INFO * sizeof(double));
    core_estimate(0, numbers, x);
    AS_BEFORE;
    return (int)info[RESULT];
}
"""
