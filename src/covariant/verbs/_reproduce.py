"""`reproduce_paper`: the numbers and figures of the papers."""

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from covariant._names import refuse_unknown
from covariant.verbs.base.outputs import check_output
from covariant.verbs.base.progress import Progress, notebook_line
from covariant.verbs.base.result import AbstractResult

PAPERS = {
    "aghannan-rouchon": "aghannan_rouchon",
    "maithripala": "maithripala",
    "sanfelice-praly": "sanfelice_praly",
    "jouffroy-fossen": "jouffroy_fossen",
}
"""The module of each paper, with `STAGES`, `TITLE`, `reproduce`, `draw`, `summary` and `page`."""


def reproduce_paper(paper: str, *, progress: Progress = notebook_line) -> "ReproduceResult":
    """Reproduce the numbers of a paper.

    Args:
        paper: "aghannan-rouchon", "maithripala", "sanfelice-praly" or "jouffroy-fossen".
        progress: Called at the beginning of each step, with the fraction of the steps that are done.

    Returns:
        All numbers that are reproduced; `result.draw(path)` and `result.report(path)` draw them.

    Raises:
        ValueError: For another paper.

    Example:
        >>> from covariant import verbs
        >>> verbs.reproduce_paper("kalman")
        Traceback (most recent call last):
            ...
        scalargraph.errors.InputError: unknown paper 'kalman'. Known: aghannan-rouchon, maithripala, ...
    """
    refuse_unknown("paper", paper, PAPERS)
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
    """Reproduced numbers of a paper.

    Attributes:
        paper: Name of the paper.
        results: The numbers in groups, by name of the group, and the time "seconds" [s] that they took.
        module: The module of `covariant.papers` that computed them.

    Example:
        >>> from covariant.verbs._reproduce import ReproduceResult
        >>> result = ReproduceResult("maithripala", {"top": {"rate": 1.127}, "seconds": 14.0}, module=None)
        >>> result
        <ReproduceResult: maithripala: 1 groups of numbers in 14.0 s>
        >>> result.summary["top"]["rate"]
        1.127
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

        return "\n".join(part if isinstance(part, str) else table(part) for part in self.module.summary(self.results))

    def draw(self, path: str | Path) -> list[Path]:
        """Draw the paper's figures.

        Args:
            path: The file of the first figure (.png); further ones have longer names beside it.

        Returns:
            The paths of all figures.

        Raises:
            ValueError: For another suffix, or a folder that does not exist.
            ImportError: Without matplotlib.
        """
        path = Path(path)
        check_output(path, ".png")
        return list(self.module.draw(path))

    def _write_page(self, path: Path) -> list[Path]:
        from covariant.report import write_article

        figures = self.draw(path.with_suffix(".png"))
        return [*figures, write_article(self.module.TITLE, self.module.page(self.results, tuple(figures)), path)]
