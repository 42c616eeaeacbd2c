"""An observer as a function of plain arrays of numbers, compiled from C."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from covariant.export import Program, program, with_open_numbers
from covariant.lowering import Signature, c_function, c_helpers, lower
from covariant.observers import AbstractObserver, Gated, chooses_substeps, needed_substeps
from covariant.runtime._compile import library

DECLARED = """
void kernel_init(const double *y, double t, double *state);
long kernel_run(double *state, long rows, const double *u, const double *y, const double *dt, double *x, double *info);
"""


class Kernel(NamedTuple):
    """A compiled observer.

    - `program`: its graphs; `sizes`: numbers of a state, an estimate and an info.
    - `run(state, rows, u, y, dt, x, info)`: advance a state in place over rows, for pointers to doubles; returns the
      number of rows done, which is less where a row needs another number of substeps.
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
    """The kernel of an observer of fixed length, or of one with so many substeps as `with_substeps` gives it.

    Raises `LoweringError` where it has no graph, and `OSError` where it cannot be compiled.
    """
    return _kernel(observer, None, y, inputs)


def kernel_of(observer: AbstractObserver, count: int, y: np.ndarray, inputs: int) -> Kernel:
    """The kernel for the rows that need `count` substeps, of an observer that chooses them itself."""
    return _kernel(with_substeps(observer, count), (observer, count), y, inputs)


def with_substeps(observer: Any, count: int) -> Any:
    """An observer that chooses its substeps itself, perhaps behind a gate, with a fixed number of them."""
    at = _chooser(observer)
    return observer if at is None else eqx.tree_at(lambda o: _chooser(o), observer, _fixed(at, count))


def chooses(observer: Any) -> bool:
    """Whether an observer chooses its number of substeps in each sample."""
    return _chooser(observer) is not None


def _chooser(observer: Any) -> Any:
    inner = observer.observer if isinstance(observer, Gated) else observer
    return inner if chooses_substeps(inner) else None


def _fixed(observer: Any, count: int) -> Any:
    return dataclasses.replace(observer, substeps=count)


def substeps_needed(observer: Any, state: Any, u: Any, dt: Any) -> Any:
    """The number of substeps that the observer would choose."""
    inner = state.inner if isinstance(observer, Gated) else state
    moves = jnp.asarray(jnp.where(jnp.isfinite(dt) & (dt > 0), dt, 0.0))
    return needed_substeps(_chooser(observer).model, inner.t, inner.q, inner.v, u, moves)


def _kernel(observer: Any, chooser: tuple[Any, int] | None, y: np.ndarray, inputs: int) -> Kernel:
    made = program(with_open_numbers(observer, ("*",)), y, inputs)
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
    asked = "    (void)0;"
    if chooser is not None:
        whose, count = chooser
        texts.append(_needs(whose, made, y, signature("sud", (*state, *u, "dt"), "z", 1)))
        asked = (
            "        double needed[1];\n        core_needs(state, u + r * INPUTS, dt[r], needed);\n"
            f"        if (needed[0] != {float(count)})\n            return r;"
        )
    helpers = c_helpers(frozenset().union(*(text.helpers for text in texts)))
    sizes = {"STATE": n_state, "INPUTS": m, "MEASURED": k, "ESTIMATE": n_x, "INFO": n_info}
    source = _SOURCE.replace("@NEEDS@", asked).replace("@CORE@", "\n".join([helpers, *(t.text for t in texts)]))
    source = source.replace("@SIZES@", "\n".join(f"#define {name} {size}" for name, size in sizes.items()))
    ffi, lib = library(source, DECLARED)
    return Kernel(made, ffi, lib, (n_state, n_x, n_info))


def _needs(observer: Any, made: Program, y: np.ndarray, signature: Signature):
    """C of the number of substeps that a row needs."""
    kinds = jax.eval_shape(lambda y: observer.init(y), jax.ShapeDtypeStruct(np.shape(y), float))
    real = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, float), kinds)

    def needs(state, u, dt):
        typed = jax.tree.map(lambda a, kind: a.astype(kind.dtype), state, kinds)
        return substeps_needed(observer, typed, u, dt).astype(float)

    u = jax.ShapeDtypeStruct((made.u,), float)
    return c_function(lower(needs, real, u, jax.ShapeDtypeStruct((), float)), "core_needs", signature, static=True)


_SOURCE = """#include <math.h>
#include <string.h>

@SIZES@

@CORE@

void kernel_init(const double *y, double t, double *state)
{
    core_init(y, t, state);
}

long kernel_run(double *state, long rows, const double *u, const double *y, const double *dt, double *x, double *info)
{
    double next[STATE + INFO];
    long r;
    for (r = 0; r < rows; ++r) {
@NEEDS@
        core_step(state, u + r * INPUTS, y + r * MEASURED, dt[r], next);
        memcpy(state, next, STATE * sizeof(double));
        memcpy(info + r * INFO, next + STATE, INFO * sizeof(double));
        core_estimate(state, x + r * ESTIMATE);
    }
    return r;
}
"""
