"""Writes the data sheet of an exported observer: cost of a step, memory, limits, and origin of the code."""

import hashlib
import re
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from covariant.codegen._program import Program
from covariant.codegen._source import Source, step_of
from covariant.signals import StepCode
from scalargraph import turn_operations

ARITHMETIC = ("add", "sub", "mul", "div", "neg", "abs", "min", "max", "sign", "sqrt")
LOGIC = ("lt", "le", "eq", "and", "or", "not", "is_finite", "select", "either")
COMPILERS = ("arm-none-eabi-gcc", "cc")
_VARYING = (
    "A step that needs one Runge–Kutta step. As many are taken as friction and dynamics ask for, and of a mechanical "
    "model at least one in 10 ms, so that a long step over a hole is predicted as exactly as the others. There are at "
    "most 10 000: where time is short, start again after a gap of seconds."
)
ARM = ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16")


class Facts(NamedTuple):
    """Facts of the data sheet that the source does not contain.

    Attributes:
        rate: Sampling rate [Hz] for which the observer was made.
        substeps: Number of Runge–Kutta steps in each sample; None if there are none, or if each step chooses it.
        certificate: Lines on the proved statements; may be empty.
        gate: Sentences that say which measurements are refused; may be empty.

    Example:
        >>> from covariant.codegen import Facts
        >>> Facts(rate=1000.0, substeps=2)
        Facts(rate=1000.0, substeps=2, certificate='', gate='')
    """

    rate: float
    substeps: int | None
    certificate: str = ""
    gate: str = ""


class Size(NamedTuple):
    """Sizes of a compiled source.

    Attributes:
        compiler: Compiler and machine.
        flash: Code with constants [bytes].
        stack: Deepest stack of a step [bytes]; None if the compiler does not report it.

    Example:
        >>> from covariant.codegen._data_sheet import Size
        >>> Size("arm-none-eabi-gcc -Os for Cortex-M4F", 1200, 96).flash
        1200
    """

    compiler: str
    flash: int
    stack: int | None


def data_sheet(program: Program, source: Source, about: str, facts: Facts) -> str:
    """Write the data sheet of an observer as Markdown."""
    width = {"double": 8, "float": 4}[program.real]
    state = sum(leaf.size for leaf in (*program.state, *program.reported)) * width
    numbers = sum(np.size(value) for value in program.numbers.values())
    step = source.functions["step"]
    lines = [f"# Data sheet of {source.name}", "", about, "", "## Work of a step", ""]
    turn = turn_operations(program.step.graph.nodes)
    lines += [_VARYING if turn else "The same in every step.", "", "| operations | count |", "|---|---|"]
    lines += [f"| {label} | {count} |" for label, count in _counts(step.operations)]
    lines += [f"| each further Runge–Kutta step | {turn} |"] if turn else []
    if program.alone:
        lines += ["", "## Work of a step by what was read", "", "| what was read | operations |", "|---|---|"]
        lines.append(f"| all | {sum(step.operations.values())} |")
        for part, _ in program.parts:
            lines.append(f"| {part} alone | {sum(source.functions[step_of(part)].operations.values())} |")
    lines += ["", "## Memory", "", "| what | bytes |", "|---|---|"]
    lines += [f"| state | {state} |", f"| numbers that may be changed | {numbers * width} |"]
    lines.append(f"| numbers kept on the stack between parts of a step | {step.scratch * width} |")
    for compiled in sizes(source):
        lines.append(f"| code and constants, {compiled.compiler} | {compiled.flash} |")
        if compiled.stack is not None:
            lines.append(f"| deepest stack of a step, {compiled.compiler} | {compiled.stack} |")
    lines += ["", "## Numbers that may be changed", "", "| name | default |", "|---|---|"]
    lines += [f"| `{key}` | {_format_values(value)} |" for key, value in program.numbers.items()] or ["| none | |"]
    lines += ["", "## Limits", ""]
    made = f"- Made for samples at {facts.rate:g} Hz, {1 / facts.rate:.6g} s apart{_substeps(facts)}"
    if facts.substeps is None:
        lines.append(f"{made}; other steps are predicted as exactly, but gains and gate are designed for these.")
    else:
        lines.append(f"{made}; slower ones are predicted less exactly.")
        lines.append("- Give a sample that is lost as one whose numbers are missing, not as a longer step.")
    if program.real == "float":
        lines.append("- Time is counted in single precision: a force that depends on time loses digits after an hour.")
    lines.append("- NaN marks what is missing, so that `-ffast-math` and `-ffinite-math-only` must not be used.")
    lines += ["", "## Gate", "", facts.gate] if facts.gate else []
    if program.signals.lines:
        lines += ["", "## What goes in and out", "", "In this order and in these units, whatever those of a log.", ""]
        lines += [f"- {line}" for line in program.signals.lines]
    lines += ["", "## Result codes", "", "| code | name | meaning |", "|---|---|---|"]
    lines += [f"| {int(result)} | `{source.name.upper()}_{result.name}` | {result.message} |" for result in StepCode]
    lines += ["", "## Certificate", "", facts.certificate] if facts.certificate else []
    lines += ["", "## Origin", "", f"- SHA-256 of header and source: `{digest(source)}`"]
    return "\n".join(lines) + "\n"


def digest(source: Source) -> str:
    """SHA-256 of header and source, which contain model, observer and default numbers.

    Args:
        source: The C of the observer.
    """
    return hashlib.sha256((source.header + source.source).encode()).hexdigest()


def _counts(operations) -> list[tuple[str, int]]:
    names = [(label, (label,)) for label in ("mul", "div", "sqrt")]
    titles = {"mul": "multiplications", "div": "divisions", "sqrt": "square roots"}
    rest = tuple(op for op in ARITHMETIC if op not in ("mul", "div", "sqrt"))
    functions = sorted(op for op in operations if op not in (*ARITHMETIC, *LOGIC))
    rows = [(titles[label], sum(operations[op] for op in ops)) for label, ops in names]
    rows.append(("additions and other arithmetic", sum(operations[op] for op in rest)))
    rows.append(("comparisons and choices", sum(operations[op] for op in LOGIC)))
    rows += [("look-ups in tables" if op == "table" else f"calls of {op}", operations[op]) for op in functions]
    return [*((label, count) for label, count in rows if count), ("all together", sum(operations.values()))]


def _format_values(value: np.ndarray) -> str:
    flat = np.ravel(value)
    return ", ".join(f"{v:.6g}" for v in flat[:9]) + (", …" if flat.size > 9 else "")


def _substeps(facts: Facts) -> str:
    if facts.substeps is None:
        return ""
    return f", with {facts.substeps} Runge–Kutta step{'s' if facts.substeps > 1 else ''} each"


def sizes(source: Source) -> list[Size]:
    """The sizes of a source with each installed compiler of `COMPILERS`."""
    return [size for name in COMPILERS if (size := _size(source, name)) is not None]


def _size(source: Source, compiler: str) -> Size | None:
    tool = shutil.which(compiler.replace("gcc", "size") if compiler != "cc" else "size")
    if shutil.which(compiler) is None or tool is None:
        return None
    flags = ARM if compiler.startswith("arm") else ()
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / f"{source.name}.h").write_text(source.header, encoding="utf-8")
        (Path(folder) / f"{source.name}.c").write_text(source.source, encoding="utf-8")
        # -Os is the usual option for code in the flash of a microcontroller.
        command = [compiler, "-std=c99", "-Os", *flags, "-fstack-usage", "-c", f"{source.name}.c"]
        if subprocess.run(command, cwd=folder, capture_output=True, check=False).returncode:
            return None
        printed = subprocess.run([tool, f"{source.name}.o"], cwd=folder, capture_output=True, text=True, check=False)
        usage = Path(folder) / f"{source.name}.su"
        stack = _deepest(usage.read_text(encoding="utf-8"), source.name) if usage.exists() else None
    # Berkeley format: text, data and bss come first.
    numbers = re.findall(r"^\s*(\d+)\s+(\d+)\s+(\d+)", printed.stdout, re.MULTILINE)
    label = f"{compiler} -Os{' for Cortex-M4F' if flags else ' of this machine'}"
    # The sum of text and data: initialised data are also in flash, and are copied to memory at the start.
    return Size(label, int(numbers[0][0]) + int(numbers[0][1]), stack) if numbers else None


def _deepest(usage: str, name: str) -> int:
    """The deepest stack [bytes] of a step with the functions that it calls; of successive calls the largest counts."""
    # A line of gcc -fstack-usage has three cells, separated by tabs: file:line:column:function, bytes, static or not.
    cells = [line.split("\t") for line in usage.splitlines()]
    # Compilers append a dot and a suffix to names of variants of a function.
    frames = {cell[0].rpartition(":")[2].partition(".")[0]: int(cell[1]) for cell in cells}

    def below(function: str) -> int:
        parts = [size for other, size in frames.items() if re.fullmatch(rf"{function}_(\d+|run)", other)]
        loops = {m.group(1) for other in frames if (m := re.match(rf"({function}_loop\d+)", other))}
        turns = [below(f"{loop}_turn") + frames.get(loop, 0) for loop in loops]
        # Parts and loops of a function run one after another, so only the deepest of each kind counts.
        return frames.get(function, 0) + max(parts, default=0) + max(turns, default=0)

    return frames.get(f"{name}_step", 0) + below(f"{name}_core_step")
