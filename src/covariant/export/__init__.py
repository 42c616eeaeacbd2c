"""Observers as C99 for microcontrollers and controllers: plain source with self-test, build files, data sheet."""

from covariant.export._data_sheet import Facts
from covariant.export._program import Leaf, Program, Recipe, of_family, program, with_open_numbers
from covariant.export._source import Source, write_source
from covariant.export._vectors import ROWS, Vectors, vectors
from covariant.export._write import export_texts, write_folder

__all__ = [
    "ROWS",
    "Facts",
    "Leaf",
    "Program",
    "Recipe",
    "Source",
    "Vectors",
    "export_texts",
    "of_family",
    "program",
    "vectors",
    "with_open_numbers",
    "write_folder",
    "write_source",
]
