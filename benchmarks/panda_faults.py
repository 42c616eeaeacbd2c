"""What a fit is worth on a Panda whose joints have friction and rotors that its file does not: prints the table.

Run `python benchmarks/panda_faults.py` from the repository's root, with MuJoCo installed. MuJoCo moves the arm, with a
friction law of Coulomb, Stribeck and viscous parts, rotors, torque constants that are off by up to 2 %, and torques
that lag by 1 ms; encoders have 17 bits and are read a thousand times a second. The file of the robot knows none of it.
The fit is to one log, and the velocities are judged on another motion. `oracle` is an observer that knows the plant.
Gains of the observers, and window and order of the Savitzky–Golay filter, are searched on the judged rows themselves
with the true velocities known.
"""

import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import mujoco
import numpy as np
from scipy.signal import lfilter, savgol_coeffs

import covariant
from covariant import calibration, engine, models
from covariant.models import robots
from covariant.observers import Intrinsic
from covariant.signals import lag_inputs

RATE, QUANTUM, LAG, STEPS = 1000, 2 * np.pi / 2**17, 1e-3, 4
"""Rows a second [Hz], tick of the encoders [rad], lag of the torques [s], and steps of the simulation in a row."""
SETTLED = 500
"""Rows after which an observer that starts at rest is judged."""
REST = np.array([0.0, 0.2, 0.0, -1.6, 0.0, 1.8, 0.5])
VISCOUS = np.array([1.0, 1.2, 0.8, 0.9, 0.5, 0.4, 0.3])
COULOMB = np.array([0.8, 1.0, 0.7, 0.8, 0.4, 0.35, 0.3])
STRIBECK = np.array([0.3, 0.35, 0.25, 0.3, 0.15, 0.12, 0.1])
ARMATURE = np.array([0.5, 0.5, 0.4, 0.4, 0.15, 0.12, 0.1])
CONSTANTS = 1 + 0.02 * np.array([1.0, -0.7, 0.5, -1.0, 0.8, -0.6, 0.9])
"""Of the joints: friction [N m s/rad, N m, N m], rotors as felt at them [kg m²], and factors of the torques."""
STRIBECK_VELOCITY, SMOOTHING = 0.1, 0.02
NUMBERS = ["friction", "friction.stribeck", "armature", "torque_constants"]
FILE = f"""
system = "robot"

[parameters]
path = "panda"

[inputs]
between = "held"

[measurement]
quantum = {QUANTUM}

[uncertainty]
acceleration = 1.0
"""


def friction(v: np.ndarray) -> np.ndarray:
    """Torque of the friction against the motion at the rates v (7,) [N m]."""
    dry = COULOMB + STRIBECK * np.exp(-((v / STRIBECK_VELOCITY) ** 2))
    return VISCOUS * v + dry * np.tanh(v / SMOOTHING)


def path(seed: int) -> Callable[[float], tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """A motion of five sines in each joint: position, velocity and acceleration at a time."""
    random = np.random.default_rng(seed)
    pace = 2 * np.pi * random.uniform(0.1, 0.9, (5, 7))
    size = random.uniform(0.3, 1.0, (5, 7)) * np.array([0.6, 0.4, 0.5, 0.5, 0.7, 0.6, 0.8]) / 2.5 / (pace / 3)
    phase = random.uniform(0, 2 * np.pi, (5, 7))

    def at(t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        s, c = np.sin(pace * t + phase), np.cos(pace * t + phase)
        q = REST + np.sum(size * (s - np.sin(phase)), axis=0)
        return q, np.sum(size * pace * c, axis=0), -np.sum(size * pace**2 * s, axis=0)

    return at


def moved(seconds: float, seed: int) -> tuple[covariant.Record, np.ndarray]:
    """The log of an arm under a controller that knows the file only, and its true velocities (T, 7)."""
    machine = mujoco.MjModel.from_xml_string(robots.located("panda").read_text(encoding="utf-8"))
    known = mujoco.MjData(machine)
    machine.opt.timestep, machine.opt.integrator = 1 / (RATE * STEPS), mujoco.mjtIntegrator.mjINT_RK4
    machine.opt.gravity[:] = 0, 0, -9.81
    machine.jnt_limited[:] = 0
    machine.dof_damping[:], machine.dof_frictionloss[:], machine.dof_armature[:] = 0, 0, ARMATURE
    mujoco.mj_setConst(machine, known)
    data, at, count = mujoco.MjData(machine), path(seed), int(seconds * RATE)
    data.qpos[:], data.qvel[:] = at(0.0)[:2]
    q, v, u = np.empty((3, count, 7))
    inertia, torque = np.zeros((7, 7)), np.zeros(7)
    decay = np.exp(-machine.opt.timestep / LAG)
    mean = (1 - decay) * LAG / machine.opt.timestep

    def passive(model: Any, now: Any) -> None:
        now.qfrc_passive[:] -= friction(now.qvel)

    mujoco.set_mjcb_passive(passive)
    try:
        for k in range(count):
            mujoco.mj_forward(machine, data)
            q[k], v[k] = data.qpos, data.qvel
            wanted = at(k / RATE)
            mujoco.mj_fullM(machine, data, inertia)
            pull = wanted[2] + 400 * (wanted[0] - data.qpos) + 40 * (wanted[1] - data.qvel)
            u[k] = inertia @ pull + data.qfrc_bias + friction(wanted[1])
            for _ in range(STEPS):
                command = CONSTANTS * u[k]
                if k == 0:
                    torque = command
                data.qfrc_applied[:] = command + mean * (torque - command)
                torque = command + decay * (torque - command)
                mujoco.mj_step(machine, data)
    finally:
        mujoco.set_mjcb_passive(None)
    return covariant.Record(np.arange(count) / RATE, u, QUANTUM * np.round(q / QUANTUM)), v


def numbers(names: tuple[str, ...], share: float) -> dict[str, Any]:
    """Lines of a model file that make the model a share of the plant: 0 is the robot of the file, 1 the plant."""
    laws = (share * np.stack([VISCOUS, COULOMB, STRIBECK], axis=1)).tolist()
    shape = {"stribeck_velocity": STRIBECK_VELOCITY, "smoothing": SMOOTHING}
    friction = {
        name: dict(zip(("viscous", "coulomb", "stribeck"), law, strict=True)) | shape
        for name, law in zip(names, laws, strict=True)
    }
    return {
        "parameters.friction": friction,
        "parameters.armature": dict(zip(names, (share * ARMATURE).tolist(), strict=True)),
        "parameters.torque_constants": dict(zip(names, (1 + share * (CONSTANTS - 1)).tolist(), strict=True)),
    }


def rmse(v: np.ndarray, true: np.ndarray) -> float:
    """Error of the velocities of all joints [rad/s]."""
    value = float(np.sqrt(np.mean((v - true)[SETTLED:-20] ** 2)))
    return value if np.isfinite(value) else np.inf


def best_gains(file: models.ModelFile, record: covariant.Record, true: np.ndarray) -> tuple[float, float, float]:
    """Least error of the intrinsic observer over its gains, with its ω [rad/s] and ζ."""
    system, acting = file.need_mechanical(file.name, "this table has"), lag_inputs(record, file.input_lag)
    best, span = (np.inf, 100.0, 0.7), 1.6
    for _ in range(3):
        pairs = [
            (best[1] * float(np.exp(a)), float(np.clip(best[2] * np.exp(b), 0.3, 3.0)))
            for a in np.linspace(-span, span, 5)
            for b in np.linspace(-span / 2, span / 2, 3)
        ]
        observers = [Intrinsic(system, 2 * z * w, w * w) for w, z in pairs]
        runs, _ = engine.run_logs(observers, acting, ("result",), "c")
        errors = [rmse(np.asarray(run.estimate)[:, 7:], true) for run in runs]
        best = min(best, *((error, *pair) for error, pair in zip(errors, pairs, strict=True)))
        span /= 3
    return best


def best_polynomial(record: covariant.Record, true: np.ndarray) -> tuple[float, str]:
    """Least error of a Savitzky–Golay filter at the end of its window, over window and order of `scipy.signal`."""
    found = []
    for order in (1, 2, 3, 4):
        for window in range(order + 2 + (order + 1) % 2, 122, 2):
            weights = savgol_coeffs(window, order, deriv=1, delta=1 / RATE, pos=window - 1)
            v = lfilter(weights, 1.0, record.y - record.y[0], axis=0)
            found.append((rmse(v, true), f"window {window}, order {order}"))
    return min(found)


def best_difference(record: covariant.Record, true: np.ndarray) -> tuple[float, str]:
    """Least error of a difference behind a low-pass filter of first order, over its bandwidth."""
    change = np.diff(record.y, axis=0, prepend=record.y[:1]) * RATE
    found = []
    for bandwidth in np.geomspace(10, 2000, 60):
        pole = np.exp(-bandwidth / RATE)
        found.append((rmse(lfilter([1 - pole], [1, -pole], change, axis=0), true), f"bandwidth {bandwidth:.0f} rad/s"))
    return min(found)


def main() -> None:
    """Simulate, fit, search and print."""
    began = time.perf_counter()
    with TemporaryDirectory() as folder:
        spec, fitted = Path(folder) / "panda.toml", Path(folder) / "fitted.toml"
        spec.write_text(FILE)
        (seen, _), (judged, true) = moved(15.0, 1), moved(3.0, 2)
        refused = calibration.misfit(models.load(spec), judged)
        print(f"estimate and compare refuse: {refused.evidence if refused else 'no'}")
        finding = covariant.check(spec, judged).findings[0]
        print(f"check: {finding.what} of {finding.where}: {finding.evidence}", flush=True)
        result = covariant.fit(spec, seen, NUMBERS)
        result.save(fitted)
        print(f"fitted after {time.perf_counter() - began:.0f} s: {len(result.values)} numbers", flush=True)
        names = models.load(spec).model.coordinates
        nothing, everything = numbers(names, 0.0), numbers(names, 1.0)
        files = {
            "intrinsic, file": models.load(spec, nothing),
            "intrinsic, fitted": models.load(fitted),
            "intrinsic, fitted, lag of 1 ms known": models.load(fitted, {"inputs.lag": LAG}),
            "intrinsic, oracle": models.load(spec, everything | {"inputs.lag": LAG}),
        }
        best = {name: best_gains(file, judged, true) for name, file in files.items()}
    rows = {name: (error, f"ω {w:.0f} rad/s, ζ {z:.2f}") for name, (error, w, z) in best.items()}
    rows |= {
        "Savitzky–Golay": best_polynomial(judged, true),
        "filtered difference": best_difference(judged, true),
    }
    polynomial = rows["Savitzky–Golay"][0]
    print("\n| velocity from | RMSE of all joints [mrad/s] | of Savitzky–Golay | best numbers |\n|---|--:|--:|---|")
    for name, (error, said) in rows.items():
        print(f"| {name} | {1e3 * error:.2f} | {error / polynomial:.2f} | {said} |")
    print(f"\n{time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
