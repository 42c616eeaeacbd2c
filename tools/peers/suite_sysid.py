"""MuJoCo's system identification beside `covariant fit`: rotor, damping and dry friction of a servo from one log.

The servo is that of `benchmarks/servo.py`. FIGAROH would be compared too; its package needs one that pip does not find.
"""

import sys
from importlib.metadata import version
from pathlib import Path

import jax
from outcome import Outcome, command_line

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
import servo

SECONDS, TRUTH = 20.0, (0.003, 0.02, 0.08)


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
    outcome.write(arguments.out)


if __name__ == "__main__":
    main()
