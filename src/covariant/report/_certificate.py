"""Draws a certificate: its region, the proved tube, and the convergence of estimates."""

import textwrap
from typing import TYPE_CHECKING

import numpy as np

from covariant.certificates import (
    ContractionCertificate,
    Projection,
    Trajectories,
    projection,
    trajectories,
)
from covariant.report._optional import optional
from covariant.report._style import INK, MUTED, PALETTE, new_figure
from scalargraph.errors import InputError

if TYPE_CHECKING:
    import matplotlib.axes
    import matplotlib.figure

_PROVED = _ESTIMATE = PALETTE.covariant
_TUBE, _WRONG, _OPEN = PALETTE.sky, PALETTE.purple, PALETTE.amber
_WORDS = {
    "estimate": "estimate of {}",
    "velocity": "estimated velocity {}",
    "error": "position error {}",
    "force": "force {}",
}
_MOST_RECTANGLES = 20_000


def certificate_figure(certificate: ContractionCertificate) -> "matplotlib.figure.Figure":
    """Draw a certificate: its region, the proved tube, and the convergence of estimates.

    There are three panels: the region with its boxes; a motion with the proved tube and estimates that begin on its
    border; and their distances below the certified line. Without a proof, the second and third panels say so.

    Args:
        certificate: The certificate, such as that of a `covariant.verbs.CertifyResult`.

    Returns:
        The figure; `save_figure` writes it.

    Raises:
        ImportError: matplotlib is not installed.

    Example:
        >>> import covariant
        >>> from covariant.report import certificate_figure
        >>> bounds = {"velocity": 1.0, "error": 0.1, "region": {"q": (-1.0, 1.0)}}
        >>> result = covariant.certify("oscillator", alpha=10.0, beta=50.0, rate=1.0, checker="off", **bounds)
        >>> len(certificate_figure(result.certificate).axes)
        3
    """
    titles = "Where it is proved", "The tube around a simulated motion", "Distance of estimates from the motion"
    figure, axes = new_figure(3, 1, panel=(9.0, 3.0), titles=titles, sharex=False)
    region, tube, distances = axes[:, 0]
    _draw_region(region, projection(certificate), certificate)
    try:
        motion = trajectories(certificate)
    except InputError as error:
        for ax in (tube, distances):
            _write_message(ax, str(error))
    else:
        (_draw_velocity if _on_group(certificate) else _draw_tube)(tube, motion, certificate)
        _draw_distances(distances, motion, certificate)
    lines = textwrap.wrap(_title(certificate), 95)
    figure.suptitle("\n".join(lines), x=0.012, ha="left", fontsize=10, fontweight="bold", color=INK)
    figure.set_figheight(figure.get_figheight() + 0.19 * len(lines))
    return figure


def _title(certificate: ContractionCertificate) -> str:
    verdict = {"holds": "Proved", "fails": "Wrong", "undecided": "Not decided"}[certificate.statement.verdict]
    statement = certificate.statement.claim
    return f"{verdict}: {statement}"


def _on_group(certificate: ContractionCertificate) -> bool:
    return not certificate.observer.model.manifold.commuting


def _label(kind: str, name: str, unit: str) -> str:
    return _WORDS[kind].format(name) + (f" [{unit}]" if unit else "")


def _names(certificate: ContractionCertificate) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units of the coordinates; on a group, of the velocities."""
    n = len(certificate.velocity)
    return certificate.domain.names[:n], certificate.domain.units[:n]


def _write_message(ax: "matplotlib.axes.Axes", text: str) -> None:
    ax.grid(visible=False)
    ax.set_xticks([])
    ax.set_yticks([])
    ax.text(0.5, 0.5, textwrap.fill(text, 50), transform=ax.transAxes, ha="center", va="center", color=MUTED)


def _legend(ax: "matplotlib.axes.Axes", **options) -> None:
    ax.legend(**{"fontsize": 8, "labelcolor": INK, "framealpha": 0.85, "edgecolor": "none"} | options)


def _draw_region(ax: "matplotlib.axes.Axes", projected: Projection, certificate: ContractionCertificate) -> None:
    collection = optional("matplotlib.collections").PolyCollection
    proved = projected.proved, _PROVED, 0.18, "boxes proved"
    undecided = projected.open, _OPEN, 0.55, "boxes not decided"
    for order, (boxes, colour, fill, label) in enumerate((proved, undecided), start=1):
        if len(boxes):
            shown = boxes[:_MOST_RECTANGLES]
            (left, bottom), (right, top) = shown[:, 0].T, shown[:, 1].T
            corners = np.stack([left, bottom, right, bottom, right, top, left, top], axis=1).reshape(-1, 4, 2)
            # Boxes that differ only in other variables overlap in the figure, so fills are drawn before all edges.
            thinned = _mix_with_white(colour, fill)
            ax.add_collection(collection(list(corners), facecolor=thinned, edgecolor="none", zorder=order))
            ax.add_collection(collection(list(corners), facecolor="none", edgecolor=colour, linewidth=0.6, zorder=3))
            ax.plot([], [], "s", color=thinned, markeredgecolor=colour, markersize=8, label=label)
    if projected.counterexample is not None:
        ax.plot(
            *projected.counterexample,
            "X",
            color=_WRONG,
            markersize=10,
            zorder=4,
            label="counter-example",
            clip_on=False,
        )
    low, high = projected.domain
    margin = 0.03 * (high - low)
    ax.set_xlim(low[0] - margin[0], high[0] + margin[0])
    ax.set_ylim(low[1] - margin[1], high[1] + 5 * margin[1])  # the legend stands above the region
    ax.set_xlabel(_label(projected.kind[0], projected.names[0], projected.units[0]))
    ax.set_ylabel(_label(projected.kind[1], projected.names[1], projected.units[1]))
    ax.grid(visible=False)
    claim = next((c for c in certificate.claims if c.proof.verdict != "holds"), certificate.claims[0])
    share = claim.proof.open_share if claim.proof.verdict == "undecided" else 0.0
    others = len(claim.proof.box.low) - 2
    caption = f"{projected.claim}, {claim.proof.boxes} boxes, seen along {others} more variables"
    ax.set_xlabel(ax.get_xlabel() + "\n" + caption + (f"; {share:.1%} open" if share else ""))
    if len(projected.proved) or len(projected.open):
        _legend(ax, loc="upper right", ncols=3)


def _mix_with_white(colour: str, share: float) -> tuple[float, float, float]:
    """A colour mixed with white; it is opaque, so that overlapping boxes look like one."""
    rgb = optional("matplotlib.colors").to_rgb(colour)
    return tuple(1 - share * (1 - part) for part in rgb)  # pyright: ignore[reportReturnType]


def _draw_tube(ax: "matplotlib.axes.Axes", motion: Trajectories, certificate: ContractionCertificate) -> None:
    i, n = motion.shown, motion.positions.shape[1]
    names, units = _names(certificate)
    x, y = motion.positions[:, i], motion.velocities[:, i]
    half = motion.half_widths[[i, i + n]]
    # The tube is drawn as rectangles; 16 between two samples overlap to a band without visible steps.
    dense = np.linspace(0, len(x) - 1, 16 * len(x))
    steps = np.arange(len(x))
    middles = np.stack([np.interp(dense, steps, x), np.interp(dense, steps, y)], axis=1)
    around = middles[:, None] + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    patches = optional("matplotlib.collections").PolyCollection
    tube = _mix_with_white(_TUBE, 0.35)
    of = f" {units[i]}" if units[i] else ""
    ax.add_collection(patches(list(around), facecolor=tube, edgecolor="none", zorder=1))
    ax.plot([], [], "s", color=tube, markersize=9, label=f"proved tube, ± {half[0]:.2g}{of} and ± {half[1]:.2g}{of}/s")
    ax.plot(x, y, color=INK, linewidth=1.6, zorder=4, label="motion of the model")
    for k in range(len(motion.estimated_positions)):
        q, v = motion.estimated_positions[k, :, i], motion.estimated_velocities[k, :, i]
        _draw_estimate(ax, q, v, k)
        ax.plot(q[0], v[0], ".", color=_ESTIMATE, zorder=5)
    unit = f" [{units[i]}]" if units[i] else ""
    ax.set_xlabel(f"{names[i]}{unit}")
    ax.set_ylabel(f"d{names[i]}/dt" + (f" [{units[i]}/s]" if units[i] else " [1/s]"))
    ax.autoscale_view()
    _legend(ax, loc="best")


def _draw_velocity(ax: "matplotlib.axes.Axes", motion: Trajectories, certificate: ContractionCertificate) -> None:
    i, n = motion.shown, motion.positions.shape[1]
    names, units = _names(certificate)
    v, half = motion.velocities[:, i], motion.half_widths[i + n]
    tube = _mix_with_white(_TUBE, 0.35)
    label = f"proved tube, ± {half:.2g} {units[i]}"
    ax.fill_between(motion.t, v - half, v + half, color=tube, linewidth=0, label=label, zorder=1)
    ax.plot(motion.t, v, color=INK, linewidth=1.6, label="motion of the model", zorder=4)
    for k, estimated in enumerate(motion.estimated_velocities[:, :, i]):
        _draw_estimate(ax, motion.t, estimated, k)
    ax.set_xlabel("t [s]")
    ax.set_ylabel(f"{names[i]} [{units[i]}]" if units[i] else names[i])
    _legend(ax, loc="best")


def _draw_estimate(ax: "matplotlib.axes.Axes", x: np.ndarray, y: np.ndarray, k: int) -> None:
    label = None if k else "estimates from its border"
    ax.plot(x, y, color=_ESTIMATE, linewidth=0.9, zorder=3, label=label)


def _draw_distances(ax: "matplotlib.axes.Axes", motion: Trajectories, certificate: ContractionCertificate) -> None:
    distances = motion.distances
    smallest = distances.high[:, 0].max() * 1e-4
    for k, curves in enumerate(zip(distances.high, distances.low, strict=True)):
        sides = zip(curves, (_ESTIMATE, INK), ("-", (0, (2, 5))), ("above", "below"), strict=True)
        for distance, colour, dash, where in sides:
            ax.plot(
                distances.t,
                np.where(distance > smallest, distance, np.nan),
                color=colour,
                linestyle=dash,
                linewidth=1.3,
                zorder=2 + (where == "below"),
                label=None if k else f"estimates, bounded from {where}",
            )
    label = f"proved: {certificate.radius:.2g} exp(−λt/2), λ/2 = {certificate.decay:.3g} 1/s"
    ax.plot(distances.t, distances.bound[0], color=_WRONG, linewidth=2, zorder=4, label=label)
    ax.set_yscale("log")  # an exponential decay is a straight line
    ax.set_ylim(smallest, 2 * certificate.radius)
    ax.set_xlabel("t [s]")
    ax.set_ylabel("distance in the metric of Q")
    _legend(ax, loc="lower left")
