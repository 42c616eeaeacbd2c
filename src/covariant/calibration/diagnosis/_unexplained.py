"""Accelerations that no suspicion explains, beside those that a right model would leave.

Smoothing is wrong about motions that are faster than its windows, and ticks hide slow ones. How much of the
accelerations a right model leaves for these reasons shows in a log that the model itself makes: from a state of the
smoothed log on, under the logged inputs, read by sensors with the same ticks and noise.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from covariant.calibration.diagnosis._case import Case, Residual, acting, clearly, residual, smoothed
from covariant.calibration.diagnosis._finding import Finding, Names
from covariant.calibration.diagnosis._smooth import Smooth, smooth
from covariant.calibration.diagnosis._thresholds import BARELY, FARTHEST, TWIN
from covariant.models import MechanicalSystem, Motion, advance
from covariant.signals import Record

ROWS = 2048
"""Rows of the twin, so that one program serves all logs."""
STEP = 5e-4
"""Longest step of the integration [s], as long as no more than `MOST_STEPS` are needed between two rows."""
MOST_STEPS = 50


def constant_inputs(record: Record, names: Names) -> str:
    """Words on the inputs that have one value in all rows of a log, which then may lack what drives the machine."""
    columns = zip(names.u, np.asarray(record.u).T, strict=True)
    same = [f"{name} is {column[0]:.4g}" for name, column in columns if np.ptp(column) == 0]
    return f"{', '.join(same)} in all {len(record.t)} rows" if same else ""


def unexplained(case: Case, left: Residual, half: float | None = None, constant: str = "") -> list[Finding]:
    """A finding where the residual accelerations exceed what the data sheet states.

    `half` is the half width of the windows of `left`, by default that of `clearly`; `constant` names the inputs that
    are constant in the whole log.
    """
    file, names, clear = case.file, case.names, left.told
    if not clear.any():
        return []
    size = np.sqrt(np.maximum(left.squares, 0.0))
    stated = file.acceleration_std
    beyond = clear & (size > FARTHEST * (stated or 0.0))
    if not beyond.any() or (stated is None and left.misfit < BARELY):
        return []
    usual = _exact_model_residual(case, half)
    if usual is not None and not (_residual_fraction(left)[beyond] > TWIN * _residual_fraction(usual)[beyond]).any():
        return []
    worst = int(np.argmax(np.where(beyond, size, 0.0)))
    unit = f"{names.units[worst]}/s²".lstrip("/") if names.units[worst] else ""
    whole = float(np.sqrt(np.mean(left.measured[left.used, worst] ** 2)))
    evidence = (
        f"the model leaves {size[worst]:.3g} {unit} of the {whole:.3g} {unit} with which {names.q[worst]} accelerates; "
        f"{f'its data sheet says {stated:.3g} {unit}' if stated else 'its data sheet says nothing of it'}"
    )
    numbers = {"left": float(size[worst]), "acceleration": whole, "stated": stated, "unexplained": left.misfit}
    what = "model" if left.misfit > BARELY else "uncertainty"
    line = f"[uncertainty] acceleration = {size[worst]:.2g}, or better [parameters]"
    if what == "model":
        line = "look at [parameters] and at what the columns are: no other unit, order or sign of the log explains it"
    if constant:
        # A large uncertainty would hide that the log lacks an input, and make an observer follow its noise.
        evidence = f"{constant}; {evidence}"
        line = f"log what drives the machine there; if nothing does, {line}"
    return [Finding(what, names.q[worst], evidence, line, True, numbers)]


def _residual_fraction(left: Residual) -> np.ndarray:
    """What the model leaves of the accelerations (n,), the noise included, as a fraction of their squares."""
    return np.mean(left.left**2, axis=0) / np.maximum(np.mean(left.measured[left.used] ** 2, axis=0), 1e-300)


def _exact_model_residual(case: Case, half: float | None) -> Residual | None:
    """The residual of a log that the model itself makes, smoothed in the same way; None where there is none."""
    log = clearly(case) if half is None else smoothed(case, half)
    made = None if log is None else twin(case.model, log, acting(case), case.ticks)
    if made is None or log is None:
        return None
    # Its inputs act as they stand; its positions are not late.
    left = residual(case.model, smooth(made, log.half, case.model.circles, 0.0, case.ticks))
    return left if left.used.any() else None


def twin(model: MechanicalSystem, log: Smooth, record: Record, ticks: Float[np.ndarray, "n"]) -> Record | None:
    """Simulate a log without faults that is like another one."""
    used = np.flatnonzero(log.used)
    if not len(used):
        return None
    begin = int(np.searchsorted(np.asarray(record.t), log.t[used[0]]))
    t, u, y = (np.asarray(a, float)[begin : begin + ROWS] for a in record[:3])
    if len(t) < 2:
        return None
    at = int(np.argmin(np.abs(log.t - t[0])))
    missing = ROWS - len(t)
    steps = np.clip(np.ceil(np.median(np.diff(t)) / STEP), 1, MOST_STEPS).astype(int)
    times, inputs = (np.concatenate([each, np.repeat(each[-1:], missing, axis=0)]) for each in (t, u))
    first = Motion(jnp.asarray(log.q[at]), jnp.asarray(log.v[at]))
    q = np.asarray(_simulate_positions(model, times, inputs, first, steps))[: len(t)]
    if not np.isfinite(q).all():
        return None
    noisy = q + np.random.default_rng(0).normal(size=q.shape) * np.where(ticks > 0, 0.0, log.noise)
    size = np.where(ticks > 0, ticks, 1.0)
    read = np.where(ticks > 0, np.round(noisy / size) * size, noisy)
    return Record(t, u, np.where(np.isnan(y), np.nan, read))


@eqx.filter_jit
def _simulate_positions(model, t, u, start, steps):
    def row(motion, item):
        begin, dt, u = item
        motion = advance(model, begin, motion, u, dt, steps)
        return motion, motion.q

    _, q = jax.lax.scan(row, start, (t[:-1], jnp.diff(t), u[:-1]))
    return jnp.concatenate([start.q[None], q])
