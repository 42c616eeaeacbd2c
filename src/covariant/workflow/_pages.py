"""The page of estimates on one log."""

import abc
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from covariant.report import EstimateReport, write_report as write_page_and_figures
from covariant.workflow._inputs import Loaded
from covariant.workflow._outputs import check_output
from covariant.workflow._recording import write_recording
from covariant.workflow._result import AbstractTable

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def estimate_report(
    title: str,
    loaded: Loaded,
    curves: dict[str, Any],
    notes: tuple[str, ...],
    rows: tuple = (),
    headline: str = "",
    warnings: tuple[str, ...] = (),
) -> EstimateReport:
    """Collect what a page of estimates shows."""
    kind, y = loaded.kind, np.asarray(loaded.record.y)
    missing = int(np.isnan(y.reshape(len(y), -1)).any(1).sum())
    notes = (
        *notes,
        f"{len(y)} samples at about {loaded.rate:.0f} Hz, {missing} of them coasted without a measurement.",
    )
    report = EstimateReport(
        title=title,
        estimated=kind.what,
        coordinates=kind.axes.names,
        units=kind.axes.units,
        t=np.asarray(loaded.record.t),
        q_measured=kind.drawn(y),
        rows=rows,
        notes=notes,
        headline=headline,
        warnings=warnings,
        **(curves if kind.draws_innovations else {"estimates": curves["estimates"]}),
    )
    if loaded.reference is not None:
        report = report._replace(v_reference=loaded.reference.v, v_reference_label=loaded.reference.label)
    return report


def write_report(path: Path, report: EstimateReport) -> list[Path]:
    """Write an interactive page, and PNG figures beside it, all or none.

    Args:
        path: The page to write (.html).
        report: What it shows.

    Returns:
        The paths of all files, the page first.
    """
    return write_page_and_figures(report, path)


class AbstractEstimates(AbstractTable):
    """Table of estimates, which is drawn on one page."""

    def rerun(self, path: str | Path) -> Path:
        """Write a recording for the Rerun viewer: measured and estimated curves, bands of ±2σ, forces, and the robot.

        The timeline `t` is that of the log [s]. Curves have every row; the bodies of a robot move at most 50 times a
        second.

        Args:
            path: The recording to write (.rrd), whole or not at all.

        Returns:
            The path.

        Raises:
            ValueError: For another suffix, or a folder that does not exist.
            ImportError: Without Rerun, `pip install 'covariant[live]'`.
        """
        path = Path(path)
        check_output(path, ".rrd")
        write_recording(path, self._page().title, self.columns, self._estimated)
        return path

    @property
    @abc.abstractmethod
    def _estimated(self) -> Any:
        """The `EstimateResult` whose measurements, results and configurations are drawn."""

    def _write_page(self, path: Path) -> list[Path]:
        return write_report(path, self._page())

    def _figure(self) -> "Figure":
        from covariant.report import figure

        return figure(self._page())

    @abc.abstractmethod
    def _page(self) -> Any:
        """What the page and the figures show."""
