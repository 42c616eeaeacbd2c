"""What a certificate says."""

from typing import Literal, NamedTuple


class Certificate(NamedTuple):
    """A statement, whether it was found to hold, and what that rests on.

    - `verdict`: "holds", "fails" (then `point` is a counter-example) or "undecided".
    - `margin`: the number that decides, with its meaning and unit in `statement`.
    - `domain`: where the statement is about.
    - `evidence`: "sampled" (at points, between which nothing is known), "bounded", "proved", or "claimed" by a
      file that was read and not verified again.
    - `point`: the state where the margin is least.
    """

    statement: str
    verdict: Literal["holds", "fails", "undecided"]
    margin: float
    domain: str
    evidence: Literal["sampled", "bounded", "proved", "claimed"]
    point: tuple[float, ...]
