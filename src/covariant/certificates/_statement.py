"""The common form of verdicts: a claim in words, the numbers it is about, and the hypotheses it rests on."""

from collections.abc import Iterable
from typing import Any, Literal, NamedTuple

Verdict = Literal["holds", "fails", "undecided"]
Evidence = Literal["proved", "sampled", "claimed", "assumed"]

MEANING: dict[Evidence, str] = {
    "proved": "by arithmetic with outward rounding, everywhere in the domain, or by a condition on numbers",
    "sampled": "at points or along motions that were tried, between which nothing is known",
    "claimed": "by a file that was read and not verified",
    "assumed": "not checked by computation",
}
"""What the words of evidence mean, the strongest first."""


class Hypothesis(NamedTuple):
    """A premise of a claim and what speaks for it.

    - `text`: the premise in words.
    - `evidence`: "proved", "sampled", "claimed" or "assumed", as `MEANING` says.
    - `verdict`: "holds", "fails" (then the claim is refuted) or "undecided". What is assumed is taken to hold.
    - `margin`: by how much, where a number says it.
    - `place`: where the margin is least, or where it fails, in words.
    """

    text: str
    evidence: Evidence
    verdict: Verdict = "holds"
    margin: float | None = None
    place: str = ""

    def __str__(self) -> str:
        word = self.evidence if self.verdict == "holds" else self.verdict
        margin = "" if self.margin is None else f", margin {self.margin:.4g}"
        return f"{word}: {self.text}{margin}{f', at {self.place}' if self.place else ''}"


class Statement(NamedTuple):
    """A claim, the numbers it is about, and its hypotheses, from which verdict and evidence are computed.

    - `claim`: one sentence.
    - `about`: lines with everything that the claim is about: the model and its parameters, gains, region and bounds.
    - `hypotheses`: all premises; the claim is proved where each of them is, but for what is assumed.
    - `margin`: the number that decides; the claim gives its meaning and unit.
    - `domain`: the states that the claim is about.
    - `point`: the state at which the margin is least, or a counter-example; may be empty.

    Example:
        >>> from covariant.certificates import Hypothesis, Statement
        >>> premises = (Hypothesis("M is positive definite", "proved"), Hypothesis("M falls", "sampled"))
        >>> found = Statement("errors vanish", (), premises, 1.0)
        >>> found.verdict, found.evidence
        ('holds', 'sampled')
    """

    claim: str
    about: tuple[str, ...]
    hypotheses: tuple[Hypothesis, ...]
    margin: float
    domain: str = ""
    point: tuple[float, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """What follows from the hypotheses: one that fails refutes the claim, one that is open leaves it open."""
        found = {hypothesis.verdict for hypothesis in self.hypotheses}
        # Without a hypothesis that was looked at there is nothing to stand on.
        looked = any(hypothesis.evidence != "assumed" for hypothesis in self.hypotheses)
        return "fails" if "fails" in found else "holds" if found == {"holds"} and looked else "undecided"

    @property
    def evidence(self) -> Evidence:
        """The weakest evidence of the hypotheses that were looked at; "assumed" where none was."""
        found = {hypothesis.evidence for hypothesis in self.hypotheses}
        weakest_first: tuple[Evidence, ...] = ("claimed", "sampled", "proved")
        for evidence in weakest_first:
            if evidence in found:
                return evidence
        return "assumed"

    @property
    def proved(self) -> bool:
        """Whether the claim holds and every hypothesis that can be checked is proved."""
        return self.verdict == "holds" and self.evidence == "proved"

    @property
    def short(self) -> str:
        """The verdict in words, with its evidence where it holds."""
        return f"holds ({self.evidence})" if self.verdict == "holds" else self.verdict

    def document(self) -> dict[str, Any]:
        """The statement as data for JSON."""
        premises = [hypothesis._asdict() for hypothesis in self.hypotheses]
        return {
            "claim": self.claim,
            "verdict": self.verdict,
            "evidence": self.evidence,
            "about": list(self.about),
            "hypotheses": premises,
        }

    def __str__(self) -> str:
        return "\n".join([f"{self.short}: {self.claim}", *self.about, "hypotheses:", *lines(self.hypotheses)])


def lines(hypotheses: Iterable[Hypothesis]) -> list[str]:
    """One line for each hypothesis."""
    return [f"- {hypothesis}" for hypothesis in hypotheses]
