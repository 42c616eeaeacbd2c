"""Proves statements about matrices that are affine in some variables, at the corners of the box of these variables."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from covariant._domains import Count, check_numbers
from covariant.certificates.base import Hypothesis, Statement
from scalargraph.proofs import MOST_BOXES, Box, Form, Proof, blocks, prove_at_corners


class Corners(NamedTuple):
    """A statement that is proved at the corners of a box, with its proofs.

    Attributes:
        statement: the claim, with a hypothesis for each block of the matrix.
        proofs: the proofs, block by block and corner by corner.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.certificates import at_corners
        >>> from scalargraph.proofs import as_form, box
        >>> matrix = as_form(lambda z: jnp.diag(jnp.stack([1 + z[0], 2 - z[0]])))
        >>> result = at_corners(matrix, box(a=(-0.5, 0.5)), ("a",), "it is definite")
        >>> len(result.proofs), result.statement.proved
        (4, True)
    """

    statement: Statement
    proofs: tuple[Proof, ...]

    @property
    def boxes(self) -> int:
        """Number of boxes evaluated, over all proofs."""
        return sum(proof.boxes for proof in self.proofs)


@check_numbers
def at_corners(matrix: Form, domain: Box, affine: Sequence[str], claim: str, *, boxes: Count = MOST_BOXES) -> Corners:
    """Prove that a symmetric matrix that is affine in some variables is positive definite on a box.

    Args:
        matrix: a function of the variables of the box, as from `contraction`. It is proved block by block.
        domain: the box.
        affine: names of the variables in which the matrix is affine.
        claim: the conclusion in words.
        boxes: largest number of boxes for each of the blocks.

    Returns:
        The statement and its proofs.

    Raises:
        ValueError: the matrix is not affine in these variables together, or has a kink in them.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.certificates import at_corners
        >>> from scalargraph.proofs import as_form, box
        >>> matrix = as_form(lambda z: jnp.diag(jnp.stack([1 + z[0], 2 - z[0]])))
        >>> at_corners(matrix, box(a=(-0.5, 0.5)), ("a",), "it is definite").statement.short
        'holds (proved)'
    """
    proofs, hypotheses = [], []
    for part in blocks(matrix, domain):
        block = matrix.then(lambda whole, part=part: whole[part][:, part])
        at_block = prove_at_corners(block, domain, affine, boxes=boxes)
        entries = ", ".join(str(k + 1) for k in part)
        text = f"the block of the entries {entries} is positive definite at {len(at_block)} corners"
        last = at_block[-1]  # it decides, since the loop stops at the first corner that does not hold
        place = "" if last.verdict == "holds" else last.reason or str(last.box)
        hypotheses.append(Hypothesis(text, "proved", last.verdict, place=place))
        proofs += at_block
    names = ", ".join(affine)
    affinity = Hypothesis(f"the matrix is affine in {names} together, without kinks, so that corners suffice", "proved")
    data = (f"domain: {domain.free}", f"corners of: {names}")
    return Corners(Statement(claim, data, (affinity, *hypotheses), math.nan, str(domain.free)), tuple(proofs))
