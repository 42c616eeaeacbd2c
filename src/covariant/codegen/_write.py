"""Writes an export as files in a folder."""

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from covariant.codegen._data_sheet import Facts, data_sheet
from covariant.codegen._program import Program
from covariant.codegen._self_test import write_test
from covariant.codegen._source import common_words, field, write_source
from covariant.codegen._vectors import Vectors, vectors
from scalargraph.errors import InputError
from scalargraph.files import temporary, write_together
from scalargraph.template import fill


def export_texts(
    program: Program,
    name: str,
    about: str,
    measured: np.ndarray,
    facts: Facts,
    run: Vectors | None = None,
    python: bool = False,
    wasm: bool = False,
    ros2: bool = False,
) -> dict[str, str]:
    """Write the texts of all files of an export: header, source, self-test, data sheet, build files and a README.

    Source and self-test are the same on every machine; the data sheet states sizes for the compilers of this machine.

    Args:
        program: The observer as graphs.
        name: Prefix of all names in C, an identifier.
        about: A line that describes the observer, for comments and texts.
        measured: Measurements (ROWS + 1, *n) of the self-test, which starts from the first one.
        facts: Further facts for the data sheet.
        run: The run that the self-test follows; by default it is computed from the measurements.
        python, wasm, ros2: Whether the README lists the files of `python_files`, `wasm_files` and `ros_files`; by
            default it does not.

    Returns:
        The texts by their path in the folder of the export.

    Raises:
        ValueError: The name is not an identifier of C.

    Example:
        >>> import numpy as np
        >>> from covariant import codegen, observers
        >>> recipe = codegen.with_open_numbers(observers.FilteredDerivative(20.0))
        >>> program = codegen.program(recipe, np.zeros(1))
        >>> measured = np.zeros((codegen.ROWS + 1, 1))
        >>> texts = codegen.export_texts(program, "speed", "A filter.", measured, codegen.Facts(100.0, None))
        >>> list(texts)[:3], texts["DATASHEET.md"].splitlines()[0]
        (['speed.h', 'speed.c', 'test/speed_test.c'], '# Data sheet of speed')
    """
    # The characters */ would end a comment of C, and a line break would end the line.
    about = " ".join(about.replace("*/", "").split())
    source = write_source(program, name, about)
    words = common_words(program, name, about)
    first = program.x[-1]
    words |= {
        "U": max(1, program.u),
        "FIRST": f"{field(first)}{'[0]' if first.shape else ''}",
        "PYTHON": [_PYTHON.replace("NAME", name)] if python else [],
        "WASM": [_WASM.replace("NAME", name)] if wasm else [],
        "ROS": [_ROS.replace("NAME", name).replace("PACKAGE", f"{name.lower()}_ros")] if ros2 else [],
    }
    # The self-test is in a folder of its own, which Arduino does not compile.
    return {
        f"{name}.h": source.header,
        f"{name}.c": source.source,
        f"test/{name}_test.c": write_test(program, words, run or vectors(program, measured, facts.rate)),
        "DATASHEET.md": data_sheet(program, source, about, facts),
        "CMakeLists.txt": fill("covariant.codegen", "CMakeLists.txt", words),
        "library.properties": fill("covariant.codegen", "library.properties", words),
        f"{name}.hpp": fill("covariant.codegen", "observer.hpp", words),
        "README.md": fill("covariant.codegen", "README.md", words),
    }


_PYTHON = """| `python/NAME` | a Python package that needs NumPy alone; put `python` on the path |
| `python/NAME-….whl` | the package as a wheel for this platform, if a C compiler was found |"""
_WASM = """| `NAME.wasm`, `NAME_wasm.c` | the observer as WebAssembly, and the C of its calls |
| `NAME.js` | a script for web pages and Node that holds it |
| `test/NAME_test.js` | its self-test: `node test/NAME_test.js` |"""
_ROS = "| `ros2/PACKAGE` | ROS 2, a node in Python: `colcon build`, `ros2 launch PACKAGE NAME.launch.py` |"
"""Rows of the README for files that are written on demand."""


def check_export(path: Path, overwrite: bool = False) -> None:
    """Check, before anything is computed, that a folder, or a unit if the path ends in .fmu, may be written.

    Args:
        path: The folder, or the file of the unit.
        overwrite: Whether files that exist may be replaced.

    Raises:
        ValueError: As for `write_folder` and `write_fmu`.

    Example:
        >>> from pathlib import Path
        >>> from covariant.codegen import check_export
        >>> check_export(Path("new"))
    """
    unit = path.suffix == ".fmu"
    if unit and (path.is_dir() or (path.exists() and not overwrite)):
        raise InputError(f"{path}: there is one already; name a new one, or replace a file by `overwrite=True`")
    if path.exists() and not (unit or path.is_dir()):
        raise InputError(f"{path}: this is a file; name a folder")
    if path.is_dir() and any(path.iterdir()) and not overwrite:
        raise InputError(f"{path}: the folder is not empty; name a new one, or replace its files by `overwrite=True`")
    if not path.resolve().parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.resolve().parent}; make it first")


def write_folder(files: Mapping[str, str | bytes], folder: Path, overwrite: bool = False) -> list[Path]:
    """Write files into a folder. A new folder appears with all of its files or not at all.

    Args:
        files: Texts and other contents by their path in the folder.
        folder: The folder, which is created if it does not exist; its parent must exist.
        overwrite: Whether files of a folder that is not empty are replaced; its other files are kept. All new files are
            written before the first old one is replaced, so that a full disk leaves the old files intact. By default a
            folder that is not empty is refused.

    Returns:
        The paths of the files.

    Raises:
        ValueError: The folder is a file, is not empty, or has no parent.

    Example:
        >>> from pathlib import Path
        >>> from covariant.codegen import write_folder
        >>> [path.as_posix() for path in write_folder({"a.h": "int a;", "test/a.c": ""}, Path("exported"))]
        ['exported/a.h', 'exported/test/a.c']
        >>> write_folder({"a.h": ""}, Path("exported"))
        Traceback (most recent call last):
        scalargraph.errors.InputError: exported: the folder is not empty; name a new one, or ...
    """
    check_export(folder, overwrite)
    contents = {path: file.encode() if isinstance(file, str) else file for path, file in files.items()}
    if folder.exists():
        for path in contents:
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
        write_together({folder / path: content for path, content in contents.items()})
    else:
        with temporary(folder, Path.mkdir) as fresh:
            for path, content in contents.items():
                (fresh / path).parent.mkdir(parents=True, exist_ok=True)
                (fresh / path).write_bytes(content)
            # A rename is atomic, so the folder never appears with only some of its files.
            os.rename(fresh, folder)
    return [folder / path for path in files]
