"""Missing, late and coarse samples: the observer coasts on its model, and says so.

The encoder of a double pendulum is coarse, its stamps jitter, one reading in a hundred is lost, and at 2 s the cable is
loose for 0.3 s. The observer knows a model whose masses are off by two per cent. Where a sample is missing its step
only predicts, so the velocities carry on, drifting apart slowly as the model is not the machine; the first readings
after the gap bring them back. The filter without a model holds what it saw last, and misses a whole turn when readings
return. Every step has a result code: 0 is good, 1 says that the step coasted.

Figure: within the gap of 0.3 s the observer is at most 0.57 rad/s off, the filtered derivative 17 rad/s.
"""

from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from covariant import calibration, models, simulation
from covariant.observers import FilteredDerivative, Intrinsic, run
from covariant.report import PALETTE, new_figure, save_figure
from covariant.signals import Record, StepCode

FIGURE = Path(__file__).parent / "out" / "05_missing_samples.png"

geometry = {"length": (0.3, 0.25), "com": (0.16, 0.14), "inertia": (0.005, 0.0026), "viscous": (0.02, 0.01)}
machine = models.pendulum_chain(mass=(0.6, 0.4), **geometry)
model = models.pendulum_chain(mass=(0.612, 0.392), **geometry)

sensor = simulation.PositionSensor(rate=500.0, quantum=2 * np.pi / 2048, jitter=2e-4, dropout=0.01)
t = simulation.stamps(sensor, duration=4.0)
amplitude, pace = jnp.array([0.9, 0.3]), jnp.array([4.0, 7.0])
motion = eqx.filter_jit(simulation.simulate)(
    machine, jnp.array([0.5, -0.5, 0.0, 0.0]), jnp.asarray(t), lambda s, x: amplitude * jnp.sin(pace * s)
)
q, v = np.split(np.asarray(motion.x), 2, axis=1)
y = simulation.sense(sensor, q)
y[(t > 2.0) & (t < 2.3)] = np.nan
record = Record(t, np.asarray(motion.u), y)

sheet = calibration.DataSheet(sensor.quantum / 12**0.5, acceleration_std=1.5, correlation_time=0.02, motion_std=75.0)
gains = calibration.observer_gains(sheet, sensor.rate)
observers = {
    "intrinsic": Intrinsic(model, gains.alpha, gains.beta),
    "filtered derivative": FilteredDerivative(calibration.filter_bandwidth(sheet, sensor.rate), model.circles),
}
runs = {name: run(observer, record) for name, observer in observers.items()}

codes = np.asarray(runs["intrinsic"].info.result)
for code in StepCode:
    if count := int((codes == code).sum()):
        print(f"{count} of {len(codes)} samples: {code.message}")

titles = ("Velocity of the second joint", "Error of the velocity", "Result code of the intrinsic observer")
figure, axes = new_figure(3, 1, panel=(8.0, 2.0), titles=titles, sharex=True)
velocity, error, result = axes[:, 0]
for ax in axes[:, 0]:
    ax.axvspan(2.0, 2.3, color=PALETTE.shade, zorder=0)
velocity.plot(t, v[:, 1], color=PALETTE.truth, linewidth=3.5, label="true")
for color, (name, done) in zip((PALETTE.covariant, PALETTE.filter), runs.items(), strict=True):
    estimate = np.asarray(done.estimate)[:, 3]
    velocity.plot(t, estimate, color, label=name)
    error.plot(t, estimate - v[:, 1], color, label=name)
    gap = (t > 2.0) & (t < 2.3)
    print(f"{name}: at most {np.abs(estimate - v[:, 1])[gap].max():.2g} rad/s off within the gap")
result.plot(t, codes, "|", color=PALETTE.covariant)
velocity.set(xlim=(1.5, 3.0), ylabel="dq₂/dt [rad/s]")
error.set(ylabel="estimate − truth [rad/s]", ylim=(-3, 3))
result.set(ylim=(-0.5, 1.5), yticks=(0, 1), yticklabels=("0: ok", "1: coasted"), xlabel="t [s]")
velocity.legend(loc="upper right")
velocity.annotate("no readings", (2.15, -25), ha="center", color=PALETTE.text)
FIGURE.parent.mkdir(exist_ok=True)
save_figure(figure, FIGURE)
