"""`covariant reproduce`: the examples of the papers."""

import importlib
import json
from pathlib import Path
from typing import Any

from covariant.cli._console import stages
from covariant.workflow._outputs import check_output

PAPERS = {
    "aghannan-rouchon": "aghannan_rouchon",
    "maithripala": "maithripala",
    "sanfelice-praly": "sanfelice_praly",
    "jouffroy-fossen": "jouffroy_fossen",
}
"""The module of each paper, with `STAGES`, `reproduce`, `draw`, `summary` and `write_page`."""


def reproduce(paper: str, out: Path | None, report: Path | None, as_json: bool) -> None:
    """Compute, print and draw the numbers of a paper."""
    if paper not in PAPERS:
        raise ValueError(f"unknown paper {paper!r}; choose one of {', '.join(PAPERS)}")
    reproduced = importlib.import_module(f"covariant.papers.{PAPERS[paper]}")
    check_output(report, ".html")
    check_output(out, ".png")
    with stages("reproducing", reproduced.STAGES, quiet=as_json) as begin:
        results = reproduced.reproduce(begin)
        written: list[Path] = []
        if out is not None or report is not None:
            begin("drawing")
            figures = reproduced.draw(out or report.with_suffix(".png"))  # pyright: ignore[reportOptionalMemberAccess]
            written += figures
            if report is not None:
                written.append(reproduced.write_page(results, figures, report))
    results["wrote"] = [str(path) for path in written]
    print(json.dumps(results) if as_json else _text(results, reproduced.summary(results)))


def _text(results: dict[str, Any], parts: list[str | list[dict[str, str]]]) -> str:
    from covariant.report import table

    lines = [part if isinstance(part, str) else table(part) for part in parts]
    return "\n".join([*lines, *(f"wrote {path}" for path in results["wrote"])])
