"""A model with the columns of its logs, the noise of its sensors and the uncertainty of its parameters."""

import inspect
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from covariant.logs import Columns
from covariant.models import _source, _toml
from covariant.models._check import check_metric
from covariant.models._columns import model_columns, unnamed_attitudes
from covariant.models._mechanical import MechanicalSystem
from covariant.models._source import Model
from covariant.models._systems import ROBOT_FILES, SYSTEMS, unknown_model
from covariant.models._toml import Overrides
from covariant.models.robots import ROBOTS


class ModelError(ValueError):
    """A model cannot be loaded.

    The message is one line: the file or module, what is wrong there, and what to do.

    Example:
        >>> from covariant import models
        >>> try:
        ...     models.load("oscilator")
        ... except models.ModelError as error:
        ...     print(str(error).split(" Known")[0])
        oscilator: unknown model 'oscilator'. Did you mean 'oscillator'?
    """


class ModelFile(NamedTuple):
    """A model and the numbers that a design starts from; a number that is not known is None.

    Attributes:
        name: What messages and titles call the model.
        model: A `MechanicalSystem` or a `StateSpace`.
        columns: Columns of a log; empty `q` and `u` stand for the model's coordinates and for u1, u2, …. Where the
            model is a `StateSpace`, `q` are its outputs.
        measurement_std: Standard deviation of a measured position [its unit], or one for each coordinate; on a group
            that of each component of `log(g⁻¹ y)`, the error as seen from the body [rad, and m where there is a
            position].
        acceleration_std: Standard deviation [unit/s²] of the acceleration that the model does not explain.
        correlation_time: Correlation time [s] of the acceleration that the model does not explain.
        motion_std: Standard deviation [unit/s²] of the acceleration of the motion, for filters that use no model.
        motion_time: Correlation time [s] of the acceleration of the motion, for filters that use no model.
        damping: Damping ratio of the error [1].
        input_lag: Time constant [s] of the first-order lag between logged input and force.
        reference_half: Half width [s] of the windows of the local polynomials that give the reference velocity for
            scoring.
        reference_order: Degree of these polynomials.
        delay: Measurement delay [s]: a position read at the stamp t was true at t − delay; or one for each coordinate.
        input_delay: Time [s] from the stamp of an input until it acts.
        input_between: Whether an input is "held" from one stamp to the next, or "linear" between them.
        quantum: One tick of the encoders [unit of the coordinates], or one for each coordinate, where the model file
            states that and not a standard deviation.
        external_force: Standard deviation of the change in a second of a force that the model does not know [N or N m],
            for a filter that estimates it: a random walk, which stays through a gap.
        process_std: Of a `StateSpace`: standard deviation of the white noise in the rate of each state [its unit/√s],
            or one for all.
        initial_state: Of a `StateSpace`: first estimate of each state [its unit], or one for all. By default the middle
            of the model's box, or zero.
        initial_std: Of a `StateSpace`: standard deviation of the first estimate [its unit], or one for all. By default
            as uncertain as the box is wide.
        natural_frequency: Natural frequency [rad/s] of the error under constant gains, where it is not designed from
            the noise.
        bias: Standard deviation of a constant offset of a measured position [its unit], or one for each coordinate, for
            a filter that estimates it.
        bias_drift: Standard deviation of the change of the offset in a second [its unit], or one for each coordinate.
        uncertain: Relative standard deviations of numbers of [parameters], by name, for a filter that estimates them.
        parameters_drift: Standard deviation of their relative change in a second.
        family: The model with these numbers open, in their order.
        external_force_std: Usual size [N or N m] of a force that the model does not know, or one for each coordinate,
            for a filter that estimates it and forgets it after `external_force_time` [s].
        external_force_time: Its time constant [s].
        system: Name of the system, where it is one of this library, as "robot".
        wrenches: Forces on links of a robot, by name, for a filter that estimates them: arguments of
            `observers.wrench`.
        sensors: Sensors beside the measured positions, by name, with the keys of their tables, for a filter that uses
            them.
        torque_std: Standard deviation of the torques or forces that the model does not explain [N m or N], or one for
            each coordinate: noise like `acceleration_std`, with its correlation time.

    Example:
        >>> from covariant import models
        >>> file = models.ModelFile("spring", models.oscillator(), measurement_std=(3e-3, 4e-3))
        >>> file.mechanical, round(file.typical_std, 4)
        (True, 0.0035)
    """

    name: str
    model: Model
    columns: Columns = Columns()
    measurement_std: float | tuple[float, ...] | None = None
    acceleration_std: float | None = None
    correlation_time: float | None = None
    motion_std: float | None = None
    motion_time: float | None = None
    damping: float = math.sqrt(0.5)
    input_lag: float = 0.0
    reference_half: float = 0.03
    reference_order: float = 3
    delay: float | tuple[float, ...] = 0.0
    input_delay: float = 0.0
    input_between: str = "held"
    quantum: float | tuple[float, ...] | None = None
    external_force: float | None = None
    process_std: float | tuple[float, ...] | None = None
    initial_state: float | tuple[float, ...] | None = None
    initial_std: float | tuple[float, ...] | None = None
    natural_frequency: float | None = None
    bias: float | tuple[float, ...] | None = None
    bias_drift: float | tuple[float, ...] = 0.0
    uncertain: Mapping[str, float] = MappingProxyType({})
    parameters_drift: float = 0.0
    family: Any = None
    external_force_std: float | tuple[float, ...] | None = None
    external_force_time: float | None = None
    system: str = ""
    wrenches: Mapping[str, Mapping[str, Any]] = MappingProxyType({})
    sensors: Mapping[str, Mapping[str, Any]] = MappingProxyType({})
    torque_std: float | tuple[float, ...] | None = None

    @property
    def typical_std(self) -> float | None:
        """The measurement noise in one number: `measurement_std`, or the root mean square of its entries."""
        std = self.measurement_std
        # hypot scales its arguments, so that no square overflows or underflows.
        return math.hypot(*std) / math.sqrt(len(std)) if isinstance(std, tuple) else std

    @property
    def dimension(self) -> int:
        """Number n of velocities; for a `StateSpace`, of states."""
        return len(self.model.velocities) or len(self.columns.q if self.mechanical else self.model.coordinates)

    @property
    def mechanical(self) -> bool:
        """Whether the model is a mechanical system, with a velocity to estimate; otherwise it is a `StateSpace`."""
        return isinstance(self.model, MechanicalSystem)

    def need_mechanical(self, spec: str, why: str) -> MechanicalSystem:
        """Require a mechanical model.

        Args:
            spec: What the message calls the model.
            why: What needs a mechanical model, for the message.

        Returns:
            The mechanical model.

        Raises:
            ValueError: The model is a `StateSpace`.
        """
        if not isinstance(self.model, MechanicalSystem):
            raise ValueError(
                f"{spec} is a state-space model, and {why} mechanical ones, a Lagrangian or a GroupSystem; design an "
                "observer for its states by `covariant design metric`"
            )
        return self.model

    @property
    def unnamed_attitudes(self) -> int:
        """Number of attitudes in a log of the model whose representation no column states."""
        return unnamed_attitudes(self.model, self.columns)


def finish(spec: str, content: dict[str, Any]) -> ModelFile:
    """Build the model file of a document and check it.

    Args:
        spec: Path or name that the document stands for.
        content: Tables and keys, as read from a model file.

    Returns:
        The model with its columns and numbers.

    Raises:
        ValueError: Names the first thing wrong.
    """
    loaded = made(spec, content)
    return _finished(loaded, Path(spec).stem if is_file(spec) else loaded.name, content)


def finish_object(given: Any, content: dict[str, Any]) -> ModelFile:
    """Build the model file of a model object, with the tables of a document on top.

    Args:
        given: A system or a `ModelFile`.
        content: Tables and keys, as read from a model file, without `system` and `parameters`.

    Returns:
        The model with its columns and numbers.

    Raises:
        ValueError: Names the first thing wrong.
    """
    for table in ("system", "parameters"):
        if table in content:
            raise ValueError(f"{table} is for models that are made from a file or by name; this one is made already")
    loaded = _build(type(given).__name__, given, {})
    return _finished(loaded, loaded.name, content)


def _finished(loaded: ModelFile, name: str, content: dict[str, Any]) -> ModelFile:
    columns = model_columns(loaded.model, loaded.columns, _toml.columns(content))
    model: Any = loaded.model
    if loaded.mechanical and model.manifold.commuting:
        check_metric(model, _points(len(columns.q)))
    # On a group the errors are components in the body frame, not logged columns: one number serves for all.
    count = len(columns.q) if model.manifold.commuting else 1
    states = 0 if loaded.mechanical else len(model.coordinates)
    return loaded._replace(name=name, columns=columns, **_toml.numbers(content, count, states))


def made(spec: str, content: dict[str, Any]) -> ModelFile:
    """Build the model of a document from its system, or from the attribute that a spec names, with its parameters.

    Args:
        spec: Path or name that the document stands for, or `module:attribute`.
        content: Tables and keys, as read from a model file; only `system` and `parameters` are used.

    Returns:
        The model file, without the other tables.

    Raises:
        ValueError: Names the system or parameter that is wrong.
    """
    what = content.get("system", spec.rpartition(":")[2])
    return _build(what, _model_or_factory(spec, content), content.get("parameters", {}))


def from_recipe(made: dict[str, Any], model: Any = None) -> Model:
    """Build the model of a recipe: a system of this library by name, with parameters of the right types.

    A recipe may come from a file, so nothing in it is ever imported. A caller who trusts the code may pass `model`.

    Args:
        made: The recipe, as `recipe` returns it: `system` or `attribute`, and `parameters`.
        model: A replacement for the system or attribute that the recipe names: a model, a function that builds one from
            the recipe's parameters, or the `module:attribute` of either.

    Returns:
        The model.

    Raises:
        ModelError: One line that names what is wrong.

    Example:
        >>> from covariant import models
        >>> models.from_recipe({"system": "oscillator", "parameters": {"stiffness": 2.0}}).coordinates
        ('q',)
    """
    parameters = made.get("parameters", {})
    try:
        if model is not None:
            return _replacement(model, parameters)
        if "attribute" in made:
            raise ValueError(
                f"the model is {made['attribute']!r}, code that a recipe does not run; whoever trusts it gives the "
                "model, as `model=module:attribute`"
            )
        factory, name = _source.system(made.get("system")), str(made.get("system"))
        with np.errstate(all="ignore"):  # parameters may make numbers infinite, which later checks find
            return _build(name, factory, parameters).model
    except Exception as error:  # parameters from a file may make a system fail in any way
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
        raise ModelError(kind + _source.first_line(error)) from error


def recipe_text(made: dict[str, Any]) -> str:
    """Describe the model of a recipe in one line, with all its parameters, default values included.

    For a model that is not of this library the line has the parameters of the recipe alone.

    Args:
        made: The recipe, as `recipe` returns it.

    Returns:
        The name, followed by `parameter = value` for each.

    Example:
        >>> from covariant import models
        >>> models.recipe_text({"system": "ball_and_beam", "parameters": {"mass": 2.0}})
        'ball_and_beam, gravity = 1.0, mass = 2.0, inertia = 1.0'
    """
    parameters = made.get("parameters", {})
    if "attribute" in made:
        name = f"{made['attribute']}, code that is not in this statement"
    else:
        name = str(made["system"])
        arguments = inspect.signature(_source.system(name)).parameters.values()
        defaults = {
            argument.name: argument.default for argument in arguments if argument.default is not inspect.Parameter.empty
        }
        parameters = defaults | parameters
    return name + "".join(f", {key} = {_number_text(value)}" for key, value in parameters.items())


def _number_text(value: Any) -> str:
    """A parameter as in a model file."""
    if isinstance(value, str) or value is None:
        return "none" if value is None else json.dumps(value, ensure_ascii=False)
    if isinstance(value, Sequence | np.ndarray):
        return "[" + ", ".join(map(_number_text, value)) + "]"
    return repr(value.item() if isinstance(value, np.generic) else value)


def _replacement(model: Any, parameters: dict[str, Any]) -> Model:
    """Build the model that a caller passes in place of the one that a recipe names."""
    name = model if isinstance(model, str) else type(model).__name__
    if isinstance(model, str) and not all(model.partition(":")):
        raise ValueError(f"a model is given as module:attribute; got {model!r}")
    candidate = _source.attribute(model) if isinstance(model, str) else model
    return _build(name, candidate, {} if isinstance(candidate, Model | ModelFile) else parameters).model


def is_file(spec: str) -> bool:
    """Whether a spec is the path of a model file, or a robot by its path or name."""
    return spec.endswith((".toml", *ROBOT_FILES)) or spec in ROBOTS


def document(spec: str, overrides: Overrides = ()) -> dict[str, Any]:
    """Read the document that a spec stands for, with overrides applied and its layout checked.

    Args:
        spec: As for `load`, except an object.
        overrides: As for `load`.

    Returns:
        Tables and keys as nested dictionaries and lists; empty for `module:attribute` without overrides.

    Raises:
        ValueError: The spec is unknown or unreadable, or a table, key or override is wrong.

    Example:
        >>> from covariant import models
        >>> models.document("oscillator", ["parameters.stiffness=2.0"])
        {'system': 'oscillator', 'parameters': {'stiffness': 2.0}}
    """
    content = _toml.override(_document(spec), overrides)
    _toml.check_layout(content)
    return content


def _document(spec: str) -> dict[str, Any]:
    if spec.endswith(ROBOT_FILES) or spec in ROBOTS:
        return {"system": "robot", "parameters": {"path": spec}}
    if is_file(spec):
        return _relative_to_file(Path(spec), _toml.parse(text(Path(spec))))
    if ":" in spec:
        return {}
    if spec not in SYSTEMS:
        raise ValueError(unknown_model(spec))
    return {"system": spec}


def _relative_to_file(path: Path, content: dict[str, Any]) -> dict[str, Any]:
    """The document of a model file; the path of a robot's file in it is relative to the folder of the model file."""
    parameters = content.get("parameters")
    if (
        content.get("system") != "robot"
        or not isinstance(parameters, dict)
        or not isinstance(parameters.get("path"), str)
    ):
        return content
    if parameters["path"] in ROBOTS:
        return content
    return content | {"parameters": parameters | {"path": str(path.parent / parameters["path"])}}


def text(path: Path) -> str:
    """Read a text file.

    Args:
        path: Path of a model file in UTF-8.

    Returns:
        Its text.

    Raises:
        ValueError: The file cannot be read.
    """
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise ValueError(f"{error.strerror or error}; give the path of a model file") from error


def _model_or_factory(spec: str, content: dict[str, Any]) -> Any:
    """Find the model that a spec names, or the function that builds it."""
    named = content.get("system")
    if is_file(spec) and isinstance(named, str) and ":" in named:
        return _source.attribute(named, Path(spec).parent)
    if is_file(spec) or ":" not in spec:
        return _source.system(named)
    if "system" in content:
        raise ValueError(f"system = {content['system']!r} contradicts module:attribute; drop one of them")
    return _source.attribute(spec)


def _build(name: str, candidate: Any, parameters: dict[str, Any]) -> ModelFile:
    """Return the model itself, or what the function makes of the parameters; for a system of this library, typed."""
    finished = isinstance(candidate, Model | ModelFile)
    if finished and parameters:
        raise ValueError(f"{name} is a finished model; only a function that makes one takes parameters")
    system = ""
    if name in SYSTEMS and candidate is _source.system(name):
        system, parameters = name, _source.typed(name, _source.system(name), parameters)
    built = candidate if finished or not callable(candidate) else _source.call(name, candidate, parameters)
    if isinstance(built, Model):
        return ModelFile(name, built, system=system)
    if isinstance(built, ModelFile):
        return built._replace(system=system or built.system)
    how = f"it {'is' if built is candidate else 'returned'} a {type(built).__name__}"
    raise ValueError(
        f"{name} must be a Lagrangian, a GroupSystem, a StateSpace, a ModelFile, or a function returning one; {how}"
    )


def _points(n: int) -> np.ndarray:
    """Points at which the metric is checked: 0, 1, and a few fixed points between 0 and 2."""
    # Fixed, so that a model passes always or never; 0 alone may be a singular point of its chart.
    return np.concatenate([np.zeros((1, n)), np.ones((1, n)), np.random.default_rng(0).uniform(0, 2, (4, n))])
