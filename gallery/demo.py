"""A machine from an independent physics engine, its encoder log, and what `covariant` makes of it.

MuJoCo moves a double pendulum driven by two motors. Its encoders are read about 500 times a second, in whole counts,
and some readings are lost. The log is then handed to the command line, as you would hand over a log of your own. The
true velocities stand in the log too, in columns that are only used to score.

What the machine does and the model file does not know, as on any test bench:

- masses, centres of mass and inertias differ from the data sheet by one or two per cent;
- bearings stick (dry friction as a hard constraint), where the model has a smooth curve;
- the motors have a cogging torque.

A second log, of other torques, is for trying things on a log that they were not tuned on (docs/your-log.md).

What to look at: the velocity errors in the reports. All estimators work from the same data sheet. Those that know the
model share one error, far below that of the filters without one; at gains this high it matters little how they correct.
"""

import argparse
import csv
import os
import shlex
import subprocess
import sys
import time
from pathlib import Path

import mujoco
import numpy as np
from rich.progress import track

ROOT = Path(__file__).resolve().parents[1]
MODEL = "examples/demo_double_pendulum.toml"

MACHINE = """
<mujoco model="double pendulum">
  <option timestep="1e-4" integrator="RK4" gravity="0 0 -9.81"><flag contact="disable"/></option>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="0.012" frictionloss="0.03"/>
      <inertial mass="0.608" pos="0 0 -0.162" diaginertia="0.00507 0.00507 0.0003"/>
      <body name="lower" pos="0 0 -0.3">
        <joint name="elbow" axis="0 1 0" damping="0.008" frictionloss="0.02"/>
        <inertial mass="0.396" pos="0 0 -0.1385" diaginertia="0.00256 0.00256 0.0002"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="shoulder"/><motor joint="elbow"/></actuator>
</mujoco>
"""
"""Both links hang along −z at q = 0 and turn about y; q2 is the angle of the elbow. SI units."""

DURATION = 10.0
"""Length of the log [s]."""
STEPS = 20
"""Simulation steps from one sample to the next, give or take `JITTER`: 2 ms, so 500 Hz."""
JITTER = 4
COUNTS = 4096
"""Encoder counts a revolution."""
LOST = 0.004
"""Share of the samples whose reading never arrives."""
COGGING = 0.01
"""Amplitude of the cogging torque [N m], twelve periods a revolution."""

AMPLITUDE = np.array([[0.55], [0.10]])
FREQUENCY = np.array([[0.31, 0.73, 1.27], [0.41, 0.96, 1.66]])
PHASE = np.array([[4.0, 1.7, 0.3], [0.1, 5.1, 5.7]])
"""Torque commands: three sines a joint [N m, Hz, rad]; enough for both links to go over the top."""
LOGS = {"log.csv": (0, PHASE), "other.csv": (1, PHASE + 2.0)}
"""The logs by name: seed of jitter and losses, and the phases of the torques."""


def command(t: float, phase: np.ndarray) -> np.ndarray:
    """Torques (2,) that the controller asks for at time t [s]; `phase` (2, 3) [rad]."""
    return (AMPLITUDE * np.sin(2 * np.pi * FREQUENCY * t + phase)).sum(1)


def encode(q: np.ndarray) -> np.ndarray:
    """What the encoders say of the joint angles q (2,): whole counts of a turn, as angles in (−π, π]."""
    counts = np.round(q * COUNTS / (2 * np.pi)).astype(int) % COUNTS
    return np.where(counts > COUNTS // 2, counts - COUNTS, counts) * 2 * np.pi / COUNTS


def record(seed: int = 0, phase: np.ndarray = PHASE) -> np.ndarray:
    """Let the machine move; rows of t, q1, q2, tau1, tau2, true_v1, true_v2, with NaN for a lost reading.

    The controller works sample by sample: it reads the encoders, sets the torques, and holds them until the next.

    Args:
        seed: Seed of the jitter and of the losses.
        phase: Phases (2, 3) of the torques [rad].
    """
    model = mujoco.MjModel.from_xml_string(MACHINE)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(seed)
    samples = int(DURATION / (STEPS * model.opt.timestep))
    rows = np.empty((samples, 7))
    for row in track(rows, "MuJoCo moves the machine"):
        torque = command(data.time, phase)
        row[:] = data.time, *encode(data.qpos), *torque, *data.qvel
        for _ in range(STEPS + rng.integers(-JITTER, JITTER + 1)):
            data.ctrl = torque + COGGING * np.sin(12 * data.qpos)
            mujoco.mj_step(model, data)
    lost = rng.random(samples) < LOST
    lost[0] = False  # an observer starts from the first reading
    rows[lost, 1:3] = np.nan
    return rows


def write(rows: np.ndarray, path: Path) -> None:
    """A plain CSV file, an empty cell where a reading is missing."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["t", "q1", "q2", "tau1", "tau2", "true_v1", "true_v2"])
        writer.writerows([["" if np.isnan(cell) else f"{cell:.7g}" for cell in row] for row in rows])


def describe(rows: np.ndarray, path: Path) -> None:
    """Print how long a log is, what was lost, and how far and how fast the joints turn."""
    turns = np.abs(np.diff(np.unwrap(rows[~np.isnan(rows[:, 1]), 1:3], axis=0), axis=0)).sum(0) / (2 * np.pi)
    print(
        f"{path}: {len(rows)} samples in {rows[-1, 0]:.1f} s, {np.isnan(rows[:, 1]).sum()} readings lost, "
        f"encoder step {2000 * np.pi / COUNTS:.2f} mrad;\nthe joints sweep {turns[0]:.1f} and {turns[1]:.1f} turns "
        f"at up to {np.abs(rows[:, 5]).max():.0f} and {np.abs(rows[:, 6]).max():.0f} rad/s"
    )


def move(out: Path, name: str) -> None:
    """Write one of `LOGS` into a folder, and describe it."""
    seed, phase = LOGS[name]
    rows = record(seed, phase)
    write(rows, out / name)
    describe(rows, out / name)


def covariant(*arguments: object) -> None:
    """Run the command line as a user would, its output passed through; raises where it fails."""
    words = [str(argument) for argument in arguments]
    print(f"\n$ covariant {shlex.join(words)}", flush=True)
    program = Path(sys.executable).with_name("covariant")
    subprocess.run([program, *words], check=True, env={"JAX_PLATFORMS": "cpu", **os.environ})


def show(out: Path, log: Path) -> None:
    """Estimate the velocities of a log, then compare all estimators on it, which takes several times as long."""
    truth = ("--truth", "true_v1,true_v2")
    covariant("estimate", MODEL, log, *truth, "-o", out / "velocities.csv", "--report", out / "estimate.html")
    print(f"\nThe velocities and their errors, in a browser: {out / 'estimate.html'}")
    print("Next, all estimators on the same log.", flush=True)
    covariant("compare", MODEL, log, *truth, "-o", out / "table.csv", "--report", out / "compare.html")
    print()


def main() -> None:
    """Make the log, estimate its velocities, compare all estimators on it; the log of other torques comes last."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("demo"), help="folder for the logs and the results")
    parser.add_argument("--only-logs", action="store_true", help="write the logs and stop")
    options = parser.parse_args()
    out = options.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    began = time.perf_counter()
    os.chdir(ROOT)
    out = Path(os.path.relpath(out))  # short names in what is printed

    first, *others = LOGS
    move(out, first)
    if not options.only_logs:
        show(out, out / first)
    for name in others:
        move(out, name)
    if options.only_logs:
        return
    print(f"\nDone in {time.perf_counter() - began:.0f} s. Open these in a browser:")
    print(f"  {out / 'estimate.html'}   the velocities and their errors\n  {out / 'compare.html'}    every estimator")
    print(f"Numbers: {out / 'velocities.csv'}, {out / 'table.csv'}")


if __name__ == "__main__":
    main()
