"""An observer as a function of plain arrays of numbers, compiled from C."""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from covariant.export import Program, Recipe, program
from covariant.lowering import CText, Lowered, Signature, c_function, c_helpers
from covariant.observers import AbstractObserver
from covariant.runtime._compile import library

DECLARED = """
void kernel_init(const double *open, const double *y, double t, double *state);
void kernel_run(const double *open, double *state, long rows, const double *u, const double *y, const double *dt,
                double *x, double *info);
int kernel_step(double *numbers, double dt);
"""


class Kernel(NamedTuple):
    """A compiled observer.

    - `program`: its graphs; `sizes`: numbers of a state, an estimate and an info.
    - `library.kernel_run(open, state, rows, u, y, dt, x, info)`: advance a state in place over rows, for pointers to
      doubles; `open` holds the open numbers one after another.
    - `library.kernel_step(numbers, dt)`: one step on an array of state, input, measurement, estimate and info, in this
      order, for an observer without open numbers; returns the result code.
    - `pointer`: the pointer to an array.
    """

    program: Program
    ffi: Any
    library: Any
    sizes: tuple[int, int, int]

    def pointer(self, array: np.ndarray) -> Any:
        """The pointer to a contiguous array of doubles, which must live as long as the pointer is used."""
        return self.ffi.cast("double *", array.ctypes.data)

    def start(self, y: np.ndarray, t: float, numbers: np.ndarray | None = None) -> np.ndarray:
        """The state at rest at a measurement; `numbers` are those that are open."""
        state, y = np.empty(self.sizes[0]), np.ascontiguousarray(y, float)
        opened = self.ffi.NULL if numbers is None else self.pointer(numbers)
        self.library.kernel_init(opened, self.pointer(y), t, self.pointer(state))
        return state


def kernel(observer: AbstractObserver, y: np.ndarray, inputs: int, opened: tuple[int, ...] = ()) -> Kernel:
    """The kernel of an observer, its numbers written into the code.

    - `opened`: which of its arrays of real numbers, counted as leaves of its pytree, are arguments instead.

    One that was made before in this process for an equal observer is given again. Raises `LoweringError` where the
    observer has no graph, and `OSError` where it cannot be compiled.
    """
    asked = _Asked(observer, np.zeros(np.shape(y)), inputs, opened)
    try:
        return _kept(asked)
    except TypeError:  # something in it has no hash
        return _compiled(asked)


class _Asked:
    """What a kernel is made of; equal where the kernels would be."""

    def __init__(self, observer: AbstractObserver, y: np.ndarray, inputs: int, opened: tuple[int, ...]):
        arrays, self.rest = eqx.partition(observer, eqx.is_inexact_array)
        self.leaves, self.tree = jax.tree.flatten(arrays)
        self.y, self.inputs, self.opened = y, inputs, opened
        told = [np.asarray(leaf) for leaf in self.leaves]
        written = tuple(b"" if i in opened else a.tobytes() for i, a in enumerate(told))
        kinds = tuple((a.shape, a.dtype.str) for a in told)
        functions, form = jax.tree.flatten(self.rest)
        self._key = (self.tree, form, tuple(functions), written, kinds, opened, y.shape, inputs)

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Asked) and self._key == other._key

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


def _compiled(asked: _Asked) -> Kernel:
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
        declared = ", ".join(f"double {n}" if n in ("dt", "t") else f"const double *restrict {n}" for n in names)
        given = tuple(entry for n in names for entry in entries[n])
        outputs = tuple(f"z[{i}]" for i in range(results))
        signature = Signature(f"{declared}, double *restrict z", (*names, "z"), given, outputs)
        return c_function(graph, name, signature, static=True)

    texts = [
        function(made.init, "core_init", "o y t", n_state),
        function(made.step, "core_step", "o s u y dt", n_state + n_info),
        function(made.estimate, "core_estimate", "o s", n_x),
    ]
    helpers = c_helpers(frozenset().union(*(text.helpers for text in texts)))
    result = [leaf.name for leaf in made.info for _ in range(leaf.size)].index("result")
    named = {"RESULT": result, "STATE": n_state, "INPUTS": made.u, "MEASURED": sizes["y"], "ESTIMATE": n_x}
    source = _SOURCE.replace("@CORE@", "\n".join([helpers, *(t.text for t in texts)]))
    source = source.replace("@SIZES@", "\n".join(f"#define {k} {v}" for k, v in (named | {"INFO": n_info}).items()))
    ffi, lib = library(source, DECLARED)
    return Kernel(made, ffi, lib, (n_state, n_x, n_info))


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

@CORE@

void kernel_init(const double *open, const double *y, double t, double *state)
{
    core_init(open, y, t, state);
}

void kernel_run(const double *open, double *state, long rows, const double *u, const double *y, const double *dt,
                double *x, double *info)
{
    double next[STATE + INFO];
    long r;
    TINY_IS_ZERO;
    for (r = 0; r < rows; ++r) {
        core_step(open, state, u + r * INPUTS, y + r * MEASURED, dt[r], next);
        memcpy(state, next, STATE * sizeof(double));
        memcpy(info + r * INFO, next + STATE, INFO * sizeof(double));
        core_estimate(open, state, x + r * ESTIMATE);
    }
    AS_BEFORE;
}

int kernel_step(double *numbers, double dt)
{
    double *u = numbers + STATE, *y = u + INPUTS, *x = y + MEASURED, *info = x + ESTIMATE;
    kernel_run(0, numbers, 1, u, y, &dt, x, info);
    return (int)info[RESULT];
}
"""
