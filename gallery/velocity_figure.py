"""The figure of the README: the velocity of the elbow by an observer, beside a filtered derivative and the truth.

The machine and its log are those of `demo.py`: MuJoCo swings a double pendulum, and its encoders are read about 500
times a second in whole counts. `covariant.compare` tunes all estimators, and nothing here tunes them further: the
observer has the gains that follow from the data sheet, with no search on the log; the derivative has the cut-off
frequency that gave the smallest error on the first third of this very log, the truth being known. What is shown lies
behind that third. Errors in the legend are root mean squares over the whole log after its start, as `compare` prints
them.

    python gallery/velocity_figure.py      # writes docs/images/velocity.png
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from demo import MODEL, ROOT, record, write

import covariant
from covariant.report import PALETTE, new_figure, save_figure

FIGURE = ROOT / "docs" / "images" / "velocity.png"
JOINT = 1
START, LENGTH = 6.2, 1.0
"""Window that is shown [s]."""
CURVES = (
    ("filtered-derivative", "filtered derivative", PALETTE[4], 1.8),
    ("intrinsic", "intrinsic observer", PALETTE[0], 3.0),
)
"""Name in the comparison, label, colour and width [points] of each curve."""


def main() -> None:
    """Make the log, run the estimators, draw."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log.csv"
        write(record(), log)
        result = covariant.compare(ROOT / MODEL, log, columns={"truth": "true_v1,true_v2"})
    reference = result.loaded.reference
    assert reference is not None  # the log has the true velocities
    t = np.asarray(result.loaded.record.t)
    shown = (t >= START) & (t <= START + LENGTH)
    t, truth = t[shown], reference.v[shown, JOINT]
    figure, axes = new_figure(2, 1, panel=(8.0, 2.9))
    above, below = axes[:, 0]
    for name, label, color, width in CURVES:
        outcome = result.outcomes[name]
        estimate = outcome.velocity[shown, JOINT]
        above.plot(t, estimate, color=color, linewidth=width, label=label)
        below.plot(
            t, estimate - truth, color=color, linewidth=width, label=f"RMSE {outcome.score.rmse[JOINT]:.2g} rad/s"
        )
    above.plot(t, truth, color="0.1", linewidth=1.6, linestyle=(0, (4, 4)), label="truth")
    above.set_ylabel("velocity [rad/s]")
    below.set(xlabel="time [s]", ylabel="error [rad/s]", xlim=(START, START + LENGTH))
    for ax in (above, below):
        ax.tick_params(labelsize=15)
        ax.xaxis.label.set_fontsize(17)
        ax.yaxis.label.set_fontsize(17)
        ax.legend(loc="upper left", fontsize=15, frameon=False, ncols=1 if ax is above else 2)
    low, high = below.get_ylim()
    below.set_ylim(low, high + 0.35 * (high - low))  # the legend stands above the curves
    figure.align_ylabels()
    path = save_figure(figure, Path(sys.argv[1]) if len(sys.argv) > 1 else FIGURE)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
