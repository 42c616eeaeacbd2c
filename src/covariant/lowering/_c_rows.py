"""C of a function for the rows of an array, in lanes."""

from string import Template

from covariant.lowering._c import Real, c_function, c_helpers
from covariant.lowering._lowered import Lowered


def c_rows(lowered: Lowered, name: str, lanes: int, real: Real = "double", most_statements: int | None = None) -> str:
    """Source of `void name(const real *x, real *y, long long count)`, from rows of all inputs to rows of all results.

    - `lanes`: how many rows are done at once, a power of 2 and more than 1. In the lanes that the rows do not fill, the
      last row is done again; nothing beyond it is read or written.
    """
    text = c_function(lowered, f"{name}_lanes", real=real, static=True, most_statements=most_statements, lanes=lanes)
    given = {"name": name, "real": real, "lanes": lanes, "core": text.text}
    given |= {"helpers": c_helpers(text.helpers, real, lanes=lanes), "inputs": lowered.inputs}
    return Template(_SOURCE).substitute(given, outputs=len(lowered.outputs))


_SOURCE = """#include <math.h>

$helpers
$core
void $name(const $real *x, $real *y, long long count);
void $name(const $real *x, $real *y, long long count)
{
    lanes in[$inputs], out[$outputs];
    long long row;
    int i, k;
    for (row = 0; row < count; row += $lanes) {
        const int left = count - row < $lanes ? (int)(count - row) : $lanes;
        for (i = 0; i < $lanes; ++i)
            for (k = 0; k < $inputs; ++k)
                in[k][i] = x[(row + (i < left ? i : left - 1)) * $inputs + k];
        ${name}_lanes(in, out);
        for (i = 0; i < left; ++i)
            for (k = 0; k < $outputs; ++k)
                y[(row + i) * $outputs + k] = out[k][i];
    }
}
"""
