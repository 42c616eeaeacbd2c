"""Draws the figures of the reproduction of Jouffroy & Fossen 2004."""

from pathlib import Path

import numpy as np

from covariant.papers.jouffroy_fossen._odin import PRINTED_K2, RATE, Loop, odin_loop
from covariant.papers.jouffroy_fossen._sea import GAPS, SETTLED, Sea, sea, sea_errors


def draw(path: Path) -> tuple[Path, Path]:
    """Draw ODIN under output feedback with both K2 and, with the suffix `_sea`, three estimators of a ship's velocity.

    Args:
        path: File of the first figure.

    Returns:
        The two paths.
    """
    return draw_odin(odin_loop(), path), draw_sea(sea(), path.with_stem(f"{path.stem}_sea"))


def draw_odin(repaired: Loop, path: Path) -> Path:
    """Draw the errors of ODIN's observer and of its tracking, with K2 repaired and as printed.

    Args:
        repaired: The closed loop with the repaired K2, as from `odin_loop`.
        path: File of the figure.

    Returns:
        The path.
    """
    from covariant.report import PALETTE, new_figure, save_figure

    titles = ("Observer error |x̃| of ODIN", "Tracking error |(η̃, s)|")
    figure, axes = new_figure(1, 2, panel=(4.5, 3.6), titles=titles)
    printed = odin_loop(PRINTED_K2, 12.0)
    for label, color, loop in (
        ("K2 as repaired", PALETTE.covariant, repaired),
        (f"K2 = I − Kp, as printed, run to {printed.t[-1]:g} s", PALETTE.purple, printed),
    ):
        for ax, error in zip(axes[0], (loop.observer, loop.tracking), strict=True):
            ax.semilogy(loop.t, np.where(error > 1e-10, error, np.nan), color=color, label=label)
    t = np.array([0.0, 30.0])
    axes[0, 0].semilogy(t, np.exp(-RATE / 2 * t), ":", color=PALETTE.text, label=f"certified: e^(−{RATE / 2:g} t)")
    for ax in axes[0]:
        ax.set(xlabel="t [s]", xlim=(0.0, 30.0), ylim=(1e-10, 1e2))
    axes[0, 0].set_ylabel("norm [m, rad, m/s, rad/s]")
    axes[0, 0].legend()
    return save_figure(figure, path)


def draw_sea(log: Sea, path: Path) -> Path:
    """Draw the log at sea, and three estimates of the velocity from it.

    Args:
        log: As from `sea`.
        path: File of the figure.

    Returns:
        The path.
    """
    from covariant.report import PALETTE, new_figure, save_figure

    colors = {
        "passive observer": PALETTE.covariant,
        "extended Kalman filter": PALETTE.ekf,
        "filtered derivative": PALETTE.filter,
    }
    t, truth = np.asarray(log.record.t), np.asarray(log.record.x)
    errors = sea_errors(log)
    figure, axes = new_figure(3, 1, panel=(8.4, 2.2), titles=("North", "Surge velocity", "Error of surge velocity"))
    y = np.asarray(log.record.y)[:, 0]
    axes[0, 0].plot(t, y, ".", markersize=1.5, color=PALETTE.truth, label="GNSS, 1 Hz")
    axes[0, 0].plot(t, truth[:, 0], color=PALETTE.text, linewidth=1.0, label="ship without wave motion")
    axes[0, 0].set_ylabel("north [m]")
    axes[1, 0].plot(t, truth[:, 3], color=PALETTE.truth, linewidth=4, label="truth")
    for name, error in reversed(errors.items()):
        size = np.sqrt(np.mean(error[t > SETTLED, 0] ** 2))
        axes[2, 0].plot(t, error[:, 0], linewidth=0.9, color=colors[name], label=f"{name}: {size:.2g} m/s")
        axes[1, 0].plot(t, truth[:, 3] + error[:, 0], linewidth=0.9, color=colors[name], label=name)
    for ax in axes[:, 0]:
        for begin, end in GAPS:
            ax.axvspan(begin, end, color=PALETTE.shade, zorder=0)
    for ax in axes[1:, 0]:
        ax.set_ylabel("[m/s]")
    axes[0, 0].legend(loc="upper left")
    axes[1, 0].legend(loc="upper left", ncols=2)
    axes[2, 0].legend(loc="upper left", ncols=3)
    axes[2, 0].set(xlabel="t [s], no GNSS where grey", ylim=(-0.4, 0.4))
    return save_figure(figure, path)
