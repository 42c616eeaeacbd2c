"""Observers as C99 for microcontrollers and controllers, with self-test and data sheet, and as units for simulators."""

from covariant.export._data_sheet import Facts
from covariant.export._fmu import Unit, fmu, write_fmu
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
    "Unit",
    "Vectors",
    "export_texts",
    "fmu",
    "of_family",
    "program",
    "vectors",
    "with_open_numbers",
    "write_fmu",
    "write_folder",
    "write_source",
]
