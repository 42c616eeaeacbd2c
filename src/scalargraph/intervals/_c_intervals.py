"""Bounds graphs by compiled C: each step of a tape is a loop over a few boxes.

The C is generated from the NumPy formulas of the operations, so that both do the same in the same order. It contains
all operations but no graph, so one compilation serves all proofs; a graph is passed to it as a list of steps.

The compiler is trusted to obey IEEE 754. No flag permits it to do otherwise: products and sums are not fused, and the
flags for errno, traps and wrapping integers change no value. When a library is loaded, each operation is compared with
NumPy's, bit by bit, on numbers of all sizes; if one differs, the library is refused.
"""

import ctypes
import functools
import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from scalargraph.compiler import EXACT, compiled, compiler, is_kept
from scalargraph.graph import Lowered, no_collection
from scalargraph.intervals._enclose import Enclosure, bounds
from scalargraph.intervals._fuse import fused
from scalargraph.intervals._numpy_to_c import HEAD, REAL, TRUTH, Text, Traced
from scalargraph.intervals._tape import KERNELS, Interval, Kernel, Place, Tape, Truth
from scalargraph.template import fill

LANES = 128
"""Number of boxes that each step processes at once: enough that the choice of the next step costs little."""


def kernel_text(text: Text, kernel: Kernel, name: str) -> str:
    """Write a kernel as a C function of the work array and the places of a step."""
    start, arguments = 2, []
    for kind, width in zip(kernel.arguments, kernel.widths, strict=True):
        ends = []
        for place in range(start, start + width):
            read = f"x{place}[i]"
            end = Traced(text, TRUTH, (text.name(TRUTH, f"{read} != 0"),)) if kind is Truth else None
            ends.append(end or Traced(text, REAL, (text.name(REAL, read),)))
        arguments.append(kind(*ends) if isinstance(kind, type) else ends)
        start += width
    results = kernel.formula(*arguments)
    stores = [f"y{k}[i] = {end.parts[0]};" for k, end in enumerate(results)]
    lines = [*text.lines(stores), *stores]
    read = [place for place in range(2, start) if f"x{place}[i]" in "".join(lines)]
    pointers = ", ".join(f"*restrict x{place} = w + at[{place}]" for place in read)
    body = "\n".join(f"        {line}" for line in lines)
    return (
        f"static void {name}(double *w, const int32_t *at)\n{{\n"
        f"    double *restrict y0 = w + at[0], *restrict y1 = w + at[1];\n    const double {pointers};\n"
        f"    int i;\n#pragma GCC ivdep\n    for (i = 0; i < LANES; ++i) {{\n{body}\n    }}\n}}\n"
    )


@functools.cache
def source() -> str:
    """Generate the C of all kernels, and of the loop that carries out the steps of a tape.

    The text is the same in every process; the compiled library is cached under a hash of it.
    """
    kernels, tables = [], dict[str, str]()
    for name, kernel in KERNELS.items():
        text = Text(tables)
        kernels.append(kernel_text(text, kernel, f"k_{name}"))
    written = [f"static const double {name}[] = {{{row}}};" for row, name in tables.items()]
    words = {
        "HEAD": [HEAD],
        "LANES": LANES,
        "KERNELS": [*written, *kernels],
        "POINTERS": ", ".join(f"k_{name}" for name in KERNELS),
        "WIDTHS": ", ".join(str(2 + sum(kernel.widths)) for kernel in KERNELS.values()),
    }
    return fill("scalargraph", "enclose.c", words)


class Library:
    """The compiled kernels, tested against NumPy.

    Args:
        text: C of the kernels, by default that of their formulas.

    Raises:
        OSError: There is no compiler, or it fails, or an operation differs from NumPy's.
    """

    def __init__(self, text: str | None = None):
        if compiler() is None:
            raise OSError("there is no C compiler `cc`, so NumPy does the work")
        self._enclose = compiled(text or source(), EXACT, ctypes.CDLL).enclose
        self._enclose.restype = None
        differing = self._differs()
        if differing:
            raise OSError(f"{compiler()} rounds {differing} in another way than NumPy, so NumPy does the work")
        # Half of it is subnormal. The sum equals SMALLEST only if subnormal numbers are not flushed to zero.
        if not np.float64(SMALLEST) * 0.5 + np.float64(SMALLEST) * 0.5 == SMALLEST:
            raise OSError(f"numbers below {SMALLEST:.0e} count as zero in this process, so NumPy does the work")

    def run(self, made: "Steps", ends: np.ndarray) -> np.ndarray:
        """Carry out the steps of a tape."""
        ends, results = np.ascontiguousarray(ends), np.empty((len(made.outputs), ends.shape[1]))
        work = made.idle.pop() if made.idle else made.work.copy()  # another thread may be using the array
        arrays = (made.steps, made.length, work, made.inputs, len(made.inputs), made.outputs, len(made.outputs))
        self._enclose(*map(_c_argument, (*arrays, ends.shape[1], ends, results)))
        made.idle.append(work)
        return results

    def _differs(self) -> str:
        """The name of a kernel whose results differ in bits from its formula; empty if there is none."""
        rng = np.random.default_rng(0)
        for name, kernel in KERNELS.items():
            ends = _trials(kernel, rng)
            tape = Tape()
            places = [[tape.place() for _ in range(width)] for width in kernel.widths]
            made = tape.step(name, [_of(kind, row) for kind, row in zip(kernel.arguments, places, strict=True)])
            numbers = [place.number for row in places for place in row]
            steps = Steps.of(tape, numbers, [end.number for end in made])
            cut = np.cumsum(kernel.widths)[:-1]
            arguments = [_of(kind, rows) for kind, rows in zip(kernel.arguments, np.split(ends, cut), strict=True)]
            with np.errstate(all="ignore"):
                expected = np.stack([np.asarray(end, float) for end in kernel.formula(*arguments)])
            # Zeros of both signs count as equal, and so do all NaN: neither changes a bound.
            if not np.array_equal(self.run(steps, ends), expected, equal_nan=True):
                return name
        return ""


SMALLEST = 2.0**-1022
"""The smallest normal double. Some libraries for fast arithmetic make a process flush smaller numbers to zero."""


def _c_argument(value: int | np.ndarray) -> ctypes.c_int64 | ctypes.c_void_p:
    return ctypes.c_int64(value) if isinstance(value, int) else ctypes.c_void_p(value.ctypes.data)


def _of(kind: type | int, rows: Sequence[Place] | np.ndarray) -> Any:
    """An argument of a kernel, assembled from its rows."""
    if kind is Truth:
        return Truth(*(row if isinstance(row, Place) else row != 0 for row in rows))
    return kind(*rows) if isinstance(kind, type) else list(rows)


SIZES = (0.0, 2.0**-1074, 2.0**-1022, 2.0**-1000, 2.0**-500, 1e-9, 0.1, 0.5, 1.0, 1.5, 3.0, 50.0, 1e5, 1e300, np.inf)
"""Sizes of the numbers on which kernels are compared."""
TRIALS = 640


def _trials(kernel: Kernel, rng: np.random.Generator) -> np.ndarray:
    """Test arguments of a kernel (places, TRIALS): intervals of all sizes, narrow, wide and unknown ones."""
    rows = []
    for kind, width in zip(kernel.arguments, kernel.widths, strict=True):
        if kind is Truth:
            rows.append(np.sort(rng.integers(0, 2, (2, TRIALS)), axis=0).astype(float))
        elif kind is Interval:
            # Half of the intervals are narrow, as in proofs; the ends of the others have unrelated sizes.
            size = rng.choice(SIZES, (2, TRIALS)) * rng.uniform(0.5, 1.0, (2, TRIALS)) * rng.choice([-1, 1], TRIALS)
            size[1] = np.where(rng.random(TRIALS) < 0.5, size[0] * (1 + 1e-6), size[1] * rng.choice([-1, 1], TRIALS))
            # A few intervals are unknown.
            size[:, rng.random(TRIALS) < 0.02] = np.nan
            rows.append(np.sort(size, axis=0))
        else:
            rows.append(rng.uniform(0, 1, (width, TRIALS)))
    return np.concatenate(rows)


def at_hand() -> bool:
    """Whether the kernels have been compiled before, so that using them takes no compilation.

    It is False if there is no compiler.
    """
    return compiler() is not None and is_kept(source(), EXACT)


class Steps(NamedTuple):
    """A tape in the form that the compiled kernels read.

    Attributes:
        steps: Number of each kernel with the offsets of its results and arguments, an int32 array.
        length: Number of steps.
        work: The work array (places, LANES), in which constants are set already.
        idle: Copies of the work array that are not in use.
        inputs: Offsets of the inputs.
        outputs: Offsets of the outputs.
    """

    steps: np.ndarray
    length: int
    work: np.ndarray
    idle: list[np.ndarray]
    inputs: np.ndarray
    outputs: np.ndarray

    @classmethod
    def of(cls, tape: Tape, inputs: Sequence[int], outputs: Sequence[int]) -> "Steps":
        """Translate a tape; a place is reused after its value was read for the last time."""
        done = fused(tape, outputs)
        last = {place: k for k, step in enumerate(done) for place in (*step.results, *step.arguments)}
        # Outputs are read at the end, and constants also for the next block of boxes: their places are never reused.
        last.update(dict.fromkeys([*outputs, *tape.constants.values()], len(done)))
        place = {number: k for k, number in enumerate([*tape.constants.values(), *inputs])}
        free, count, rows = [], len(place), []
        kernels = {name: k for k, name in enumerate(KERNELS)}
        for k, step in enumerate(done):
            # Results get their places before the places of the arguments are released, because kernels read and write
            # through `restrict` pointers.
            for result in step.results:
                if free:
                    place[result] = free.pop()
                else:
                    place[result], count = count, count + 1
            rows += [kernels[step.kernel], *(LANES * place[number] for number in (*step.results, *step.arguments))]
            free += [place[number] for number in {*step.results, *step.arguments} if last[number] == k]
        work = np.zeros((count, LANES))
        work[: len(tape.constants)] = np.array([np.frombuffer(bits)[0] for bits in tape.constants])[:, None]
        ends = (np.array([LANES * place[number] for number in numbers], np.int32) for numbers in (inputs, outputs))
        return cls(np.array(rows, np.int32), len(done), work, [], *ends)


class CompiledBounds:
    """Bounds of a function by compiled C; call it with the corners of boxes (B, inputs), as `enclose`.

    Args:
        lowered: The function.
        library: The compiled kernels.
    """

    @no_collection()
    def __init__(self, lowered: Lowered, library: Library):
        tape = Tape()
        inputs = [Interval(tape.place(), tape.place()) for _ in range(lowered.inputs)]
        values, smooth = bounds(lowered, inputs)
        outputs = [tape.number_of(end) for end in (*(v.low for v in values), *(v.high for v in values), smooth.must)]
        places = [end.number for end in itertools.chain(*inputs)]
        self._library, self._steps = library, Steps.of(tape, places, outputs)

    def __call__(self, low: np.ndarray, high: np.ndarray) -> Enclosure:
        """Bounds of the function over boxes, as `enclose` returns them."""
        ends = np.stack([low.T, high.T], axis=1).reshape(-1, len(low))
        results = self._library.run(self._steps, ends)
        count = len(results) // 2
        return Enclosure(results[:count].T, results[count:-1].T, results[-1] != 0)
