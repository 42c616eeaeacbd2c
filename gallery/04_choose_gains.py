"""Gains from data-sheet numbers: what the design rule predicts, and what simulation says.

Low gains trust the model, and what the model does not know pulls the estimate away; high gains trust the encoder, and
its steps get through. `calibration.gains` finds the bandwidth between the two and predicts the velocity error that is
left. Here a double pendulum swings for a minute with random accelerations that no observer knows, encoders round its
angles, and observers with an eighth to eight times the designed bandwidth ω estimate its velocities (α = 2ζω, β = ω²).
The prediction holds to 15 % for all of them, although the inertia of the pendulum changes all the time, and the design
sits at the minimum.

Figure: 0.018 rad/s are predicted for the designed gains, 0.017 rad/s found in simulation.
"""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from covariant import calibration, models
from covariant.observers import Intrinsic
from covariant.report import PALETTE, new_figure, save_figure

FIGURE = Path(__file__).parent / "out" / "04_choose_gains.png"

RATE, QUANTUM = 500.0, 2 * np.pi / 4096
"""Samples a second [Hz] and encoder step [rad]."""
UNKNOWN = 3.0
"""Standard deviation of the accelerations that the model does not know [rad/s²], new at each sample."""
SAMPLES, SETTLED, RUNS = 2500, 1000, 12
INSIDE = 4
"""Simulation steps a sample."""

model = models.pendulum_chain(mass=(0.6, 0.4), length=(0.3, 0.25), com=(0.16, 0.14), inertia=(0.005, 0.0026))
chosen = calibration.gains(QUANTUM / 12**0.5, RATE, UNKNOWN)
S_m, S_a = (QUANTUM**2 / 12) / RATE, UNKNOWN**2 / RATE  # densities of the two noises
relative = np.geomspace(1 / 8, 8, 13)
alphas, betas = chosen.alpha * relative, chosen.beta * relative**2
no_torque = jnp.zeros(2)


@jax.vmap
def swing(key):
    """True states (SAMPLES, 4) of one run: the midpoint rule, with a random kick at each step."""
    first, second = jax.random.split(key)
    start = jax.random.uniform(first, (4,), minval=-1, maxval=1) * jnp.array([2.0, 2.0, 5.0, 5.0])
    h = 1 / (INSIDE * RATE)

    def step(x, kick):
        def rate(x):
            return jnp.concatenate([x[2:], models.acceleration(model, 0.0, x[:2], x[2:], no_torque)])

        x = x + h * rate(x + h / 2 * rate(x)) + (S_a * h) ** 0.5 * jnp.concatenate([jnp.zeros(2), kick])
        return x, x

    kicks = jax.random.normal(second, (SAMPLES * INSIDE, 2))
    return jax.lax.scan(step, start, kicks)[1][::INSIDE]


def velocity_error(x, alpha, beta):
    """Root mean square error of the velocities that one observer finds from one run, once settled."""
    observer = Intrinsic(model, alpha, beta, substeps=1)
    y = jnp.round(x[:, :2] / QUANTUM) * QUANTUM
    start = observer.init(y[0])._replace(v=x[0, 2:])

    def step(state, reading):
        state, _ = observer.step(state, no_torque, reading, jnp.asarray(1 / RATE))
        return state, state.v

    v = jax.lax.scan(step, start, y[1:])[1]
    return jnp.mean((v - x[1:, 2:])[SETTLED:] ** 2)


@eqx.filter_jit
def monte_carlo(x):
    """Root mean square velocity error for each pair of gains, over all runs."""
    of_gains = jax.vmap(velocity_error, (None, 0, 0))
    return jnp.sqrt(jnp.mean(jax.vmap(of_gains, (0, None, None))(x, jnp.asarray(alphas), jnp.asarray(betas)), axis=0))


found = np.asarray(monte_carlo(jax.jit(swing)(jax.random.split(jax.random.key(0), RUNS))))
print(chosen.summary)
print(f"found in simulation with the designed gains: {found[len(found) // 2]:.2g} rad/s")

omega = np.sqrt(chosen.beta) * np.geomspace(1 / 8, 8, 100)


def predicted(measurement_density, acceleration_density):
    """Velocity error that the theory predicts for every bandwidth ω."""
    densities = (measurement_density, acceleration_density)
    return [calibration.predict_errors(2**0.5 * w, w**2, *densities).velocity_std for w in omega]


figure, axes = new_figure(panel=(7.0, 3.8), titles=("Velocity error by the bandwidth of the observer",))
ax = axes[0, 0]
ax.loglog(omega, predicted(S_m, S_a), label="predicted")
ax.loglog(omega, predicted(S_m, 0.0), color=PALETTE.purple, linestyle="--", label="its part from the encoder steps")
ax.loglog(
    omega, predicted(0.0, S_a), color=PALETTE.sky, linestyle="--", label="its part from the unknown accelerations"
)
ax.loglog(np.sqrt(betas), found, "ko", markersize=4.5, label="found in simulation")
ax.axvline(np.sqrt(chosen.beta), color=PALETTE.text, linestyle=":")
ax.annotate("designed", (np.sqrt(chosen.beta), 0.0035), xytext=(4, 0), textcoords="offset points", color=PALETTE.text)
ax.set(xlabel="bandwidth ω [rad/s]", ylabel="rms velocity error [rad/s]", ylim=(0.003, 0.4))
ax.legend(loc="upper center")
FIGURE.parent.mkdir(exist_ok=True)
save_figure(figure, FIGURE)
