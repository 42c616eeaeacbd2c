"""Names the columns of a model's logs, from the model file or from the model itself."""

from typing import Any, NamedTuple

from covariant.geometry import AbstractManifold, Coordinates
from covariant.geometry.lie import SE2, SE3, SO2, SO3, AbstractGroup
from covariant.logs import ATTITUDES, Columns, check_unit
from covariant.models._mechanical import MechanicalSystem, check_model, input_count
from covariant.models._state_space import StateSpace
from covariant.models.files._source import Model
from covariant.models.robots import servos_in
from scalargraph.errors import InputError


class _Needs(NamedTuple):
    """Number of columns of each kind that a configuration needs."""

    position: int = 0
    attitudes: int = 0
    angle: int = 0
    q: int = 0

    @property
    def remedy(self) -> str:
        keys = [key for key in ("position", "angle", "q") if getattr(self, key)]
        keys += [f"one of {', '.join(ATTITUDES)}"] if self.attitudes else []
        return f"name {' and '.join(keys)} instead"


_NEEDS = ((SO3, _Needs(0, 1, 0)), (SE3, _Needs(3, 1, 0)), (SE2, _Needs(2, 0, 1)), (SO2, _Needs(0, 0, 1)))


def model_columns(model: Model, loaded: Columns, given: dict[str, Any]) -> Columns:
    """Columns of a model's logs.

    Names in the model file take precedence over names loaded with the model, and these over names derived from the
    model. An attitude gets no default names, since its representation is unknown.
    """
    if any(given.get(kind) for kind in ATTITUDES):
        # The file's representation replaces the loaded one, as an attitude must not have two kinds of columns.
        loaded = loaded._replace(**dict.fromkeys(ATTITUDES, ()))
    given = {key: value for key, value in loaded._asdict().items() if value} | given
    columns = _name_columns(model, given)
    _check_units(model, columns)
    return columns


def _name_columns(model: Any, names: dict[str, Any]) -> Columns:
    """Columns whose missing names are derived from the model."""
    if not model.manifold.commuting:
        return _on_manifold(model, names)
    by_outputs = isinstance(model, StateSpace)
    kind, columns = ("outputs", _of_outputs) if by_outputs else ("coordinates", _in_coordinates)
    for key in ("position", *ATTITUDES, "angle"):
        if names.get(key):
            raise InputError(f"columns.{key} is for a model on a group; this one has {kind}: name them in columns.q")
    return columns(model, names)


def unnamed_attitudes(model: Model, columns: Columns) -> int:
    """Number of attitudes in a log of the model for which no column states a representation."""
    return 0 if any(getattr(columns, kind) for kind in ATTITUDES) else _needs(model.manifold.ambient).attitudes


def _in_coordinates(model: MechanicalSystem, names: dict[str, Any]) -> Columns:
    n = len(model.coordinates) or len(names.get("q", ()))
    if not n:
        raise InputError("the model names no coordinates; give it some, or columns.q")
    check_model(model, n)
    m = input_count(model, n)
    servos = servos_in(model)
    inputs = _input_names(model, m) if servos is None else servos.input_names
    columns = Columns(q=model.coordinates, u=inputs)._replace(**names)
    _check_count("q", columns.q, n, "coordinates")
    _check_count("u", columns.u, m, "inputs")
    _check_count("v", columns.v or columns.q, n, "coordinates")
    _check_count("truth", columns.truth or columns.q, n, "coordinates")
    return columns


def _of_outputs(model: StateSpace, names: dict[str, Any]) -> Columns:
    if not model.coordinates:
        raise InputError("the model names no coordinates; give it some: they say how many states it has")
    if names.get("v"):
        raise InputError("columns.v: a state-space model has no velocities; name its outputs in columns.q")
    columns = Columns(q=model.outputs, u=_input_names(model, model.inputs))._replace(**names)
    _check_count("q", columns.q, len(model.outputs), "outputs")
    _check_count("u", columns.u, model.inputs, "inputs")
    _check_count("truth", columns.truth or model.coordinates, len(model.coordinates), "states")
    return columns


def _on_manifold(model: MechanicalSystem, names: dict[str, Any]) -> Columns:
    needs, n = _needs(model.manifold.ambient), len(model.velocities)
    inputs = input_count(model, n)
    attitudes = [kind for kind in ATTITUDES if names.get(kind)]
    if names.get("q") and not needs.q:
        raise InputError(f"columns.q: the model is on a group and has no coordinates; {needs.remedy}")
    if len(attitudes) > 1:
        raise InputError(f"columns.{attitudes[0]} and columns.{attitudes[1]} both give the attitude; keep one")
    if attitudes and not needs.attitudes:
        raise InputError(f"columns.{attitudes[0]}: the model has no attitude in space; {needs.remedy}")
    columns = Columns(
        q=model.coordinates if needs.q else (),
        u=_input_names(model, inputs),
        position=("px", "py", "pz")[: needs.position],
        angle=_numbered_names("angle", needs.angle) if needs.angle != 1 else ("angle",),
    )._replace(**names)
    for kind in attitudes:
        whole = "this way to write an attitude" if needs.attitudes == 1 else f"so written {needs.attitudes} attitudes"
        _check_count(kind, getattr(columns, kind), needs.attitudes * ATTITUDES[kind], "entries", whole)
    _check_count("position", columns.position, needs.position, "coordinates of a position")
    _check_count("angle", columns.angle, needs.angle, "angles")
    _check_count("q", columns.q, needs.q, "coordinates")
    # A body in free flight has no forces to log; with u = [] its inputs are zero.
    _check_count("u", columns.u or _numbered_names("u", inputs), inputs, "inputs")
    _check_count("v", columns.v or model.velocities, n, "velocities")
    _check_count("truth", columns.truth or model.velocities, n, "velocities")
    return columns


def _needs(manifold: AbstractManifold) -> _Needs:
    """The columns that a manifold needs; raises `ValueError` if logs cannot represent its configurations."""
    if manifold.commuting:
        return _Needs()
    first, *rest = _factors(manifold)
    needs = next((needs for group, needs in _NEEDS if group == first), None)
    joints = [part.dimension or 0 for part in rest if isinstance(part, Coordinates)]
    wheels = [part for part in rest if part == SO2]
    # Ball joints have attitudes in separate arrays, unlike bodies, which are blocks of one matrix.
    balls = [part for part in manifold.factors[1:] if part == SO3 and first in (SO3, SE3) and not wheels]
    if isinstance(manifold, AbstractGroup):
        balls = []
    if needs is None or len(joints) > 1 or len(joints) + len(wheels) + len(balls) < len(rest):
        raise InputError(
            f"logs hold one attitude or pose, and ball joints, angles or coordinates after it: SO3, SE3, SE2, SO2, or "
            f"one of them times SO3s, SO2s or Coordinates; the model is on {manifold}, so use it from Python"
        )
    attitudes = needs.attitudes + len(balls)
    return needs._replace(attitudes=attitudes, angle=needs.angle + len(wheels), q=sum(joints))


def _factors(manifold: AbstractManifold) -> list[AbstractManifold]:
    return [factor for part in manifold.factors for factor in _factors(part)] or [manifold]


def _check_units(model: Model, columns: Columns) -> None:
    """Raise `ValueError` if the unit of a column measures another quantity, or the number of units is wrong."""
    expected = {"t": ("s",), **model.logged_units, "position": ("m",) * len(columns.position)}
    expected["angle"] = ("rad",) * len(columns.angle)
    for key, texts in columns.units.items():
        names = (columns.t,) if key == "t" else getattr(columns, key)
        if len(texts) not in (1, len(names)):
            raise InputError(f"units.{key} lists {len(texts)} units; give {len(names)}, or one without brackets")
        for i, unit in enumerate(expected.get(key, ())):
            try:
                check_unit(columns.unit_of(key, i) or unit, unit)
            except InputError as error:
                raise InputError(f"units.{key}: {error}") from error


def _input_names(model: Model, count: int) -> tuple[str, ...]:
    return model.input_names or _numbered_names("u", count)


def _numbered_names(letter: str, count: int) -> tuple[str, ...]:
    return tuple(f"{letter}{i + 1}" for i in range(count))


def _check_count(key: str, names: tuple[str, ...], needed: int, what: str, whole: str = "the model") -> None:
    if len(names) != needed:
        named = f" ({', '.join(names)})" if names else ""
        raise InputError(f"columns.{key} names {len(names)} columns{named}; {whole} has {needed} {what}")
