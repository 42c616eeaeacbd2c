from . import checker as checker
from ._box import Box as Box, box as box, check_box as check_box
from ._conditions import show_conditions as show_conditions
from ._file import Field as Field, digest as digest, parse_file as parse_file, read_file as read_file
from ._form import Form as Form, as_form as as_form, derivative_form as derivative_form
from ._models import Polynomials as Polynomials, polynomials as polynomials
from ._prove import (
    MOST_BOXES as MOST_BOXES,
    Proof as Proof,
    blocks as blocks,
    prove as prove,
    prove_at_corners as prove_at_corners,
)
from ._saved import (
    LETTERS as LETTERS,
    MOST_LETTERS as MOST_LETTERS,
    from_letters as from_letters,
    graph_rows as graph_rows,
    saved_graph as saved_graph,
    saved_levels as saved_levels,
    to_letters as to_letters,
)
from ._tree import OPEN as OPEN, PROVED as PROVED, leaves as leaves

__all__ = ["Box", "Proof", "as_form", "box", "prove"]
