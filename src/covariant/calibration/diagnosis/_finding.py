"""Findings of a diagnosis."""

from typing import Any, NamedTuple


class Finding(NamedTuple):
    """A defect or peculiarity of a log.

    Attributes:
        what: Its name, as "unit of time" or "delay".
        where: The column concerned, or "".
        evidence: A sentence with the numbers, their units and their uncertainty.
        line: What to write into the model file, or to do with the log; "" where nothing has to change.
        wrong: Whether estimates from the unchanged log are wrong; False for a note.
        numbers: The numbers of the evidence by name, in SI units.

    Example:
        >>> from covariant.calibration import Finding
        >>> delay = Finding("delay", "q2", "q2 is 10 ms late", "[measurement] delay = 0.01", True, {"delay": 0.01})
        >>> delay.wrong, delay.line
        (True, '[measurement] delay = 0.01')
    """

    what: str
    where: str
    evidence: str
    line: str
    wrong: bool
    numbers: dict[str, Any]


class Diagnosis(NamedTuple):
    """Result of `diagnose`.

    Attributes:
        findings: The findings, the gravest first.
        looked_for: Names of the checks that log and model allow.

    Example:
        >>> from covariant.calibration import Diagnosis, Finding
        >>> note = Finding("missing rows", "", "2 rows are missing in 1 place", "nothing to change", False, {"rows": 2})
        >>> Diagnosis((note,), ("missing rows",)).wrong
        False
    """

    findings: tuple[Finding, ...]
    looked_for: tuple[str, ...]

    @property
    def wrong(self) -> bool:
        """Whether estimates from the unchanged log are wrong."""
        return any(finding.wrong for finding in self.findings)
