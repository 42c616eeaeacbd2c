"""Packs an exported observer as a Python package that needs only NumPy: compiled C, loaded by ctypes, and a wheel.

Sources: PEP 427 and PEP 425, wheels and the tags in their names.
"""

import base64
import hashlib
import keyword
import math
import platform
import sysconfig
from collections.abc import Mapping, Sequence

import numpy as np

from covariant.codegen._names import check_export_name
from covariant.codegen._program import DTYPES, Member, Program
from covariant.codegen._source import common_words
from covariant.signals import StepCode
from scalargraph.compiler import built, compiler_command
from scalargraph.files import zipped
from scalargraph.template import Words, fill

FLAGS = ("-std=c99", "-O2", "-fno-math-errno", "-ffp-contract=off", "-fPIC", "-shared")
"""Flags of the compiler, for all processors of a kind: except for `<math.h>`, results are the same on all of them."""
SUFFIXES = {"Darwin": ".dylib", "Windows": ".dll"}
"""Ending of the name of a library, by system; `.so` on all others."""
LEAST_PYTHON = "3.9"


def python_files(program: Program, texts: Mapping[str, str], name: str, about: str, rate: float) -> dict[str, bytes]:
    """Build a Python package of an exported observer, compiled for this machine, and a wheel of it.

    Args:
        program: The observer as graphs.
        texts: Its header and source, as `export_texts` writes them.
        name: Prefix of all names in C, and name of the package.
        about: A line that describes the observer.
        rate: Sampling rate [Hz] for which it was made.

    Returns:
        Contents by their path in the folder of the export. Without a C compiler there is neither a library nor a wheel;
        the package then builds its library on a machine that has a compiler.

    Raises:
        ValueError: The name belongs to a module of Python, or is not allowed for an export.
        OSError: The compiler refuses the sources.

    Example:
        >>> import numpy as np
        >>> from covariant import codegen, observers
        >>> recipe = codegen.with_open_numbers(observers.FilteredDerivative(20.0))
        >>> program = codegen.program(recipe, np.zeros(1))
        >>> source = codegen.write_source(program, "speed", "A filtered derivative.")
        >>> texts = {"speed.h": source.header, "speed.c": source.source}
        >>> list(codegen.python_files(program, texts, "speed", "A filtered derivative.", 100.0))[:2]
        ['python/speed/__init__.py', 'python/speed/__main__.py']
    """
    check_export_name(name, python=True)
    token = hashlib.sha256("".join([texts[f"{name}.h"], texts[f"{name}.c"], about, repr(rate)]).encode()).hexdigest()
    version = f"1.0.0+x{token[:8]}"  # another export is another version, so that installing it replaces the former
    words = common_words(program, name, about) | _words(program, about, rate, token[:32], version)
    package = {
        "__init__.py": fill("covariant.codegen", "module.py", words).encode(),
        "__main__.py": fill("covariant.codegen", "__main__.py", words).encode(),
        f"{name}.h": texts[f"{name}.h"].encode(),
        f"{name}.c": texts[f"{name}.c"].encode(),
        f"{name}_rows.c": fill("covariant.codegen", "rows.c", words).encode(),
    }
    command = compiler_command()
    wheel: dict[str, bytes] = {}
    if command is not None:
        library = f"lib{name}{SUFFIXES.get(platform.system(), '.so')}"
        package[library] = built(command, FLAGS, package, "the package")
        tag = f"py3-none-{_platform()}"
        wheel[f"python/{name}-{version}-{tag}.whl"] = _wheel(package, name, about, version, tag)
    return {f"python/{name}/{path}": content for path, content in package.items()} | wheel


def _platform() -> str:
    """The tag of this machine; its compiler makes code for one architecture."""
    tag = sysconfig.get_platform().replace("universal2", platform.machine())
    return tag.replace("-", "_").replace(".", "_")


def _wheel(package: Mapping[str, bytes], name: str, about: str, version: str, tag: str) -> bytes:
    place = f"{name}-{version}.dist-info"
    metadata = (
        f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\nSummary: {about[:500]}\n"
        f"Requires-Python: >={LEAST_PYTHON}\nRequires-Dist: numpy\n"
    )
    kind = f"Wheel-Version: 1.0\nGenerator: covariant\nRoot-Is-Purelib: false\nTag: {tag}\n"
    files = {f"{name}/{path}": content for path, content in package.items()}
    files |= {f"{place}/METADATA": metadata.encode(), f"{place}/WHEEL": kind.encode()}
    digests = {path: base64.urlsafe_b64encode(hashlib.sha256(c).digest()).rstrip(b"=") for path, c in files.items()}
    lines = [f"{path},sha256={digests[path].decode()},{len(content)}" for path, content in files.items()]
    record = "\n".join([*lines, f"{place}/RECORD,,"]) + "\n"
    return zipped(files | {f"{place}/RECORD": record.encode()})


def _words(program: Program, about: str, rate: float, token: str, version: str) -> Words:
    lines = [f"    {line}" for line in program.signals.lines]
    title = "Numbers in their order, in these units, whatever those of a log:"
    # Some standard deviations are both in the estimate and in the report of a step; a run contains them once.
    columns = {leaf.name: leaf for leaf in [*program.output, *program.reported]}
    return {
        # It goes into a docstring between three quotes.
        "ABOUT": about.replace("\\", "/").replace('"', "'"),
        "TOKEN": token,
        "VERSION": version,
        "FIRST": _field(program.x[-1]),
        "RATE": repr(float(rate)),
        "DTYPE": np.dtype(DTYPES[program.real]).name,
        "MEASUREMENT": repr(program.y),
        "SENSORS": f": {program.parts_text}" if program.sensors else "",
        "SIGNALS": "\n".join([title, "", *lines, "", ""]) if lines else "",
        "STARTS": program.parts[0][1],
        "FLAGS": repr(FLAGS),
        "FIRST_REPORTED": sum(leaf.size for leaf in program.state),
        "REPORTED": sum(leaf.size for leaf in program.reported),
        "PARAMS": _shapes(program.parameters),
        "STATE": _shapes(program.stored),
        "OUTPUT": _shapes(program.output),
        "REPORTED_LEAVES": _shapes(program.reported),
        "CODES": [f"    {result.name} = {int(result)}" for result in StepCode],
        "MESSAGES": [f"    Result.{result.name}: {result.message!r}," for result in StepCode],
        "ESTIMATE_FIELDS": [_field_line(leaf, ()) for leaf in program.output if leaf.size],
        "RUN_FIELDS": [_field_line(leaf, ("T",)) for leaf in columns.values() if leaf.size],
    }


def _field(leaf: Member) -> str:
    return f"{leaf.name}_" if keyword.iskeyword(leaf.name) else leaf.name


def _shapes(leaves: Sequence[Member]) -> str:
    pairs = "".join(f"\n    ({leaf.name!r}, {leaf.shape!r})," for leaf in leaves if math.prod(leaf.shape))
    return f"({pairs}\n)" if pairs else "()"


def _field_line(leaf: Member, rows: tuple[str, ...]) -> str:
    sides = [*rows, *map(str, leaf.shape)]
    return f"    {_field(leaf)}: np.ndarray  # ({', '.join(sides)}{',' if len(sides) == 1 else ''})"
