"""Data for drawing a certificate: its boxes projected on two variables, and the rates that its gains allow.

Source: Aghannan & Rouchon 2003, Fig. 2.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.certificates._contraction_certificate import ContractionCertificate
from covariant.certificates._tangent_metric import conditioning, error_matrix, lyapunov, optimal_lyapunov, rate_of
from covariant.proofs import OPEN, PROVED, leaves


class Projection(NamedTuple):
    """The boxes of one proof, projected on two variables.

    - `claim`: its kind; `kind`: that of each of the two variables; `names`, `units`: as in the certificate.
    - `proved`, `open` (k, 2, 2): distinct rectangles, as low then high ends of both variables.
    - `domain` (2, 2): of both variables; `counterexample` (2,): where the statement was proved wrong, or None.
    """

    claim: str
    kind: tuple[str, str]
    names: tuple[str, str]
    units: tuple[str, str]
    proved: Float[np.ndarray, "k 2 2"]
    open: Float[np.ndarray, "j 2 2"]
    domain: Float[np.ndarray, "2 2"]
    counterexample: Float[np.ndarray, "2"] | None


class TradeOff(NamedTuple):
    """Rates λ [1/s] that the gains allow at q̂ = q, and the condition numbers of the metrics for them.

    - `rate`, `condition` (k,): those of the best conditioned Q for each rate.
    - `used`, `paper`: rate and condition number of the certificate's Q, and of that of the paper.
    - `certified`: the rate of the certificate.
    """

    rate: Float[np.ndarray, "k"]
    condition: Float[np.ndarray, "k"]
    used: tuple[float, float]
    paper: tuple[float, float]
    certified: float


def projection(certificate: ContractionCertificate) -> Projection:
    """Boxes of the first claim that is not proved, or of the contraction, over the two variables halved most often."""
    undecided = [claim for claim in certificate.claims if claim.proof.verdict != "holds"]
    claim = (undecided or certificate.claims)[0]
    domain, proof = claim.proof.box, claim.proof
    codes = np.concatenate(proof.levels)
    splits = np.bincount(codes[codes >= 0], minlength=len(domain.low)) + 0.5 * (domain.high > domain.low)
    i, j = sorted(np.argsort(-splits, kind="stable")[:2].tolist())
    found = {PROVED: [np.zeros((0, 2, 2))], OPEN: [np.zeros((0, 2, 2))]}
    for state, low, high in leaves(domain, proof.levels):
        for code, kept in found.items():
            of = state == code
            kept.append(np.stack([low[of][:, [i, j]], high[of][:, [i, j]]], axis=1))
    proved, remaining = (np.unique(np.concatenate(found[code]), axis=0) for code in (PROVED, OPEN))
    wrong = certificate.counterexample
    what = certificate.kinds
    return Projection(
        claim.kind,
        (what[i], what[j]),
        (domain.names[i], domain.names[j]),
        (domain.units[i], domain.units[j]),
        proved,
        remaining,
        np.stack([domain.low[[i, j]], domain.high[[i, j]]]),
        None if wrong is None else wrong.mean(axis=0)[[i, j]],
    )


def trade_off(certificate: ContractionCertificate, count: int = 40) -> TradeOff:
    """Rates that the gains of a certificate's observer allow, from slow ones to nearly the fastest."""
    alpha, beta = float(certificate.observer.alpha), float(certificate.observer.beta)
    fastest = -2 * float(np.linalg.eigvals(error_matrix(alpha, beta)).real.max())
    rates = fastest * np.linspace(0.02, 0.98, count)
    matrices = [optimal_lyapunov(alpha, beta, rate) for rate in rates]

    def both(q) -> tuple[float, float]:
        return rate_of(alpha, beta, q), conditioning(beta, q)

    found = np.array(sorted(both(q) for q in matrices))
    return TradeOff(found[:, 0], found[:, 1], both(certificate.q), both(lyapunov(alpha, beta)), certificate.rate)
