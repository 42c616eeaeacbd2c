"""A model with what surrounds it: the columns of its logs, the noise of its sensors, and its own uncertainty."""

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
    """A model that cannot be loaded. The message is one line: the file or module, what is wrong there, what to do."""


class ModelFile(NamedTuple):
    """A model and the numbers that a design starts from; a number that is not known is None.

    - `columns`: columns of a log; empty `q` and `u` stand for the model's coordinates and for u1, u2, …. Where the
      model is a `StateSpace`, `q` are its outputs.
    - `measurement_std`: standard deviation of a measured position [its unit], or one for each coordinate; on a group
      that of each component of `log(g⁻¹ y)`, the error as seen from the body [rad, and m where there is a position].
    - `delay` [s]: a position read at the stamp t was true at t − delay; or one for each coordinate.
    - `acceleration_std`, `correlation_time`: standard deviation [unit/s²] and correlation time [s] of the acceleration
      that the model does not explain.
    - `motion_std`, `motion_time`: the same of the acceleration of the motion itself, for filters that use no model.
    - `damping`: damping ratio of the error.
    - `natural_frequency` [rad/s]: of the error under constant gains, where it is not designed from the noise.
    - `input_lag`: time constant of the first-order lag between logged input and force [s].
    - `input_delay` [s]: how long after its stamp an input acts; `input_between`: whether it is "held" from one stamp to
      the next, or "linear" between them.
    - `reference_half` [s], `reference_order`: half width of the windows, and degree, of the local polynomials that
      give the reference velocity for scoring.
    - `quantum`: one tick of the encoders [unit of the coordinates], or one for each coordinate, where the model file
      gives that and not a standard deviation.
    - `process_std`, `initial_state`, `initial_std`: of a `StateSpace`, for each state or one for all: standard
      deviation of the white noise in its rate [its unit/√s], first estimate, and how uncertain that is. Where they are
      not given, the first estimate is the middle of the model's box, or zero, and as uncertain as the box is wide.
    - `external_force`: standard deviation of what a force that the model does not know changes by in a second [N or
      N m], for a filter that estimates it.
    - `bias`: standard deviation of a constant offset of a measured position [its unit], or one for each coordinate, for
      a filter that estimates it; `bias_drift`: of what the offset changes by in a second.
    - `uncertain`: relative standard deviations of numbers of [parameters], by name, for a filter that estimates them;
      `parameters_drift`: of their relative change in a second; `family`: the model with these numbers open, in their
      order.
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

    @property
    def typical_std(self) -> float | None:
        """`measurement_std` where it is one number, else the root mean square of those of the coordinates."""
        given = self.measurement_std
        return math.hypot(*given) / math.sqrt(len(given)) if isinstance(given, tuple) else given

    @property
    def dimension(self) -> int:
        """Number n of velocities; for a `StateSpace`, of states."""
        return len(self.model.velocities) or len(self.columns.q if self.mechanical else self.model.coordinates)

    @property
    def mechanical(self) -> bool:
        """Whether the model is a mechanical system, with a velocity to estimate; otherwise it is a `StateSpace`."""
        return isinstance(self.model, MechanicalSystem)

    def need_mechanical(self, spec: str, why: str) -> MechanicalSystem:
        """The mechanical model; for a state-space one raises `ValueError`, a message with `spec` and `why`."""
        if not isinstance(self.model, MechanicalSystem):
            raise ValueError(
                f"{spec} is a state-space model, and {why} mechanical ones, a Lagrangian or a GroupSystem; design an "
                "observer for its states by `covariant design metric`"
            )
        return self.model

    @property
    def unnamed_attitudes(self) -> int:
        """How many attitudes a log of the model holds whose representation no column states."""
        return unnamed_attitudes(self.model, self.columns)


def finish(spec: str, content: dict[str, Any]) -> ModelFile:
    """The model file of a document that stands for a spec, checked; raises `ValueError`."""
    loaded = made(spec, content)
    return _finished(loaded, Path(spec).stem if is_file(spec) else loaded.name, content)


def finish_object(given: Any, content: dict[str, Any]) -> ModelFile:
    """The model file of a system, or of a model file with the tables of a document on top; raises `ValueError`."""
    for table in ("system", "parameters"):
        if table in content:
            raise ValueError(f"{table} is for models that are made from a file or by name; this one is made already")
    loaded = _make(type(given).__name__, given, {})
    return _finished(loaded, loaded.name, content)


def _finished(loaded: ModelFile, name: str, content: dict[str, Any]) -> ModelFile:
    columns = model_columns(loaded.model, loaded.columns, _toml.columns(content))
    model: Any = loaded.model
    if loaded.mechanical and model.manifold.commuting:
        check_metric(model, _points(len(columns.q)))
    count = len(columns.q) if model.manifold.commuting else 1
    states = 0 if loaded.mechanical else len(model.coordinates)
    return loaded._replace(name=name, columns=columns, **_toml.numbers(content, count, states))


def made(spec: str, content: dict[str, Any]) -> ModelFile:
    """What the system of a document, or the attribute that a spec names, makes of the parameters of the document."""
    what = content.get("system", spec.rpartition(":")[2])
    return _make(what, _find(spec, content), content.get("parameters", {}))


def from_recipe(made: dict[str, Any], model: Any = None) -> Model:
    """The model that a recipe makes: a system of the fixed table by name, with parameters of the right types.

    A recipe may come from a file, so nothing in it is ever imported. A caller who trusts the code may give `model` in
    place of the system or attribute that the recipe names: a model, a function that makes one from the recipe's
    parameters, or the `module:attribute` of either. Raises `ModelError`, one line that names what is wrong.
    """
    parameters = made.get("parameters", {})
    try:
        if model is not None:
            return _given(model, parameters)
        if "attribute" in made:
            raise ValueError(
                f"the model is {made['attribute']!r}, code that a recipe does not run; whoever trusts it gives the "
                "model, as --model module:attribute or model=..."
            )
        factory, name = _source.system(made.get("system")), str(made.get("system"))
        with np.errstate(all="ignore"):  # parameters may make numbers infinite, which later checks find
            return _make(name, factory, parameters).model
    except Exception as error:  # parameters from a file may make a system fail in any way
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
        raise ModelError(kind + _source.first_line(error)) from error


def recipe_text(made: dict[str, Any]) -> str:
    """The model of a recipe in one line, with all its parameters, those that the recipe leaves at their defaults too.

    Of a model that is not of this library the line has the parameters of the recipe alone.
    """
    parameters = made.get("parameters", {})
    if "attribute" in made:
        name = f"{made['attribute']}, code that is not in this statement"
    else:
        name = str(made["system"])
        known = inspect.signature(_source.system(name)).parameters.values()
        defaults = {each.name: each.default for each in known if each.default is not inspect.Parameter.empty}
        parameters = defaults | parameters
    return name + "".join(f", {key} = {_number_text(value)}" for key, value in parameters.items())


def _number_text(value: Any) -> str:
    """A parameter as in a model file."""
    if isinstance(value, str) or value is None:
        return "none" if value is None else json.dumps(value, ensure_ascii=False)
    if isinstance(value, Sequence | np.ndarray):
        return "[" + ", ".join(map(_number_text, value)) + "]"
    return repr(value.item() if isinstance(value, np.generic) else value)


def _given(model: Any, parameters: dict[str, Any]) -> Model:
    """The model that a caller gives in place of the one that a recipe names."""
    name = model if isinstance(model, str) else type(model).__name__
    if isinstance(model, str) and not all(model.partition(":")):
        raise ValueError(f"a model is given as module:attribute; got {model!r}")
    found = _source.attribute(model) if isinstance(model, str) else model
    return _make(name, found, {} if isinstance(found, Model | ModelFile) else parameters).model


def is_file(spec: str) -> bool:
    return spec.endswith((".toml", *ROBOT_FILES)) or spec in ROBOTS


def document(spec: str, overrides: Overrides = ()) -> dict[str, Any]:
    """The document that a spec stands for, with overrides and a known layout; raises `ValueError`."""
    content = _toml.override(_document(spec), overrides)
    _toml.check_layout(content)
    return content


def _document(spec: str) -> dict[str, Any]:
    if spec.endswith(ROBOT_FILES) or spec in ROBOTS:
        return {"system": "robot", "parameters": {"path": spec}}
    if is_file(spec):
        return _beside(Path(spec), _toml.parse(text(Path(spec))))
    if ":" in spec:
        return {}
    if spec not in SYSTEMS:
        raise ValueError(unknown_model(spec))
    return {"system": spec}


def _beside(path: Path, content: dict[str, Any]) -> dict[str, Any]:
    """The document of a model file; where it names the file of a robot, that is looked for from its own folder."""
    given = content.get("parameters")
    if content.get("system") != "robot" or not isinstance(given, dict) or not isinstance(given.get("path"), str):
        return content
    if given["path"] in ROBOTS:
        return content
    return content | {"parameters": given | {"path": str(path.parent / given["path"])}}


def text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise ValueError(f"{error.strerror or error}; give the path of a model file") from error


def _find(spec: str, content: dict[str, Any]) -> Any:
    """The model that a spec names, or the function that makes it."""
    named = content.get("system")
    if is_file(spec) and isinstance(named, str) and ":" in named:
        return _source.attribute(named, Path(spec).parent)
    if is_file(spec) or ":" not in spec:
        return _source.system(named)
    if "system" in content:
        raise ValueError(f"system = {content['system']!r} contradicts module:attribute; drop one of them")
    return _source.attribute(spec)


def _make(name: str, found: Any, parameters: dict[str, Any]) -> ModelFile:
    """The model itself, or what the function makes of the parameters; a system of this library, of its types."""
    finished = isinstance(found, Model | ModelFile)
    if finished and parameters:
        raise ValueError(f"{name} is a finished model; only a function that makes one takes parameters")
    if name in SYSTEMS and found is _source.system(name):
        parameters = _source.typed(name, _source.system(name), parameters)
    made = found if finished or not callable(found) else _source.call(name, found, parameters)
    if isinstance(made, Model):
        return ModelFile(name, made)
    if isinstance(made, ModelFile):
        return made
    how = f"it {'is' if made is found else 'returned'} a {type(made).__name__}"
    raise ValueError(
        f"{name} must be a Lagrangian, a GroupSystem, a StateSpace, a ModelFile, or a function returning one; {how}"
    )


def _points(n: int) -> np.ndarray:
    """Points at which the metric is checked: 0, 1, and a few fixed points between 0 and 2."""
    return np.concatenate([np.zeros((1, n)), np.ones((1, n)), np.random.default_rng(0).uniform(0, 2, (4, n))])
