"""Writes the C header and the C source of an exported observer.

All names begin with the name of the export. The code allocates no memory and has no global variables except constants.
A state is a plain structure, so that a copy of it is a snapshot, and every function uses only its arguments.
"""

import re
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import NamedTuple

import numpy as np

from covariant.codegen._names import check_export_name
from covariant.codegen._program import Member, Program, part_text
from covariant.signals import StepCode
from scalargraph import C_KEYWORDS, C_MACROS, CText, Lowered, Signature, c_function, c_helpers, c_number
from scalargraph.errors import InputError
from scalargraph.template import Words, fill

RESERVED = C_KEYWORDS | C_MACROS | {"info"}
"""Words that cannot name a number in C; `info` is the name of the diagnostics of a step."""
SENTENCE = "This text is yours: use, change and sell it as you like; no licence of its generator extends to it."


class Source(NamedTuple):
    """The C of an observer.

    Attributes:
        name: Prefix of all names.
        header: Text of the header.
        source: Text of the source.
        functions: The functions "init", "step" and "estimate", with the operations of a call of each.

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


def write_source(program: Program, name: str, about: str) -> Source:
    """Generate the header and the source of an observer, in C99.

    Use it to add the C to a build of your own. It allocates no memory and has no global variables.
    `covariant.export` also adds a self-test and a data sheet, so begin with that.

    Args:
        program: The observer as graphs.
        name: Prefix of all names in C, an identifier.
        about: A line that describes the observer, for comments and texts.

    Raises:
        ValueError: The name is not an identifier of C, or is reserved in C, C++, JavaScript or Python or by the
            system.

    Example:
        >>> import numpy as np
        >>> from covariant import codegen, observers
        >>> recipe = codegen.with_open_numbers(observers.FilteredDerivative(20.0))
        >>> program = codegen.program(recipe, np.zeros(1))
        >>> codegen.write_source(program, "double", "A filtered derivative.")
        Traceback (most recent call last):
        scalargraph.errors.InputError: 'double' is a keyword of C or C++; take another name, such as 'my_double'
    """
    check_export_name(name)
    core = {"init": _init(program, name), "step": _step(program, name, program.step, program.measurements)}
    for part, count in program.parts if program.alone else ():
        if step_of(part) in core:
            raise InputError(f"the steps by sensor need names that differ in C; {step_of(part)} is there twice")
        core[step_of(part)] = _step(program, name, dict(program.alone)[part], count)
    core["estimate"] = _estimate(program, name)
    functions = {
        key: c_function(graph, f"{name}_core_{key}", signature, program.real, f"{name}_", static=True)
        for key, (graph, signature) in core.items()
    }
    words = common_words(program, name, about)
    return Source(name, _header(program, words), _source(program, words, functions), functions)


def entries(owner: str, leaf: Member) -> list[str]:
    """The C expressions of the entries of an array of a structure."""
    return [f"{owner}{field(leaf)}[{i}]" for i in range(leaf.size)] if leaf.shape else [f"{owner}{field(leaf)}"]


def field(leaf: Member) -> str:
    """The name of an array in C, with an underscore if it is a keyword or a macro."""
    return f"{leaf.name}_" if leaf.name in RESERVED else leaf.name


def common_words(program: Program, name: str, about: str) -> Words:
    """Texts that are common to the templates of several languages."""
    return {
        "NAME": name,
        "UPPER": name.upper(),
        "ABOUT": about,
        "VERSION": _version(),
        "SENTENCE": SENTENCE,
        "REAL": program.real,
        "MEASUREMENTS": program.measurements,
        "INPUTS": program.u,
        "WITH_U": ", u" if program.u else "",
        "AT_END": int(program.input_at_end),
        "SENT": "the input at the stamp of y" if program.input_at_end else "the input since then",
        "U_SENT": "u is that of now" if program.input_at_end else "u acted since the last call",
    }


def _header(program: Program, words: Words) -> str:
    upper, real = words["UPPER"], f"{words['NAME']}_real"

    def members(leaves: Sequence[Member]) -> list[str]:
        lines = [f"    {real} {field(leaf)}{f'[{leaf.size}]' if leaf.shape else ''};" for leaf in leaves if leaf.size]
        return lines or [f"    {real} unused;"]  # a structure without members is no C

    order = [f" * {line}" for line in program.signals.lines]
    title = "/* Numbers in their order, in these units, whatever those of a log:"
    rows = f"numbers of a measurement, {' x '.join(map(str, program.y))} by rows"
    last = max(StepCode)
    own = {
        "SIGNALS": [title, *order, " */"] if order else [],
        "MEASURED": f"numbers of a measurement: {program.parts_text}" if program.sensors else rows,
        "STARTED": "the configuration in y" if program.sensors else "y",
        "CODES": [f"    {upper}_{r.name} = {int(r)}{'' if r is last else ','} /* {r.message} */" for r in StepCode],
        "PARAMS": members(program.parameters),
        "STATE": members(program.stored),
        "OUTPUT": members(program.output),
        "PART_STEPS": _part_steps(program, words, "part_step.h"),
    }
    return fill("covariant.codegen", "observer.h", words | own)


def _part_steps(program: Program, words: Words, file: str) -> list[str]:
    """Declarations or definitions of steps in which only one part of a measurement was read."""
    return [
        fill("covariant.codegen", file, words | {"STEP": step_of(part), "COUNT": count, "PART": part_text(part)})
        for part, count in (program.parts if program.alone else ())
    ]


def _init(program: Program, name: str) -> tuple[Lowered, Signature]:
    inputs = [*_numbers(program), *(f"y[{i}]" for i in range(program.measurements)), "t"]
    outputs = [e for leaf in program.state for e in entries("state->", leaf)]
    declared = (
        f"const {name}_params *restrict params, const {name}_real *restrict y, {name}_real t,\n"
        f"    {name}_state *restrict state"
    )
    return program.init, Signature(declared, ("params", "y", "t", "state"), tuple(inputs), tuple(outputs))


def step_of(part: str) -> str:
    """Name of a step in which only one part of a measurement was read."""
    return f"step_{re.sub(r'[^A-Za-z0-9_]', '_', part)}"


def _step(program: Program, name: str, step: Lowered, measured: int) -> tuple[Lowered, Signature]:
    state = [e for leaf in program.state for e in entries("state->", leaf)]
    u, y = ([f"{n}[{i}]" for i in range(k)] for n, k in (("u", program.u), ("y", measured)))
    after = [e for leaf in program.state for e in entries("next->", leaf)]
    lowered, info = _drop_unread_results(program, step)
    slots = ["*result" if leaf.name == "result" else None for leaf in info]
    outputs = [*after]
    for leaf, result in zip(info, slots, strict=True):
        outputs += [result] if result else entries("next->", leaf.last)
    declared = (
        f"const {name}_params *restrict params, const {name}_state *restrict state,\n"
        f"    const {name}_real *restrict u, const {name}_real *restrict y, {name}_real dt,\n"
        f"    {name}_state *restrict next, {name}_real *restrict result"
    )
    passed = ("params", "state", "u", "y", "dt", "next", "result")
    inputs = (*_numbers(program), *state, *u, *y, "dt")
    return lowered, Signature(declared, passed, inputs, tuple(outputs))


def _drop_unread_results(program: Program, step: Lowered) -> tuple[Lowered, list[Member]]:
    """A step without the results that are never read."""
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


def _source(program: Program, words: Words, functions: dict[str, CText]) -> str:
    name, real = f"{words['NAME']}_", program.real
    helpers = c_helpers(frozenset().union(*(text.helpers for text in functions.values())), real, name)
    told = [zip(entries("output->", leaf), entries("state->", leaf.last), strict=True) for leaf in program.told]
    inputs = {
        "NO_INPUT": [f"    const {name}real none[{program.u}] = {{{c_number(0.0, real)}}};"] if program.u else [],
        "ACTING": "u != NULL ? u : none" if program.u else "u",
    }
    own = {
        "SIZE": {"double": 8, "float": 4}[real],
        "DEFAULTS": [_defaults(program)],
        "HELPERS": [helpers] if helpers else [],
        "FUNCTIONS": [text.text for text in functions.values()],
        "NEEDED": len(program.largest),
        "LARGEST": ", ".join(c_number(bound, real) for bound in program.largest),
        "ESTIMATED": sum(leaf.size for leaf in program.x),
        # Diagnostics are unknown before the first step.
        "UNKNOWN": [f"    {e} = ({name}real)NAN;" for leaf in program.reported for e in entries("state->", leaf.last)],
        "COPIED": [f"    {output} = {state};" for pairs in told for output, state in pairs],
        "PART_STEPS": _part_steps(program, words | inputs, "part_step.c"),
    }
    # In the template, y - y is 0 for finite y and NaN for all others, without a function of <math.h>. The template
    # refuses -ffast-math and -ffinite-math-only: with them compilers assume that no number is NaN, and drop the tests
    # for missing measurements. If a compiler does not define a macro for these options, the self-test detects them. C90
    # is refused, since functions of <math.h> that are not declared would return an int there. C++ has no `restrict`,
    # which only permits faster code.
    return fill("covariant.codegen", "observer.c", words | inputs | own)


def _defaults(program: Program) -> str:
    lines = []
    for key, value in program.numbers.items():
        digits = ", ".join(c_number(v, program.real) for v in np.ravel(value).tolist())
        lines.append(f"    {'{' + digits + '}' if np.ndim(value) else digits} /* {key} */")
    return ",\n".join(lines) or "    0"


def _version() -> str:
    try:
        return version("covariant")
    except PackageNotFoundError:
        return "from its source"
