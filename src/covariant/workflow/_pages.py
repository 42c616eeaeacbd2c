"""The page of estimates on one log."""

from pathlib import Path
from typing import Any

import numpy as np

from covariant import scoring
from covariant.report import EstimateReport
from covariant.workflow._inputs import Loaded, coordinates


def estimate_report(
    title: str, loaded: Loaded, curves: dict[str, Any], notes: tuple[str, ...], rows: tuple = ()
) -> EstimateReport:
    """What the page of some estimates shows.

    Args:
        title: The headline.
        loaded: The model and the log.
        curves: Fields of the report with the curves of each estimator, from `report_curves`.
        notes: Sentences under the title.
        rows: Rows of a comparison, best first.
    """
    names, units = coordinates(loaded.file)
    y = np.asarray(loaded.record.y)
    missing = int(np.isnan(y.reshape(len(y), -1)).any(1).sum())
    drawn = scoring.unwrap(y, loaded.model.circles) if loaded.model.manifold.commuting else None
    if not loaded.file.mechanical:  # the panels are those of the states, and the outputs are others
        drawn, curves = None, {"estimates": curves["estimates"]}
    notes = (
        *notes,
        f"{len(y)} samples at about {loaded.rate:.0f} Hz, {missing} of them coasted without a measurement.",
    )
    report = EstimateReport(
        title=title,
        estimated=loaded.model.sought.what,
        coordinates=names,
        units=units,
        t=np.asarray(loaded.record.t),
        q_measured=drawn,
        rows=rows,
        notes=notes,
        **curves,
    )
    if loaded.reference is not None:
        report = report._replace(v_reference=loaded.reference.v, v_reference_label=loaded.reference.label)
    return report


def write_report(path: Path, report: EstimateReport) -> list[Path]:
    """Write the interactive page, and PNG figures beside it; returns all paths."""
    from covariant.report import write_html, write_png

    return [write_html(report, path), *write_png(report, path.with_suffix(""))]
