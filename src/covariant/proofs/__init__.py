"""Proofs that a matrix is positive definite everywhere in a box: branch and bound, its checker, and files of trees.

The matrix is a JAX function of variables in a box. It becomes a graph of scalars, which is bounded over boxes in
outward-rounded arithmetic, and boxes are halved until each is decided. `proofs.checker` proves the same in another
arithmetic. This package knows functions and boxes only; what a matrix says about an observer is in
`covariant.certificates`.
"""

from covariant.proofs._balls import BITS, BallMatrix
from covariant.proofs._box import Box, box, check_box
from covariant.proofs._conditions import show_conditions
from covariant.proofs._file import Field, digest, parse_file, read_file
from covariant.proofs._form import Form, as_form, derivative_form
from covariant.proofs._prove import MOST_BOXES, Proof, blocks, prove, prove_at_corners
from covariant.proofs._saved import (
    LETTERS,
    MOST_LETTERS,
    from_letters,
    graph_rows,
    saved_graph,
    saved_levels,
    to_letters,
)
from covariant.proofs._tree import OPEN, PROVED, leaves

__all__ = [
    "BITS",
    "LETTERS",
    "MOST_BOXES",
    "MOST_LETTERS",
    "OPEN",
    "PROVED",
    "BallMatrix",
    "Box",
    "Field",
    "Form",
    "Proof",
    "as_form",
    "blocks",
    "box",
    "check_box",
    "derivative_form",
    "digest",
    "from_letters",
    "graph_rows",
    "leaves",
    "parse_file",
    "prove",
    "prove_at_corners",
    "read_file",
    "saved_graph",
    "saved_levels",
    "show_conditions",
    "to_letters",
]
