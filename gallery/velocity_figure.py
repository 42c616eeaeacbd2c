"""The figure of the README: the velocity of the elbow from the readings alone, by a filter, and by an observer.

The machine and its log are those of `demo.py`: MuJoCo swings a double pendulum, and its encoders are read about 500
times a second in whole counts. `covariant.compare` tunes all estimators, and nothing here tunes them further: the
observer has the gains that follow from the data sheet, with no search on the log; of the filters without a model, each
at the setting that gave its smallest error on the first third of this log, the one with the smallest error is drawn.
What is shown lies behind that third. The legend has the root mean square of the error over the whole log after its
start, as `compare` prints it.

    python gallery/velocity_figure.py      # writes docs/images/velocity.png
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from demo import MODEL, ROOT, record, write

import covariant
from covariant import scoring
from covariant.report import PALETTE, new_figure, save_figure

FIGURE = ROOT / "docs" / "images" / "velocity.png"
JOINT = 1
START, LENGTH = 6.2, 0.6
"""Window of the errors [s]."""
CLOSER = (6.24, 6.34)
"""Window of the velocities [s], short enough to tell the curves apart."""
FILTERS = ("filtered-derivative", "levant", "joint-kalman", "high-gain")


def main() -> None:
    """Make the log, run the estimators, draw."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log.csv"
        write(record(), log)
        result = covariant.compare(ROOT / MODEL, log, columns={"truth": "true_v1,true_v2"})
    reference = result.loaded.reference
    assert reference is not None  # the log has the true velocities
    t, y = np.asarray(result.loaded.record.t), np.asarray(result.loaded.record.y)[:, JOINT]
    errors = {name: float(outcome.score.rmse[JOINT]) for name, outcome in result.outcomes.items()}
    print({name: round(error, 4) for name, error in errors.items()})
    best = min((name for name in FILTERS if name in errors), key=errors.__getitem__)
    turn = (np.diff(y) + np.pi) % (2 * np.pi) - np.pi  # the encoder begins anew after a turn
    raw = np.append(np.nan, turn / np.diff(t))
    scored = scoring.scored_window(t) & np.isfinite(raw)
    raw_error = np.sqrt(np.mean((raw - reference.v[:, JOINT])[scored] ** 2))
    curves = {
        f"difference of two readings: {raw_error:.2g} rad/s": (raw, PALETTE.amber, 0.9),
        f"best filter without a model ({best}): {errors[best]:.2g} rad/s": (
            result.outcomes[best].velocity[:, JOINT],
            PALETTE.filter,
            1.8,
        ),
        f"covariant, from the same readings: {errors['intrinsic']:.2g} rad/s": (
            result.outcomes["intrinsic"].velocity[:, JOINT],
            PALETTE.covariant,
            1.8,
        ),
    }
    shown = (t >= START) & (t <= START + LENGTH)
    closer = (t >= CLOSER[0]) & (t <= CLOSER[1])
    titles = ("Velocity of the elbow, a tenth of a second [rad/s]", "Error [rad/s]; below, its root mean square")
    figure, axes = new_figure(2, 1, panel=(6.0, 2.4), titles=titles, sharex=False)
    above, below = axes[:, 0]
    above.plot(t[closer], reference.v[closer, JOINT], color=PALETTE.truth, linewidth=6.0, label="truth")
    for label, (velocity, color, width) in curves.items():
        above.plot(t[closer], velocity[closer], color=color, linewidth=width)
        below.plot(t[shown], (velocity - reference.v[:, JOINT])[shown], color=color, linewidth=width, label=label)
    largest = np.abs(result.outcomes[best].velocity[:, JOINT] - reference.v[:, JOINT])[shown].max()
    above.set(xlim=CLOSER)
    below.set(xlabel="t [s]", xlim=(START, START + LENGTH), ylim=(-1.6 * largest, 1.6 * largest))
    figure.legend(loc="outside lower center", ncols=1, frameon=False)
    path = save_figure(figure, Path(sys.argv[1]) if len(sys.argv) > 1 else FIGURE)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
