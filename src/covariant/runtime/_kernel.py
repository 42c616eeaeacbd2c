"""An observer as a function of plain arrays of numbers, compiled from C."""

from typing import Any, NamedTuple

import numpy as np

from covariant.export import Program, program, with_open_numbers
from covariant.lowering import Signature, c_function, c_helpers
from covariant.observers import AbstractObserver
from covariant.runtime._compile import library

DECLARED = """
void kernel_init(const double *y, double t, double *state);
void kernel_run(double *state, long rows, const double *u, const double *y, const double *dt, double *x, double *info);
int kernel_step(double *numbers, double dt);
"""


class Kernel(NamedTuple):
    """A compiled observer.

    - `program`: its graphs; `sizes`: numbers of a state, an estimate and an info.
    - `library.kernel_run(state, rows, u, y, dt, x, info)`: advance a state in place over rows, for pointers to doubles.
    - `library.kernel_step(numbers, dt)`: one step on an array of state, input, measurement, estimate and info, in this
      order; returns the result code.
    - `pointer`: the pointer to an array.
    """

    program: Program
    ffi: Any
    library: Any
    sizes: tuple[int, int, int]

    def pointer(self, array: np.ndarray) -> Any:
        """The pointer to a contiguous array of doubles, which must live as long as the pointer is used."""
        return self.ffi.cast("double *", array.ctypes.data)

    def start(self, y: np.ndarray, t: float) -> np.ndarray:
        """The state at rest at a measurement."""
        state, y = np.empty(self.sizes[0]), np.ascontiguousarray(y, float)
        self.library.kernel_init(self.pointer(y), t, self.pointer(state))
        return state


def kernel(observer: AbstractObserver, y: np.ndarray, inputs: int) -> Kernel:
    """The kernel of an observer.

    Raises `LoweringError` where it has no graph, and `OSError` where it cannot be compiled.
    """
    made = program(with_open_numbers(observer, ("*",)), y, inputs, loops=True)
    n_state = sum(leaf.size for leaf in made.state)
    n_x, n_info = sum(leaf.size for leaf in made.x), sum(leaf.size for leaf in made.info)
    k, m = int(np.prod(made.y)), made.u
    state, u, measured = (tuple(f"{n}[{i}]" for i in range(size)) for n, size in (("s", n_state), ("u", m), ("y", k)))

    def signature(arguments: str, inputs: tuple[str, ...], into: str, count: int) -> Signature:
        names = {"s": "const double *restrict s", "u": "const double *restrict u", "y": "const double *restrict y"}
        names |= {"d": "double dt", "t": "double t"}
        declared = ", ".join([*(names[a] for a in arguments), f"double *restrict {into}"])
        passed = tuple("dt" if a == "d" else a for a in arguments)
        return Signature(declared, (*passed, into), inputs, tuple(f"{into}[{i}]" for i in range(count)))

    texts = [
        c_function(made.init, "core_init", signature("yt", (*measured, "t"), "z", n_state), static=True),
        c_function(
            made.step, "core_step", signature("suyd", (*state, *u, *measured, "dt"), "z", n_state + n_info), static=True
        ),
        c_function(made.estimate, "core_estimate", signature("s", state, "z", n_x), static=True),
    ]
    helpers = c_helpers(frozenset().union(*(text.helpers for text in texts)))
    result = [leaf.name for leaf in made.info for _ in range(leaf.size)].index("result")
    sizes = {"RESULT": result, "STATE": n_state, "INPUTS": m, "MEASURED": k, "ESTIMATE": n_x, "INFO": n_info}
    source = _SOURCE.replace("@CORE@", "\n".join([helpers, *(t.text for t in texts)]))
    source = source.replace("@SIZES@", "\n".join(f"#define {name} {size}" for name, size in sizes.items()))
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

void kernel_init(const double *y, double t, double *state)
{
    core_init(y, t, state);
}

void kernel_run(double *state, long rows, const double *u, const double *y, const double *dt, double *x, double *info)
{
    double next[STATE + INFO];
    long r;
    TINY_IS_ZERO;
    for (r = 0; r < rows; ++r) {
        core_step(state, u + r * INPUTS, y + r * MEASURED, dt[r], next);
        memcpy(state, next, STATE * sizeof(double));
        memcpy(info + r * INFO, next + STATE, INFO * sizeof(double));
        core_estimate(state, x + r * ESTIMATE);
    }
    AS_BEFORE;
}

int kernel_step(double *numbers, double dt)
{
    double *u = numbers + STATE, *y = u + INPUTS, *x = y + MEASURED, *info = x + ESTIMATE;
    kernel_run(numbers, 1, u, y, &dt, x, info);
    return (int)info[RESULT];
}
"""
