"""Computes the data of figures: the boxes of a certificate projected on two variables.

Source: Aghannan & Rouchon 2003, Fig. 2.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.certificates.proving._contraction_certificate import ContractionCertificate
from scalargraph.proofs import OPEN, PROVED, leaves


class Projection(NamedTuple):
    """The boxes of one proof, projected on two variables.

    Attributes:
        claim: kind of the claim: "contraction", "reach" or "disturbance".
        kind: kind of each of the two variables: "estimate", "velocity", "error" or "force".
        names, units: name and unit of each, as in the certificate.
        proved: distinct proved rectangles (k, 2, 2), with low then high ends of both variables.
        open: distinct rectangles (j, 2, 2) that are undecided.
        domain: low then high ends (2, 2) of both variables.
        counterexample: point (2,) at which the statement was proved wrong, or None.

    Example:
        >>> import numpy as np
        >>> from covariant.certificates import Projection
        >>> square = np.array([[-1.0, -1.0], [1.0, 1.0]])
        >>> labels = "contraction", ("velocity", "error"), ("v", "e"), ("m/s", "m")
        >>> picture = Projection(*labels, square[None], np.zeros((0, 2, 2)), square, None)
        >>> len(picture.proved), len(picture.open)
        (1, 0)
    """

    claim: str
    kind: tuple[str, str]
    names: tuple[str, str]
    units: tuple[str, str]
    proved: Float[np.ndarray, "k 2 2"]
    open: Float[np.ndarray, "j 2 2"]
    domain: Float[np.ndarray, "2 2"]
    counterexample: Float[np.ndarray, "2"] | None


def projection(certificate: ContractionCertificate) -> Projection:
    """Project the boxes of a certificate on the two variables that were halved most often.

    Args:
        certificate: a certificate.

    Returns:
        The boxes of the first claim that is not proved, or of the contraction if all claims are proved.
    """
    undecided = [claim for claim in certificate.claims if claim.proof.verdict != "holds"]
    claim = (undecided or certificate.claims)[0]
    domain, proof = claim.proof.box, claim.proof
    codes = np.concatenate(proof.levels)
    # Among variables that were never halved, half a split puts those with a width before fixed ones.
    splits = np.bincount(codes[codes >= 0], minlength=len(domain.low)) + 0.5 * (domain.high > domain.low)
    i, j = sorted(np.argsort(-splits, kind="stable")[:2].tolist())
    rectangles = {PROVED: [np.zeros((0, 2, 2))], OPEN: [np.zeros((0, 2, 2))]}
    for state, low, high in leaves(domain, proof.levels):
        for code, group in rectangles.items():
            rows = state == code
            group.append(np.stack([low[rows][:, [i, j]], high[rows][:, [i, j]]], axis=1))
    proved, remaining = (np.unique(np.concatenate(rectangles[code]), axis=0) for code in (PROVED, OPEN))
    counterexample = certificate.counterexample
    kinds = certificate.kinds
    return Projection(
        claim.kind,
        (kinds[i], kinds[j]),
        (domain.names[i], domain.names[j]),
        (domain.units[i], domain.units[j]),
        proved,
        remaining,
        np.stack([domain.low[[i, j]], domain.high[[i, j]]]),
        None if counterexample is None else counterexample.mean(axis=0)[[i, j]],
    )
