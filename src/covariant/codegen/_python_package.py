"""An exported observer as a Python package that needs NumPy alone: the C, compiled and loaded by ctypes, and a wheel.

Sources: PEP 427 and PEP 425, wheels and the tags in their names.
"""

import base64
import hashlib
import keyword
import math
import platform
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from covariant._compile import compiler_command
from covariant._files import zipped
from covariant.codegen._companions import filled
from covariant.codegen._program import DTYPES, Leaf, Program
from covariant.codegen._python_checks import CHECKS
from covariant.codegen._python_module import MAIN, MODULE, ROWS_IN_C
from covariant.codegen._source import SENTENCE
from covariant.signals import Result

FLAGS = ("-std=c99", "-O2", "-fno-math-errno", "-ffp-contract=off", "-fPIC", "-shared")
"""Flags of the compiler, for all processors of a kind: results are the same on all of them, but for `<math.h>`."""
SUFFIXES = {"Darwin": ".dylib", "Windows": ".dll"}
"""What the name of a library ends with, by system; `.so` on others."""
LEAST_PYTHON = "3.9"


def python_files(program: Program, texts: Mapping[str, str], name: str, about: str, rate: float) -> dict[str, bytes]:
    """A Python package of an exported observer, compiled for the machine at hand, and a wheel of it.

    Args:
        program: The observer as graphs.
        texts: Its header and source, as `export_texts` writes them.
        name: Prefix of all names in C, and name of the package.
        about: A line that says what the observer is.
        rate: Sampling rate [Hz] that it is made for.

    Returns:
        Contents by their path in the folder of the export. Without a C compiler there is neither a library nor a wheel,
        and the package builds its library where there is one.

    Raises:
        ValueError: The name is a word of Python, or that of a module which the package needs.
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
    if keyword.iskeyword(name) or name in sys.stdlib_module_names or name == "numpy":
        raise ValueError(f"{name!r} is a word or a module of Python; name the export otherwise (`name`)")
    token = hashlib.sha256("".join([texts[f"{name}.h"], texts[f"{name}.c"], about, repr(rate)]).encode()).hexdigest()
    version = f"1.0.0+x{token[:8]}"  # another export is another version, so that installing it replaces the former
    replacements = _replacements(program, name, about, rate, token[:32], version)
    package = {
        "__init__.py": filled(MODULE + CHECKS, replacements).encode(),
        "__main__.py": filled(MAIN, replacements).encode(),
        f"{name}.h": texts[f"{name}.h"].encode(),
        f"{name}.c": texts[f"{name}.c"].encode(),
        f"{name}_rows.c": filled(ROWS_IN_C, replacements).encode(),
    }
    command = compiler_command()
    wheel: dict[str, bytes] = {}
    if command is not None:
        package[f"lib{name}{SUFFIXES.get(platform.system(), '.so')}"] = _library(command, package, name)
        tag = f"py3-none-{_platform()}"
        wheel[f"python/{name}-{version}-{tag}.whl"] = _wheel(package, name, about, version, tag)
    return {f"python/{name}/{path}": content for path, content in package.items()} | wheel


def _library(command: Sequence[str], package: Mapping[str, bytes], name: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        for path, content in package.items():
            (Path(folder) / path).write_bytes(content)
        words = [*command, *FLAGS, f"{name}.c", f"{name}_rows.c", "-lm", "-o", "made"]
        run = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
        if run.returncode:
            raise OSError(f"{' '.join(command)} does not compile the package: {run.stderr.strip()[:200]}")
        return (Path(folder) / "made").read_bytes()


def _platform() -> str:
    """The tag of the machine at hand, whose compiler makes code for one architecture."""
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


def _replacements(program: Program, name: str, about: str, rate: float, token: str, version: str) -> dict[str, str]:
    params = [Leaf(key, np.shape(value)) for key, value in program.numbers.items()]
    reported = [leaf._replace(name=f"last_{leaf.name}") for leaf in program.reported]
    output = [*program.x, *program.told]
    # An estimate has standard deviations that a step reports as well; a run has them once.
    columns = list({leaf.name: leaf for leaf in [*output, *program.reported]}.values())
    parts = [f"{count} of {'the ' if of == program.parts[0][0] else ''}{of}" for of, count in program.parts]
    return {
        "@NAME@": name,
        "@UPPER@": name.upper(),
        # In a docstring between three quotes.
        "@ABOUT@": about.replace("\\", "/").replace('"', "'"),
        "@SENTENCE@": SENTENCE,
        "@TOKEN@": token,
        "@VERSION@": version,
        "@WITH_U@": ", u" if program.u else "",
        "@FIRST@": _field(program.x[-1]),
        "@RATE@": repr(float(rate)),
        "@DTYPE@": np.dtype(DTYPES[program.real]).name,
        "@MEASUREMENT@": repr(program.y),
        "@SENSORS@": f": {', then '.join(parts)}" if program.sensors else "",
        "@SIGNALS@": _signals(program),
        "@INPUTS@": str(program.u),
        "@STARTS@": str(program.parts[0][1]),
        "@FLAGS@": repr(FLAGS),
        "@FIRST_REPORTED@": str(sum(leaf.size for leaf in program.state)),
        "@REPORTED@": str(sum(leaf.size for leaf in reported)),
        "@PARAMS@": _shapes(params),
        "@STATE@": _shapes([*program.state, *reported]),
        "@OUTPUT@": _shapes(output),
        "@REPORTED_LEAVES@": _shapes(program.reported),
        "@CODES@": "\n".join(f"    {result.name} = {int(result)}" for result in Result),
        "@MESSAGES@": "\n".join(f"    Result.{result.name}: {result.message!r}," for result in Result),
        "@ESTIMATE_FIELDS@": "\n".join(_annotated(leaf, ()) for leaf in output if leaf.size),
        "@RUN_FIELDS@": "\n".join(_annotated(leaf, ("T",)) for leaf in columns if leaf.size),
    }


def _signals(program: Program) -> str:
    """Lines of the docstring on the order and the units of the numbers."""
    lines = "".join(f"    {line}\n" for line in program.signals.lines)
    return f"Numbers in their order, in these units, whatever those of a log:\n\n{lines}\n" if lines else ""


def _field(leaf: Leaf) -> str:
    return f"{leaf.name}_" if keyword.iskeyword(leaf.name) else leaf.name


def _shapes(leaves: Sequence[Leaf]) -> str:
    pairs = "".join(f"\n    ({leaf.name!r}, {leaf.shape!r})," for leaf in leaves if math.prod(leaf.shape))
    return f"({pairs}\n)" if pairs else "()"


def _annotated(leaf: Leaf, rows: tuple[str, ...]) -> str:
    sides = [*rows, *map(str, leaf.shape)]
    return f"    {_field(leaf)}: np.ndarray  # ({', '.join(sides)}{',' if len(sides) == 1 else ''})"
