"""A model is written once, as a JAX function, and read in several ways: here it becomes a graph of scalar operations.

`lower` interprets the function's jaxpr over scalars: loops are unrolled, constants folded, zeros pruned, equal parts
shared. A graph is then read in any arithmetic that knows its operations: in numbers, or in intervals, which bound its
values over whole boxes, and say where it is defined and does not jump. Knows only jaxprs.
"""

from covariant.lowering._differentiate import Derivative, expand, pairs
from covariant.lowering._enclose import Enclosure, enclose, fulfilled
from covariant.lowering._graph import FOLD, Condition, Graph, Node
from covariant.lowering._intervals import INTERVALS, Interval, Truth
from covariant.lowering._lowered import Conditions, Lowered, LoweringError
from covariant.lowering._read import NUMBERS, Domain, evaluate, numbers
from covariant.lowering._stumpff import STUMPFF, stumpff
from covariant.lowering._trace import graft, lower, substitute

__all__ = [
    "FOLD",
    "INTERVALS",
    "NUMBERS",
    "STUMPFF",
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
    "Truth",
    "enclose",
    "evaluate",
    "expand",
    "fulfilled",
    "graft",
    "lower",
    "numbers",
    "pairs",
    "stumpff",
    "substitute",
]
