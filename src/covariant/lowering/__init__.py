"""JAX functions lowered to graphs of scalar operations, which can be evaluated in several arithmetics.

`lower` interprets the jaxpr of a function over scalars: loops are unrolled, constants folded, zeros pruned, and equal
sub-expressions shared. A graph can then be evaluated in any arithmetic that has its operations: in numbers, or in
intervals. Intervals bound its values over whole boxes, and prove where it is defined and has no jumps. This package
knows only jaxprs.
"""

from covariant._rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
