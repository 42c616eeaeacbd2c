"""A model is written once, as a JAX function, and read in several ways: here it becomes a graph of scalar operations.

`lower` interprets the function's jaxpr over scalars: loops are unrolled, constants folded, zeros pruned, equal parts
shared. A graph is then read in any arithmetic that knows its operations: in numbers, or in intervals, which bound its
values over whole boxes. Knows only jaxprs.
"""

from covariant.lowering._differentiate import expand, pairs
from covariant.lowering._graph import FOLD, Graph, Node
from covariant.lowering._intervals import INTERVALS, Enclosure, Interval, Truth, enclose
from covariant.lowering._read import NUMBERS, Domain, evaluate, numbers
from covariant.lowering._trace import Lowered, LoweringError, lower

__all__ = [
    "FOLD",
    "INTERVALS",
    "NUMBERS",
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
    "lower",
    "numbers",
    "pairs",
]
