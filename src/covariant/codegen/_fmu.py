"""An observer as a functional mock-up unit (FMU) for co-simulation, in FMI 3.0 or 2.0: description, sources, binary.

The measurement that a step from t to t + h gets is of the time t, as simulators set inputs: it corrects the estimate
there. The outputs are the estimate predicted to t + h.

Source: Modelica Association 2022, Functional Mock-up Interface Specification 3.0, and 2.0.4 of the same year.
"""

import hashlib
import platform
import subprocess
import tempfile
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np

from covariant._compile import NO_COMPILER, compiler_command
from covariant._files import write_atomically, zipped
from covariant.codegen._fmu_c import unit_source
from covariant.codegen._program import Program
from covariant.codegen._source import write_source
from covariant.signals import Result

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

OUTCOMES = "; ".join(f"{int(result)} {result.name}: {result.message}" for result in Result)


class UnitVariable(NamedTuple):
    """A variable of a unit.

    Attributes:
        name: Its name.
        causality: "input", "parameter" or "output".
        shape: Its shape.
        start: Its first values, row by row; empty for an output.
        about: A description; may be empty.
        unit: Its unit; empty where it has none, or where it is not known.

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
    unit: str = ""

    @property
    def size(self) -> int:
        """Number of entries."""
        return int(np.prod(self.shape, dtype=int))


class Unit(NamedTuple):
    """The files of a functional mock-up unit (FMU).

    Attributes:
        files: Contents by their path in the unit.
        without_binary: Why there is no binary among them; "" where there is one.

    Example:
        >>> from covariant.codegen import Unit
        >>> Unit({"modelDescription.xml": b"<fmiModelDescription/>"}, "there is no C compiler").without_binary
        'there is no C compiler'
    """

    files: dict[str, bytes]
    without_binary: str


def fmu(program: Program, name: str, about: str, rate: float, y: np.ndarray, version: Version = "3.0") -> Unit:
    """An observer as a unit for co-simulation, whose inputs are the measurement `y` and the input `u`.

    Its parameters, the open numbers, are tunable, and have the units of the model. The binary is compiled for the
    machine at hand, by the compiler that CC names, `cc`, or that of the package ziglang.

    Args:
        program: The observer as graphs.
        name: Prefix of all names in C, an identifier.
        about: A line that says what the observer is, for comments and texts.
        rate: Rate [Hz] that the unit suggests; any other will do.
        y: Measurement from which it starts where the simulator sets none.
        version: Version of FMI. 3.0 has arrays; in 2.0 each entry is a separate variable, such as `y[1]`.

    Returns:
        The unit, without a binary where no compiler is there or FMI names no folder for the machine.

    Raises:
        ValueError: The name is no identifier of C.
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
    # A comment of C ends at */, and one line must stay one.
    about = " ".join(about.replace("*/", "").split())
    source = write_source(program, name, about)
    variables = list(_variables(program, y))
    sizes, starts = [v.size for v in variables], [value for v in variables for value in v.start]
    token = "@TOKEN@"
    drafts = {
        f"sources/{name}.h": source.header,
        f"sources/{name}.c": source.source,
        f"sources/{name}_fmu.c": unit_source(program, name, version, token, sizes, starts),
        "modelDescription.xml": _describe(name, about, rate, variables, version, token),
    }
    if version == "3.0":
        drafts["sources/buildDescription.xml"] = _BUILD.replace("@NAME@", name)
    # A token by content, not at random: equal units are equal files, and description and binary fit together.
    identifier = uuid.uuid5(uuid.NAMESPACE_OID, hashlib.sha256("".join(drafts.values()).encode()).hexdigest())
    files = {path: text.replace(token, f"{{{identifier}}}").encode() for path, text in drafts.items()}
    place = PLACES.get((version, platform.system(), platform.machine()))
    if place is None:
        return Unit(files, f"FMI {version} names no binary of {platform.system()} on {platform.machine()}")
    command = compiler_command()
    if command is None:
        return Unit(files, NO_COMPILER)
    suffix = "dylib" if platform.system() == "Darwin" else "so"
    return Unit(files | {f"binaries/{place}/{name}.{suffix}": _compiled(command, files, name)}, "")


def write_fmu(unit: Unit, path: Path, overwrite: bool = False) -> None:
    """Write a unit as one file, whole or not at all.

    Args:
        unit: The unit.
        path: Path of the file, which ends in .fmu.
        overwrite: Replace a file that is there. By default it is refused.

    Raises:
        ValueError: There is such a file or folder already, or no parent folder.

    Example:
        >>> import zipfile
        >>> from pathlib import Path
        >>> from covariant.codegen import Unit, write_fmu
        >>> write_fmu(Unit({"modelDescription.xml": b"<fmiModelDescription/>"}, ""), Path("speed.fmu"))
        >>> zipfile.ZipFile("speed.fmu").namelist()
        ['modelDescription.xml']
    """
    if path.is_dir() or (path.exists() and not overwrite):
        raise ValueError(f"{path}: there is one already; name a new one, or replace a file by `overwrite=True`")
    if not path.resolve().parent.is_dir():
        raise ValueError(f"{path}: there is no folder {path.resolve().parent}; make it first")
    write_atomically(path, lambda file: file.write(zipped(unit.files)))


def _compiled(command: Sequence[str], files: dict[str, bytes], name: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        for path, content in files.items():
            (Path(folder) / path).parent.mkdir(exist_ok=True)
            (Path(folder) / path).write_bytes(content)
        sources = [f"sources/{name}.c", f"sources/{name}_fmu.c"]
        words = [*command, *FLAGS, *sources, "-lm", "-o", "made"]
        run = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
        if run.returncode:
            raise OSError(f"{' '.join(command)} does not compile the unit: {run.stderr.strip()[:200]}")
        return (Path(folder) / "made").read_bytes()


def _variables(program: Program, y: np.ndarray) -> Iterator[UnitVariable]:
    """The variables in the order of their numbers in C."""
    beside = "".join(f", then {count} of {name}" for name, count in program.sensors)
    about = f"measured configuration{beside}{_listed(program, 'y')}; NaN where missing"
    yield UnitVariable("y", "input", program.y, tuple(np.ravel(y).tolist()), about)
    if program.u:
        about = f"input of the model{_listed(program, 'u')}, held over a step"
        yield UnitVariable("u", "input", (program.u,), (0.0,) * program.u, about)
    for key, value in program.numbers.items():
        unit = program.units.get(key, "1")
        first = tuple(np.ravel(value).tolist())
        yield UnitVariable(f"parameters.{key}", "parameter", np.shape(value), first, unit="" if unit == "1" else unit)
    for leaf in (*program.x, *program.told):
        if leaf.size:
            yield UnitVariable(leaf.name, "output", leaf.shape, about=program.signals.of(leaf.name))


def _listed(program: Program, array: str) -> str:
    names = program.signals.of(array)
    return f": {names}" if names else ""


def _describe(name: str, about: str, rate: float, variables: list[UnitVariable], version: Version, token: str) -> str:
    """The description of the model as XML."""
    body = _variables_3(variables) if version == "3.0" else _variables_2(variables)
    token_name = "instantiationToken" if version == "3.0" else "guid"
    state = "FMUState" if version == "3.0" else "FMUstate"
    files = ""
    if version == "2.0":
        listed = "".join(f'<File name="{file}"/>' for file in (f"{name}.c", f"{name}_fmu.c"))
        files = f"<SourceFiles>{listed}</SourceFiles>"
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<fmiModelDescription fmiVersion="{version}" modelName="{name}" {token_name}="{token}"'
        f' description={quoteattr(about)} generationTool="covariant" variableNamingConvention="structured">\n'
        f'  <CoSimulation modelIdentifier="{name}" canHandleVariableCommunicationStepSize="true"'
        f' canGetAndSet{state}="true" canSerialize{state}="true"{f">{files}</CoSimulation>" if files else "/>"}\n'
        f"{_units(variables)}"
        f'  <DefaultExperiment startTime="0" stepSize="{1 / rate!r}"/>\n'
        f"{body}</fmiModelDescription>\n"
    )


def _units(variables: list[UnitVariable]) -> str:
    """The definitions of the units that variables have."""
    names = dict.fromkeys(v.unit for v in variables if v.unit)
    listed = "".join(f"    <Unit name={quoteattr(name)}/>\n" for name in names)
    return f"  <UnitDefinitions>\n{listed}  </UnitDefinitions>\n" if names else ""


def _variability(variable: UnitVariable) -> str:
    return "tunable" if variable.causality == "parameter" else "continuous"


def _start_text(value: float) -> str:
    # The spelling of xs:double in XML Schema.
    return "NaN" if np.isnan(value) else repr(float(value))


def _variables_3(variables: list[UnitVariable]) -> str:
    # References 0 and 1 are those of time and outcome, as `_fmi3` has them.
    lines = ['    <Float64 name="time" valueReference="0" causality="independent" variability="continuous"/>']
    lines.append(
        f'    <Int32 name="outcome" valueReference="1" description={quoteattr(OUTCOMES)} causality="output"'
        ' variability="discrete"/>'
    )
    for reference, v in enumerate(variables, start=2):
        sides = "".join(f'<Dimension start="{side}"/>' for side in v.shape)
        start = f' start="{" ".join(map(_start_text, v.start))}"' if v.start else ""
        about = f" description={quoteattr(v.about)}" if v.about else ""
        about += f" unit={quoteattr(v.unit)}" if v.unit else ""
        head = f'    <Float64 name="{v.name}" valueReference="{reference}"{about} causality="{v.causality}"'
        lines.append(f'{head} variability="{_variability(v)}"{start}' + (f">{sides}</Float64>" if sides else "/>"))
    outputs = [1, *(k for k, v in enumerate(variables, start=2) if v.causality == "output")]
    ends = [f'    <{tag} valueReference="{k}"/>' for tag in ("Output", "InitialUnknown") for k in outputs]
    return "\n".join(
        ["  <ModelVariables>", *lines, "  </ModelVariables>", "  <ModelStructure>", *ends, "  </ModelStructure>", ""]
    )


def _variables_2(variables: list[UnitVariable]) -> str:
    lines, outputs, reference = [], [], 0
    for v in variables:
        for k in range(v.size):
            # FMI's structured names count from one.
            place = f"[{','.join(str(i + 1) for i in np.unravel_index(k, v.shape))}]" if v.shape else ""
            start = f' start="{_start_text(v.start[k])}"' if v.start else ""
            start += f" unit={quoteattr(v.unit)}" if v.unit else ""
            about = f" description={quoteattr(v.about)}" if v.about else ""
            lines.append(
                f'    <ScalarVariable name="{v.name}{place}" valueReference="{reference}"{about}'
                f' causality="{v.causality}" variability="{_variability(v)}"><Real{start}/></ScalarVariable>'
            )
            reference += 1
            if v.causality == "output":
                # FMI 2.0 counts variables from one, so the index is the length so far.
                outputs.append(len(lines))
    lines.append(
        f'    <ScalarVariable name="outcome" valueReference="0" description={quoteattr(OUTCOMES)} causality="output"'
        ' variability="discrete"><Integer/></ScalarVariable>'
    )
    outputs.append(len(lines))
    unknowns = "".join(f'<Unknown index="{k}"/>' for k in outputs)
    return "\n".join(
        [
            *("  <ModelVariables>", *lines, "  </ModelVariables>", "  <ModelStructure>"),
            f"    <Outputs>{unknowns}</Outputs>",
            f"    <InitialUnknowns>{unknowns}</InitialUnknowns>",
            *("  </ModelStructure>", ""),
        ]
    )


_BUILD = """<?xml version="1.0" encoding="UTF-8"?>
<fmiBuildDescription fmiVersion="3.0">
  <BuildConfiguration modelIdentifier="@NAME@">
    <SourceFileSet language="C99">
      <SourceFile name="@NAME@.c"/>
      <SourceFile name="@NAME@_fmu.c"/>
    </SourceFileSet>
  </BuildConfiguration>
</fmiBuildDescription>
"""
