"""What a diagnosis finds."""

from typing import Any, NamedTuple


class Finding(NamedTuple):
    """One thing found in a log.

    - `what`: its name, as "unit of time" or "delay"; `where`: the column it is about, or "".
    - `evidence`: a sentence with the numbers, their units and their uncertainty.
    - `line`: what to write into the model file, or to do with the log; "" where nothing has to change.
    - `wrong`: whether estimates from the log as it is are wrong; False for what is merely worth knowing.
    - `numbers`: the numbers of the evidence by name, in SI units.
    """

    what: str
    where: str
    evidence: str
    line: str
    wrong: bool
    numbers: dict[str, Any]


class Diagnosis(NamedTuple):
    """The findings, and what was looked for: names of findings that the log and model allow to be made."""

    findings: tuple[Finding, ...]
    looked_for: tuple[str, ...]

    @property
    def wrong(self) -> bool:
        """Whether estimates from the log as it is are wrong."""
        return any(finding.wrong for finding in self.findings)
