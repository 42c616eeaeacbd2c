"""Observers as C99 for microcontrollers and real-time programs.

One plain source file without memory management, with its self-test, build files and data sheet.
"""

from covariant.export._program import Leaf, Program, Recipe, of_family, program, with_open_numbers
from covariant.export._source import Source, write_source
