"""The checker's arithmetic: shows again, by Taylor models, what branch and bound has proved in intervals.

It is made for checking another arithmetic and shares nothing with it: it reads JAX's programs itself, and trusts IEEE
`+ − × ÷ √` alone.
"""

from covariant.proofs.checker._definite import show_definite
from covariant.proofs.checker._enclosure import TaylorEnclosure
from covariant.proofs.checker._plain import plain
from covariant.proofs.checker._taylor import ROUND
from covariant.proofs.checker._tree import halves, leaves

__all__ = ["ROUND", "TaylorEnclosure", "halves", "leaves", "plain", "show_definite"]
