"""Proves that a matrix is positive definite everywhere in a box, checks such proofs, and saves their trees of boxes.

The matrix is a JAX function of variables in a box. It becomes a graph of scalars, which is bounded over boxes in
outward-rounded arithmetic, and boxes are halved until each is decided. `proofs.checker` proves the same statement in
another arithmetic.
"""

from scalargraph.rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
