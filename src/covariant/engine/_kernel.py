"""An observer as a function of plain arrays of numbers, compiled from C."""

import functools
import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from covariant._programs import cache_folder
from covariant.codegen import Recipe, program
from covariant.engine._compile import library
from covariant.engine._recall import digest, recalled
from covariant.lowering import CText, Lowered, LoweringError, Signature, c_function, c_helpers
from covariant.observers import AbstractObserver

DECLARED = """
void kernel_init(const double *open, const double *y, const double *t, double *state);
void kernel_run(const double *open, double *state, const long *rows, const double *const *logs,
                const int *kept, int count, double *const *found);
"""
DECLARED_STEP = "int kernel_step(double *numbers, double dt);"


class Kernel(NamedTuple):
    """A compiled observer, for so many runs at once as it has lanes.

    - `text`: what was compiled.
    - `library.kernel_init(open, y, t, state)`: the states at rest at a measurement; `open` are the open numbers one
      after another. Of several lanes each number is a row, with an entry for each lane.
    - `library.kernel_run(open, state, rows, logs, kept, count, found)`: advance the states in place, over as many rows
      as each lane has. For each lane `logs` holds the pointers to its inputs, measurements and time steps, and `found`
      those to its estimates and to the `count` columns `kept` of its infos.
    - `library.kernel_step(numbers, dt)`: one step on an array of state, input, measurement, estimate and info, in this
      order, for an observer without open numbers and with one lane; returns the result code.
    - `pointer`: the pointer to an array.
    """

    text: "Text"
    ffi: Any
    library: Any
    lanes: int

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Numbers of a state, an estimate and an info."""
        return self.text.sizes

    def pointer(self, array: np.ndarray) -> Any:
        """The pointer to a contiguous array of doubles, which must live as long as the pointer is used."""
        return self.ffi.cast("double *", array.ctypes.data)

    def pointers(self, arrays: Sequence[np.ndarray]) -> Any:
        """The pointers to several such arrays, one after another."""
        return self.ffi.new("double *[]", [self.pointer(array) for array in arrays])


def kernel(
    observer: AbstractObserver, y: np.ndarray, inputs: int, opened: tuple[int, ...] = (), lanes: int = 1
) -> Kernel:
    """The kernel of an observer, its numbers written into the code.

    - `opened`: which of its arrays of real numbers, counted as leaves of its pytree, are arguments instead.
    - `lanes`: how many runs it does at once.

    One that was made before in this process for an equal observer is given again. Raises `LoweringError` where the
    observer has no graph, and `OSError` where it cannot be compiled.
    """
    asked = _Asked(observer, np.zeros(np.shape(y)), inputs, opened, lanes)
    try:
        return _kept(asked)
    except TypeError:  # something in it has no hash
        return _compiled(asked)


def outlasts(observer: AbstractObserver, y: np.ndarray, inputs: int, opened: tuple[int, ...] = ()) -> bool:
    """Whether the kernel of an observer, once made, is there in later processes, so that it is only loaded."""
    return cache_folder() is not None and _key(_Asked(observer, np.zeros(np.shape(y)), inputs, opened, 1)) is not None


class Text(NamedTuple):
    """An observer as C, and the shapes of what it takes and gives.

    - `source`, `declared`: the text, and the functions in it; `sizes`: numbers of a state, an estimate and an info.
    - `y`: the shape of a measurement; `u`: the number of inputs.
    - `info`, `estimate`: these, as arrays' shapes and types.
    """

    source: str
    declared: str
    sizes: tuple[int, int, int]
    y: tuple[int, ...]
    u: int
    info: Any
    estimate: Any


class _Asked:
    """What a kernel is made of; equal where the kernels would be."""

    def __init__(self, observer: AbstractObserver, y: np.ndarray, inputs: int, opened: tuple[int, ...], lanes: int):
        self.observer = observer
        arrays, self.rest = eqx.partition(observer, eqx.is_inexact_array)
        self.leaves, self.tree = jax.tree.flatten(arrays)
        self.y, self.inputs, self.opened, self.lanes = y, inputs, opened, lanes
        told = [np.asarray(leaf) for leaf in self.leaves]
        written = tuple(b"" if i in opened else a.tobytes() for i, a in enumerate(told))
        kinds = tuple((a.shape, a.dtype.str) for a in told)
        functions, form = jax.tree.flatten(self.rest)
        self._key = (self.tree, form, tuple(functions), written, kinds, opened, y.shape, inputs, lanes)

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Asked) and self._key == other._key

    def told(self) -> Any:
        """The same in plain words: the observer, with the bytes of its arrays but for those that are open."""
        counted = itertools.count()

        def told(leaf: Any) -> Any:
            if not eqx.is_inexact_array(leaf):
                return leaf
            a = np.asarray(leaf)
            return ("array", a.shape, a.dtype.str, None if next(counted) in self.opened else a.tobytes())

        return jax.tree.map(told, self.observer), self.y.shape, self.inputs, self.lanes

    def recipe(self) -> Recipe:
        """The observer with its open arrays as arguments, by names that sort as they are counted."""
        names = {i: f"n{i:06d}" for i in self.opened}

        def make(values: Any) -> AbstractObserver:
            chosen = [values[names[i]] if i in names else leaf for i, leaf in enumerate(self.leaves)]
            return eqx.combine(jax.tree.unflatten(self.tree, chosen), self.rest)

        return Recipe(make, {name: np.asarray(self.leaves[i]) for i, name in names.items()})


@functools.lru_cache(maxsize=64)
def _kept(asked: _Asked) -> Kernel:
    return _compiled(asked)


def _key(asked: _Asked) -> str | None:
    """What later processes find the text of a kernel by, if they do."""
    try:
        return _told(asked)
    except TypeError:  # as above
        return digest(asked.told())


@functools.lru_cache(maxsize=64)
def _told(asked: _Asked) -> str | None:
    return digest(asked.told())


def _compiled(asked: _Asked) -> Kernel:
    text = recalled(_key(asked), (Text, str), functools.partial(_written_or_why, asked))
    if isinstance(text, str):
        raise LoweringError(text)
    return Kernel(text, *library(text.source, text.declared), asked.lanes)


def _written_or_why(asked: _Asked) -> Text | str:
    """The text, or why there is none, which takes as long to find out."""
    try:
        return _written(asked)
    except LoweringError as error:
        return str(error)


def _written(asked: _Asked) -> Text:
    made = program(asked.recipe(), asked.y, asked.inputs, loops=True)
    n_state = sum(leaf.size for leaf in made.state)
    n_x, n_info = sum(leaf.size for leaf in made.x), sum(leaf.size for leaf in made.info)
    sizes = {"o": sum(leaf.size for leaf in made.given), "s": n_state, "u": made.u, "y": int(np.prod(made.y))}
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
        return c_function(graph, name, signature, static=True, lanes=asked.lanes)

    texts = [
        function(made.init, "core_init", "o y t", n_state),
        function(made.step, "core_step", "o s u y dt", n_state + n_info),
        function(made.estimate, "core_estimate", "o s", n_x),
    ]
    helpers = c_helpers(frozenset().union(*(text.helpers for text in texts)), lanes=asked.lanes)
    result = [leaf.name for leaf in made.info for _ in range(leaf.size)].index("result")
    named = {"RESULT": result, "STATE": n_state, "INPUTS": made.u, "MEASURED": sizes["y"], "ESTIMATE": n_x}
    named |= {"INFO": n_info, "OPEN": sizes["o"], "LANES": asked.lanes}
    alone = asked.lanes == 1
    parts = {
        "SIZES": "\n".join(f"#define {k} {v}" for k, v in named.items()),
        "HELPERS": helpers,
        "REAL": f"typedef {'double' if alone else 'lanes'} real;",
        "CORE": "\n".join(text.text for text in texts),
    }
    source = _SOURCE + (_STEP if alone else "")
    for key, text in parts.items():
        source = source.replace(f"@{key}@", text)
    declared = DECLARED + (DECLARED_STEP if alone else "")
    observer: Any = asked.observer
    shape = jax.ShapeDtypeStruct(made.y, float)
    estimate = jax.eval_shape(lambda y: observer.estimate(observer.init(y)), shape)
    return Text(source, declared, (n_state, n_x, n_info), made.y, made.u, made.told_as, estimate)


# A velocity at rest decays until its last digits are gone, and numbers so small take processors many times as long:
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
