"""The header and the source of an exported observer.

All names begin with the name of the export. There is no memory management and no variable but constants; a state is a
plain structure, so that a copy of it is a snapshot, and every function works on its arguments alone.
"""

import math
import re
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Literal, NamedTuple, get_args

import numpy as np

from covariant.codegen._program import CONFIGURATION, Leaf, Program, Real
from covariant.lowering import C_KEYWORDS, CText, Lowered, Signature, c_function, c_helpers, c_number
from covariant.signals import Result

KEYWORDS = C_KEYWORDS | {"info"}
"""Words that are no names of an export or of its numbers; the info of a step is called so."""
SENTENCE = "This text is yours: use, change and sell it as you like; no licence of its generator extends to it."


Tables = Literal["none", "once", "all"]

CODE = {
    "none": {"float": 0.41, "double": 0.85},
    "once": {"float": 0.34, "double": 0.68},
    "all": {"float": 0.32, "double": 0.44},
}
"""Bytes that a character of C, but for constant arrays, becomes on a Cortex-M4F by gcc -Os, at most, for each use of
tables: in single precision, and in double, which that processor does by functions."""
LOOK_UP = {"float": 10, "double": 60}
"""Further bytes of a look-up in a table."""
WIDTHS = {"double": 8, "float": 4, "unsigned": 4, "unsigned short": 2}
"""Bytes of an entry of a constant array there."""
ARRAY = re.compile(rf"^static const ({'|'.join(WIDTHS)}) \w+\[(\d+)\] = {{[^}}]*}};$", re.MULTILINE)


class Source(NamedTuple):
    """The C of an observer.

    Attributes:
        name: Prefix of all names.
        header: Text of the header.
        source: Text of the source.
        functions: The functions "init", "step" and "estimate", with the operations of a call of each.
        tables: Which like statements are loops over tables: "none", those outside loops ("once"), or "all" of them.

    Example:
        >>> import numpy as np
        >>> from covariant import codegen, observers
        >>> recipe = codegen.with_open_numbers(observers.FilteredDerivative(20.0))
        >>> program = codegen.program(recipe, np.zeros(1))
        >>> source = codegen.write_source(program, "speed", "A filtered derivative.")
        >>> source.functions["step"].operations["div"], "speed_step" in source.header
        (1, True)
    """

    name: str
    header: str
    source: str
    functions: dict[str, CText]
    tables: Tables = "none"


def write_source(program: Program, name: str, about: str, flash: int | float = math.inf) -> Source:
    """The header and the source of an observer, in C99.

    Args:
        program: The observer as graphs.
        name: Prefix of all names in C, an identifier.
        about: A line that says what the observer is, for comments and texts.
        flash: Limit [bytes] of code and constants; by default there is none. Where straight C is estimated to take
            more, like statements are loops over tables. The estimate is by the length of the text, the same on every
            machine.

    Raises:
        ValueError: The name is no identifier of C, or the tables are estimated to take more than `flash` too.

    Example:
        >>> import numpy as np
        >>> from covariant import codegen, observers
        >>> recipe = codegen.with_open_numbers(observers.FilteredDerivative(20.0))
        >>> program = codegen.program(recipe, np.zeros(1))
        >>> codegen.write_source(program, "double", "A filtered derivative.")
        Traceback (most recent call last):
        ValueError: 'double' is no name in C; take letters, digits and underscores, beginning with a letter
    """
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) or name in KEYWORDS:
        raise ValueError(f"{name!r} is no name in C; take letters, digits and underscores, beginning with a letter")
    least = math.inf
    # From the fastest code to the smallest: the first that fits is taken.
    for tables in get_args(Tables):
        source = _written(program, name, about, tables)
        size = _estimated(source, program.real)
        if size <= flash:
            return source
        least = min(least, math.ceil(size / 1024))
    closed = ", close numbers by `parameters=[]`" if program.numbers else ""
    raise ValueError(
        f"{name} takes about {least} kB of flash, with loops over tables too, and may take {flash / 1024:g}; give it "
        f"{least}k or more{closed}, or choose a cheaper observer"
    )


def _estimated(source: Source, real: Real) -> float:
    """Bytes of code and constants on a Cortex-M4F, more than its compiler makes of it, whatever the name."""
    arrays = sum(WIDTHS[kind] * int(count) for kind, count in ARRAY.findall(source.source))
    # A name of fixed length in place of the export's, so that the estimate does not depend on it.
    code = re.sub(rf"\b{source.name}_", "arm_", ARRAY.sub("", source.source))
    return arrays + LOOK_UP[real] * code.count("arm_table(") + CODE[source.tables][real] * len(code)


def _written(program: Program, name: str, about: str, tables: Tables) -> Source:
    core = {"init": _init(program, name), "step": _step(program, name, program.step, math.prod(program.y))}
    for part, count in program.parts if program.alone else ():
        if step_of(part) in core:
            raise ValueError(f"the steps by sensor need names that differ in C; {step_of(part)} is there twice")
        core[step_of(part)] = _step(program, name, dict(program.alone)[part], count)
    core["estimate"] = _estimate(program, name)
    functions = {
        key: c_function(graph, f"{name}_core_{key}", signature, program.real, f"{name}_", static=True, tables=tables)
        for key, (graph, signature) in core.items()
    }
    return Source(name, _header(program, name, about), _source(program, name, about, functions), functions, tables)


def entries(owner: str, leaf: Leaf) -> list[str]:
    """The C expressions of the entries of an array of a structure.

    Args:
        owner: Expression of the structure with its operator, such as `state->`.
        leaf: The array; one without axes is a plain variable.
    """
    return [f"{owner}{field(leaf)}[{i}]" for i in range(leaf.size)] if leaf.shape else [f"{owner}{field(leaf)}"]


def field(leaf: Leaf) -> str:
    """The name of an array in C, with an underscore where it is a keyword.

    Args:
        leaf: The array.
    """
    return f"{leaf.name}_" if leaf.name in KEYWORDS else leaf.name


def number(value: float, real: Real) -> str:
    """A number as a constant in C.

    Args:
        value: The number.
        real: Its type, "double" or "float".
    """
    return c_number(value, real)


def _members(leaves: Sequence[Leaf], name: str) -> str:
    lines = [f"    {name}_real {field(leaf)}{f'[{leaf.size}]' if leaf.shape else ''};" for leaf in leaves if leaf.size]
    return "\n".join(lines)


def _structure(kind: str, name: str, about: str, members: str) -> str:
    # A structure without members is no C.
    return f"/* {about} */\ntypedef struct {{\n{members or f'    {name}_real unused;'}\n}} {name}_{kind};\n"


def _header(program: Program, name: str, about: str) -> str:
    upper = name.upper()
    last = Result(max(Result))
    codes = "\n".join(
        f"    {upper}_{result.name} = {int(result)}{'' if result is last else ','} /* {result.message} */"
        for result in Result
    )
    order = [f" * {line}\n" for line in program.signals.lines]
    told = (
        f"/* Numbers in their order, in these units, whatever those of a log:\n{''.join(order)} */\n" if order else ""
    )
    y = int(np.prod(program.y))
    held = f"numbers of a measurement, {' x '.join(map(str, program.y))} by rows"
    started = "y"
    if program.sensors:
        each = [f"{count} of {'the ' if of == CONFIGURATION else ''}{of}" for of, count in program.parts]
        held = f"numbers of a measurement: {', then '.join(each)}"
        started = "the configuration in y"
    parameters = [Leaf(key, np.shape(value)) for key, value in program.numbers.items()]
    parts = [
        f"/* {about}\n *\n * Written by covariant {_version()}. {SENTENCE}\n */",
        f"#ifndef {upper}_H\n#define {upper}_H\n",
        '#ifdef __cplusplus\nextern "C" {\n#endif\n',
        f"typedef {program.real} {name}_real;\n",
        f"{told}#define {upper}_MEASUREMENTS {y} /* {held} */\n#define {upper}_INPUTS {program.u}\n",
        f"/* Outcome of a step; a larger one is worse. */\nenum {{\n{codes}\n}};\n",
        _structure(
            "params", name, "Numbers that may be changed at any time, between two steps.", _members(parameters, name)
        ),
        _structure(
            "state",
            name,
            "What is remembered; a copy is a snapshot. Innovation and standard deviations are of the last step.",
            _members([*program.state, *(_last(leaf) for leaf in program.reported)], name),
        ),
        _structure("output", name, "An estimate.", _members([*program.x, *program.told], name)),
        f"extern const {name}_params {name}_default;\n",
        f"/* Start at rest at the measurement y, at the time t [s]. Returns {upper}_OK or, where {started} is not all\n"
        f" * finite, {upper}_NOT_FINITE, and then leaves the state as it was. */\n"
        f"int {name}_init({name}_state *state, const {name}_params *params, const {name}_real *y, {name}_real t);\n",
        "/* Advance by dt [s] under the input u, held over the step, then correct by the measurement y.\n"
        " *\n"
        " * missing: for each number of y, 1 where it was not measured; NULL for none. NaN in y says the same.\n"
        " * u: NULL counts as zero. An input that is not finite is replaced by the last one, and a step dt that is\n"
        " * not positive leaves the state as it was; the outcome says so. */\n"
        f"int {name}_step({name}_state *state, const {name}_params *params, const {name}_real *u,\n"
        f"    const {name}_real *y, const unsigned char *missing, {name}_real dt);\n",
        *_declared_alone(program, name),
        "/* The estimate of a state. */\n"
        f"void {name}_estimate(const {name}_state *state, const {name}_params *params, {name}_output *output);\n",
        "#ifdef __cplusplus\n}\n#endif\n",
        "#endif",
    ]
    return "\n".join(parts) + "\n"


def _declared_alone(program: Program, name: str) -> list[str]:
    """Declarations of the steps in which only one part of a measurement was read."""
    return [
        f"/* The same step where nothing but the {count} numbers of "
        f"{'the ' if part == CONFIGURATION else ''}{part} were read, with less work. */\n"
        f"int {name}_{step_of(part)}({name}_state *state, const {name}_params *params, const {name}_real *u,\n"
        f"    const {name}_real *y, {name}_real dt);\n"
        for part, count in (program.parts if program.alone else ())
    ]


def _last(leaf: Leaf) -> Leaf:
    return leaf._replace(name=f"last_{leaf.name}")


def _init(program: Program, name: str) -> tuple[Lowered, Signature]:
    inputs = [*_numbers(program), *(f"y[{i}]" for i in range(int(np.prod(program.y)))), "t"]
    outputs = [e for leaf in program.state for e in entries("state->", leaf)]
    declared = (
        f"const {name}_params *restrict params, const {name}_real *restrict y, {name}_real t,\n"
        f"    {name}_state *restrict state"
    )
    return program.init, Signature(declared, ("params", "y", "t", "state"), tuple(inputs), tuple(outputs))


def step_of(part: str) -> str:
    """Name of the step in which only one part of a measurement was read.

    Args:
        part: Name of the part, as `Program.parts` has it.
    """
    return f"step_{re.sub(r'[^A-Za-z0-9_]', '_', part)}"


def _step(program: Program, name: str, step: Lowered, measured: int) -> tuple[Lowered, Signature]:
    state = [e for leaf in program.state for e in entries("state->", leaf)]
    u, y = ([f"{n}[{i}]" for i in range(k)] for n, k in (("u", program.u), ("y", measured)))
    after = [e for leaf in program.state for e in entries("next->", leaf)]
    lowered, info = _only_reported(program, step)
    slots = ["*result" if leaf.name == "result" else None for leaf in info]
    outputs = [*after]
    for leaf, result in zip(info, slots, strict=True):
        outputs += [result] if result else entries("next->", _last(leaf))
    declared = (
        f"const {name}_params *restrict params, const {name}_state *restrict state,\n"
        f"    const {name}_real *restrict u, const {name}_real *restrict y, {name}_real dt,\n"
        f"    {name}_state *restrict next, {name}_real *restrict result"
    )
    passed = ("params", "state", "u", "y", "dt", "next", "result")
    inputs = (*_numbers(program), *state, *u, *y, "dt")
    return lowered, Signature(declared, passed, inputs, tuple(outputs))


def _only_reported(program: Program, step: Lowered) -> tuple[Lowered, list[Leaf]]:
    """A step without the results that nothing reads."""
    wanted = [*program.reported, *(leaf for leaf in program.info if leaf.name == "result")]
    count = sum(leaf.size for leaf in program.state)
    places, at, chosen = list(range(count)), count, []
    for leaf in program.info:
        if leaf in wanted:
            places += range(at, at + leaf.size)
            chosen.append(leaf)
        at += leaf.size
    graph, outputs = step.graph.pruned([step.outputs[i] for i in places])
    return step._replace(graph=graph, outputs=tuple(outputs)), chosen


def _estimate(program: Program, name: str) -> tuple[Lowered, Signature]:
    state = [e for leaf in program.state for e in entries("state->", leaf)]
    outputs = [e for leaf in program.x for e in entries("output->", leaf)]
    declared = (
        f"const {name}_params *restrict params, const {name}_state *restrict state,\n    {name}_output *restrict output"
    )
    inputs = (*_numbers(program), *state)
    return program.estimate, Signature(declared, ("params", "state", "output"), inputs, tuple(outputs))


def _numbers(program: Program) -> list[str]:
    return [e for leaf in program.given for e in entries("params->", leaf)]


def _source(program: Program, name: str, about: str, functions: dict[str, CText]) -> str:
    used = frozenset().union(*(text.helpers for text in functions.values()))
    upper = name.upper()
    y = int(np.prod(program.y))
    size = {"double": 8, "float": 4}[program.real]
    copied = "".join(_copy(leaf, "output->", "state->") for leaf in program.told)
    unknown = "".join(_unknown(leaf, name) for leaf in program.reported)
    no_input = f"    const {name}_real none[{program.u}] = {{{number(0.0, program.real)}}};\n" if program.u else ""
    acting = "u != NULL ? u : none" if program.u else "u"
    parts = [
        f"/* {about}\n *\n * Written by covariant {_version()}. {SENTENCE}\n */",
        f'#include "{name}.h"\n\n#include <math.h>\n#include <stddef.h>\n',
        # -ffast-math lets a compiler assume that no number is NaN, and drop the tests for missing measurements.
        "#ifdef __FAST_MATH__\n#error missing measurements are NaN: compile this file without -ffast-math\n#endif\n",
        "/* Where double has four bytes, as on some microcontrollers, export the observer in float. */\n"
        f"typedef char {name}_size_of_real[sizeof({name}_real) == {size} ? 1 : -1];\n",
        f"const {name}_params {name}_default = {{\n{_defaults(program)}\n}};\n",
        c_helpers(used, program.real, f"{name}_"),
        *(text.text for text in functions.values()),
        f"int {name}_init({name}_state *state, const {name}_params *params, const {name}_real *y, {name}_real t)\n{{\n"
        f"    int i;\n"
        f"    for (i = 0; i < {program.parts[0][1] if program.sensors else f'{upper}_MEASUREMENTS'}; ++i) {{\n"
        # y − y is 0 for finite y and NaN for all others, without a function of <math.h>.
        f"        if (!(y[i] - y[i] == 0))\n            return {upper}_NOT_FINITE;\n    }}\n"
        f"    {name}_core_init(params, y, t, state);\n"
        f"{unknown}    return {upper}_OK;\n}}\n",
        f"int {name}_step({name}_state *state, const {name}_params *params, const {name}_real *u,\n"
        f"    const {name}_real *y, const unsigned char *missing, {name}_real dt)\n{{\n"
        f"{no_input}"
        f"    {name}_state next;\n    {name}_real seen[{y}], result;\n    int i;\n"
        f"    for (i = 0; i < {upper}_MEASUREMENTS; ++i)\n"
        f"        seen[i] = missing != NULL && missing[i] ? ({name}_real)NAN : y[i];\n"
        f"    {name}_core_step(params, state, {acting}, seen, dt, &next, &result);\n"
        f"    *state = next;\n    return (int)result;\n}}\n",
        *(
            f"int {name}_{step_of(part)}({name}_state *state, const {name}_params *params, const {name}_real *u,\n"
            f"    const {name}_real *y, {name}_real dt)\n{{\n"
            f"{no_input}"
            f"    {name}_state next;\n    {name}_real result;\n"
            f"    {name}_core_{step_of(part)}(params, state, {acting}, y, dt, &next, &result);\n"
            f"    *state = next;\n    return (int)result;\n}}\n"
            for part, _ in (program.parts if program.alone else ())
        ),
        f"void {name}_estimate(const {name}_state *state, const {name}_params *params, {name}_output *output)\n{{\n"
        f"    {name}_core_estimate(params, state, output);\n{copied}}}",
    ]
    return "\n".join(part for part in parts if part) + "\n"


def _defaults(program: Program) -> str:
    lines = []
    for key, value in program.numbers.items():
        digits = ", ".join(number(v, program.real) for v in np.ravel(value).tolist())
        lines.append(f"    {'{' + digits + '}' if np.ndim(value) else digits} /* {key} */")
    return ",\n".join(lines) or "    0"


def _copy(leaf: Leaf, into: str, out_of: str) -> str:
    pairs = zip(entries(into, leaf), entries(out_of, _last(leaf)), strict=True)
    return "".join(f"    {a} = {b};\n" for a, b in pairs)


def _unknown(leaf: Leaf, name: str) -> str:
    """Assignments of NaN to diagnostics, which are unknown before the first step."""
    return "".join(f"    {e} = ({name}_real)NAN;\n" for e in entries("state->", _last(leaf)))


def _version() -> str:
    try:
        return version("covariant")
    except PackageNotFoundError:
        return "from its source"
