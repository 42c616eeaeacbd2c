"""A leg that lands: the velocity against the ground is lost at once, and the estimate has to lose it too.

A leg of two links hops over level ground, with its joints and the place of its hip measured a thousand times a second.
The log tells when its foot is on the ground. An observer that is given the contacts takes the jump of each touch-down;
the same observer without them, and a difference of positions, do not know of it. The masses of the model are five per
cent wrong.
"""

from pathlib import Path

import jax.numpy as jnp
import numpy as np

from covariant import engine, models, observers
from covariant.report import PALETTE, new_figure, save_figure
from covariant.signals import Record
from covariant.simulation import simulate_contacts

FIGURE = Path(__file__).parent / "out" / "19_a_leg_that_lands.png"
NOISE = 1e-4

leg = models.hopping_leg()


def torques(t, motion, down):
    """Springs towards one posture in the air, and towards a longer one on the ground, which pushes off."""
    posture = jnp.where(down[0], jnp.array([0.4, -0.8]), jnp.array([0.6, -1.2]))
    return jnp.where(down[0], 100.0, 30.0) * (posture - motion.q[2:]) - motion.v[2:]


start = models.Motion(jnp.array([0.0, 0.62, 0.6, -1.2]), jnp.array([0.3, 0.0, 0.0, 0.0]))
truth = simulate_contacts(leg, start, jnp.arange(0.0, 2.0, 1e-3), torques)
t, u, v = np.asarray(truth.t), np.asarray(truth.u), np.asarray(truth.x)[:, 4:]
y = np.asarray(truth.y) + NOISE * np.random.default_rng(0).normal(size=truth.y.shape)
record = Record(t, u, y)

heavier = models.hopping_leg(body=4.2, mass=(0.95, 0.42))
observer = observers.Intrinsic(heavier, 60.0, 1800.0, substeps=1)
rivals = {f"difference, {w:g} rad/s": observers.FilteredDerivative(w) for w in (100.0, 200.0, 400.0, 800.0)}
variants = {"with contacts": observers.Contacts(observer), "without contacts": observer}
estimates = {
    name: np.asarray(engine.run_log(each, record)[0].estimate)[:, 4:] for name, each in (variants | rivals).items()
}
late = t > 0.3
errors = {name: np.sqrt(np.mean((each - v)[late] ** 2, axis=0)) for name, each in estimates.items()}
for name, error in errors.items():
    print(f"{name}: RMSE of the hip's velocity {np.hypot(*error[:2]):.3f} m/s, of the knee's rate {error[3]:.2f} rad/s")

best = min(rivals, key=lambda name: errors[name][3])
shown = (t > 0.45) & (t < 1.3)
titles = ("Rate of the knee", "Size of its error")
figure, axes = new_figure(2, 1, panel=(8.0, 2.6), titles=titles, sharex=True)
rate, error = axes[:, 0]
rate.plot(t[shown], v[shown, 3], color=PALETTE.truth, linewidth=2.5, label="true")
lines = ((best, PALETTE.filter), ("without contacts", PALETTE.ekf), ("with contacts", PALETTE.covariant))
for name, color in lines:
    if name != "without contacts":
        rate.plot(t[shown], estimates[name][shown, 3], color=color, linewidth=1.0, label=name)
    error.semilogy(t[shown], np.abs(estimates[name] - v)[shown, 3], color=color, linewidth=1.0, label=name)
for ax in (rate, error):
    ax.fill_between(
        t[shown],
        -100.0 if ax is rate else 1e-3,
        1e4,
        where=u[shown, 2] > 0,
        color=PALETTE.truth,
        alpha=0.12,
        linewidth=0,
        label="on the ground",
    )
rate.set(ylabel="[rad/s]", ylim=(-13.0, 19.0))
error.set(ylabel="[rad/s]", xlabel="t [s]", ylim=(1e-3, 1e4))
rate.legend(loc="upper right", ncols=3)
error.legend(loc="upper right", ncols=3)
FIGURE.parent.mkdir(exist_ok=True)
save_figure(figure, FIGURE)
