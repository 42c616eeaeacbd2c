"""Packs an exported observer as WebAssembly, with a script that a web page or Node loads."""

import base64
import json
import re
import shutil
from collections.abc import Mapping, Sequence

import numpy as np

from covariant.codegen._names import check_export_name
from covariant.codegen._program import Member, Program
from covariant.codegen._source import common_words
from covariant.codegen._vectors import Vectors
from covariant.signals import StepCode
from scalargraph.compiler import built, zig
from scalargraph.errors import InputError
from scalargraph.template import Words, fill

FLAGS = (
    "--target=wasm32-wasi",
    "-std=c99",
    "-O2",
    "-fno-math-errno",
    "-ffp-contract=off",
    "-nostartfiles",
    "-mexec-model=reactor",
    "-Wl,--no-entry",
    "-Wl,--strip-all",
)
"""Flags of the compiler, for a module without `main` that imports nothing."""
ARRAYS = {"double": "Float64Array", "float": "Float32Array"}
REMEDY = "install the packages clang, lld and wasi-libc of the system, or the extra wasm: pip install 'covariant[wasm]'"


def wasm_files(
    program: Program, texts: Mapping[str, str], name: str, about: str, rate: float, run: Vectors
) -> dict[str, bytes]:
    """Build an exported observer as WebAssembly, a script that also contains it, and a self-test for Node.

    Args:
        program: The observer as graphs.
        texts: Its header and source, as `export_texts` writes them.
        name: Prefix of all names in C, and name of the script's object.
        about: A line that describes the observer.
        rate: Sampling rate [Hz] for which it was made.
        run: The run that the self-test follows.

    Returns:
        Contents by their path in the folder of the export.

    Raises:
        ValueError: No compiler for WebAssembly is installed; it refuses the sources, in which case the message quotes
            it; or the name belongs to a global of JavaScript.

    Example:
        >>> import numpy as np
        >>> from covariant import codegen, observers
        >>> recipe = codegen.with_open_numbers(observers.FilteredDerivative(20.0))
        >>> program = codegen.program(recipe, np.zeros(1))
        >>> source = codegen.write_source(program, "speed", "A filtered derivative.")
        >>> texts = {"speed.h": source.header, "speed.c": source.source}
        >>> run = codegen.vectors(program, np.zeros((codegen.ROWS + 1, 1)), 100.0)
        >>> try:
        ...     files = list(codegen.wasm_files(program, texts, "speed", "A filtered derivative.", 100.0, run))
        ... except ValueError:  # no compiler
        ...     files = ["speed.wasm", "speed.js", "speed_wasm.c", "test/speed_test.js"]
        >>> files
        ['speed.wasm', 'speed.js', 'speed_wasm.c', 'test/speed_test.js']
    """
    check_export_name(name, wasm=True)
    words = common_words(program, name, about) | _words(program, rate)
    calls = fill("covariant.codegen", "wasm.c", words)
    binary = _compiled({f"{name}.h": texts[f"{name}.h"], f"{name}.c": texts[f"{name}.c"], "calls.c": calls})
    script = fill("covariant.codegen", "wasm.js", words | {"WASM": base64.b64encode(binary).decode()})
    return {
        f"{name}.wasm": binary,
        f"{name}.js": script.encode(),
        f"{name}_wasm.c": calls.encode(),
        f"test/{name}_test.js": fill("covariant.codegen", "wasm_test.js", words | _rows(run)).encode(),
    }


def check_wasm_compiler() -> None:
    """Compile an empty module; raises `ValueError` if no installed compiler can compile to WebAssembly."""
    _compiled({"empty.c": "#include <math.h>\ndouble covariant_empty(double x) { return sin(x); }\n"})


def _compiled(files: Mapping[str, str]) -> bytes:
    """The module, by the first compiler that succeeds."""
    clang, packaged = shutil.which("clang"), zig()
    commands = ([[clang]] if clang else []) + ([packaged] if packaged else [])
    if not commands:
        raise InputError(f"no compiler for WebAssembly is installed; {REMEDY}")
    messages = []
    for command in commands:
        try:
            return built(command, FLAGS, files, "the observer")
        except OSError as error:
            messages.append(str(error))
    raise InputError(f"no WebAssembly could be compiled; {REMEDY}\n" + "\n".join(messages))


def _words(program: Program, rate: float) -> Words:
    return {
        "SIGNALS": "".join(f" * {line}\n" for line in program.signals.lines),
        "FIRST": program.x[-1].name,
        "RATE": repr(float(rate)),
        "RESULTS": json.dumps([result.name for result in StepCode]),
        "MESSAGES": json.dumps([result.message for result in StepCode], ensure_ascii=False),
        "PARAMS": _sizes(program.parameters),
        "STATE": _sizes(program.stored),
        "OUTPUT": _sizes(program.output),
        "ARRAY": ARRAYS[program.real],
    }


def _sizes(leaves: Sequence[Member]) -> str:
    return json.dumps([[leaf.name, leaf.size] for leaf in leaves if leaf.size])


def _rows(run: Vectors) -> Words:
    tables = {
        "START": run.start,
        "STEPS": run.dt,
        "INPUT_ROWS": run.u,
        "MEASURED": np.where(run.missing, np.nan, run.y),
        "EXPECTED": run.expected,
        "ALLOWED": run.allowed,
        "OUTCOMES": run.result,
    }
    # Python writes NaN and Infinity like JavaScript; each row gets a line.
    return {key: re.sub(r"\], \[", "],\n    [", json.dumps(table.tolist())) for key, table in tables.items()}
