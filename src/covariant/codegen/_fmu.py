"""Builds an observer as a functional mock-up unit (FMU) for co-simulation, in FMI 3.0 or 2.0.

A step from t to t + h uses the measurement at the time t, since simulators set inputs before a step, and corrects the
estimate at t. The outputs are the estimate predicted to t + h.

Source: Modelica Association 2022, Functional Mock-up Interface Specification 3.0, and 2.0.4 of the same year.
"""

import hashlib
import platform
import re
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal, NamedTuple
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np

from covariant.codegen._program import Program
from covariant.codegen._source import common_words, entries, write_source
from covariant.codegen._write import check_export
from covariant.signals import StepCode
from scalargraph import c_number
from scalargraph.compiler import NO_COMPILER, built, compiler_command
from scalargraph.files import write_atomically, zipped
from scalargraph.template import Words, fill, template

Version = Literal["3.0", "2.0"]
FLAGS = ("-std=c99", "-O2", "-fPIC", "-shared", "-fvisibility=hidden")
PLACES = {
    ("3.0", "Linux", "x86_64"): "x86_64-linux",
    ("3.0", "Linux", "aarch64"): "aarch64-linux",
    ("3.0", "Darwin", "x86_64"): "x86_64-darwin",
    ("3.0", "Darwin", "arm64"): "aarch64-darwin",
    ("2.0", "Linux", "x86_64"): "linux64",
    ("2.0", "Darwin", "x86_64"): "darwin64",
}
"""Folders of binaries, by version, system and machine."""

SPELLINGS = {
    "3.0": {"FMI": "fmi3", "STATE": "State", "DE": "Deserialize", "BYTE": "uint8_t"},
    "2.0": {"FMI": "fmi2", "STATE": "state", "DE": "DeSerialize", "BYTE": "char"},
}
"""Spelling of functions that exist in both versions, for each version."""
ABLE = ("canGetAndSet", "canSerialize")
OUTCOME = {
    "name": "outcome",
    "description": "; ".join(f"{int(result)} {result.name}: {result.message}" for result in StepCode),
    "causality": "output",
    "variability": "discrete",
}
DEVIATION_OF = {"velocity_std": "v", "state_std": "x"}
"""Name of the estimated array for each array of standard deviations."""
_TOKEN = "@TOKEN@"
"""Placeholder of the token, which is a hash of the texts that contain it."""


class UnitVariable(NamedTuple):
    """A variable of a unit.

    Attributes:
        name: Its name.
        causality: "input", "parameter" or "output".
        shape: Its shape.
        start: Its first values, row by row; empty for an output.
        about: A description; may be empty.
        units: The unit of each entry, or one for all; "" for an entry without a unit, and empty if units are not known.

    Example:
        >>> from covariant.codegen._fmu import UnitVariable
        >>> UnitVariable("y", "input", (3,), (0.0, 0.0, 0.0)).size
        3
    """

    name: str
    causality: str
    shape: tuple[int, ...]
    start: tuple[float, ...] = ()
    about: str = ""
    units: tuple[str, ...] = ()

    @property
    def size(self) -> int:
        """Number of entries."""
        return int(np.prod(self.shape, dtype=int))

    def unit(self, entry: int | None = None) -> str:
        """The unit of an entry, or the common unit of all entries, which is "" if they differ."""
        if entry is not None and len(self.units) == self.size:
            return self.units[entry]
        return self.units[0] if len(set(self.units)) == 1 and len(self.units) in (1, self.size) else ""


class Unit(NamedTuple):
    """The files of a functional mock-up unit (FMU).

    Attributes:
        files: Contents by their path in the unit.
        without_binary: Reason why there is no binary among them; "" if there is one.

    Example:
        >>> from covariant.codegen._fmu import Unit
        >>> Unit({"modelDescription.xml": b"<fmiModelDescription/>"}, "there is no C compiler").without_binary
        'there is no C compiler'
    """

    files: dict[str, bytes]
    without_binary: str


def fmu(program: Program, name: str, about: str, rate: float, y: np.ndarray, version: Version = "3.0") -> Unit:
    """Build an observer as a unit for co-simulation, whose inputs are the measurement `y` and the input `u`.

    Its parameters are the open numbers; they are tunable, and have the units of the model. The binary is compiled for
    this machine, by the compiler named in CC, by `cc`, or by the compiler of the package ziglang.

    Args:
        program: The observer as graphs.
        name: Prefix of all names in C, an identifier.
        about: A line that describes the observer, for comments and texts.
        rate: Rate [Hz] that the unit suggests; any other rate works too.
        y: Measurement from which it starts if the simulator sets none.
        version: Version of FMI. 3.0 has arrays; in 2.0 each entry is a separate variable, such as `y[1]`.

    Returns:
        The unit, without a binary if there is no compiler or FMI defines no folder for the machine.

    Raises:
        ValueError: The name is not an identifier of C.
        OSError: The compiler refuses the sources.

    Example:
        >>> import numpy as np
        >>> from covariant import codegen, observers
        >>> recipe = codegen.with_open_numbers(observers.FilteredDerivative(20.0))
        >>> program = codegen.program(recipe, np.zeros(1))
        >>> unit = codegen.fmu(program, "speed", "A filtered derivative.", 100.0, np.zeros(1), version="2.0")
        >>> [path for path in unit.files if not path.startswith("binaries")]
        ['sources/speed.h', 'sources/speed.c', 'sources/speed_fmu.c', 'modelDescription.xml']
    """
    # The characters */ would end a comment of C, and a line break would end the line.
    about = " ".join(about.replace("*/", "").split())
    source = write_source(program, name, about)
    variables = list(_variables(program, y))
    words = common_words(program, name, about) | {"TOKEN": _TOKEN}
    drafts = {
        f"sources/{name}.h": source.header,
        f"sources/{name}.c": source.source,
        f"sources/{name}_fmu.c": _unit_source(program, words, variables, version),
        "modelDescription.xml": _describe(name, about, rate, variables, version),
    }
    if version == "3.0":
        drafts["sources/buildDescription.xml"] = fill("covariant.codegen", "build.xml", words)
    # The token depends on the content, so that equal units are equal files, and description and binary fit together.
    identifier = uuid.uuid5(uuid.NAMESPACE_OID, hashlib.sha256("".join(drafts.values()).encode()).hexdigest())
    files = {path: text.replace(_TOKEN, f"{{{identifier}}}").encode() for path, text in drafts.items()}
    place = PLACES.get((version, platform.system(), platform.machine()))
    if place is None:
        return Unit(files, f"FMI {version} names no binary of {platform.system()} on {platform.machine()}")
    command = compiler_command()
    if command is None:
        return Unit(files, NO_COMPILER)
    suffix = "dylib" if platform.system() == "Darwin" else "so"
    return Unit(files | {f"binaries/{place}/{name}.{suffix}": built(command, FLAGS, files, "the unit")}, "")


def write_fmu(unit: Unit, path: Path, overwrite: bool = False) -> None:
    """Write a unit as one file, whole or not at all.

    Pass it the unit of `fmu`. The file runs only on the operating system and processor for which its binary was
    compiled. `covariant.export` builds and writes it in one call.

    Args:
        unit: The unit.
        path: Path of the file, which ends in .fmu.
        overwrite: Whether an existing file is replaced. By default it is refused.

    Raises:
        ValueError: There is such a file or folder already, or no parent folder.

    Example:
        >>> import zipfile
        >>> from pathlib import Path
        >>> from covariant.codegen import write_fmu
        >>> from covariant.codegen._fmu import Unit
        >>> write_fmu(Unit({"modelDescription.xml": b"<fmiModelDescription/>"}, ""), Path("speed.fmu"))
        >>> zipfile.ZipFile("speed.fmu").namelist()
        ['modelDescription.xml']
    """
    check_export(path, overwrite)
    write_atomically(path, lambda file: file.write(zipped(unit.files)))


def _variables(program: Program, y: np.ndarray) -> Iterator[UnitVariable]:
    """The variables in the order of their numbers in C."""
    beside = "".join(f", then {count} of {name}" for name, count in program.sensors)
    about = f"measured configuration{beside}{_signal_list(program, 'y')}; NaN where missing"
    units = program.signals.units
    yield UnitVariable("y", "input", program.y, tuple(np.ravel(y).tolist()), about, units("y"))
    if program.u:
        about = f"input of the model{_signal_list(program, 'u')}, held over a step"
        yield UnitVariable("u", "input", (program.u,), (0.0,) * program.u, about, units("u"))
    for key, value in program.numbers.items():
        unit = program.units.get(key, "1")
        # A unit such as "kg, kg m^2" belongs to numbers of several kinds.
        known = () if unit == "1" or "," in unit else (unit,)
        start = tuple(np.ravel(value).tolist())
        yield UnitVariable(f"parameters.{key}", "parameter", np.shape(value), start, "", known)
    for leaf in (*program.x, *program.told):
        of = DEVIATION_OF.get(leaf.name, leaf.name)
        about = program.signals.of(of)
        if about and of != leaf.name:
            about = f"standard deviations of {about}"
        if leaf.size:
            yield UnitVariable(leaf.name, "output", leaf.shape, about=about, units=units(of))


def _signal_list(program: Program, array: str) -> str:
    names = program.signals.of(array)
    return f": {names}" if names else ""


def _unit_source(program: Program, words: Words, variables: Sequence[UnitVariable], version: Version) -> str:
    """The C source of a unit, in addition to the source of the observer."""
    parameters = [e for leaf in program.parameters for e in entries("params->", leaf)]
    shown = [e for leaf in program.output for e in entries("output->", leaf)]
    inputs = program.measurements + program.u
    outputs = inputs + len(parameters)
    starts = [value for variable in variables for value in variable.start]
    sizes = [variable.size for variable in variables]
    reads = [f"    {e} = ({words['NAME']}_real)m->numbers[{i}];" for i, e in enumerate(parameters, inputs)]
    words = words | {
        "INPUTS": inputs,
        "OUTPUTS": outputs,
        "NUMBERS": outputs + len(shown),
        "VARIABLES": len(sizes),
        "FIRSTS": ", ".join(map(str, np.cumsum([0, *sizes])[:-1].tolist())),
        "SIZES": ", ".join(map(str, sizes)),
        # Without parameters the structure has one unused member, since C demands a member, and m is not read.
        "TAKEN": reads or ["    (void)m;", "    params->unused = 0;"],
        "SHOWN": [f"    m->numbers[{i}] = (double){e};" for i, e in enumerate(shown, outputs)],
        # `forget` sets all numbers to zero first.
        "START": [f"    m->numbers[{i}] = {c_number(v)};" for i, v in enumerate(starts) if v != 0],
        **SPELLINGS[version],
    }
    kind = f"fmi{version[0]}"
    declarations = template("covariant.codegen", f"{kind}_refused.h")
    refused = re.findall(r"^(void \*|int )(\w+)\(([^)]*)\);$", declarations, re.MULTILINE)
    texts = [fill("covariant.codegen", "fmu.c", words), fill("covariant.codegen", f"{kind}.c", words)]
    return "".join(texts) + "\n".join(_refusing_function(*declared) for declared in refused)


def _refusing_function(kind: str, name: str, declared: str) -> str:
    """A function that this unit does not support: it returns an error, or no error if no values are requested."""
    types = [text.strip() for text in declared.split(",")]
    arguments = ", ".join(f"{text} a{i}".replace("* ", "*") for i, text in enumerate(types))
    ignored = "".join(f"    (void)a{i};\n" for i in range(len(types)))
    # A call that requests no values, n = 0, has nothing to refuse.
    asked = f"a{types.index('size_t')} == 0 ? OK : ERROR" if "size_t" in types else "ERROR"
    result = "NULL" if kind == "void *" else asked
    return f"EXPORT {kind}{name}({arguments})\n{{\n{ignored}    return {result};\n}}\n"


def _describe(name: str, about: str, rate: float, variables: list[UnitVariable], version: Version) -> str:
    """The description of the model as XML."""
    arrays = version == "3.0"
    root = Element("fmiModelDescription", fmiVersion=version, modelName=name)
    root.attrib |= {"instantiationToken" if arrays else "guid": _TOKEN, "description": about}
    root.attrib |= {"generationTool": "covariant", "variableNamingConvention": "structured"}
    abilities = ("canHandleVariableCommunicationStepSize", *(f"{can}FMU{SPELLINGS[version]['STATE']}" for can in ABLE))
    unit = SubElement(root, "CoSimulation", {"modelIdentifier": name} | dict.fromkeys(abilities, "true"))
    if not arrays:
        sources = SubElement(unit, "SourceFiles")
        for file in (f"{name}.c", f"{name}_fmu.c"):
            SubElement(sources, "File", name=file)
    stated = ["s", *(v.unit() for v in variables)] if arrays else [v.unit(k) for v in variables for k in range(v.size)]
    units = dict.fromkeys(text for text in stated if text)
    defined = SubElement(root, "UnitDefinitions") if units else root
    for text in units:
        SubElement(defined, "Unit", name=text)
    SubElement(root, "DefaultExperiment", startTime="0", stepSize=repr(1 / rate))
    (_add_arrays if arrays else _add_scalars)(root, variables)
    indent(root)
    return tostring(root, encoding="UTF-8", xml_declaration=True).decode() + "\n"


def _attributes(v: UnitVariable, name: str, reference: int) -> dict[str, str]:
    about = {"description": v.about} if v.about else {}
    variability = "tunable" if v.causality == "parameter" else "continuous"
    return {
        "name": name,
        "valueReference": str(reference),
        **about,
        "causality": v.causality,
        "variability": variability,
    }


def _start(v: UnitVariable, unit: str, values: Sequence[float]) -> dict[str, str]:
    """Unit and first values, in the spelling of xs:double in XML Schema."""
    return ({"unit": unit} if unit else {}) | (
        {"start": " ".join("NaN" if np.isnan(x) else repr(float(x)) for x in values)} if v.start else {}
    )


def _add_arrays(root: Element, variables: Sequence[UnitVariable]) -> None:
    """Add the variables of FMI 3.0. References 0 and 1 are time and outcome, as in `fmi3.c`."""
    listed, structure = SubElement(root, "ModelVariables"), SubElement(root, "ModelStructure")
    time = {"name": "time", "valueReference": "0", "causality": "independent", "variability": "continuous"}
    SubElement(listed, "Float64", time | {"unit": "s"})
    SubElement(listed, "Int32", OUTCOME, valueReference="1")
    for reference, v in enumerate(variables, start=2):
        variable = SubElement(listed, "Float64", _attributes(v, v.name, reference) | _start(v, v.unit(), v.start))
        for side in v.shape:
            SubElement(variable, "Dimension", start=str(side))
    outputs = [1, *(k for k, v in enumerate(variables, start=2) if v.causality == "output")]
    for tag in ("Output", "InitialUnknown"):
        for k in outputs:
            SubElement(structure, tag, valueReference=str(k))


def _add_scalars(root: Element, variables: Sequence[UnitVariable]) -> None:
    """Add the variables of FMI 2.0, one for each entry."""
    listed, structure = SubElement(root, "ModelVariables"), SubElement(root, "ModelStructure")
    entries_of = [(v, k) for v in variables for k in range(v.size)]
    for reference, (v, k) in enumerate(entries_of):
        # FMI's structured names count from one.
        place = f"[{','.join(str(i + 1) for i in np.unravel_index(k, v.shape))}]" if v.shape else ""
        variable = SubElement(listed, "ScalarVariable", _attributes(v, f"{v.name}{place}", reference))
        SubElement(variable, "Real", _start(v, v.unit(k), v.start[k : k + 1]))
    SubElement(SubElement(listed, "ScalarVariable", OUTCOME, valueReference="0"), "Integer")
    # An output is referenced by its place in the list, counted from one.
    outputs = [k for k, (v, _) in enumerate(entries_of, start=1) if v.causality == "output"]
    for tag in ("Outputs", "InitialUnknowns"):
        unknowns = SubElement(structure, tag)
        for k in [*outputs, len(entries_of) + 1]:
            SubElement(unknowns, "Unknown", index=str(k))
