"""An independent check, by Taylor models, of what branch and bound has proved in intervals.

To be independent it shares nothing with the prover: it reads JAX's programs itself, and relies on IEEE `+ − × ÷ √`
alone.
"""

from covariant.proofs.checker._definite import show_definite
from covariant.proofs.checker._enclosure import TaylorEnclosure
from covariant.proofs.checker._plain import plain
from covariant.proofs.checker._taylor import ROUND
from covariant.proofs.checker._tree import halves, leaves

__all__ = ["ROUND", "TaylorEnclosure", "halves", "leaves", "plain", "show_definite"]
