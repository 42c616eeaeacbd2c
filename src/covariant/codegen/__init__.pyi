from ._data_sheet import Facts as Facts
from ._fmu import fmu as fmu, write_fmu as write_fmu
from ._names import check_export_name as check_export_name, export_name as export_name
from ._program import (
    Program as Program,
    Recipe as Recipe,
    Signals as Signals,
    of_family as of_family,
    program as program,
    trace_program as trace_program,
    with_open_numbers as with_open_numbers,
)
from ._python_package import python_files as python_files
from ._ros_package import ros_files as ros_files
from ._source import write_source as write_source
from ._vectors import ROWS as ROWS, vectors as vectors
from ._wasm import check_wasm_compiler as check_wasm_compiler, wasm_files as wasm_files
from ._write import check_export as check_export, export_texts as export_texts, write_folder as write_folder

__all__ = ["Program", "fmu", "program", "write_fmu", "write_source"]
