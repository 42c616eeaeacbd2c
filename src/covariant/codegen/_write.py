"""An export as files in a folder."""

import math
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from covariant._files import temporary, write_atomically
from covariant.codegen._companions import companions
from covariant.codegen._data_sheet import Facts, data_sheet
from covariant.codegen._program import Program
from covariant.codegen._self_test import write_test
from covariant.codegen._source import write_source
from covariant.codegen._vectors import vectors


def export_texts(
    program: Program, name: str, about: str, measured: np.ndarray, facts: Facts, flash: int | float = math.inf
) -> dict[str, str]:
    """All files of an export by their path in its folder.

    - `name`: what all names in C begin with; `about`: a line that says what the observer is.
    - `measured` (T, *n): measurements of the self-test, the first of which starts it.
    - `flash` [bytes]: how much code and constants may take, see `write_source`.

    The texts of source and self-test are the same on every machine; the data sheet names the sizes of its compilers.
    Raises `ValueError` where the observer is estimated to take more flash.
    """
    about = " ".join(about.replace("*/", "").split())
    source = write_source(program, name, about, flash)
    return {
        f"{name}.h": source.header,
        f"{name}.c": source.source,
        f"test/{name}_test.c": write_test(program, name, vectors(program, measured, facts.rate)),
        "DATASHEET.md": data_sheet(program, source, about, facts),
        **companions(program, name, about, facts.rate),
    }


def write_folder(texts: Mapping[str, str], folder: Path, overwrite: bool = False) -> list[Path]:
    """Write the files into a folder, which is made where it is not there; returns their paths.

    A new folder appears with all of its files or not at all. Raises `ValueError` for a folder with files in it, unless
    `overwrite` is set: then the files are replaced one by one, and others stay.
    """
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder}: this is a file; name a folder")
    if folder.exists() and any(folder.iterdir()) and not overwrite:
        raise ValueError(f"{folder}: the folder is not empty; name a new one, or replace its files by --overwrite")
    if not folder.resolve().parent.is_dir():
        raise ValueError(f"{folder}: there is no folder {folder.resolve().parent}; make it first")
    if folder.exists():
        for path, text in texts.items():
            (folder / path).parent.mkdir(exist_ok=True)
            write_atomically(folder / path, lambda file, text=text: file.write(text.encode()))
    else:
        with temporary(folder, Path.mkdir) as fresh:
            for path, text in texts.items():
                (fresh / path).parent.mkdir(exist_ok=True)
                (fresh / path).write_bytes(text.encode())
            os.rename(fresh, folder)
    return [folder / path for path in texts]
