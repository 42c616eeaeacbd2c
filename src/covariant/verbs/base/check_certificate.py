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
    """Verify a saved certificate: all leaves of its proofs.

    A certificate that is not verified gives a result with the reason, where `certificates.check` raises an exception.
    `model` runs code of the person who checks, and never code from the file.

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
    content = read_file(path)  # only once, so that both kinds of certificates are read from the same content
    counted = functools.partial(_leaves, progress)
    try:
        checked = certificates.check_globally(path, content, model=model, progress=counted)
        if checked is None:
            document = certificates.parse(path, content)
            processes = int(above_zero("processes", processes))
            checked = certificates.check(document, model=model, processes=processes, progress=counted)
    except InputError as refusal:
        return CertificateCheckResult(path, model, None, str(refusal))
    return CertificateCheckResult(path, model, checked)


@dataclass(frozen=True, repr=False)
class CertificateCheckResult(AbstractResult):
    """Whether a saved certificate is verified.

    Attributes:
        path: The file.
        model: The `module:attribute` that was given for its model, or None.
        checked: What was verified; None where the certificate is refused.
        reason: Why the certificate is refused; empty where it is verified.

    Example:
        >>> from covariant import verbs
        >>> verbs.CertificateCheckResult("top.json", None, None, "its digest does not fit")
        <CertificateCheckResult: top.json: refused>
    """

    path: Path
    model: str | None
    checked: certificates.Checked | None
    reason: str = ""

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
            return {"verified": False, "reason": self.reason}
        assumed = [each.text for each in self.checked.statement.hypotheses if each.evidence == "assumed"]
        details = {"model": self.model, "assumed": assumed}
        return {"verified": True, **self.checked._asdict(), "statement": self.checked.statement.document(), **details}

    def __str__(self) -> str:
        details = self.checked
        if details is None:
            return f"Refused: {self.reason}"
        lines = [f"Verified: {details.leaves} leaves in {details.seconds:.1f} s."]
        if details.model_given:
            given = f"The model is {self.model}, given by the person who checks"
            lines.append(f"{given}; that the file means this one is not verified.")
        return "\n".join([*lines, str(details.statement)])


def _leaves(progress: Progress, done: int, total: int) -> None:
    progress(f"checking leaves, {done} of {total}", done / max(total, 1))
