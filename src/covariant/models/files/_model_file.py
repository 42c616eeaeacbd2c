"""Defines the content of a model file: a model with its logs' columns, its sensors' noise, and its uncertainties."""

import contextlib
import math
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Annotated, Any, NamedTuple, get_origin, get_type_hints

from covariant.logs import Columns
from covariant.models._mechanical import MechanicalSystem
from covariant.models._parameters import ANY_SIGN, ZERO_OR_MORE
from covariant.models.files._columns import unnamed_attitudes
from covariant.models.files._keys import Choice, Deviations, Key, Number
from covariant.models.files._source import Model, first_line
from covariant.models.files._systems import JOINTED, OF_LINKS, PLAIN, Vocabulary
from scalargraph.errors import InputError

Several = float | tuple[float, ...]
Unknown = Several | None
"""A number, or one for each coordinate or state; None if it is not known."""


CHOSEN = ("intrinsic", "intrinsic-force", "intrinsic-kalman", "measured-coefficients")
"""Observers that a model file may choose."""


class ModelError(InputError):
    """A model cannot be loaded.

    The message is one line: the file or module, the fault, and the remedy.

    It is a `ValueError`, so that one `except` catches it together with other faults of the arguments.

    Example:
        >>> from covariant import models
        >>> try:
        ...     models.load("oscilator")
        ... except models.ModelError as error:
        ...     print(str(error).split(" Known")[0])
        oscilator: unknown model 'oscilator'. Did you mean 'oscillator'?
    """


@contextlib.contextmanager
def named(spec: str) -> Iterator[None]:
    """Raise a `ValueError` as a `ModelError`: the name of the model, and the first line of the message."""
    try:
        yield
    except InputError as error:
        line = first_line(error)  # for a robot's file it contains the path already
        raise ModelError(line if line.startswith(f"{spec}: ") else f"{spec}: {line}") from error


class ModelFile(NamedTuple):
    """A model and the numbers from which a design starts; a number that is not known is None.

    Most fields are keys of the model file. Key and range of each are declared with the field, its meaning and unit only
    in the list below; reading, overrides, messages and the table of keys use these.

    Attributes:
        name: Name of the model in messages and titles.
        model: A `MechanicalSystem` or a `StateSpace`.
        columns: Columns of a log; empty `q` and `u` mean the model's coordinates and u1, u2, …. For a `StateSpace`,
            `q` are the outputs.
        input_lag: Time constant [s] of the first-order lag between logged input and force.
        input_delay: Time [s] from the stamp of an input until it acts; for a command a key of its `[servo.JOINT]`.
        input_lead: Time [s]; an input is increased by this time multiplied by its rate. For a command it follows from
            the `feedforward` of its servo.
        input_kind: Whether each input is a "torque" (or force), or the "command" of a servo.
        input_between: Whether an input is "held" from one stamp to the next, or "linear" between them.
        measurement_std: Standard deviation of a measured position [its unit]; on a group, of each component of
            `log(g⁻¹ y)`, the error as seen from the body [rad, and m where there is a position].
        delay: Measurement delay [s]: a position read at the stamp t was true at t − delay.
        quantum: One tick of the encoders [unit of the coordinates], in place of a standard deviation.
        period: Period [unit of the coordinates] after which an encoder reads the same again, such as a single-turn
            encoder behind a gear; 0 for none. Angles on a full circle have the period 2π anyway.
        bias: Standard deviation of a constant offset of a measured position [its unit], for a filter that estimates it.
        bias_drift: Standard deviation of the change of the offset in a second [its unit].
        acceleration_std: Standard deviation [unit/s²] of the acceleration that the model does not explain.
        torque_std: Standard deviation of the torques or forces that the model does not explain [N m or N]: as noise of
            the acceleration it is larger for a smaller inertia. It has the same correlation time.
        correlation_time: Correlation time [s] of the acceleration that the model does not explain.
        process_std: Standard deviation of the white noise in the rate of each state [its unit/√s].
        external_force: Standard deviation of the change per second of an unknown force [N or N m], for a filter that
            estimates it: a random walk, which keeps its value through a gap.
        external_force_std: Usual size [N or N m] of an unknown force, for a filter that estimates it and forgets it
            over time.
        external_force_time: Time constant [s] with which that force is forgotten.
        presliding: Distance [rad or m] over which the Coulomb friction of a joint turns at a reversal, for a filter
            that has its force as a state; 0 for none.
        uncertain: Relative standard deviations of numbers of `[parameters]`, by name, for a filter that estimates them.
        parameters_drift: Standard deviation of their relative change in a second.
        motion_std: Standard deviation [unit/s²] of the acceleration of the motion, for filters that use no model.
        motion_time: Correlation time [s] of the acceleration of the motion, for filters that use no model.
        initial_state: First estimate of each state [its unit]. By default the middle of the model's box, or zero.
        initial_std: Standard deviation of the first estimate [its unit]. By default as large as the box is wide.
        damping: Damping ratio of the error [1].
        natural_frequency: Natural frequency [rad/s] of the error under constant gains, if it is not designed from the
            noise.
        force_rate: Rate [1/s] at which an unknown force is learnt under constant gains, 0 for none. By default it is
            designed from the size and time of the force in `[uncertainty]`.
        observer: Observer to run where none is asked for, as `covariant tune` chooses it.
        alpha: Gain α [1/s] of `measured-coefficients`, as `covariant certify` finds it, with `design.beta`.
        beta: Gain β [1/s²] of `measured-coefficients`.
        speed_bound: Bound of the true velocities [unit/s] to which `measured-coefficients` clips; by default none.
        reference_half: Half width [s] of the windows of the local polynomials that give the reference velocity for
            scoring.
        reference_order: Degree of these polynomials.
        wrenches: Forces on links of a robot, by name, for a filter that estimates them: arguments of
            `covariant.observers.wrench`.
        sensors: Further sensors, by name, with the keys of their tables, for a filter that uses them.
        family: The model with the numbers of `uncertain` open, in their order.
        system: Name of the system, if it is from this library, such as "robot".
        stated: Keys of [parameters], which `covariant.fit` accepts as names.

    Example:
        >>> from covariant import models
        >>> file = models.ModelFile("spring", models.oscillator(), measurement_std=(3e-3, 4e-3))
        >>> file.mechanical, round(file.typical_std, 4)
        (True, 0.0035)
    """

    name: str
    model: Model
    columns: Columns = Columns()
    input_lag: Annotated[float, Number("inputs.lag", ZERO_OR_MORE)] = 0.0
    input_delay: Annotated[Several, Number("inputs.delay", ZERO_OR_MORE, "input")] = 0.0
    input_lead: Annotated[Several, Number("inputs.lead", ANY_SIGN, "input")] = 0.0
    input_kind: Annotated[str, Choice("inputs.kind", ("torque", "command"))] = "torque"
    input_between: Annotated[str, Choice("inputs.between", ("held", "linear"))] = "held"
    measurement_std: Annotated[Unknown, Number("measurement.std", each="component", replaces=("quantum",))] = None
    delay: Annotated[Several, Number("measurement.delay", ZERO_OR_MORE, "coordinate")] = 0.0
    quantum: Annotated[Unknown, Number("measurement.quantum", each="coordinate", replaces=("std",))] = None
    period: Annotated[Several, Number("measurement.period", ZERO_OR_MORE, "coordinate")] = 0.0
    bias: Annotated[Unknown, Number("measurement.bias", ZERO_OR_MORE, "coordinate")] = None
    bias_drift: Annotated[Several, Number("measurement.bias_drift", ZERO_OR_MORE, "coordinate")] = 0.0
    acceleration_std: Annotated[float | None, Number("uncertainty.acceleration")] = None
    torque_std: Annotated[Unknown, Number("uncertainty.torque", each="velocity")] = None
    correlation_time: Annotated[float | None, Number("uncertainty.correlation_time")] = None
    process_std: Annotated[Unknown, Number("uncertainty.process", each="state")] = None
    external_force: Annotated[
        float | None,
        Number("uncertainty.external_force", replaces=("external_force_std", "external_force_time")),
    ] = None
    external_force_std: Annotated[
        Unknown, Number("uncertainty.external_force_std", each="velocity", replaces=("external_force",))
    ] = None
    external_force_time: Annotated[float | None, Number("uncertainty.external_force_time")] = None
    presliding: Annotated[Several, Number("uncertainty.presliding", ZERO_OR_MORE, "velocity")] = 0.0
    uncertain: Annotated[Mapping[str, float], Deviations("uncertainty.parameters")] = MappingProxyType({})
    parameters_drift: Annotated[float, Number("uncertainty.parameters_drift", ZERO_OR_MORE)] = 0.0
    motion_std: Annotated[float | None, Number("uncertainty.motion_acceleration")] = None
    motion_time: Annotated[float | None, Number("uncertainty.motion_time")] = None
    initial_state: Annotated[Unknown, Number("initial.state", ANY_SIGN, "state")] = None
    initial_std: Annotated[Unknown, Number("initial.std", each="state")] = None
    damping: Annotated[float, Number("design.damping")] = math.sqrt(0.5)
    natural_frequency: Annotated[float | None, Number("design.natural_frequency")] = None
    force_rate: Annotated[float | None, Number("design.force_rate", ZERO_OR_MORE)] = None
    observer: Annotated[str, Choice("design.observer", CHOSEN)] = ""
    alpha: Annotated[Unknown, Number("design.alpha", each="coordinate")] = None
    beta: Annotated[Unknown, Number("design.beta", each="coordinate")] = None
    speed_bound: Annotated[Unknown, Number("design.speed", each="coordinate")] = None
    reference_half: Annotated[float, Number("reference.half")] = 0.03
    reference_order: Annotated[float, Number("reference.order", whole=True)] = 3
    wrenches: Mapping[str, Mapping[str, Any]] = MappingProxyType({})
    sensors: Mapping[str, Mapping[str, Any]] = MappingProxyType({})
    family: Any = None
    system: str = ""
    stated: tuple[str, ...] = ()

    @property
    def typical_std(self) -> float | None:
        """The measurement noise in one number: `measurement_std`, or the root mean square of its entries."""
        std = self.measurement_std
        # hypot scales its arguments, so no square overflows or underflows.
        return math.hypot(*std) / math.sqrt(len(std)) if isinstance(std, tuple) else std

    @property
    def dimension(self) -> int:
        """Number n of velocities; for a `StateSpace`, of states."""
        return len(self.model.velocities) or len(self.columns.q if self.mechanical else self.model.coordinates)

    @property
    def mechanical(self) -> bool:
        """Whether the model is a mechanical system, with a velocity to estimate; otherwise it is a `StateSpace`."""
        return isinstance(self.model, MechanicalSystem)

    @property
    def vocabulary(self) -> Vocabulary:
        """What sentences call the parts of the machine, such as its joints."""
        return JOINTED if self.system in OF_LINKS else PLAIN

    def uncertain_std(self, name: str) -> float | None:
        """Relative standard deviation of a number such as `mass[0]`, by that of `mass` too; None if it is known."""
        plain = {key.strip().removeprefix("parameters."): std for key, std in self.uncertain.items()}
        return plain.get(name, plain.get(name.partition("@")[0].partition("[")[0]))

    def need_mechanical(self, spec: str, why: str) -> MechanicalSystem:
        """Require a mechanical model.

        Args:
            spec: Name of the model in the message.
            why: The purpose that needs a mechanical model, for the message.

        Returns:
            The mechanical model.

        Raises:
            ValueError: The model is a `StateSpace`.
        """
        if not isinstance(self.model, MechanicalSystem):
            raise InputError(
                f"{spec} is a state-space model, and {why} mechanical ones, a Lagrangian or a GroupSystem; design an "
                "observer for its states by `covariant design metric`"
            )
        return self.model

    @property
    def unnamed_attitudes(self) -> int:
        """Number of attitudes in a log of the model for which no column states a representation."""
        return unnamed_attitudes(self.model, self.columns)


KEYS: dict[str, Key] = {
    field: hint.__metadata__[0]
    for field, hint in get_type_hints(ModelFile, include_extras=True).items()
    if get_origin(hint) is Annotated
}
"""The keys of a model file, by the field of `ModelFile` that they fill."""
