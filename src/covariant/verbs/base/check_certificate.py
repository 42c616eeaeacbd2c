"""Verifies a saved certificate, of any kind."""

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from covariant import certificates
from covariant.verbs.base.arguments import above_zero
from covariant.verbs.base.progress import Progress, notebook_line
from covariant.verbs.base.result import AbstractResult
from scalargraph.errors import InputError
from scalargraph.proofs import read_file


def check_certificate(
    path: str | Path, *, model: str | None = None, processes: int = 1, progress: Progress = notebook_line
) -> "CertificateCheckResult":
    """Verify a saved certificate: all leaves of its proofs, and some of them again in ball arithmetic.

    A certificate that is not verified gives a result with the reason, rather than an exception. `model` runs code of
    the person who checks, and never code from the file. `certificates.check` is the same without ball arithmetic, and
    returns the statement.

    Args:
        path: The certificate (.json), as `certify` saves it.
        model: The `module:attribute` of a model that is not of this library, given by the person who checks.
        processes: Largest number of processes to check with; with several, a script needs the
            `if __name__ == "__main__"` guard. Up to 1024 leaves are checked in this process.
        progress: Called with the fraction of the leaves that are checked.

    Returns:
        Whether the certificate is verified, and otherwise why not.

    Raises:
        ValueError: Where there is no such file.

    Example:
        >>> import covariant
        >>> bounds = {"velocity": 1.0, "error": 0.1, "region": {"q": (-1.0, 1.0)}}
        >>> proved = covariant.certify("oscillator", alpha=10.0, beta=50.0, rate=1.0, **bounds)
        >>> covariant.verbs.check_certificate(proved.save("oscillator.json")).verified
        True
    """
    path = Path(path)
    content = read_file(path)  # only once, so that both checks examine the same content
    counted = functools.partial(_leaves, progress)
    try:
        checked = certificates.check_globally(path, content, model=model, progress=counted)
        if checked is not None:
            return CertificateCheckResult(path, model, checked, 0, "none in ball arithmetic")
        document = certificates.parse(path, content)
        processes = int(above_zero("processes", processes))
        checked = certificates.check(document, model=model, processes=processes, progress=counted)
        return CertificateCheckResult(path, model, checked, *_in_balls(document, model))
    except InputError as refusal:
        return CertificateCheckResult(path, model, None, 0, str(refusal))


@dataclass(frozen=True, repr=False)
class CertificateCheckResult(AbstractResult):
    """Whether a saved certificate is verified.

    Attributes:
        path: The file.
        model: The `module:attribute` that was given for its model, or None.
        checked: What was verified; None where the certificate is refused.
        balls: Number of leaves that were verified again in ball arithmetic.
        note: A remark on the balls, or why the certificate is refused.

    Example:
        >>> from covariant import verbs
        >>> verbs.CertificateCheckResult("top.json", None, None, 0, "its digest does not fit")
        <CertificateCheckResult: top.json: refused>
    """

    path: Path
    model: str | None
    checked: certificates.Checked | None
    balls: int
    note: str

    @property
    def verified(self) -> bool:
        """Whether all leaves of the proofs are verified."""
        return self.checked is not None

    @property
    def headline(self) -> str:
        return f"{self.path}: {'refused' if self.checked is None else f'verified, {self.checked.leaves} leaves'}"

    @property
    def summary(self) -> dict[str, Any]:
        if self.checked is None:
            return {"verified": False, "reason": self.note}
        assumed = [each.text for each in self.checked.statement.hypotheses if each.evidence == "assumed"]
        details = {"model": self.model, "balls": self.balls, "assumed": assumed}
        return {"verified": True, **self.checked._asdict(), "statement": self.checked.statement.document(), **details}

    def __str__(self) -> str:
        details = self.checked
        if details is None:
            return f"Refused: {self.note}"
        lines = [f"Verified: {details.leaves} leaves in {details.seconds:.1f} s, {self.note}."]
        if details.model_given:
            given = f"The model is {self.model}, given by the person who checks"
            lines.append(f"{given}; that the file means this one is not verified.")
        return "\n".join([*lines, str(details.statement)])


def _leaves(progress: Progress, done: int, total: int) -> None:
    progress(f"checking leaves, {done} of {total}", done / max(total, 1))


def _in_balls(document: certificates.Document, model: str | None) -> tuple[int, str]:
    """The number of leaves verified in ball arithmetic, also in words."""
    try:
        balls = certificates.check_sample(document, model=model).leaves
    except ImportError as missing:
        return 0, f"none in ball arithmetic: {missing}"
    return balls, f"{balls} of them again in ball arithmetic"
