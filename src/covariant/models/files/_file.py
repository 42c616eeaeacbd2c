"""Builds model files from documents, with system and parameters, and rebuilds models from their recipes."""

import inspect
from pathlib import Path
from typing import Any

import numpy as np

from covariant._door import MODEL, parse_toml, read_text
from covariant.models.files import _source, _toml
from covariant.models.files._check import check_metric
from covariant.models.files._columns import model_columns
from covariant.models.files._model_file import KEYS, ModelError, ModelFile
from covariant.models.files._rewrite import written
from covariant.models.files._source import Model
from covariant.models.files._systems import ROBOT_FILES, SYSTEMS, unknown_model
from covariant.models.files._toml import Overrides
from covariant.models.robots import ROBOTS, complete_tables, servos_in
from scalargraph.errors import InputError


def finish(spec: str, content: dict[str, Any]) -> ModelFile:
    """Build the model file of a document and check it."""
    loaded = made(spec, content)
    name = Path(spec).stem if is_file(spec) else loaded.name
    return _complete_file(loaded._replace(stated=tuple(content.get("parameters", {}))), name, content)


def finish_object(given: object, content: dict[str, Any]) -> ModelFile:
    """Build the model file of a model object, with the tables of a document applied to it."""
    for table in ("system", "parameters", _toml.SERVO, _toml.LOOP):
        if table in content:
            raise InputError(f"{table} is for models that are made from a file or by name; this one is made already")
    loaded = _build(type(given).__name__, given, {})
    stated = {f"{table}.{key}" for table, keys in content.items() if isinstance(keys, dict) for key in keys}
    rivals = {
        f"{key.path.partition('.')[0]}.{rival}" for key in KEYS.values() if key.path in stated for rival in key.replaces
    }
    replaced = {field: ModelFile._field_defaults[field] for field, key in KEYS.items() if key.path in rivals}
    return _complete_file(loaded._replace(**replaced), loaded.name, content)


def _complete_file(loaded: ModelFile, name: str, content: dict[str, Any]) -> ModelFile:
    columns = model_columns(loaded.model, loaded.columns, _toml.columns(content))
    model: Any = loaded.model
    if loaded.mechanical and model.manifold.commuting:
        check_metric(model, _points(len(columns.q)))
    velocities = len(model.velocities if loaded.mechanical else ()) or len(columns.q)
    counts = {
        # All parts of a pose are read together, so that one delay serves for all of them.
        "coordinate": len(columns.q) if model.manifold.commuting else 1,
        # On a group, errors are components in the body frame and not logged columns.
        "component": len(columns.q) if model.manifold.commuting else velocities,
        "velocity": velocities,
        "state": 0 if loaded.mechanical else len(model.coordinates),
        "input": len(columns.u),
    }
    read = _toml.numbers(content, counts)
    return _with_servos(loaded._replace(name=name, columns=columns, **read), content)


def _with_servos(file: ModelFile, content: dict[str, Any]) -> ModelFile:
    """The file, completed by what its servos determine about inputs and positions."""
    servos = servos_in(file.model)
    if servos is None:
        if file.input_kind == "command":
            raise InputError('inputs.kind = "command" needs [servo.JOINT] tables: how each joint follows its command')
        return file
    if file.input_kind == "torque" and "kind" in content.get("inputs", {}):
        raise InputError('inputs.kind = "torque" contradicts the servos of the robot, whose inputs are commands')
    for key, several in (("delay", servos.delay), ("lead", servos.lead)):
        if key in content.get("inputs", {}) and np.any(several):
            raise InputError(f"inputs.{key} states again what [servo.JOINT] says; keep one of them")
        if np.any(several):
            file = file._replace(**{f"input_{key}": tuple(np.asarray(several, float).tolist())})
    tables = servo_tables(content)
    backlash = [tables.get(name, {}).get("backlash", 0.0) for name in file.model.coordinates]
    if any(backlash) and file.measurement_std is not None:
        # An error distributed uniformly over the backlash has the variance backlash²/12.
        std = np.sqrt(np.square(file.measurement_std) + np.square(backlash) / 12)
        file = file._replace(measurement_std=tuple(std.tolist()))
    return file._replace(input_kind="command")


def made(spec: str, content: dict[str, Any]) -> ModelFile:
    """Build the model of a document with its parameters, from its system or from the attribute that a spec names."""
    name = content.get("system", spec.rpartition(":")[2])
    return _build(name, _model_or_factory(spec, content), parameters_of(content))


def parameters_of(content: dict[str, Any]) -> dict[str, Any]:
    """The parameters of the system of a document, together with its tables of servos and loops."""
    parameters = content.get("parameters", {})
    own = {table: content[table] for table in (_toml.SERVO, _toml.LOOP) if table in content}
    for table in own:
        if content.get("system") != "robot":
            raise InputError(f'[{table}] is for robots, system = "robot"; this model is {content.get("system")!r}')
    servos = {"servos": servo_tables(content)} if _toml.SERVO in own else {}
    return parameters | servos | ({"loops": own[_toml.LOOP]} if _toml.LOOP in own else {})


def servo_tables(content: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The tables of the servos of a document, each completed by the table named in its key `like`."""
    return complete_tables(content.get("servo", {}))


def from_recipe(made: dict[str, Any], model: object = None) -> Model:
    """Build the model of a recipe: a system of this library by name, with parameters of the right types.

    A recipe may come from a file, so its content is never imported. A caller who trusts the code may pass `model`.

    Args:
        made: The recipe, as `recipe` returns it: `system` or `attribute`, and `parameters`.
        model: A replacement for the system or attribute that the recipe names: a model, a function that builds one from
            the recipe's parameters, or the `module:attribute` of either.

    Returns:
        The model.

    Raises:
        ModelError: The recipe is wrong; the message is one line that says why.

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
            raise InputError(
                f"the model is {made['attribute']!r}, code that a recipe does not run; whoever trusts it gives the "
                "model, as `model=module:attribute`"
            )
        factory, name = _source.system(made.get("system")), str(made.get("system"))
        with np.errstate(all="ignore"):  # parameters may make numbers infinite; later checks detect this
            return _build(name, factory, parameters).model
    except Exception as error:  # parameters from a file may cause any error in a system
        kind = "" if isinstance(error, InputError) else f"{type(error).__name__}: "
        raise ModelError(kind + _source.first_line(error)) from error


def recipe_text(made: dict[str, Any]) -> str:
    """Describe the model of a recipe in one line, with all its parameters, including default values.

    If the model is not from this library, the line contains only the parameters in the recipe.

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
        arguments = inspect.signature(_source.system(name)).parameters.items()
        defaults = {key: each.default for key, each in arguments if each.default is not inspect.Parameter.empty}
        parameters = defaults | parameters
    texts = {key: "none" if value is None else written(_toml.plain(value)) for key, value in parameters.items()}
    return name + "".join(f", {key} = {text}" for key, text in texts.items())


def _replacement(model: object, parameters: dict[str, Any]) -> Model:
    """Build the model that a caller passes to replace the one in a recipe."""
    name = model if isinstance(model, str) else type(model).__name__
    if isinstance(model, str) and not all(model.partition(":")):
        raise InputError(f"a model is given as module:attribute; got {model!r}")
    candidate = _source.attribute(model) if isinstance(model, str) else model
    return _build(name, candidate, {} if isinstance(candidate, Model | ModelFile) else parameters).model


def is_file(spec: str) -> bool:
    """Whether a spec denotes a model file by its path, or a robot by path or name."""
    return spec.endswith((".toml", *ROBOT_FILES)) or spec in ROBOTS


def document(spec: str, overrides: Overrides = ()) -> dict[str, Any]:
    """Read the document that a spec denotes, apply overrides, and check its layout.

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
        return _relative_to_file(Path(spec), parse_toml(text(Path(spec))))
    if ":" in spec:
        return {}
    if spec not in SYSTEMS:
        raise InputError(unknown_model(spec))
    return {"system": spec}


def _relative_to_file(path: Path, content: dict[str, Any]) -> dict[str, Any]:
    """The document of a model file; a robot's path in it is relative to the folder of the model file."""
    if content.get("system") not in ("robot", "legged_base"):
        return content
    parameters = content.get("parameters")
    if not isinstance(parameters, dict):
        return content
    stated = parameters.get("path")
    if not isinstance(stated, str) or stated in ROBOTS:
        return content
    return content | {"parameters": parameters | {"path": str(path.parent / stated)}}


def text(path: Path) -> str:
    """Read a model file in UTF-8."""
    return read_text(path, MODEL)


def _model_or_factory(spec: str, content: dict[str, Any]) -> Any:
    """Find the model that a spec denotes, or the function that builds it."""
    named = content.get("system")
    if is_file(spec) and isinstance(named, str) and ":" in named:
        return _source.attribute(named, Path(spec).parent)
    if is_file(spec) or ":" not in spec:
        return _source.system(named)
    if "system" in content:
        raise InputError(f"system = {content['system']!r} contradicts module:attribute; drop one of them")
    return _source.attribute(spec)


def _build(name: str, candidate: object, parameters: dict[str, Any]) -> ModelFile:
    """Return a finished model, or call a factory with the parameters; library systems get converted types."""
    finished = isinstance(candidate, Model | ModelFile)
    if finished and parameters:
        raise InputError(f"{name} is a finished model; only a function that makes one takes parameters")
    system = ""
    if name in SYSTEMS and candidate is _source.system(name):
        system, parameters = name, _source.typed(name, _source.system(name), parameters)
    built = candidate if finished or not callable(candidate) else _source.call(name, candidate, parameters)
    if isinstance(built, Model):
        return ModelFile(name, built, system=system)
    if isinstance(built, ModelFile):
        return built._replace(system=system or built.system)
    how = f"it {'is' if built is candidate else 'returned'} a {type(built).__name__}"
    raise InputError(
        f"{name} must be a Lagrangian, a GroupSystem, a StateSpace, a ModelFile, or a function returning one; {how}"
    )


def _points(n: int) -> np.ndarray:
    """Points at which the metric is checked: 0, 1, and a few fixed points between 0 and 2."""
    # They are fixed, so that the check gives the same result each time; 0 alone may be a singular point of the chart.
    return np.concatenate([np.zeros((1, n)), np.ones((1, n)), np.random.default_rng(0).uniform(0, 2, (4, n))])
