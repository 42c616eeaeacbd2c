"""JAX functions lowered to graphs of scalar operations, which can be evaluated in several arithmetics.

`lower` interprets the jaxpr of a function over scalars: loops are unrolled, constants folded, zeros pruned, and equal
sub-expressions shared. A graph can then be evaluated in any arithmetic that has its operations: in numbers, or in
intervals. Intervals bound its values over whole boxes, and prove where it is defined and has no jumps. This package
knows only jaxprs.
"""

from covariant.lowering._c import CText, Signature, c_function, c_helpers, c_number
from covariant.lowering._differentiate import Derivative, expand, pairs
from covariant.lowering._enclose import Enclosure, enclose, fulfilled
from covariant.lowering._graph import FOLD, Condition, Graph, Node
from covariant.lowering._intervals import INTERVALS, Interval, Truth
from covariant.lowering._lowered import Conditions, Lowered, LoweringError
from covariant.lowering._peephole import simplified
from covariant.lowering._read import NUMBERS, Domain, evaluate, numbers
from covariant.lowering._rounding import perturbed
from covariant.lowering._stumpff import STUMPFF, stumpff
from covariant.lowering._trace import graft, lower, substitute

__all__ = [
    "FOLD",
    "INTERVALS",
    "NUMBERS",
    "STUMPFF",
    "CText",
    "Condition",
    "Conditions",
    "Derivative",
    "Domain",
    "Enclosure",
    "Graph",
    "Interval",
    "Lowered",
    "LoweringError",
    "Node",
    "Signature",
    "Truth",
    "c_function",
    "c_helpers",
    "c_number",
    "enclose",
    "evaluate",
    "expand",
    "fulfilled",
    "graft",
    "lower",
    "numbers",
    "pairs",
    "perturbed",
    "simplified",
    "stumpff",
    "substitute",
]
