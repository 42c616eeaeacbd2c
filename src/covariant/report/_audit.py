"""Figure and page of an audit: every law of an observer on one page."""

import math
import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from covariant.certificates.audit import Audit, Law
from covariant.report._article import write_article
from covariant.report._style import GRID, INK, MUTED, PALETTE, figure_format, new_figure, save_figure

if TYPE_CHECKING:
    import matplotlib.axes
    import matplotlib.figure

_HOLDS, _FAILS = PALETTE[:2]
_LOW, _LEAST, _MOST, _HIGH = 1e-19, 1e-18, 1e2, 1e3
"""Ends of the axis, and the range drawn to scale: deviations outside it are drawn at its ends, NaN at the upper one."""

_INTRODUCTION = (
    "Every law is measured at random states, from the observer's own equations and the model's own geometry, in a way "
    "that does not use what it checks. Deviations are relative to the terms of the law. Between the states nothing is "
    "proved."
)


def draw_audit(audit: Audit, path: str | os.PathLike[str]) -> Path:
    """Draw the figure of an audit into a file.

    Args:
        audit: The audit, such as the `audit` of a `covariant.workflow.AuditResult`.
        path: The file; its suffix is the format, such as .png, .pdf or .svg.

    Returns:
        The path.

    Raises:
        ValueError: For a suffix that is no format.
        ImportError: Without matplotlib.

    Example:
        >>> from covariant import workflow
        >>> from covariant.report import draw_audit
        >>> draw_audit(workflow.audit_observer("oscillator", points=2).audit, "audit.png").name
        'audit.png'
    """
    figure_format(path)
    return save_figure(audit_figure(audit), path)


def audit_figure(audit: Audit) -> "matplotlib.figure.Figure":
    """Draw the deviations of an audit against their tolerances, on a logarithmic axis.

    Args:
        audit: The audit, such as the `audit` of a `covariant.workflow.AuditResult`.

    Returns:
        The figure, one line for each law.

    Raises:
        ImportError: Without matplotlib.

    Example:
        >>> from covariant import workflow
        >>> from covariant.report import audit_figure
        >>> audit = workflow.audit_observer("oscillator", points=2).audit
        >>> len(audit_figure(audit).axes[0].get_yticks()) == len(audit.rows)
        True
    """
    figure, axes = new_figure(panel=(10.8, 0.36 * len(audit.rows) + 0.5))
    ax = axes[0, 0]
    ax.set_xscale("log")
    ax.set_xlim(_LOW, _HIGH)
    ax.set_ylim(len(audit.rows) - 0.5, -0.5)
    for line, row in enumerate(audit.rows):
        _draw(ax, line, row)
    ax.set_xticks(10.0 ** np.arange(-16, 1, 4))
    ax.set_yticks(np.arange(len(audit.rows)), [row.statement for row in audit.rows], fontsize=8.5)
    ax.tick_params(axis="y", length=0)
    ax.grid(axis="y", visible=False)
    ax.set_xlabel("largest relative deviation, in the bar of what it may be")
    color = _HOLDS if audit.passed else _FAILS
    title = f"{audit.observer}: {audit.verdict}"
    figure.suptitle(title, x=0.012, ha="left", fontsize=11, fontweight="bold", color=color)
    return figure


def _draw(ax: "matplotlib.axes.Axes", line: int, row: Law) -> None:
    if row.verdict == "skipped":
        ax.text(_LEAST, line, f"skipped: {row.reason}", va="center", fontsize=8, color=MUTED)
        return
    color = _HOLDS if row.passed else _FAILS
    # The axis is logarithmic and ends at _LOW and _HIGH: an exact 0, an infinity and NaN are drawn at its ends.
    x = _MOST if math.isnan(row.deviation) else min(max(row.deviation, _LEAST), _MOST)
    ax.barh(line, row.tolerance, left=_LOW, height=0.62, color=GRID, zorder=1)
    ax.vlines(row.tolerance, line - 0.31, line + 0.31, color=INK, linewidth=1.2, zorder=2)
    ax.plot(x, line, "o" if row.passed else "X", color=color, markersize=8, zorder=3)
    transform = ax.get_yaxis_transform()  # y in lines of the plot, x in widths of the axes
    ax.text(1.01, line, row.detail, transform=transform, va="center", fontsize=8, color=INK if row.passed else color)


def write_audit(audit: Audit, title: str, path: str | os.PathLike[str]) -> Path:
    """Write an audit as a self-contained HTML page: its figure, a table of the laws, and the reasons of tolerances.

    Args:
        audit: The audit, such as the `audit` of a `covariant.workflow.AuditResult`.
        title: Title, plain text; "passed", "failed" or "undecided" is appended.
        path: The page to write (.html).

    Returns:
        The path.

    Raises:
        ImportError: Without matplotlib.

    Example:
        >>> from covariant import workflow
        >>> from covariant.report import write_audit
        >>> audit = workflow.audit_observer("oscillator", points=2).audit
        >>> write_audit(audit, "Oscillator", "audit.html").name
        'audit.html'
    """
    rows = [
        {
            "law": row.name,
            "verdict": row.verdict,
            "deviation": row.deviation,
            "tolerance": row.tolerance,
            "source": row.source,
            "found": row.remark,
        }
        for row in audit.rows
    ]
    reasons = dict.fromkeys(f"{row.tolerance:g}: {row.reason}." for row in audit.rows if row.verdict != "skipped")
    with tempfile.TemporaryDirectory() as folder:
        figure = draw_audit(audit, Path(folder) / "audit.png")
        blocks = [figure, rows, f"At {audit.domain}. {_INTRODUCTION}", "# Tolerances", *reasons]
        title = f"{title}: {audit.verdict.partition(':')[0]}"
        return write_article(title, blocks, path, headline=f"{audit.observer}: {audit.verdict}.")
