"""Defines the common form of verdicts: a claim in words, the data it depends on, and its hypotheses."""

import dataclasses
import math
import typing
from collections.abc import Iterable
from typing import Any, Literal, NamedTuple

import jax

from scalargraph.errors import InputError

Verdict = Literal["holds", "fails", "undecided"]
Evidence = Literal["proved", "sampled", "claimed", "assumed"]


@dataclasses.dataclass(frozen=True)
class Hypothesis:
    """A premise of a claim, with the evidence for it.

    Use it in a `Statement` of your own. "proved" is for premises that arithmetic has shown on the whole domain, and
    "sampled" for those tried at points; an "assumed" premise is never checked, and must be true of the machine.

    Attributes:
        text: the premise in words.
        evidence: "proved": by arithmetic with outward rounding, everywhere in the domain, or by a condition on numbers.
            "sampled": at points or along motions that were tried, between which nothing is known. "claimed": by a file
            that was read and not verified. "assumed": not checked by computation.
        verdict: "holds", "fails" (which refutes the claim) or "undecided". An assumed premise is taken to hold.
        margin: amount by which the premise holds, in the unit of its text; None where no number says it.
        place: where the margin is least, or where the premise fails, in words; may be empty.

    Raises:
        ValueError: The evidence or the verdict is an unknown word, the premise holds with a margin of NaN, or something
            is proved while JAX runs without doubles.

    Example:
        >>> from covariant.certificates import Hypothesis
        >>> print(Hypothesis("V decreases", "sampled", margin=0.25))
        sampled: V decreases, margin 0.25
    """

    text: str
    evidence: Evidence
    verdict: Verdict = "holds"
    margin: float | None = None
    place: str = ""

    def __post_init__(self):
        for field, kind in (("evidence", Evidence), ("verdict", Verdict)):
            # The verdict of a statement is computed from these words, and an unknown one would be ignored.
            if (word := getattr(self, field)) not in (known := typing.get_args(kind)):
                raise InputError(f"Hypothesis: {field} must be one of {', '.join(known)}; got {word!r}")
        if self.evidence == "proved":
            need_doubles("a proof")
        if self.verdict == "holds" and self.margin is not None and math.isnan(self.margin):
            raise InputError(f"Hypothesis: {self.text!r} cannot hold by a margin that is not a number")

    def __str__(self) -> str:
        label = self.evidence if self.verdict == "holds" else self.verdict
        margin = "" if self.margin is None else f", margin {self.margin:.4g}"
        return f"{label}: {self.text}{margin}{f', at {self.place}' if self.place else ''}"


def need_doubles(what: str) -> None:
    """Refuse to prove in single precision, in which traced constants differ from the written ones."""
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise InputError(f"{what} needs doubles, and jax_enable_x64 is off; turn it on before the model is made")


class Statement(NamedTuple):
    """A claim with its hypotheses, from which verdict and evidence are computed.

    Read `short` for the verdict with its evidence, and `hypotheses` for its premises. In programs use `proved`:
    `verdict` alone is also "holds" for claims that were only sampled.

    Attributes:
        claim: one sentence.
        about: lines with everything on which the claim depends: the model and its parameters, gains, region and bounds.
        hypotheses: all premises. The claim is proved if every premise that is not assumed is proved.
        margin: the decisive number; the claim states its meaning and unit.
        domain: the states that the claim covers, as text.
        point: the state with the least margin, or a counterexample; may be empty.

    Example:
        >>> from covariant.certificates import Hypothesis, Statement
        >>> premises = (Hypothesis("M is positive definite", "proved"), Hypothesis("M decreases", "sampled"))
        >>> statement = Statement("errors vanish", (), premises, 1.0)
        >>> statement.verdict, statement.evidence, statement.short
        ('holds', 'sampled', 'holds (sampled)')
    """

    claim: str
    about: tuple[str, ...]
    hypotheses: tuple[Hypothesis, ...]
    margin: float
    domain: str = ""
    point: tuple[float, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """The verdict that follows from the hypotheses.

        Returns:
            "fails" if a hypothesis fails; "holds" if all hold and at least one is more than assumed; else "undecided".
        """
        present = {hypothesis.verdict for hypothesis in self.hypotheses}
        # Assumptions alone support no claim: at least one hypothesis has to be examined.
        examined = any(hypothesis.evidence != "assumed" for hypothesis in self.hypotheses)
        # One failure refutes the claim; one open premise leaves it open.
        return "fails" if "fails" in present else "holds" if present == {"holds"} and examined else "undecided"

    @property
    def evidence(self) -> Evidence:
        """The weakest evidence among the hypotheses that were examined; "assumed" if none was."""
        present = {hypothesis.evidence for hypothesis in self.hypotheses}
        # "assumed" is left out: assumptions are listed with the statement, but do not lower its evidence.
        weakest_first: tuple[Evidence, ...] = ("claimed", "sampled", "proved")
        for evidence in weakest_first:
            if evidence in present:
                return evidence
        return "assumed"

    @property
    def proved(self) -> bool:
        """Whether the claim holds and every hypothesis that can be checked is proved."""
        return self.verdict == "holds" and self.evidence == "proved"

    @property
    def short(self) -> str:
        """The verdict in words, with its evidence if it holds."""
        return f"holds ({self.evidence})" if self.verdict == "holds" else self.verdict

    def document(self) -> dict[str, Any]:
        """Convert the statement to data for JSON.

        Returns:
            The claim, the verdict and its evidence, the lines `about`, and a dictionary of fields for each hypothesis.
        """
        premises = [dataclasses.asdict(hypothesis) for hypothesis in self.hypotheses]
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
    """Format each hypothesis as one line of a list."""
    return [f"- {hypothesis}" for hypothesis in hypotheses]


def exact(value: float) -> str:
    """Return the shortest text that represents exactly this number."""
    return repr(float(value) + 0.0).removesuffix(".0")  # + 0.0 takes the sign from a zero


def rounded_up(value: float) -> str:
    """Round a positive number up to four digits."""
    text = f"{value:.4g}"
    if float(text) >= value:
        return text
    last = math.floor(math.log10(abs(value))) - 3
    return f"{float(text) + 10.0**last:.4g}"


def rounded_down(value: float) -> str:
    """Round a number down to four digits, so that no more is claimed than is proved."""
    text = f"{value:.4g}"
    if float(text) <= value:
        return text
    # `.4g` rounds to nearest; subtracting one unit of the last digit gives a number below the value.
    last = math.floor(math.log10(abs(value))) - 3
    return f"{float(text) - 10.0**last:.4g}"
