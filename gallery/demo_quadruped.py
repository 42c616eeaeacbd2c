"""The twist and the joint rates of a quadruped in free flight, from its pose and its encoders, within their bound.

MuJoCo throws the quadruped that comes along into the air; it tumbles while known torques swing its legs. What is
logged, a thousand times a second, is its pose with the noise of a camera system and its joints with encoders of 2¹⁵
counts a turn. The intrinsic observer carries all errors alike along the motion, so that the length of its velocity
error, as kinetic energy has it, is known before anything flies: `calibration.predict_sampled_errors` for its gains.
Beside it stand parabolas through the last samples, the windows chosen with the true velocities in hand.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from covariant import calibration
from covariant.geometry.lie import SE3
from covariant.models import robots
from covariant.observers import Intrinsic, run
from covariant.report import PALETTE, new_figure, save_figure
from covariant.signals import Record

FIGURE = Path(__file__).parent / "out" / "demo_quadruped.png"
RATE, SECONDS, QUANTUM = 1000, 2.0, 2 * np.pi / 2**15
NOISE = np.array([5e-4] * 3 + [1e-3] * 3)
"""Standard deviations of the pose: position [m] and attitude [rad]."""
UNEXPLAINED = 1.0
"""Acceleration that the model does not explain, independent at each sample: it sets the gains [m/s², rad/s²]."""
SETTLED = 600
"""Samples after which an observer that starts at rest is judged."""
THROWN = np.array([0.5, 0.0, 12.0, 1.0, 3.0, 0.5])
"""Twist with which the base starts [m/s, rad/s]."""
WINDOWS = (10, 15, 20, 30, 40, 60)
"""Numbers of samples that the parabolas may go through."""
REST, SWING, PACE = np.tile([0.0, 0.8, -1.6], 4), np.tile([0.3, 0.5, 0.6], 4), np.linspace(5.0, 9.0, 12)
STIFFNESS, DAMPING = 1.5, 0.05
"""Of the controller of the joints [N m/rad, N m s/rad]."""

quadruped = robots.load("quadruped")
joints = quadruped.coordinates


def swing() -> tuple[np.ndarray, ...]:
    """Stamps (T,), torques (T, 12), poses (T, 4, 4), angles (T, 12) and velocities (T, 18) of a flight."""
    model = mujoco.MjModel.from_xml_string(robots.located("quadruped").read_text(encoding="utf-8"))
    model.opt.timestep, model.opt.integrator = 2.5e-4, mujoco.mjtIntegrator.mjINT_RK4
    model.opt.gravity[:] = 0, 0, -9.81
    model.jnt_limited[:] = 0
    data, turned = mujoco.MjData(model), np.zeros(9)
    ids = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) for name in joints]
    angles, rates = (np.array([address[i] for i in ids]) for address in (model.jnt_qposadr, model.jnt_dofadr))
    data.qpos[angles], data.qvel[rates] = REST, SWING * PACE
    data.qvel[:6] = THROWN  # at the start the axes of the base are those of the world
    t = np.arange(round(SECONDS * RATE)) / RATE
    u, q, v, poses = np.empty((len(t), 12)), np.empty((len(t), 12)), np.empty((len(t), 18)), np.empty((len(t), 4, 4))
    for k, now in enumerate(t):
        mujoco.mju_quat2Mat(turned, data.qpos[3:7])
        rotation = turned.reshape(3, 3)
        poses[k] = np.block([[rotation, data.qpos[:3, None]], [np.zeros(3), 1.0]])
        q[k] = data.qpos[angles]
        v[k] = np.concatenate([rotation.T @ data.qvel[:3], data.qvel[3:6], data.qvel[rates]])
        error = REST + SWING * np.sin(PACE * now) - q[k]
        u[k] = STIFFNESS * error + DAMPING * (SWING * PACE * np.cos(PACE * now) - v[k, 6:])
        data.qfrc_applied[rates] = u[k]
        for _ in range(round(1 / RATE / model.opt.timestep)):
            mujoco.mj_step(model, data)
    return t, u, poses, q, v


def measured(poses: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Configurations (T, 28): poses with noise, then the encoders."""
    noise = NOISE * np.random.default_rng(3).normal(size=(len(q), 6))
    seen = jax.jit(jax.vmap(lambda g, e: g @ SE3.exp(e)))(jnp.asarray(poses), jnp.asarray(noise))
    return np.concatenate([np.asarray(seen).reshape(-1, 16), QUANTUM * np.round(q / QUANTUM)], axis=1)


def parabolas(y: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Velocities (T, 18) without a model: slopes of parabolas through the last samples, in coordinates around the last.

    Of each velocity by the window that is best on the first samples, the true velocities being known.
    """
    longest = max(WINDOWS)
    rows = jnp.arange(longest, len(y))[:, None] - jnp.arange(longest)
    around = jax.vmap(jax.vmap(quadruped.manifold.local, (None, 0)), (0, 0))
    ways = np.asarray(jax.jit(lambda y: around(y[longest:], y[rows]))(jnp.asarray(y)))
    slopes = [np.linalg.pinv(np.vander(-np.arange(k) / RATE, 3, increasing=True))[1] for k in WINDOWS]
    found = np.stack([np.einsum("j,kji->ki", slope, ways[:, : len(slope)]) for slope in slopes])
    errors = np.mean((found - v[longest:])[:, :SETTLED] ** 2, axis=1)
    best = found[np.argmin(errors, axis=0), :, np.arange(18)].T
    return np.concatenate([np.full((longest, 18), np.nan), best])


t, u, poses, q, v = swing()
y = measured(poses, q)
gains = calibration.gains(float(np.sqrt(np.mean(NOISE**2))), RATE, UNEXPLAINED)
observer = Intrinsic(quadruped, gains.alpha, gains.beta, substeps=1)
estimate = run(observer, Record(t, u, y), keep=("result",)).estimate
polynomial = parabolas(y, v)

true = jnp.asarray(np.concatenate([poses.reshape(-1, 16), q], axis=1))
std = np.concatenate([NOISE, np.full(12, QUANTUM / 12**0.5)])


@jax.jit
@jax.vmap
def lengths(x, v, at, w):
    """Kinetic energy of the error of a velocity w at a configuration beside x, and |n|² of the noise expected at x."""
    space = quadruped.space
    error = w + space.connection(x, space.manifold.local(x, at), w) - v  # w is carried to x first
    matrix = space(x)
    return error @ matrix @ error, jnp.sum(jnp.diag(matrix) * std**2)


squares, noise = (np.asarray(part) for part in lengths(true, jnp.asarray(v), estimate.q, estimate.v))
bound = calibration.predict_sampled_errors(gains.alpha, gains.beta, RATE, float(np.sqrt(noise.mean()))).velocity_std
settled = slice(SETTLED, None)
length = float(np.sqrt(squares[settled].mean()))
pitch = np.arcsin(np.clip(-poses[:, 2, 0], -1, 1))
print(f"{gains.summary}\npitch up to {np.degrees(np.abs(pitch).max()):.0f}°")
print(f"length of the velocity error: {length:.5f} √(2 J), predicted {bound:.5f} √(2 J)")
print(f"{'':<28}{'usual':>10}{'observer':>10}{'parabolas':>10}")
GROUPS = {
    "velocity of the base [m/s]": slice(0, 3),
    "spin of the base [rad/s]": slice(3, 6),
    "joints [rad/s]": slice(6, 18),
}
for name, part in GROUPS.items():
    usual, *errors = (
        float(np.sqrt(np.mean(a[settled, part] ** 2))) for a in (v, np.asarray(estimate.v) - v, polynomial - v)
    )
    print(f"{name:<28}{usual:10.2f}{errors[0]:10.5f}{errors[1]:10.5f}")

figure, axes = new_figure(
    3,
    1,
    panel=(8.4, 2.1),
    titles=("Spin of the base", "Joint rates of a leg", "Length of the velocity error"),
    sharex="col",
)
spin, legs, below = axes[:, 0]
for axis, first, where in ((spin, 3, "lower left"), (legs, 6, "upper right")):
    for i, color in zip(range(first, first + 3), (PALETTE.covariant, PALETTE.sky, PALETTE.navy), strict=True):
        label = joints[i - 6] if i >= 6 else f"ω{i - 2}"
        axis.plot(t, v[:, i], PALETTE.truth, linewidth=3.5, label="true" if i == first else None)
        axis.plot(t, estimate.v[:, i], color, linewidth=1, label=label)
    axis.set(ylabel="[rad/s]")
    axis.margins(y=0.2)  # room for the legend
    axis.legend(ncols=4, loc=where)
below.semilogy(t, np.sqrt(squares), PALETTE.covariant, linewidth=0.6, label="intrinsic")
below.axhline(bound, color=PALETTE.text, linestyle="--", label="predicted, root of the mean square")
below.set(xlabel="t [s]", ylabel="error, 1 = √(2 J)", ylim=(1e-3, 10))
below.legend(loc="upper right")
FIGURE.parent.mkdir(exist_ok=True)
save_figure(figure, FIGURE)
