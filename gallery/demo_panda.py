"""The joint velocities of a Franka Panda from its URDF and its encoders, beside the filters that know no model.

MuJoCo swings the arm by known torques and reads encoders of 2¹⁵ counts a turn a thousand times a second. Twice: once
the machine is the one of the file, once the masses of its links are off by up to five per cent and its joints have
friction that no model knows. Every estimator has one number, which is tuned on the first third of each log to what is
best there, the true velocities being known; that of the observers is the acceleration that the model does not explain.
What is reported is the rest of the log.
"""

from pathlib import Path

import mujoco
import numpy as np

from covariant import calibration
from covariant.models import robots
from covariant.observers import REGISTRY, run
from covariant.report import PALETTE, new_figure, save_figure
from covariant.signals import Record

FIGURE = Path(__file__).parent / "out" / "demo_panda.png"
RATE, SECONDS, QUANTUM = 1000, 4.0, 2 * np.pi / 2**15
SETTLED = 600
"""Samples after which an observer that starts at rest is judged."""
REST = np.array([0.0, 0.2, 0.0, -1.6, 0.0, 1.8, 0.5])
SWING = np.array([0.8, 0.5, 0.7, 0.6, 0.9, 0.7, 1.0])
PACE = np.array([2.1, 2.9, 2.5, 3.3, 3.7, 2.3, 4.1])
FRICTION = np.array([0.6, 0.6, 0.5, 0.5, 0.3, 0.3, 0.2])
"""Dry friction of the joints [N m], and damping [N m s/rad] of the same size: chosen, as of an arm of this size."""
UNEXPLAINED = (0.01, 1.0, 10.0)
"""Accelerations that the model does not explain [rad/s²], to choose from."""
OBSERVERS = ("intrinsic", "ekf")
FREE = ("savitzky-golay", "filtered-derivative", "high-gain", "joint-kalman", "pll", "levant")
TITLES = {"known": "Model and torques known", "unknown": "Masses off by up to 5 %, friction not known"}

panda = robots.load("panda")
text = robots.located("panda").read_text(encoding="utf-8")


def machine(spoiled: bool) -> mujoco.MjModel:
    """The arm in MuJoCo; spoiled, it is not the one of the file."""
    rng = np.random.default_rng(7)
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.timestep, model.opt.integrator = 2.5e-4, mujoco.mjtIntegrator.mjINT_RK4
    model.opt.gravity[:] = 0, 0, -9.81
    model.jnt_limited[:] = 0
    if spoiled:
        scale = rng.uniform(0.95, 1.05, model.nbody)
        model.body_mass[:] *= scale
        model.body_inertia[:] *= scale[:, None]
        model.dof_frictionloss[:], model.dof_damping[:] = FRICTION, FRICTION
        mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def swing(model: mujoco.MjModel) -> tuple[Record, np.ndarray]:
    """The log of a controller that lets the arm follow sines, and the true velocities (T, 7)."""
    data = mujoco.MjData(model)
    data.qpos[:] = REST
    data.qvel[:] = SWING * PACE
    count = int(SECONDS * RATE)
    t, q, v, u = np.arange(count) / RATE, *np.empty((3, count, 7))
    inertia = np.zeros((7, 7))
    for k, now in enumerate(t):
        mujoco.mj_forward(model, data)
        q[k], v[k] = data.qpos, data.qvel
        turn = PACE * now
        error = REST + SWING * np.sin(turn) - data.qpos
        slip = SWING * PACE * np.cos(turn) - data.qvel
        mujoco.mj_fullM(model, data, inertia)
        wanted = 100 * error + 20 * slip - SWING * PACE**2 * np.sin(turn)
        u[k] = inertia @ wanted + data.qfrc_bias
        data.qfrc_applied[:] = u[k]
        for _ in range(round(1 / RATE / model.opt.timestep)):
            mujoco.mj_step(model, data)
    return Record(t, u, QUANTUM * np.round(q / QUANTUM)), v


def errors(record: Record, v: np.ndarray) -> dict[str, tuple[np.ndarray, float]]:
    """Velocities and their RMSE [rad/s] by estimator: those that know the model, and the best of the others."""
    third = len(record.t) // 3
    start = Record(record.t[:third], record.u[:third], record.y[:third])
    trial = calibration.Trial(start.t, start.y, v[:third])

    def tuned(names, unexplained):
        sheet = calibration.DataSheet(QUANTUM / 12**0.5, unexplained, 0.05, 8.0, 0.3, speed=tuple(v.std(axis=0)))
        return calibration.tuned_estimators(panda, 7, sheet, RATE, trial, names)

    def rmse(observer, record, v, skip):
        estimate = np.asarray(run(observer, record, keep=("result",)).estimate)[:, 7:]
        return estimate, float(np.sqrt(np.mean((estimate - v)[skip:-20] ** 2)))

    chosen = tuned(FREE, 1.0)
    for name in OBSERVERS:
        offered = {value: tuned((name,), value)[name] for value in UNEXPLAINED}
        best = min(offered, key=lambda value: rmse(offered[value], start, v[:third], SETTLED)[1])
        chosen[name] = offered[best]
        print(f"  {name}: unexplained acceleration {best} rad/s²")
    found = {name: rmse(observer, record, v, third) for name, observer in chosen.items()}
    for name, (_, error) in found.items():
        print(f"  {name:<20} {1e3 * error:8.3f} mrad/s")
    best = min((name for name in found if name in FREE), key=lambda name: found[name][1])
    print(f"  the best filter without a model, {best}: {found[best][1] / found['intrinsic'][1]:.1f} times the error")
    return {name: found[name] for name in (*OBSERVERS, best)}


labels = {entry.name: entry.observer.__name__ for entry in REGISTRY}
figure, axes = new_figure(2, 2, panel=(4.5, 2.6), titles=(*TITLES.values(), "", ""), sharex="row")
for column, (case, title) in enumerate(TITLES.items()):
    print(f"{title}:")
    record, v = swing(machine(case == "unknown"))
    found = errors(record, v)
    above, below = axes[:, column]
    above.plot(record.t, v[:, 3], color=PALETTE.truth, linewidth=4, label="true")
    for color, (name, (estimate, rmse)) in zip(
        (PALETTE.covariant, PALETTE.ekf, PALETTE.filter), found.items(), strict=False
    ):
        above.plot(record.t, estimate[:, 3], color, linewidth=1, label=labels[name])
        below.plot(record.t, 1e3 * (estimate - v)[:, 3], color, linewidth=0.8, label=f"{name}: {1e3 * rmse:.2g}")
    above.set(xlim=(2, 3), ylabel="dq₄/dt [rad/s]")
    below.set(xlim=(2, 3), ylim=((-10, 10), (-150, 150))[column], xlabel="t [s]", ylabel="error of dq₄/dt [mrad/s]")
    below.legend(title="RMSE of all joints [mrad/s]", loc="upper right")
axes[0, 0].legend()
FIGURE.parent.mkdir(exist_ok=True)
save_figure(figure, FIGURE)
