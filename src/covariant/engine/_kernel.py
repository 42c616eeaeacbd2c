"""Compiles an observer in C, as a function of plain arrays of numbers."""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from covariant.codegen import Program, Recipe, trace_program
from covariant.engine._cache import cache_key, cache_layout, cached_layout, cached_text, result_index
from covariant.engine._compile import library
from covariant.engine._description import description_key
from covariant.engine._layout import Layout
from covariant.engine._numbers import Places, filled
from covariant.observers import AbstractObserver
from scalargraph import CText, Lowered, LoweringError, Signature, c_function, c_helpers, split
from scalargraph.template import fill

DECLARED = """
void kernel_init(const double *open, const double *y, const double *t, double *state);
void kernel_run(const double *open, double *state, const long *rows, const double *const *logs,
                const int *kept, int count, double *const *found);
"""
DECLARED_STEP = """
int kernel_fixed(void);
void kernel_fix(const double *open, double *fixed);
int kernel_step(double *numbers, double dt);
"""


class Kernel(NamedTuple):
    """A compiled observer, which advances as many runs at once as it has lanes.

    The functions of `library` are

    - `kernel_init(open, y, t, state)`: write states at rest at a measurement; `open` holds the open numbers one after
      another. With several lanes each number is a row, with an entry for each lane.
    - `kernel_run(open, state, rows, logs, kept, count, found)`: advance the states in place, over as many rows as each
      lane has. For each lane `logs` holds pointers to its inputs, measurements and time steps, and `found` pointers to
      its estimates and to the `count` columns `kept` of its infos.
    - `kernel_step(numbers, dt)`: make one step with one lane, on an array of state, input, measurement, estimate, info
      and fixed numbers, in this order; return the result code.
    - `kernel_fix(open, fixed)`: write the `kernel_fixed()` fixed numbers, the values computed from the open numbers
      that a step needs.

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
    """Raised if an observer cannot be compiled; the message gives the reason."""


class KernelForm(NamedTuple):
    """The conditions for which an observer is compiled.

    Attributes:
        y: Shape of a measurement, (n,) or (N, N).
        inputs: Number of inputs m.
        opened: For each array of real numbers of the observer, in the order of its pytree's leaves, the index of the
            argument of the compiled code for each entry, −1 for a constant; None for an array of constants. By default
            all are constants.
        lanes: Number of runs done at once, 1 by default.
        real: Whether measurements are real numbers, True by default.

    Example:
        >>> from covariant.engine._kernel import KernelForm
        >>> KernelForm((2,), inputs=1).lanes
        1
    """

    y: tuple[int, ...]
    inputs: int
    opened: Places = ()
    lanes: int = 1
    real: bool = True


def prepared(observer: AbstractObserver, form: KernelForm) -> "Prepared":
    """Trace an observer for compilation; numbers that are not open are written into the code."""
    key = _KernelKey(observer, form)
    try:
        return _prepared(key)
    except TypeError:  # a part of it cannot be hashed
        return Prepared(key)


class _KernelKey:
    """All that determines a kernel; equal keys mean equal kernels."""

    def __init__(self, observer: AbstractObserver, form: KernelForm):
        arrays, self.rest = eqx.partition(observer, eqx.is_inexact_array)
        self.leaves, self.tree = jax.tree.flatten(arrays)
        self.form, self.observer = form, observer
        values = [np.asarray(leaf) for leaf in self.leaves]
        places = form.opened or (None,) * len(values)
        # Open numbers are arguments of the code, so only the values of the other numbers distinguish kernels.
        written = tuple(
            a.tobytes() if at is None else a.ravel()[np.array(at, int) < 0].tobytes()
            for a, at in zip(values, places, strict=True)
        )
        kinds = tuple((a.shape, a.dtype.str) for a in values)
        functions, structure = jax.tree.flatten(self.rest)
        self._key = (self.tree, structure, tuple(functions), written, kinds, form)

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _KernelKey) and self._key == other._key

    def recipe(self) -> Recipe:
        """The observer as a function of one argument, its open numbers."""
        count = 1 + max((k for at in self.form.opened if at is not None for k in at), default=-1)
        if count == 0:
            return Recipe(lambda values: self.observer, {})

        def make(values: Any) -> AbstractObserver:
            leaves = filled(self.leaves, self.form.opened, values["open"])
            return eqx.combine(jax.tree.unflatten(self.tree, leaves), self.rest)

        # The values of the example do not matter: the code is the same for all.
        return Recipe(make, {"open": np.ones(count)})


class Prepared:
    """An observer whose cache key is known; its kernel is compiled on first use.

    Attributes:
        key: Key of its C text in the cache; None if it is not cached.
    """

    def __init__(self, key: _KernelKey):
        form = key.form
        self._kernel_key, self._lanes = key, form.lanes
        description = description_key(key.observer, form.opened, form.y, form.inputs, form.lanes)
        cached = cached_layout(description)
        if cached is not None:
            self.key, self._layout = cached
            return
        self.key, self._layout = cache_key(self._traced, self._lanes), Layout.of(self._traced)
        cache_layout(description, self.key, self._layout)

    @functools.cached_property
    def _traced(self) -> Program:
        form = self._kernel_key.form
        return trace_program(self._kernel_key.recipe(), np.zeros(form.y), form.inputs)

    @property
    def kernel(self) -> Kernel:
        """Compiled observer."""
        if isinstance(self._outcome, str):
            raise NoKernelError(self._outcome)
        return self._outcome

    @functools.cached_property
    def _outcome(self) -> Kernel | str:
        """The kernel, or the reason why there is none; the reason is cached too, as it takes as long to find."""
        try:
            source = cached_text(self.key, lambda: _c_text(self._traced, self._lanes))
            declared = DECLARED + (DECLARED_STEP if self._lanes == 1 else "")
            return Kernel(self._layout, *library(source, declared), self._lanes)
        except (LoweringError, OSError) as error:
            return str(error)
        finally:
            self.__dict__.pop("_traced", None)  # frees memory: a jaxpr of a robot takes megabytes


_prepared = functools.lru_cache(maxsize=64)(Prepared)


def _c_text(traced: Program, lanes: int) -> str:
    """The text of a kernel; raises `LoweringError`."""
    # On a computer the time of a step may depend on its numbers; code for a controller has fixed loops.
    program = traced.lower(loops=True)
    n_state, n_x, n_info = Layout.of(traced).sizes
    count = sum(leaf.size for leaf in program.given)
    # Values that depend on open numbers only are computed once for many steps. Then a step has about as many operations
    # as if these numbers were constants (double pendulum +1 %, Panda −1 %).
    (fix_step, step), (fix_estimate, estimate) = (split(each, count) for each in (program.step, program.estimate))
    fixed = len(fix_step.outputs), len(fix_estimate.outputs)
    sizes = {"o": count, "d": fixed[0], "e": fixed[1], "s": n_state, "u": program.u, "y": int(np.prod(program.y))}
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
        function(fix_step, "core_fix_step", "o", fixed[0]),
        function(fix_estimate, "core_fix_estimate", "o", fixed[1]),
        function(step, "core_step", "d s u y dt", n_state + n_info),
        function(estimate, "core_estimate", "e s", n_x),
    ]
    helpers = c_helpers(frozenset().union(*(text.helpers for text in texts)), lanes=lanes)
    named = {"RESULT": result_index(traced), "STATE": n_state, "INPUTS": program.u, "MEASURED": sizes["y"]}
    named |= {"ESTIMATE": n_x, "INFO": n_info, "OPEN": count, "LANES": lanes}
    named |= {"FIXED_STEP": fixed[0], "FIXED": sum(fixed)}
    words = {
        "SIZES": [f"#define {k} {v}" for k, v in named.items()],
        "HELPERS": [helpers],
        "REAL": "double" if lanes == 1 else "lanes",
        "CORE": [text.text for text in texts],
    }
    return fill("covariant.engine", "kernel.c", words)
