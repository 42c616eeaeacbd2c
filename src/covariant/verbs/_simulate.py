"""`simulate`: a log of a simulated machine, with the true state beside what its sensors read."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from covariant import logs
from covariant.verbs.base.arguments import Amounts, Overrides
from covariant.verbs.base.progress import Progress, notebook_line
from covariant.verbs.base.result import AbstractTable
from covariant.verbs.base.scenario import FORCE, Scenario, check_scenario


def simulate(
    model: Any,
    *,
    duration: float = 10.0,
    rate: float = 500.0,
    q0: Amounts | None = None,
    v0: Amounts | None = None,
    amplitude: Amounts | None = None,
    frequency: float = 0.5,
    noise: Amounts = 0.0,
    quantum: Amounts = 0.0,
    jitter: float = 0.0,
    dropout: float = 0.0,
    seed: int = 0,
    push: Amounts | None = None,
    overrides: Overrides = (),
    progress: Progress = notebook_line,
) -> "SimulateResult":
    """Simulate a model and its sensors.

    Inputs are sinusoids, sampled at the stamps. Between them they act as the model file says of its logs: held, unless
    [inputs] has between = "linear"; later by its `delay`, and behind its `lag`. Nothing stops the joints of a robot at
    the limits of its file; a warning names those that leave them, and when. Where no motion is asked for, by q0, v0,
    amplitude or push, and a machine at rest stays at rest, the log begins with a velocity of 1 in all coordinates, or
    with another state of a state-space model; a warning says so.

    Args:
        model: A model file (.toml), a robot (.urdf, .xml), `module:attribute`, the name of a system or a robot of the
            library, a `ModelFile`, or a system.
        duration: Length of the log [s].
        rate: Samples a second [Hz].
        q0: Initial positions (n,); on a group exponential coordinates of a pose; of a state-space model the whole
            initial state; zeros by default.
        v0: Initial velocities (n,), zeros by default.
        amplitude: Amplitudes (m,) of the inputs, zeros by default.
        frequency: Frequency of the first input [Hz]; the others are faster by 37 % of it each.
        noise: Standard deviation of the noise of a position [its unit, SI], one or one for each; on a group, of the
            rotations and translations of its error as seen from the body.
        quantum: Step of the encoders [unit of the position, SI], one or one for each.
        jitter: Standard deviation of the sampling instants [s].
        dropout: Probability that a sample is missing.
        seed: Seed of noise, jitter and dropouts.
        push: Largest force (n,) of pushes from outside [N or N m], as generalised forces along the velocities; one
            begins every two seconds. The first begins after one second, each rises and falls within a second, on each
            coordinate in turn, and their sign alternates from round to round. The log then has them as
            `true_external_force1`, ….
        overrides: Values that replace those of the model file: `{"parameters.mass": [2.0]}`, or
            `["parameters.mass=[2.0]"]`.
        progress: Called with a description and a fraction as the work goes on.

    Returns:
        The log as a table, and as a `Record` with the true state.

    Raises:
        ValueError: For an argument that makes no sense, a model that cannot be used, or a motion that leaves the finite
            numbers.

    Example:
        >>> import covariant
        >>> result = covariant.simulate("oscillator", duration=2.0, rate=100.0, q0=[1.0], noise=1e-3)
        >>> list(result.columns)
        ['t', 'q', 'u1', 'true_q', 'true_v']
    """
    scenario = Scenario(duration, rate, q0, v0, amplitude, frequency, noise, quantum, jitter, dropout, seed, push)
    check_scenario(scenario)
    from covariant.verbs.base.simulated_log import simulated_log  # loads what computes, after the arguments are checked

    return SimulateResult(*simulated_log(model, overrides, scenario, progress))


@dataclass(frozen=True, repr=False)
class SimulateResult(AbstractTable):
    """Log of a simulated machine: stamps, what its sensors read, its inputs, and the true state as true_….

    Attributes:
        model_name: The model, by its path or name.
        mechanical: Whether the model is a mechanical system; otherwise it is a state-space model.
        layout: The `logs.Columns`: names of the log as the model file names them, and their units there.
        record: The `Record`: stamps, inputs, measurements and the true state x, in SI units.
        truth_columns: The columns of the true velocities, or of the states of a state-space model.
        si_columns, si_units: The columns in SI units and radians, and these units.
        sensors: Sensors of the model file, whose columns are among these.
        remarks: Sentences: with what a motion was begun that nothing was given for, or that nothing moves; and which
            joints of a robot leave their limits, and when.

    Example:
        >>> import covariant
        >>> result = covariant.simulate("oscillator", duration=2.0, rate=100.0, q0=[1.0])
        >>> result
        <SimulateResult: 201 rows over 2 s of oscillator>
        >>> result.truth_columns, round(float(result.columns["q"][0]), 6)
        (('true_v',), 1.0)
    """

    model_name: str
    mechanical: bool
    layout: Any
    record: Any
    truth_columns: tuple[str, ...]
    si_columns: dict[str, np.ndarray]
    si_units: dict[str, str]
    sensors: tuple[Any, ...] = ()
    remarks: tuple[str, ...] = ()

    @property
    def warnings(self) -> tuple[str, ...]:
        return self.remarks

    @property
    def columns(self) -> dict[str, np.ndarray]:
        return self._in_units(messages=False)

    @property
    def units(self) -> dict[str, str]:
        return self.si_units | {name: unit for name, unit in self._units(messages=False).items() if unit is not None}

    @property
    def headline(self) -> str:
        span = self.record.t[-1] - self.record.t[0]
        return f"{len(self.record.t)} rows over {span:g} s of {Path(self.model_name).stem}"

    @property
    def force_columns(self) -> tuple[str, ...]:
        """The columns of the true forces from outside; none where nothing pushes."""
        return tuple(name for name in self.si_columns if name.startswith(f"true_{FORCE}"))

    @property
    def summary(self) -> dict[str, Any]:
        truth, forces = ",".join(self.truth_columns), ",".join(self.force_columns)
        pushed = {"force_columns": forces} if forces else {}
        warned = {"warnings": list(self.warnings)} if self.warnings else {}
        return {"model": self.model_name, "rows": len(self.record.t), "truth_columns": truth, **pushed, **warned}

    def __str__(self) -> str:
        use = 'score against `columns["truth"]`' if self.mechanical else "the true state is in"
        forces = ", true forces are in " * bool(self.force_columns) + ",".join(self.force_columns)
        rows = f"{len(self.record.t)} rows; {use} {','.join(self.truth_columns)}{forces}"
        return "\n".join([rows, *self.warnings])

    written = logs.WRITTEN

    def _write(self, path: Path) -> None:
        logs.write(path, self._in_units(path.suffix in logs.MESSAGES))

    def _units(self, messages: bool) -> dict[str, str | None]:
        """Units of the columns, None where they are in SI units; the stamps of ROS messages are not converted."""
        names = self.layout
        fields = {"t": () if messages else (names.t,), "q": names.q, "u": names.u}
        fields |= {"position": names.position, "angle": names.angle}
        units = {name: names.unit_of(field, i) for field, each in fields.items() for i, name in enumerate(each)}
        units |= {f"true_{name}": unit for name, unit in units.items()}
        units |= {name: names.unit_of("truth", i) for i, name in enumerate(self.truth_columns)}
        units |= {name: unit for part in self.sensors for name, unit in part.units.items()}
        return {name: unit for name, unit in units.items() if name in self.si_columns}

    def _in_units(self, messages: bool) -> dict[str, np.ndarray]:
        # A factor converts the log's unit to the SI unit, so SI values are divided by it.
        factors = {name: logs.unit_factor(unit) for name, unit in self._units(messages).items() if unit is not None}
        return {name: column / factors.get(name, 1.0) for name, column in self.si_columns.items()}
