"""`covariant reproduce`: the papers' examples."""

import json
from pathlib import Path
from typing import Any

from covariant.cli._console import stages

PAPERS = ("aghannan-rouchon",)


def reproduce(paper: str, out: Path | None, report: Path | None, as_json: bool) -> None:
    """Compute, print and draw a paper's numbers."""
    from covariant.papers import aghannan_rouchon

    if paper not in PAPERS:
        raise ValueError(f"unknown paper {paper!r}; choose one of {', '.join(PAPERS)}")
    if report is not None and report.suffix != ".html":
        raise ValueError(f"{report}: a report is an .html file")
    with stages("reproducing", aghannan_rouchon.STAGES, quiet=as_json) as begin:
        results = aghannan_rouchon.reproduce(begin)
        written: list[Path] = []
        if out is not None or report is not None:
            begin("figure 4")
            runs = aghannan_rouchon.figure4_runs()
            figure = out or report.with_suffix(".png")  # pyright: ignore[reportOptionalMemberAccess]
            written.append(aghannan_rouchon.draw_figure4(runs, figure))
            if report is not None:
                written.append(aghannan_rouchon.write_page(results, runs, figure, report))
    results["wrote"] = [str(path) for path in written]
    print(json.dumps(results) if as_json else _text(results))


def _text(results: dict[str, Any]) -> str:
    from covariant.report import table

    def rows(key: str) -> list[dict[str, str | float]]:
        return [
            {"observer": name}
            | {f"t = {t:g} s": "escaped" if e is None else f"{e:.4g}" for t, e in zip(*run.values(), strict=True)}
            for name, run in results[key].items()
        ]

    basin, tutorial = results["basin"], results["tutorial"]
    lines = [
        "Figure 4, ball and beam: |(q̂ − q, v̂ − v)|",
        table(rows("fig4")),
        "",
        "The same with high-frequency noise on the measurements",
        table(rows("fig4_noise")),
        "",
        "Error at t = 40 s by size of the initial error, as a multiple of that of figure 4",
        table(
            [
                {"observer": name}
                | {
                    f"{s:g}×": "escaped" if e is None else f"{e:.2g}"
                    for s, e in zip(basin["scale"], basin[name], strict=True)
                }
                for name in ("exact", "approximate")
            ]
        ),
        "",
        f"Tutorial: the exact observer agrees in the charts q and r to {max(tutorial['geodesic_difference']):.1e};"
        f" the approximate one differs with slope {tutorial['intrinsic_slope']:.2f} in the error",
    ]
    return "\n".join([*lines, *(f"wrote {path}" for path in results["wrote"])])
