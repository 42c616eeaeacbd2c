"""FMPy on exported units: it validates them, and its simulation is that of Python."""

import tempfile
from importlib.metadata import version
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from fmpy import simulate_fmu
from fmpy.validation import validate_fmu
from outcome import Outcome, command_line

from covariant import codegen, models, observers

jax.config.update("jax_enable_x64", True)
RATE, ROWS = 200.0, 60


def cases():
    """An observer without a covariance, and one with it."""
    chain = models.pendulum_chain(viscous=(0.05, 0.05))
    yield "Intrinsic", observers.Intrinsic(chain, 20.0, 100.0)
    yield "EKF", observers.EKF(chain, 0.1 * np.eye(2), 1e-6 * np.eye(2), gate=None)


def main() -> None:
    """Both observers as units of both versions."""
    arguments = command_line()
    outcome = Outcome(f"fmpy {version('fmpy')}")
    t = np.arange(ROWS + 1) / RATE
    y = np.stack([0.3 * np.sin(3 * t), 0.2 * np.cos(4 * t)], axis=1)
    u = np.stack([0.1 * np.cos(5 * t), 0.05 * np.sin(2 * t)], axis=1)
    rows = []
    for name, observer in cases():
        program = codegen.program(codegen.with_open_numbers(observer), np.zeros(2), loops=True)
        expected = in_python(observer, t, y, u)
        for fmi in ("2.0", "3.0"):
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder, "arm.fmu")
                codegen.write_fmu(codegen.fmu(program, "arm", f"{name} of a double pendulum.", RATE, y[0], fmi), path)
                problems = validate_fmu(str(path))
                outcome.case(f"no problem in {name}, FMI {fmi}: {len(problems)} of them", not problems)
                simulated = by_fmpy(path, fmi, t, y, u)
            apart = np.abs(simulated[1:] - expected).max()
            outcome.close(f"simulation of {name}, FMI {fmi}", float(apart), 1e-9)
            rows.append((name, fmi, len(problems), f"{apart:.1e}"))
    head = ("observer", "FMI", "problems that FMPy finds", "largest difference to Python")
    outcome.table("Units", head, rows, f"{ROWS} steps at {RATE:g} Hz, of positions and velocities in rad and rad/s.")
    outcome.write(arguments.out)


def in_python(observer, t, y, u) -> np.ndarray:
    """What the observer predicts from each stamp to the next."""
    step = jax.jit(lambda *a: observer.step(*a)[0])
    state, rows = observer.init(jnp.asarray(y[0]), jnp.asarray(t[0])), []
    for k in range(ROWS):
        h = jnp.asarray(t[k + 1] - t[k])
        if k:
            state = step(state, jnp.asarray(u[k - 1]), jnp.asarray(y[k]), h)
        rows.append(np.asarray(observer.estimate(step(state, jnp.asarray(u[k]), jnp.full(2, jnp.nan), h))))
    return np.array(rows)


def by_fmpy(path: Path, fmi: str, t, y, u) -> np.ndarray:
    """The outputs q and v (T, 4) of a simulation by FMPy."""
    if fmi == "3.0":
        kinds, rows = [("time", "f8"), ("y", "f8", 2), ("u", "f8", 2)], list(zip(t, y, u, strict=True))
        names = ["q", "v"]
    else:
        kinds = [(key, "f8") for key in ("time", "y[1]", "y[2]", "u[1]", "u[2]")]
        rows = [(a, *b, *c) for a, b, c in zip(t, y, u, strict=True)]
        names = ["q[1]", "q[2]", "v[1]", "v[2]"]
    result = simulate_fmu(
        str(path), stop_time=t[-1], step_size=1 / RATE, output_interval=1 / RATE,
        input=np.array(rows, dtype=kinds), output=names,
    )  # fmt: skip
    return np.column_stack([np.reshape(result[key], (len(result), -1)) for key in names])


if __name__ == "__main__":
    main()
