"""Turns JAX functions into graphs of scalar operations, for C code, bounds, derivatives, proofs and their check.

`lower` interprets the jaxpr of a function over scalars: loops are unrolled, constants folded, zeros pruned, and equal
sub-expressions shared. A graph can then be evaluated in any arithmetic that has its operations: in numbers, or in
intervals, which bound its values over whole boxes and prove where it is defined and has no jumps. It can be
differentiated, written as C, and a matrix can be proved to be positive definite everywhere in a box. The package deals
with functions and boxes only; it has no notion of a mechanical system.
"""

from scalargraph.rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
