from ._c import c_function as c_function, c_helpers as c_helpers, c_number as c_number
from ._c_names import C_KEYWORDS as C_KEYWORDS, C_MACROS as C_MACROS, check_name as check_name
from ._c_rows import c_rows as c_rows
from ._c_writer import CText as CText, Signature as Signature
from ._invariants import split as split
from ._peephole import simplified as simplified
from ._to_c import to_c as to_c
