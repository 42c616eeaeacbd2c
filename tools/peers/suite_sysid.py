"""MuJoCo's system identification and FIGAROH beside `covariant fit`, on the same logs.

`mujoco.sysid` fits rotor, damping and dry friction of the servo of `benchmarks/servo.py`. FIGAROH, in its own
environment, finds the base parameters of robots from torques that this library computes: they should be those of the
robot's file, and leave nothing unexplained.

Source: Gautier 1991, Numerical calculation of the base inertial parameters of robots, Journal of Robotic Systems 8(4).
"""

import json
import subprocess
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from outcome import Outcome, command_line

sys.path += [str(Path(__file__).parents[2] / "benchmarks"), str(Path(__file__).parents[1])]
import compare_robots
import servo

from covariant.geometry import differential
from covariant.models import robots

SECONDS, TRUTH, ROBOTS, ROWS = 20.0, (0.003, 0.02, 0.08), ("scara", "panda"), 120
FIGAROH = """
import contextlib, json, sys
from importlib.metadata import version
import numpy as np, pinocchio as pin
with contextlib.redirect_stdout(sys.stderr):
    from figaroh.tools.qrdecomposition import double_QR
    from figaroh.tools.regressor import build_regressor_basic, eliminate_non_dynaffect
    urdf, samples = sys.argv[1:]
    robot, at = pin.RobotWrapper.BuildFromURDF(urdf), np.load(samples)
    model = robot.model
    order = [model.joints[model.getJointId(str(name))].idx_v for name in at["names"]]
    q, v, a, tau = (np.zeros((len(at["q"]), model.nv)) for _ in range(4))
    for whole, key in ((q, "q"), (v, "v"), (a, "a"), (tau, "tau")):
        whole[:, order] = at[key]
    full = np.array([pin.neutral(model) for _ in q])
    for j in model.joints[1:]:
        angle = q[:, j.idx_v]
        full[:, j.idx_q : j.idx_q + j.nq] = angle[:, None] if j.nq == 1 else np.stack([np.cos(angle), np.sin(angle)], 1)
    flags = ("has_friction", "has_actuator_inertia", "has_joint_offset", "is_external_wrench")
    param = {key: False for key in flags} | {"is_joint_torques": True, "force_torque": None}
    W = build_regressor_basic(robot, full, v, a, param)
    keys, places = ("Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz", "mx", "my", "mz", "m"), (4, 5, 7, 6, 8, 9, 1, 2, 3, 0)
    rest = ("ia", "fv", "fs", "off")[: W.shape[1] // model.nv - 10]
    standard = {}
    for i in range(1, model.nv + 1):
        numbers = model.inertias[i].toDynamicParameters()
        standard |= {f"{key}{i}": float(numbers[k]) for key, k in zip(keys, places)}
        standard |= {f"{key}{i}": 0.0 for key in rest}
    stacked = tau.T.ravel()
    explained = W @ np.array(list(standard.values()))
    W_e, names = eliminate_non_dynaffect(W, standard, tol_e=1e-6)
    W_b, _, base, outcome, right = double_QR(stacked, W_e, names, standard)[:5]
size = float(np.abs(stacked).max())
print(json.dumps({
    "version": version("figaroh"),
    "count": len(base),
    "regressor": float(np.abs(explained - stacked).max()) / size,
    "residual": float(np.abs(W_b @ np.asarray(outcome, float) - stacked).max()) / size,
    "base": float(np.abs(np.asarray(outcome, float) - np.asarray(right, float)).max()),
}))
"""


def torques_of(name: str, folder: Path) -> tuple[Path, Path]:
    """A robot's file without friction, and a file of random states, accelerations and the torques that they take."""
    urdf, samples = folder / "robot.urdf", folder / "samples.npz"
    urdf.write_text(compare_robots.plain(robots.located(name).read_text(encoding="utf-8")), encoding="utf-8")
    model = robots.load(urdf)
    rng = np.random.default_rng(0)
    q, v, a = rng.uniform(-2, 2, (3, ROWS, len(model.coordinates)))

    def torque(q, v, a):
        space = model.space
        weight = differential(model.manifold, model.potential, q)
        return space(q) @ a + space.connection_force(q, v, v) + weight

    tau = np.asarray(jax.jit(jax.vmap(torque))(*map(jnp.asarray, (q, v, a))))
    np.savez(samples, q=q, v=v, a=a, tau=tau, names=np.array(list(model.coordinates)))
    return urdf, samples


def by_figaroh(python: str, outcome: Outcome) -> str:
    """Base parameters of robots, and the version of FIGAROH."""
    rows, last = [], ""
    for name in ROBOTS:
        with tempfile.TemporaryDirectory() as folder:
            paths = torques_of(name, Path(folder))
            asked = [python, "-c", FIGAROH, *map(str, paths)]
            done = subprocess.run(asked, capture_output=True, text=True, check=False)
        if done.returncode:
            outcome.case(f"FIGAROH runs on {name}: {done.stderr.strip().splitlines()[-1]}", False)
            continue
        said = json.loads(done.stdout.strip().splitlines()[-1])
        last = said["version"]
        outcome.close(f"torques of {name} beside FIGAROH's regressor", said["regressor"], 1e-9)
        # FIGAROH rounds base parameters to six decimals, and its reference to five.
        outcome.close(f"torques of {name} that base parameters leave unexplained", said["residual"], 1e-5)
        outcome.close(f"base parameters of {name} [SI units]", said["base"], 1e-4)
        rows.append((name, said["count"], *(f"{said[key]:.1e}" for key in ("regressor", "residual", "base"))))
    head = ("robot", "base parameters", "torques: difference", "left unexplained", "parameters: difference [SI]")
    outcome.table(
        "FIGAROH on torques of this library", head, rows, f"{ROWS} random states; torques relative to the largest."
    )
    return last


def main() -> None:
    """Both, on logs that they share."""
    jax.config.update("jax_enable_x64", True)
    arguments = command_line()
    outcome = Outcome(f"mujoco.sysid {version('mujoco')}")
    record = servo.in_mujoco(*TRUTH, SECONDS)
    fit, spent = servo.fitted(record, "armature,friction.viscous,friction.coulomb")
    rows = [("true", *(f"{value:.5g}" for value in TRUTH), "")]
    rows.append(("`covariant fit`", *(f"{value:.5g}" for value in fit.values), f"{spent:.1f}"))
    try:
        numbers, seconds = servo.by_sysid(record)
    except ImportError as reason:
        outcome.left_out("mujoco.sysid", 3, f"it cannot be imported: {reason}")
    else:
        rows.append(("`mujoco.sysid`", *(f"{value:.5g}" for value in numbers), f"{seconds:.1f}"))
        for name, ours, theirs, truth in zip(
            ("rotor", "damping", "dry friction"), fit.values, numbers, TRUTH, strict=True
        ):
            outcome.close(f"{name} beside mujoco.sysid, relative", abs(float(ours) - float(theirs)) / truth, 0.01)
            outcome.close(f"{name} beside the true one, relative", abs(float(ours) - truth) / truth, 0.01)
    head = ("", "rotor [kg m²]", "damping [N m s/rad]", "dry friction [N m]", "processor time [s]")
    outcome.table(
        f"A servo, {SECONDS:g} s at 1 kHz", head, rows, "The log is simulated by MuJoCo, with noise of 0.1 mrad."
    )
    if arguments.beside and (other := by_figaroh(arguments.beside, outcome)):
        outcome.version += f", FIGAROH {other}"
    outcome.write(arguments.out)


if __name__ == "__main__":
    main()
