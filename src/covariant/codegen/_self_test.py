"""Writes the self-test of an exported observer: a program that runs the test vectors and compares the results."""

import numpy as np

from covariant.codegen._program import Program
from covariant.codegen._source import entries
from covariant.codegen._vectors import Vectors
from scalargraph import c_number
from scalargraph.template import Words, fill


def write_test(program: Program, words: Words, vectors: Vectors) -> str:
    """Write the C of the self-test, which needs only <stdio.h> and <math.h> besides the export.

    It prints the largest deviation as a fraction of the allowed one, and returns 0 if this is at most 1 and all
    outcomes are as expected.
    """
    outputs = [e for leaf in program.output for e in entries("output.", leaf)]

    def row(values: np.ndarray) -> str:
        # C does not allow an array of length zero.
        return ", ".join(c_number(float(v), program.real) for v in values) or c_number(0.0, program.real)

    def table(name: str, values: np.ndarray) -> list[str]:
        return [
            f"static const {words['NAME']}_real {name}[ROWS][{max(1, values.shape[1])}] = {{",
            ",\n".join(f"    {{{row(each)}}}" for each in values),
            "};",
        ]

    missing = ",\n".join(f"    {{{', '.join(map(str, each))}}}" for each in vectors.missing.astype(int).tolist())
    placeholders = {
        "ROWS": len(vectors.y),
        "NUMBERS": len(outputs),
        "ZERO": c_number(0.0, program.real),
        "START": row(vectors.start),
        "STEPS": row(vectors.dt),
        "INPUT_ROWS": table("inputs", vectors.u),
        "MEASURED_ROWS": table("measured", vectors.y),
        "MISSING": [missing],
        "EXPECTED": table("expected", vectors.expected),
        # Allowed deviations are a multiple of the observed ones, since a compiler may fuse products and sums, which
        # changes their rounding.
        "ALLOWED": table("allowed", vectors.allowed),
        "OUTCOMES": ", ".join(map(str, vectors.result.tolist())),
        "READ": [f"        found[{i}] = {e};" for i, e in enumerate(outputs)],
    }
    return fill("covariant.codegen", "self_test.c", words | placeholders)
