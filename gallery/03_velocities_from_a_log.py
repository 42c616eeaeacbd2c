"""Using the library by hand: from a log to velocities, and the loop that does it written out.

A double pendulum with motors is logged: stamps, torques, and the angles its encoders report. `logs.read` makes a record
of the file, `calibration.gains` turns data-sheet numbers into gains, `run` drives the observer along the record, and
`scoring.rmse` says how good the velocities are. The last lines do the work of `run` step by step, as a controller would
in real time, and find the same estimates.

Figure: the observer is 0.0051 rad/s off in the second joint (RMSE), the difference of two readings 0.63 rad/s.
"""

from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from covariant import calibration, logs, models, scoring, simulation
from covariant.observers import Intrinsic, run
from covariant.report import PALETTE, new_figure, save_figure

OUT = Path(__file__).parent / "out"
FIGURE, LOG = OUT / "03_velocities_from_a_log.png", OUT / "03_log.csv"
OUT.mkdir(exist_ok=True)

model = models.pendulum_chain(
    mass=(0.6, 0.4), length=(0.3, 0.25), com=(0.16, 0.14), inertia=(0.005, 0.0026), viscous=(0.02, 0.01)
)

# A log, as a machine would write it: 1000 readings a second of encoders with 4096 counts a turn.
encoder = simulation.PositionSensor(rate=1000.0, quantum=2 * np.pi / 4096)
t = jnp.asarray(simulation.stamps(encoder, duration=5.0))
amplitude, pace = jnp.array([0.9, 0.3]), jnp.array([4.0, 7.0])
motion = eqx.filter_jit(simulation.simulate)(
    model, jnp.array([0.5, -0.5, 0.0, 0.0]), t, lambda s, x: amplitude * jnp.sin(pace * s)
)
q, v = np.split(np.asarray(motion.x), 2, axis=1)
y, u = simulation.sense(encoder, q), np.asarray(motion.u)
columns = ("t", "q1", "q2", "tau1", "tau2", "true_v1", "true_v2")
logs.write(LOG, dict(zip(columns, np.column_stack([t, y, u, v]).T, strict=True)))

# From the log to velocities.
log = logs.read(LOG, logs.Columns(t="t", q=("q1", "q2"), u=("tau1", "tau2"), truth=("true_v1", "true_v2")))
chosen = calibration.gains(measurement_std=encoder.quantum / 12**0.5, rate=encoder.rate, acceleration_std=1.0)
observer = Intrinsic(model, chosen.alpha, chosen.beta)
done = run(observer, log.record)
velocities = np.asarray(done.estimate)[:, 2:]
scored = scoring.scored_window(log.record.t)
error = scoring.rmse(velocities[scored], log.truth[scored])
print(chosen.summary)
print(f"velocity RMSE: {error[0]:.4f} and {error[1]:.4f} rad/s")

# The same by hand: a state that you keep, one step a sample.
step = eqx.filter_jit(observer.step)
t, u, y, _ = log.record
state = observer.init(jnp.asarray(y[0]), t[0])
by_hand = [observer.estimate(state)]
for k in range(1, len(t)):
    state, info = step(state, u[k - 1], y[k], t[k] - t[k - 1])  # u[k − 1] acted since the previous stamp
    by_hand.append(observer.estimate(state))
difference = np.abs(np.stack(by_hand) - np.asarray(done.estimate)).max()
print(f"the loop by hand differs from run by {difference:.1e}")
assert difference < 1e-9

titles = (
    "Velocity of the second joint",
    "The same, a closer look",
    "Error of the estimate",
    "Error of the differences",
)
figure, axes = new_figure(2, 2, panel=(4.5, 2.6), titles=titles, sharex=False)
whole, close, off, coarse = axes.flat
raw = np.diff(y[:, 1], prepend=y[0, 1]) / np.diff(t, prepend=t[0] - 1e-3)
for ax in (whole, close):
    ax.plot(t, raw, color=PALETTE.amber, linewidth=0.8, label="difference of the readings")
    ax.plot(t, log.truth[:, 1], color=PALETTE.truth, linewidth=4, label="true")
    ax.plot(t, velocities[:, 1], color=PALETTE.covariant, label="intrinsic observer")
    ax.set(ylabel="dq₂/dt [rad/s]")
close.set(xlim=(3.6, 4.05), ylim=(6.5, 12.5))
off.plot(t, (velocities - log.truth)[:, 1], color=PALETTE.covariant, label=f"RMSE {error[1]:.2g} rad/s")
coarse_error = np.sqrt(np.mean((raw - log.truth[:, 1])[scored] ** 2))
print(f"differences of the readings: {coarse_error:.2g} rad/s")
coarse.plot(t, raw - log.truth[:, 1], color=PALETTE.amber, linewidth=0.8, label=f"RMSE {coarse_error:.2g} rad/s")
off.set(ylabel="estimate − truth [rad/s]", ylim=(-0.03, 0.03))
coarse.set(ylim=(-3, 3))
for ax in (off, coarse):
    ax.set(xlabel="t [s]")
    ax.legend(loc="upper right")
whole.legend(loc="lower left", ncols=3)
save_figure(figure, FIGURE)
