"""Statements about matrices that are affine in some variables, proved at the corners of the box of these."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from covariant.certificates._statement import Hypothesis, Statement
from covariant.proofs import MOST_BOXES, Box, Form, Proof, blocks, prove_at_corners


class Corners(NamedTuple):
    """A statement, and the proofs that it rests on, block by block and corner by corner."""

    statement: Statement
    proofs: tuple[Proof, ...]

    @property
    def boxes(self) -> int:
        """Number of boxes evaluated."""
        return sum(proof.boxes for proof in self.proofs)


def at_corners(matrix: Form, domain: Box, affine: Sequence[str], claim: str, *, boxes: int = MOST_BOXES) -> Corners:
    """Prove that a symmetric matrix that is affine in some variables is positive definite on a box, block by block.

    - `matrix`: a function of the variables of the box, as from `contraction`; `affine`: names of those variables.
    - `claim`: what follows, in words.
    - `boxes`: effort for each of the blocks.

    Raises `ValueError` where the matrix is not affine in these variables together, or has a kink in them.

    >>> import jax.numpy as jnp
    >>> from covariant.certificates import at_corners
    >>> from covariant.proofs import as_form, box
    >>> matrix = as_form(lambda z: jnp.diag(jnp.stack([1 + z[0], 2 - z[0]])))
    >>> at_corners(matrix, box(a=(-0.5, 0.5)), ("a",), "it is definite").statement.short
    'holds (proved)'
    """
    proofs, hypotheses = [], []
    for part in blocks(matrix, domain):
        found = prove_at_corners(
            matrix.then(lambda whole, part=part: whole[part][:, part]), domain, affine, boxes=boxes
        )
        entries = ", ".join(str(k + 1) for k in part)
        # The last one decides, since it stops at the first corner that does not hold.
        hypotheses.append(
            Hypothesis(
                f"the block of the entries {entries} is positive definite at {len(found)} corners",
                "proved",
                found[-1].verdict,
                place="" if found[-1].verdict == "holds" else found[-1].reason or str(found[-1].box),
            )
        )
        proofs += found
    names = ", ".join(affine)
    affinity = Hypothesis(f"the matrix is affine in {names} together, without kinks, so that corners suffice", "proved")
    about = (f"domain: {domain.free}", f"corners of: {names}")
    return Corners(Statement(claim, about, (affinity, *hypotheses), math.nan, str(domain.free)), tuple(proofs))
