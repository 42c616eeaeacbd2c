"""The self-test of an exported observer: a program that follows the test vectors and compares."""

import numpy as np

from covariant.codegen._program import Program
from covariant.codegen._source import SENTENCE, entries, number
from covariant.codegen._vectors import Vectors


def write_test(program: Program, name: str, vectors: Vectors) -> str:
    """The C of the self-test, which needs <stdio.h> and <math.h> alone besides the export.

    It prints the largest deviation as a fraction of the allowed one, and returns 0 where that is at most 1 and all
    outcomes are as expected.

    Args:
        program: The observer as graphs.
        name: Prefix of all names in C.
        vectors: The run to follow.
    """
    upper, real = name.upper(), program.real
    shown = [e for leaf in [*program.x, *program.told] for e in entries("output.", leaf)]
    rows, k = vectors.y.shape

    def table(kind: str, label: str, values: np.ndarray) -> str:
        cells = np.asarray(values).reshape(rows, -1)
        # C has no array of zero numbers.
        width = max(1, cells.shape[1])
        write = (lambda v: str(int(v))) if kind != f"{name}_real" else (lambda v: number(v, real))
        lines = ",\n".join("    {" + ", ".join(map(write, row)) + "}" for row in cells.tolist() or [])
        if cells.shape[1] == 0:
            lines = ",\n".join(f"    {{{write(0.0)}}}" for _ in range(rows))
        return f"static const {kind} {label}[ROWS][{width}] = {{\n{lines}\n}};\n"

    kind = f"{name}_real"
    start = ", ".join(number(v, real) for v in vectors.start.tolist())
    read = "\n".join(f"        found[{i}] = {e};" for i, e in enumerate(shown))
    parts = [
        f"/* Self-test of {name}. {SENTENCE} */\n",
        f'#include "{name}.h"\n\n#include <math.h>\n#include <stdio.h>\n',
        f"#define ROWS {rows}\n#define NUMBERS {len(shown)}\n",
        f"static const {kind} start[{k}] = {{{start}}};\n",
        f"static const {kind} steps[ROWS] = {{{', '.join(number(v, real) for v in vectors.dt.tolist())}}};\n",
        table(kind, "inputs", vectors.u),
        table(kind, "measured", vectors.y),
        table("unsigned char", "missing", vectors.missing),
        table(kind, "expected", vectors.expected),
        # A multiple, since a compiler may fuse products and sums, and so round differently from all of these runs.
        "/* Ten times what roundings at random make of the same run. */",
        table(kind, "allowed", vectors.allowed),
        "/* The outcome of each step, or -1 where rounding decides it. */\n"
        f"static const int outcomes[ROWS] = {{{', '.join(map(str, vectors.result.tolist()))}}};\n",
        _MAIN.replace("@NAME@", name)
        .replace("@UPPER@", upper)
        .replace("@READ@", read)
        .replace("@ZERO@", number(0.0, real)),
    ]
    return "\n".join(parts)


_MAIN = """int main(void)
{
    @NAME@_state state;
    @NAME@_output output;
    @NAME@_real found[NUMBERS], worst = @ZERO@;
    int row, i, wrong = @NAME@_init(&state, &@NAME@_default, start, @ZERO@) != @UPPER@_OK;

    for (row = 0; row < ROWS; ++row) {
        const int outcome =
            @NAME@_step(&state, &@NAME@_default, inputs[row], measured[row], missing[row], steps[row]);
        if (outcomes[row] >= 0 && outcome != outcomes[row]) {
            printf("row %d: outcome %d in place of %d\\n", row, outcome, outcomes[row]);
            wrong = 1;
        }
        @NAME@_estimate(&state, &@NAME@_default, &output);
@READ@
        for (i = 0; i < NUMBERS; ++i) {
            const @NAME@_real off = found[i] > expected[row][i] ? found[i] - expected[row][i]
                                                                : expected[row][i] - found[i];
            const @NAME@_real part = off / allowed[row][i];
            if (expected[row][i] != expected[row][i])
                continue; /* not known there, nor compared */
            if (!(part <= 1)) {
                printf("row %d: number %d is %.17g in place of %.17g\\n", row, i, (double)found[i],
                    (double)expected[row][i]);
                wrong = 1;
            }
            if (part > worst)
                worst = part;
        }
    }
    printf("@NAME@: %s, %d steps, largest deviation %.3f of the allowed one\\n", wrong ? "WRONG" : "ok", ROWS,
        (double)worst);
    return wrong;
}
"""
