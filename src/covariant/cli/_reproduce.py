"""`covariant reproduce`: the papers' examples."""

import json
from pathlib import Path
from typing import Any

from covariant.cli._console import stages
from covariant.cli._job import check_output

PAPERS = ("aghannan-rouchon",)


def reproduce(paper: str, out: Path | None, report: Path | None, as_json: bool) -> None:
    """Compute, print and draw a paper's numbers."""
    from covariant.papers import aghannan_rouchon as paper_room

    if paper not in PAPERS:
        raise ValueError(f"unknown paper {paper!r}; choose one of {', '.join(PAPERS)}")
    check_output(report, ".html")
    check_output(out, ".png")
    with stages("reproducing", paper_room.STAGES, quiet=as_json) as begin:
        results = paper_room.reproduce(begin)
        written: list[Path] = []
        if out is not None or report is not None:
            begin("drawing")
            stem = out or report.with_suffix(".png")  # pyright: ignore[reportOptionalMemberAccess]
            panels = paper_room.draw_figure4(paper_room.figure4_runs(), stem)
            errors = paper_room.draw_errors(stem.with_stem(f"{stem.stem}_errors"))
            written += [panels, errors]
            if report is not None:
                written.append(paper_room.write_page(results, (errors, panels), report))
    results["wrote"] = [str(path) for path in written]
    print(json.dumps(results) if as_json else _text(results, paper_room))


def _text(results: dict[str, Any], paper_room: Any) -> str:
    from covariant.report import table

    tutorial = results["tutorial"]
    lines = [
        "Figure 4, ball and beam: |(q̂ − q, v̂ − v)|",
        table(paper_room.error_rows(results["fig4"])),
        "The same with high-frequency noise on the measurements",
        table(paper_room.error_rows(results["fig4_noise"])),
        "Error left at t = 40 s, by the initial error as a multiple of that of figure 4",
        table(paper_room.basin_rows(results["basin"])),
        f"Tutorial: in the charts q and r the exact observer agrees to {max(tutorial['geodesic_difference']):.1e}, the"
        f" approximate one differs with slope {tutorial['intrinsic_slope']:.2f} in the initial error",
    ]
    return "\n".join([*lines, *(f"wrote {path}" for path in results["wrote"])])
