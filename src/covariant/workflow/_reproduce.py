"""`reproduce_paper`: the numbers and figures of the papers."""

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from covariant.workflow._outputs import check_output
from covariant.workflow._progress import Progress, silent
from covariant.workflow._result import AbstractResult

PAPERS = {
    "aghannan-rouchon": "aghannan_rouchon",
    "maithripala": "maithripala",
    "sanfelice-praly": "sanfelice_praly",
    "jouffroy-fossen": "jouffroy_fossen",
}
"""The module of each paper, with `STAGES`, `reproduce`, `draw`, `summary` and `write_page`."""


def reproduce_paper(paper: str, *, progress: Progress = silent) -> "ReproduceResult":
    """Compute the numbers of a paper.

    Args:
        paper: "aghannan-rouchon", "maithripala", "sanfelice-praly" or "jouffroy-fossen".
        progress: Called at the beginning of each step, with the fraction of the steps that are done.

    Returns:
        All numbers that are reproduced; `result.draw(path)` and `result.report(path)` draw them.

    Raises:
        ValueError: For another paper.

    Example:
        >>> from covariant import workflow
        >>> result = workflow.reproduce_paper("maithripala")
        >>> round(result.summary["top"]["rate"], 3)
        1.127
    """
    if paper not in PAPERS:
        raise ValueError(f"unknown paper {paper!r}; choose one of {', '.join(PAPERS)}")
    progress("reading the paper's models", 0.0)
    module = importlib.import_module(f"covariant.papers.{PAPERS[paper]}")
    begun = 0

    def begin(step: str) -> None:
        nonlocal begun
        progress(f"{step} ({begun + 1} of {module.STAGES})", begun / module.STAGES)
        begun += 1

    return ReproduceResult(paper, module.reproduce(begin), module)


@dataclass(frozen=True, repr=False)
class ReproduceResult(AbstractResult):
    """The numbers of a paper.

    Attributes:
        paper: Name of the paper.
        results: The numbers by what they are of.
        module: The module of the paper.
    """

    paper: str
    results: dict[str, Any]
    module: Any

    @property
    def headline(self) -> str:
        return f"{self.paper}: {len(self.results) - 1} groups of numbers in {self.results['seconds']} s"

    @property
    def summary(self) -> dict[str, Any]:
        return self.results

    def __str__(self) -> str:
        from covariant.report import table

        parts = self.module.summary(self.results)
        return "\n".join(part if isinstance(part, str) else table(part) for part in parts)

    def draw(self, path: str | Path) -> list[Path]:
        """Draw the paper's figures (.png), the second with a longer name; returns their paths."""
        path = Path(path)
        check_output(path, ".png")
        return list(self.module.draw(path))

    def report(self, path: str | Path) -> list[Path]:
        """Write a page (.html), and its figures beside it; returns all paths."""
        path = Path(path)
        check_output(path, ".html")
        figures = self.draw(path.with_suffix(".png"))
        return [*figures, self.module.write_page(self.results, tuple(figures), path)]
