"""Shares a number of boxes among the proofs of one certificate."""

import dataclasses
import functools
from collections.abc import Callable

import numpy as np

from covariant.certificates.base._claims import AnyClaim
from scalargraph.proofs import Box, Form, Proof, prove


@dataclasses.dataclass
class Effort:
    """Proofs over one region that share a number of boxes.

    Attributes:
        domain: the region.
        boxes: number of boxes that are left.
        seconds: limit of time [s] of each proof, or None.
        processes: number of processes.
        progress: called with the name of the proof, the share that is done, and the number of boxes; or None.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.certificates.base._effort import Effort
        >>> from scalargraph.proofs import as_form, box
        >>> effort = Effort(box(a=(0.0, 1.0)), 10, None, 1, None)
        >>> effort.prove("it", as_form(lambda z: jnp.array([[1 + z[0]]]))).verdict, effort.boxes
        ('holds', 9)
    """

    domain: Box
    boxes: int
    seconds: float | None
    processes: int
    progress: Callable[[str, float, int], None] | None

    def report(self, what: str, share: float, boxes: int) -> None:
        """Report progress."""
        if self.progress is not None:
            self.progress(what, share, boxes)

    def prove(self, what: str, matrix: Form, domain: Box | None = None) -> Proof:
        """Prove that a matrix is positive definite, with the boxes that are left."""
        proof = prove(
            matrix,
            self.domain if domain is None else domain,
            boxes=self.boxes,
            seconds=self.seconds,
            processes=self.processes,
            progress=functools.partial(self.report, what),
        )
        self.boxes = max(self.boxes - proof.boxes, 0)
        return proof

    def prove_claim(
        self,
        what: str,
        claim: AnyClaim,
        form: Callable[[AnyClaim], Form],
        wider: Callable[[AnyClaim, np.ndarray], AnyClaim] | None = None,
        tries: int = 0,
        domain: Box | None = None,
    ) -> AnyClaim:
        """Prove a claim; if a point that was not sampled refutes it, try again with wider bounds."""
        claim = dataclasses.replace(claim, proof=self.prove(what, form(claim), domain))
        for _ in range(tries):
            if wider is None or claim.proof.counterexample is None:
                break
            claim = wider(claim, claim.proof.counterexample.mean(axis=0))
            claim = dataclasses.replace(claim, proof=self.prove(what, form(claim), domain))
        return claim
