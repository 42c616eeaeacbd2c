"""The common form of certificates."""

from typing import Literal, NamedTuple


class Certificate(NamedTuple):
    """A statement, whether it holds, and the evidence for it.

    - `verdict`: "holds", "fails" (then `point` is a counter-example) or "undecided".
    - `margin`: the number that decides; `statement` gives its meaning and unit.
    - `domain`: the states that the statement is about.
    - `evidence`: "sampled" (at points, between which nothing is known), "bounded", "proved", or "claimed" by a
      file that was read and not verified again.
    - `point`: the state at which the margin is least.
    """

    statement: str
    verdict: Literal["holds", "fails", "undecided"]
    margin: float
    domain: str
    evidence: Literal["sampled", "bounded", "proved", "claimed"]
    point: tuple[float, ...]
