"""A system that is not mechanical, from its equations to a metric, to observers: the frequency of a pendulum.

A pendulum swings, its encoder is logged, and nobody knows its length. Near the bottom it is the oscillator of unknown
frequency, with position, velocity and ω² as states. `metrics.metric_at` solves the Riccati equation of Sanfelice &
Praly at a state, looking back along the solution as far as it must; at rest the answer is that the state is not
reconstructible. `metrics.metric_on_grid` does so on a grid, into a store that may be larger than memory, and
`metrics.load_metric` makes a function of the store. The observer takes the metric from either. Beside it runs an
extended Kalman filter with the same noise densities, which is as good here, and a high-gain observer, which breaks down
where the angle passes zero: the acceleration there tells nothing of the frequency. The verdict says what is promised:
convergence from nearby only.
"""

import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from covariant import certificates, metrics, models, simulation
from covariant.observers import InformationEKF, Riccati, run
from covariant.report import PALETTE, new_figure, save_figure
from covariant.signals import Record, StepCode

OUT = Path(__file__).parent / "out"
FIGURE, STORE = OUT / "09_frequency_of_a_pendulum.png", OUT / "09_metric.zarr"
OUT.mkdir(exist_ok=True)

# The log of a real pendulum: not quite linear, a little damped, angles counted in steps of the encoder.
encoder = simulation.PositionSensor(rate=1000.0, quantum=2 * np.pi / 40_000)
pendulum = models.pendulum_chain(mass=(0.15,), length=(0.15,), viscous=(1e-5,))
truth = 9.81 / 0.15
t = simulation.stamps(encoder, duration=4.0)
motion = simulation.simulate(pendulum, jnp.array([-0.066, 0.0]), jnp.asarray(t))
record = Record(t, np.zeros((len(t), 0)), simulation.sense(encoder, np.asarray(motion.y)))

# What is measured, and what the model does not know: accelerations of 0.02 rad/s² for 50 ms, a slow drift of ω².
model = models.unknown_frequency()
noise = jnp.array([[encoder.quantum**2 / 12 / encoder.rate]])
process = jnp.diag(jnp.array([1e-12, 2 * 0.02**2 * 0.05, 1.0]))
equation = metrics.Equation(process_cov=process, measurement_cov=noise)

metric_at = jax.jit(lambda x: metrics.metric_at(model, equation, x, tolerance=1e-4, start=1e-6))
for x in ([-0.066, 0.0, truth], [0.0, 0.0, truth]):
    found = metric_at(jnp.array(x))
    print(f"at {np.round(x, 3)}: past of {found.horizon:.2f} s, {StepCode(int(found.result)).message}")

# The metric on a grid, and as a function.
grid = metrics.Grid(model.coordinates, model.units, (-0.08, -0.64, 30.0), (0.08, 0.64, 90.0), (17, 17, 5))
shutil.rmtree(STORE, ignore_errors=True)  # a finished store would be kept as it is
metrics.metric_on_grid(model, equation, grid, STORE, tolerance=1e-3, start=1e-6, name="unknown_frequency")
field = metrics.load_metric(STORE)
along = metrics.RiccatiMetric(model, equation, length=1.5, steps=150, start=1e-6)
ring = np.array([[0.066 * np.cos(a), 0.53 * np.sin(a), truth] for a in np.linspace(0, 2 * np.pi, 9)[:-1]])
print(certificates.observability(model, field, ring).verdict)

start = jnp.array([record.y[0, 0], 0.0, 40.0])
known = jnp.diag(1 / jnp.array([encoder.quantum, 0.5, 40.0]) ** 2)
observers = {
    "Riccati, metric computed along": Riccati(model, along, start, 0.5, noise),
    "Riccati, metric looked up": Riccati(model, field, start, 0.5, noise),
    "extended Kalman filter": InformationEKF(model, equation, start, known),
    "high gain": Riccati(model, metrics.high_gain(model, 8.0), start, 0.5),
}
COLORS = dict(zip(observers, (PALETTE.sky, PALETTE.covariant, PALETTE.ekf, PALETTE.purple), strict=True))
figure, axes = new_figure(1, 2, panel=(4.5, 3.4), titles=("How well ω² can be known", "ω² from the encoder"))
for name, observer in reversed(observers.items()):  # the last hides the others least
    done = run(observer, record)
    squared = np.asarray(done.estimate)[:, 2]
    late = squared[t > 3]
    kept = np.abs(late - truth).max() < truth
    print(
        f"{name}: " + (f"ω² = {late.mean():.2f} ± {late.std():.2f} 1/s² in the last second" if kept else "broke down")
    )
    label = f"{name}: {late.mean():.1f} ± {late.std():.1f}" if kept else f"{name}: lost"
    axes[0, 1].plot(t, squared, color=COLORS[name], label=label, linewidth=3.0 if "along" in name else 1.0)
axes[0, 1].axhline(truth, color=PALETTE.text, linestyle=":", label=f"g / length = {truth:.1f} 1/s²")
axes[0, 1].set_ylim(30, 130)
axes[0, 1].set_xlabel("t [s]")
axes[0, 1].set_ylabel("ω² [1/s²]")
axes[0, 1].legend(loc="upper left")

slice_ = metrics.open_grid(STORE).metric.sel(x3=truth, method="nearest").values
missing = np.isnan(slice_).any(axis=(-2, -1))
inverse = np.linalg.inv(np.where(missing[..., None, None], np.eye(3), slice_))
std = np.where(missing, np.nan, np.sqrt(inverse[..., 2, 2]))
ax = axes[0, 0]
shown = ax.pcolormesh(*grid.axes[:2], std.T, cmap="viridis_r", norm="log", shading="nearest")
figure.colorbar(
    shown, ax=ax, label="standard deviation of ω² [1/s²]", location="bottom", ticks=[1, 2, 5, 10, 20, 50], format="%g"
)
ax.plot(*np.asarray(motion.x).T, color="w", linewidth=0.6)
ax.annotate(
    "at rest: not reconstructible", (0.0, 0.0), (-0.07, -0.58), color="w", arrowprops={"arrowstyle": "->", "color": "w"}
)
ax.set_xlabel("angle [rad]")
ax.set_ylabel("velocity [rad/s]")
save_figure(figure, FIGURE)
