"""A suspicion about a log or its model, and the one test that judges suspicions against each other.

A suspicion says what the log or the model would be if it were so. What the model then leaves of the accelerations is
compared with what it leaves as they are: of `BLOCKS` blocks of time two in three choose among suspicions, and the third
ones judge the one that was chosen.
"""

from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from covariant.calibration.diagnosis._case import Case, Residual, compared, smoothed_residual
from covariant.calibration.diagnosis._finding import Finding
from covariant.calibration.diagnosis._thresholds import THRESHOLDS

BLOCKS = 30
HELD_OUT = np.arange(BLOCKS) % 3 == 2
"""Blocks of time that judge a suspicion; the others choose it."""
EVIDENCE = 4.0
"""Least evidence of a suspicion, in standard errors, where blocks of time are shorter than a motion."""
FLOOR = 0.1
"""Fraction of the noise below which nothing shows of what a model leaves."""


class Unexplained(NamedTuple):
    """What a model leaves of a log in blocks of time, as fractions of the squares of its accelerations.

    Attributes:
        blocks: Fractions (b, n) in each block, without the noise.
        noise: Fraction (n,) that is noise.
        known: Which coordinates (n,) exceed their noise.
        motions: Number of independent parts (n,) of the motion, of which a short log has few; None if blocks are such.
    """

    blocks: Float[np.ndarray, "b n"]
    noise: Float[np.ndarray, "n"]
    known: Bool[np.ndarray, "n"]
    motions: Float[np.ndarray, "n"] | None = None

    @classmethod
    def of(cls, residual: Residual) -> "Unexplained":
        """Those of residual accelerations."""
        return cls(residual.misfits(BLOCKS), residual.noise**2 / residual.scale, residual.told)

    def share(self, blocks: Bool[np.ndarray, "b"], known: Bool[np.ndarray, "n"]) -> float:
        """Mean over some blocks and coordinates; by chance it may be negative."""
        return float(self.blocks[blocks][:, known].mean())

    @property
    def most(self) -> float:
        """Largest of the coordinates, with the noise in which it may hide."""
        return float(np.max(self.blocks.mean(axis=0) + self.noise))


class Comparison(NamedTuple):
    """What the model leaves if a suspicion is right, and as the log is, on the blocks that choose and those held out.

    Attributes:
        choosing: Fraction that is left on the blocks that choose; by chance it may be negative.
        before, after: Fractions on the blocks held out, as the log is and if it were so; `before` is NaN where the
            log as it is lasts too short a time.
        sure: Standard errors of the signed ranks of the falls in all blocks.
        parts: Number of blocks in which less is left.
        floor: Fraction below which nothing shows for the noise.
        evidence: Standard errors that the fall itself is worth, by as many independent parts as the log has.
    """

    choosing: float
    before: float
    after: float
    sure: float
    parts: int
    floor: float
    evidence: float = np.inf

    @classmethod
    def of(cls, now: Unexplained | None, then: Unexplained) -> "Comparison":
        """Compare what is left as the log is with what is left if it were so."""
        known = then.known
        choosing, after = then.share(~HELD_OUT, known), then.share(HELD_OUT, known)
        if now is None:
            floor = FLOOR * float(then.noise[known].mean())
            return cls(choosing, float("nan"), max(after, floor), np.inf, 0, floor)
        # One floor for both, so that neither is the lesser by its noise.
        floor = FLOOR * max(float(each.noise[known].mean()) for each in (now, then))
        before, after = max(now.share(HELD_OUT, known), floor), max(after, floor)
        falls = (now.blocks - then.blocks)[:, known].mean(axis=1)
        parts = int((falls > 0).sum())
        return cls(choosing, before, after, signed_ranks(falls), parts, floor, _evidence(now, then, before / after))

    def passes(self, threshold: str) -> bool:
        """Whether it explains as much as a threshold of the table asks for."""
        limit = THRESHOLDS[threshold]
        far_less = not self.before <= limit.least and not self.after >= limit.falls * self.before
        sure = self.sure >= limit.sure and self.evidence >= EVIDENCE
        return far_less and self.after < limit.most and sure


class Suspicion(NamedTuple):
    """What may be wrong with a log or with the model for it.

    Attributes:
        what: Name of the finding, as "sign of a position".
        where: Column concerned, or "".
        words: How the evidence describes the log if it is so, as "q1 with the other sign".
        remedy: What to write into the model file, or to do with the log.
        apply: Function from a case to the case as it would be if it were so.
        threshold: Name of its threshold in `THRESHOLDS`.
        claim: Sentence before the evidence, for a suspicion with numbers.
        numbers: These numbers.
        expected: Share that the regression leaves which gave these numbers, to order suspicions before they are tried.
    """

    what: str
    where: str
    words: str
    remedy: str
    apply: Callable[[Case], Case]
    threshold: str = "columns"
    claim: str = ""
    numbers: Mapping[str, Any] = MappingProxyType({})
    expected: float = float("nan")

    def finding(self, comparison: Comparison, rivals: Iterable[str] = (), subject: str = "accelerations") -> Finding:
        """The finding on a suspicion that was accepted; `rivals` explain as much."""
        before, after = _percent(comparison.before), _percent(comparison.after)
        evidence = f"on rows held out the model leaves {before} of the squares of the {subject} as the log is, and "
        evidence += f"{after} {self.words}, less in {comparison.parts} of {BLOCKS} parts of the log"
        if not np.isfinite(comparison.before):
            evidence = f"as the log is, it lasts too short a time to compare {subject}; of their squares the model "
            evidence += f"leaves {after} {self.words}"
        if self.claim:
            evidence = f"{self.claim}; {evidence}" if comparison.after < comparison.before else self.claim
        if others := ", or ".join(rivals):
            evidence += f"; the log cannot tell it from {others}"
        shares = {"unexplained": comparison.before, "unexplained_after": comparison.after, "parts": comparison.parts}
        return Finding(self.what, self.where, evidence, self.remedy, True, {**self.numbers, **shares})


def blocks_of(count: int) -> np.ndarray:
    """The block of each of some rows in order."""
    return np.repeat(np.arange(BLOCKS), [len(part) for part in np.array_split(np.arange(count), BLOCKS)])


def judge(
    case: Case,
    suspicions: Iterable[Suspicion],
    compare: Callable[[Case], Unexplained | None],
    subject: str = "accelerations",
) -> tuple[Suspicion, Finding] | None:
    """The suspicion that explains a case best, with the finding on it; None where none passes its threshold."""
    return choose(compare_all(case, suspicions, compare), subject)


def compare_all(
    case: Case, suspicions: Iterable[Suspicion], compare: Callable[[Case], Unexplained | None]
) -> list[tuple[Suspicion, Comparison]]:
    """Each suspicion that may be right, with what it explains."""
    now, tried = compare(case), []
    for each in suspicions:
        limit = THRESHOLDS[each.threshold]
        if now is not None and now.known.any() and now.share(np.ones(BLOCKS, bool), now.known) < limit.least:
            continue
        then = compare(each.apply(case))
        if then is not None and then.known.any():
            tried.append((each, Comparison.of(now, then)))
    return tried


def choose(
    tried: Iterable[tuple[Suspicion, Comparison]], subject: str = "accelerations"
) -> tuple[Suspicion, Finding] | None:
    """The first of the suspicions that explain about as much as the best one; None where it fails its threshold."""
    tried = [(each, comparison) for each, comparison in tried if comparison.choosing < THRESHOLDS[each.threshold].most]
    if not tried:
        return None
    least = min(comparison.choosing for _, comparison in tried)
    alike = [(each, one) for each, one in tried if one.choosing <= _alike(each, one, least)]
    chosen, comparison = alike[0]
    if not comparison.passes(chosen.threshold):
        return None
    # A suspicion of another kind that explains as much contains this one, and is no rival.
    others = (each for each, _ in alike[1:] if each.threshold == chosen.threshold and each.words != chosen.words)
    rivals = [each.words.removeprefix("with ") for each in others]
    return chosen, chosen.finding(comparison, rivals, subject)


def _alike(suspicion: Suspicion, comparison: Comparison, least: float) -> float:
    """Largest share with which a suspicion explains as much as the best one, whose share may be negative by chance."""
    limit = THRESHOLDS[suspicion.threshold]
    floor = comparison.floor if limit.alike > 1 else least
    return max(least + (limit.alike - 1) * abs(least), floor, limit.rest * (comparison.before - least))


def clearly_unexplained(case: Case) -> Unexplained | None:
    """What the model leaves, in the narrowest windows whose accelerations exceed the noise."""
    left = compared(case)
    return Unexplained.of(left) if left is not None and left.enough else None


def unexplained_at(half: float) -> Callable[[Case], Unexplained | None]:
    """Function from a case to what its model leaves in windows of ±`half` [s]."""

    def compare(case: Case) -> Unexplained | None:
        left = smoothed_residual(case, half)
        return Unexplained.of(left) if left.enough else None

    return compare


def signed_ranks(falls: Float[np.ndarray, "b"]) -> float:
    """Wilcoxon's statistic of differences, as a standard normal: how surely their middle is above zero."""
    count = len(falls)
    # Ranks from 1 to b: the position of each in the order of sizes; equal sizes have probability zero.
    ranks = np.argsort(np.argsort(np.abs(falls))) + 1.0
    # Under symmetry about zero the variance of the sum is b (b + 1) (2b + 1) / 6.
    return float(np.sum(ranks * np.sign(falls)) / np.sqrt(count * (count + 1) * (2 * count + 1) / 6))


def _evidence(now: Unexplained, then: Unexplained, ratio: float) -> float:
    """Root of the deviance n log(before / after) of n independent errors, as standard errors.

    Errors of a model go on as long as a motion does, so n is no more than the number of motions; and it is no more than
    the number of blocks over which the fall is spread.
    """
    if now.motions is None:
        return np.inf
    falls = (now.blocks - then.blocks) * then.known
    i = int(np.argmax(falls.sum(axis=0)))
    # Kish 1965, Survey sampling, eq. 11.2.6: the number of equal parts that are worth as much as unequal ones.
    spread = max(float(falls[:, i].sum()), 0.0) ** 2 / max(float(np.sum(falls[:, i] ** 2)), 1e-300)
    return float(np.sqrt(max(min(spread, now.motions[i]) * np.log(ratio), 0.0)))


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %"
