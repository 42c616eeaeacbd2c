"""Simulated logs of several machines, right or with one fault, for counting what `diagnose` says of them.

A machine is integrated by Runge and Kutta's method with `STEPS` steps a row, under inputs that are held between rows or
go linearly; nothing of the library's smoothing or fitting is used.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from covariant.models import ModelFile, acceleration, document, load
from covariant.signals import Record

ROWS, PERIOD, STEPS = 1500, 0.004, 8


class Machine(NamedTuple):
    """A machine: its model, the size of its inputs, and how far from zero it starts."""

    model: str
    overrides: tuple[str, ...]
    push: tuple[float, ...]
    start: float


MACHINES = {
    "pendulum": Machine("examples/dfki_simple_pendulum.toml", ("inputs.lag=0",), (3.0,), 2.0),
    "double pendulum": Machine("examples/demo_double_pendulum.toml", (), (0.4, 0.2), 2.0),
    "oscillator": Machine("oscillator", (), (1.0,), 1.0),
}


class Made(NamedTuple):
    """A log with the model file that describes it, the exact positions at its stamps, and how it was made."""

    file: ModelFile
    record: Record
    exact: np.ndarray
    quantum: float
    std: float
    arguments: dict[str, Any]


@eqx.filter_jit
def _moved(model, t, u, slope, start):
    """States (T, 2n) at the stamps; within a row the input is u + slope (t − stamp)."""
    n = start.shape[0] // 2

    def flow(t, x, u):
        return jnp.concatenate([x[n:], acceleration(model, t, x[:n], x[n:], u)])

    def row(x, item):
        begin, h, u, slope = item

        def step(k, x):
            now, half = begin + k * h, h / 2
            acting = [u + slope * (k * h + s) for s in (0.0, half, h)]
            a = flow(now, x, acting[0])
            b = flow(now + half, x + half * a, acting[1])
            c = flow(now + half, x + half * b, acting[1])
            d = flow(now + h, x + h * c, acting[2])
            return x + h / 6 * (a + 2 * b + 2 * c + d)

        new = jax.lax.fori_loop(0, STEPS, step, x)
        return new, new

    h = jnp.diff(t) / STEPS
    return jnp.concatenate([start[None], jax.lax.scan(row, start, (t[:-1], h, u[:-1], slope))[1]])


def inputs(random: np.random.Generator, t: np.ndarray, sizes: tuple[float, ...], fast: bool) -> np.ndarray:
    """Sums of sines, or values that jump every few rows."""
    count = len(sizes)
    if fast:
        every = int(random.integers(1, 6))
        values = random.uniform(-1, 1, (len(t) // every + 1, count))
        return np.repeat(values, every, axis=0)[: len(t)] * sizes
    phases = random.uniform(0, 2 * np.pi, (3, count))
    speeds = np.array([2.0, 5.0, 11.0])[:, None]
    return sizes * np.mean(np.sin(speeds[:, None] * t[None, :, None] + phases[:, None]), axis=0)


def made(
    name: str,
    seed: int,
    fast: bool = False,
    between: str = "held",
    counts: float = 0,
    std: float | None = None,
    push: float = 1.0,
    unknown: tuple[str, ...] = (),
) -> Made:
    """A log without a fault.

    Args:
        name: Key of `MACHINES`.
        seed: Seed of start, inputs, noise, jitter and missing cells.
        fast: Whether inputs jump every few rows.
        between: How inputs go from row to row, which the model file says.
        counts: Counts of the encoders a turn; 0 for noise instead.
        std: Noise of the sensors; None for one between 3e-5 and 2e-3.
        push: Size of the inputs, in those of the machine.
        unknown: Overrides that make the machine from the model that the file states.
    """
    arguments = {"name": name, "seed": seed, "fast": fast, "between": between, "counts": counts, "std": std}
    machine, random = MACHINES[name], np.random.default_rng(seed)
    std = 10 ** random.uniform(-4.5, -2.8) if std is None else std
    sensor = f"measurement.quantum={2 * np.pi / counts}" if counts else f"measurement.std={std}"
    other = f'inputs.between="{between}"'
    file = load(machine.model, (*machine.overrides, sensor, other))
    if not counts:
        file = file._replace(quantum=None)
    t = PERIOD * np.arange(ROWS)
    t = t + random.uniform(-0.05, 0.05, ROWS) * PERIOD * (seed % 2)
    u = push * inputs(random, t, machine.push, fast)
    slope = np.diff(u, axis=0) / np.diff(t)[:, None] * (between == "linear")
    start = random.uniform(-machine.start, machine.start, 2 * file.dimension)
    moving = load(machine.model, (*machine.overrides, *unknown)).model
    exact = np.asarray(_moved(moving, *map(jnp.asarray, (t, u, slope, start))))[:, : file.dimension]
    y = sensed(random, exact, 2 * np.pi / counts if counts else 0.0, std)
    y[1:][random.random((ROWS - 1, y.shape[1])) < 0.02 * (seed % 3 == 1)] = np.nan
    names = [f"{letter}{i + 1}" for letter, n in (("q", y.shape[1]), ("u", u.shape[1])) for i in range(n)]
    columns = file.columns._replace(q=tuple(names[: y.shape[1]]), u=tuple(names[y.shape[1] :]))
    quantum = 2 * np.pi / counts if counts else 0.0
    return Made(file._replace(columns=columns), Record(t, u, y), exact, quantum, std, arguments | {"push": push})


def sensed(random: np.random.Generator, exact: np.ndarray, quantum: float, std: float) -> np.ndarray:
    """Positions as encoders of this step, or sensors with this noise, read them."""
    return np.round(exact / quantum) * quantum if quantum else exact + random.normal(0, std, exact.shape)


def rows_late(y: np.ndarray, column: int, rows: int) -> np.ndarray:
    """The positions with one column moved down by some rows."""
    y = y.copy()
    y[rows:, column] = y[: len(y) - rows, column]
    return y


def seconds_late(t: np.ndarray, values: np.ndarray, columns: list[int], time: float) -> np.ndarray:
    """Values with some columns late by a time [s], interpolated linearly."""
    values = values.copy()
    for i in columns:
        seen = np.isfinite(values[:, i])
        values[:, i] = np.interp(t - time, t[seen], values[seen, i])
    return values


class Fault(NamedTuple):
    """A log with one fault.

    Attributes:
        file: The model file.
        record: The log.
        names: Findings, any of which names the fault.
        where: Column that the finding has to name; "" for any.
        shows: Whether the fault is larger than the noise.
    """

    file: ModelFile
    record: Record
    names: tuple[str, ...]
    where: str = ""
    shows: bool = True


def _moved_positions(made: Made, y: np.ndarray, names: tuple[str, ...], where: str = "") -> Fault:
    noise = made.quantum / np.sqrt(12) or made.std
    change = np.sqrt(np.nanmean((y - made.record.y) ** 2, axis=0)).max()
    return Fault(made.file, made.record._replace(y=y), names, where, bool(change > 3 * noise))


def row_shift(made: Made, random: np.random.Generator, joint: int) -> Fault:
    y = rows_late(made.record.y, joint, int(random.integers(1, 4)))
    return _moved_positions(made, y, ("delay", "row shift"), f"q{joint + 1}")


def delay(made: Made, random: np.random.Generator, joint: int) -> Fault:
    late = seconds_late(made.record.t, made.exact, [joint], PERIOD * random.uniform(1.2, 4))
    y = sensed(random, late, made.quantum, made.std)
    return _moved_positions(made, y, ("delay", "row shift"), f"q{joint + 1}")


def common_delay(made: Made, random: np.random.Generator, joint: int) -> Fault:
    n = made.exact.shape[1]
    late = seconds_late(made.record.t, made.exact, list(range(n)), PERIOD * random.uniform(2, 5))
    return _moved_positions(made, sensed(random, late, made.quantum, made.std), ("delay against the inputs",))


def sign_of_an_input(made: Made, random: np.random.Generator, joint: int) -> Fault:
    u = made.record.u * np.where(np.arange(made.record.u.shape[1]) == joint, -1, 1)
    # Of a single joint the sign of the angle does the same.
    return Fault(made.file, made.record._replace(u=u), ("sign of an input", "sign of a position"))


def sign_of_a_position(made: Made, random: np.random.Generator, joint: int) -> Fault:
    y = made.record.y * np.where(np.arange(made.record.y.shape[1]) == joint, -1, 1)
    return Fault(made.file, made.record._replace(y=y), ("sign of a position",))


def degrees(made: Made, random: np.random.Generator, joint: int) -> Fault:
    return Fault(made.file, made.record._replace(y=np.rad2deg(made.record.y)), ("unit of positions",))


def milliseconds(made: Made, random: np.random.Generator, joint: int) -> Fault:
    return Fault(made.file, made.record._replace(t=1e3 * made.record.t), ("unit of time",))


def gravity(made: Made, random: np.random.Generator, joint: int) -> Fault:
    """Gravity with the other sign is the zero of the first angle half a turn on."""
    name = "pendulum" if made.exact.shape[1] == 1 else "double pendulum"
    turned = load(MACHINES[name].model, (*MACHINES[name].overrides, "parameters.gravity=-9.81")).model
    return Fault(made.file._replace(model=turned), made.record, ("zero of a position",))


def other_inputs(made: Made, random: np.random.Generator, joint: int) -> Fault:
    other = {"held": "linear", "linear": "held"}[made.file.input_between]
    return Fault(made.file._replace(input_between=other), made.record, ("inputs between rows",))


def inputs_after_they_acted(made: Made, random: np.random.Generator, joint: int) -> Fault:
    u = np.concatenate([made.record.u[:1], made.record.u[:-1]])
    return Fault(made.file, made.record._replace(u=u), ("inputs between rows", "delay against the inputs"))


def many_outliers(made: Made, random: np.random.Generator, joint: int) -> Fault:
    bad = random.random(made.record.y.shape) < 0.03
    bad[:3] = False
    y = made.record.y + bad * (0.3 + np.abs(random.normal(0, 0.5, bad.shape)))
    return Fault(made.file, made.record._replace(y=y), ("outliers",))


def swapped_positions(made: Made, random: np.random.Generator, joint: int) -> Fault:
    return Fault(made.file, made.record._replace(y=made.record.y[:, ::-1]), ("swapped positions",))


def swapped_joints(made: Made, random: np.random.Generator, joint: int) -> Fault:
    y, u = made.record.y[:, ::-1], made.record.u[:, ::-1]
    return Fault(made.file, made.record._replace(y=y, u=u), ("swapped joints",))


def scale(made: Made, random: np.random.Generator, joint: int) -> Fault:
    return Fault(made.file, made.record._replace(u=2 * made.record.u), ("scale of an input",))


def gap(made: Made, random: np.random.Generator, joint: int) -> Fault:
    kept = np.ones(ROWS, bool)
    first = int(random.integers(200, 1200))
    kept[first : first + int(random.integers(5, 60))] = False
    return Fault(made.file, Record(*(a[kept] for a in made.record[:3])), ("missing rows",))


def held_readings(made: Made, random: np.random.Generator, joint: int) -> Fault:
    y = made.record.y[np.arange(ROWS) // 4 * 4]
    return Fault(made.file, made.record._replace(y=y), ("repeated rows",))


def stuck_encoder(made: Made, random: np.random.Generator, joint: int) -> Fault:
    """A position keeps one value from the middle on, or for a tenth of the log."""
    y, begin = made.record.y.copy(), int(random.integers(ROWS // 3, ROWS // 2))
    end = ROWS if random.random() < 0.5 else begin + ROWS // 10
    y[begin:end, joint] = y[begin, joint]
    return Fault(made.file, made.record._replace(y=y), ("repeated rows",))


def moved_zero(made: Made, random: np.random.Generator, joint: int) -> Fault:
    """A position has another zero from a row on."""
    y = made.record.y.copy()
    y[int(random.integers(ROWS // 3, 2 * ROWS // 3)) :, joint] += random.choice([-1, 1]) * random.uniform(0.1, 0.4)
    return Fault(made.file, made.record._replace(y=y), ("zero of a position",))


def clock_forward(made: Made, random: np.random.Generator, joint: int) -> Fault:
    t = made.record.t + 0.4 * (np.arange(ROWS) >= int(np.argmax(np.abs(np.diff(made.exact[200:1200, 0])))) + 200)
    return Fault(made.file, made.record._replace(t=t), ("clock set forward",))


def _lacking(made_: Made, name: str, sizes: list[float], joint: int) -> Record:
    """The log of a machine with another number of one joint than the model file states."""
    stated = document(MACHINES[made_.arguments["name"]].model)["parameters"].get(name, [0.0] * len(sizes))
    values = [one + size * (i == joint) for i, (one, size) in enumerate(zip(stated, sizes, strict=True))]
    return made(**made_.arguments, unknown=(f"parameters.{name}={values}",)).record


def unknown_friction(made: Made, random: np.random.Generator, joint: int) -> Fault:
    sizes = [0.2 * size for size in MACHINES[made.arguments["name"]].push]
    return Fault(made.file, _lacking(made, "viscous", sizes, joint), ("friction",), f"q{joint + 1}")


def unknown_rotor(made: Made, random: np.random.Generator, joint: int) -> Fault:
    """A rotor as heavy as the link is at its joint; the sign or scale of the only input cannot be it, for gravity."""
    gear = document(MACHINES[made.arguments["name"]].model)["parameters"].get("gear", [1.0] * made.exact.shape[1])
    metric = np.diag(made.file.model.space(jnp.zeros(made.exact.shape[1])))
    sizes = [float(one / ratio**2) for one, ratio in zip(metric, gear, strict=True)]
    return Fault(made.file, _lacking(made, "rotor_inertia", sizes, joint), ("rotor inertia",), f"q{joint + 1}")


def thousandths(made: Made, random: np.random.Generator, joint: int) -> Fault:
    """Inputs in thousandths of their unit, as of a drive that logs mN m."""
    return Fault(made.file, made.record._replace(u=1e3 * made.record.u), ("unit of an input",))


def compensated(made_: Made, random: np.random.Generator, joint: int) -> Fault:
    """The log has the inputs beyond gravity compensation."""
    record = made(**made_.arguments, unknown=("parameters.gravity=0.0",)).record
    return Fault(made_.file, record, ("gravity", "gravity and friction"))


def geared(made: Made, random: np.random.Generator, joint: int) -> Fault:
    """The encoder of a joint is behind a gear and begins anew several times a turn."""
    period = 2 * np.pi / int(random.integers(3, 12))
    period = np.round(period / made.quantum) * made.quantum if made.quantum else period
    y = made.record.y.copy()
    # The first reading is right, and the next ones follow it within a period about it.
    begin = y[0, joint] - period / 2
    y[:, joint] = begin + (y[:, joint] - begin) % period
    jumps = np.abs(np.diff(y[np.isfinite(y[:, joint]), joint])) > period / 2
    return Fault(made.file, made.record._replace(y=y), ("period",), f"q{joint + 1}", bool(jumps.sum() > 3))


def second_sender(made: Made, random: np.random.Generator, joint: int) -> Fault:
    """Every few rows come from another machine, or late from the same one."""
    y, t = made.record.y.copy(), made.record.t
    rows = np.arange(int(random.integers(2, 5)), len(t), int(random.integers(2, 12)))
    moved = np.interp(t - 0.05, t, made.exact[:, joint])
    moved = moved if random.random() < 0.5 else 0.4 * np.sin(3 * t) - moved
    y[rows, joint] = sensed(random, moved[rows], made.quantum, made.std)
    return _moved_positions(made, y, ("several senders",), f"q{joint + 1}")


ANGLES, ALL, TWO = ("pendulum", "double pendulum"), tuple(MACHINES), ("double pendulum",)
FAULTS = {
    "row shift": (row_shift, TWO),
    "delay": (delay, TWO),
    "common delay": (common_delay, ALL),
    "sign of an input": (sign_of_an_input, ALL),
    "sign of a position": (sign_of_a_position, TWO),
    "degrees": (degrees, ANGLES),
    "milliseconds": (milliseconds, ALL),
    "gravity": (gravity, ANGLES),
    "other inputs": (other_inputs, ALL),
    "inputs after they acted": (inputs_after_they_acted, ALL),
    "outliers": (many_outliers, ALL),
    "swapped positions": (swapped_positions, TWO),
    "swapped joints": (swapped_joints, TWO),
    "scale": (scale, ALL),
    "gap": (gap, ALL),
    "held readings": (held_readings, ALL),
    "stuck encoder": (stuck_encoder, ALL),
    "moved zero": (moved_zero, ALL),
    "clock set forward": (clock_forward, ALL),
    "unknown friction": (unknown_friction, ANGLES),
    "unknown rotor": (unknown_rotor, ANGLES),
    "thousandths": (thousandths, ALL),
    "compensated": (compensated, ANGLES),
    "geared": (geared, ANGLES),
    "second sender": (second_sender, ALL),
}
"""Faults by name, and the machines that can have them."""
CLEAN = ("other inputs", "inputs after they acted")
"""Faults of half a row or one: their logs are of good sensors and of strong inputs that jump."""
STRONG = 4.0
"""Size of these inputs, in those of the machine."""
TICKLESS = ("held readings",)
"""Faults that ticks look like: their logs are of sensors with noise."""


def without_fault(seed: int) -> Made:
    """A log without faults: machine, inputs, sensors and what goes on between rows depend on the seed."""
    random = np.random.default_rng(1000 + seed)
    fast, between = bool(random.random() < 0.4), "linear" if random.random() < 0.4 else "held"
    counts = (0, 0, 52, 128, 256, 1024, 4096)[int(random.integers(7))]
    return made(ALL[seed % len(ALL)], seed, fast, between, counts)


def with_fault(kind: str, seed: int) -> Fault:
    """A log with a fault that shows, the first one from this seed on."""
    change, machines = FAULTS[kind]
    while True:
        random = np.random.default_rng(5000 + seed)
        fast = kind in (*CLEAN, "common delay") or bool(random.random() < 0.3)
        between = "linear" if random.random() < 0.3 else "held"
        counts = 0 if kind in (*CLEAN, *TICKLESS) else (0, 0, 1024, 4096)[int(random.integers(4))]
        std, push = (2e-5, STRONG) if kind in CLEAN else (None, 1.0)
        log = made(machines[seed % len(machines)], seed, fast, between, counts, std, push)
        fault = change(log, random, int(random.integers(log.exact.shape[1])))
        if fault.shows:
            return fault
        seed += 100


PAIRS = (
    *(("unknown friction", "thousandths"), ("compensated", "thousandths"), ("compensated", "degrees")),
    *(("unknown friction", "degrees"), ("delay", "milliseconds"), ("unknown friction", "sign of an input")),
    *(("compensated", "sign of an input"), ("geared", "thousandths"), ("unknown friction", "milliseconds")),
)
"""Two faults at once, of which the second one changes the log of the first."""


def with_two_faults(first: str, second: str, seed: int) -> Fault:
    """A log with two faults; `names` are those of the second one, and then those of the first."""
    (change, machines), after = FAULTS[first], FAULTS[second][0]
    while True:
        random = np.random.default_rng(7000 + seed)
        log = made(machines[seed % len(machines)], seed, counts=(0, 4096)[seed % 2])
        joint = int(random.integers(log.exact.shape[1]))
        fault = change(log, random, joint)
        if fault.shows:
            both = after(log._replace(file=fault.file, record=fault.record), random, joint)
            return both._replace(names=(*both.names, *fault.names))
        seed += 100


def alarms(found: list, what: tuple[str, ...] = ()) -> list[str]:
    """The findings that are wrong, beside those that are expected."""
    return [f"{each.what} {each.where}: {each.evidence}" for each in found if each.wrong and each.what not in what]


def named(found: list, fault: Fault) -> bool:
    """Whether the fault is named, and nothing else is called wrong."""
    right = [each for each in found if each.what in fault.names and fault.where in ("", each.where)]
    return bool(right) and not alarms(found, fault.names)
