"""Arguments and options that several commands share."""

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_type_hints

import typer

from covariant.cli._names import ESTIMATORS, SMOOTHED, STATE_ESTIMATORS, Engine
from covariant.models import check_spec


def existing_model(spec: str | None) -> str | None:
    """Check that a model exists, as far as its name or path shows, before anything heavy is loaded.

    Args:
        spec: A path, `module:attribute`, or the name of a system or a robot; None passes.

    Returns:
        The same.

    Raises:
        ValueError: One line that names the model, and for a name suggests the nearest one.
    """
    if spec is not None:
        check_spec(spec)
    return spec


def existing_log(path: Path) -> Path:
    """Check that a log exists, before anything heavy is loaded.

    Returns:
        The path.

    Raises:
        FileNotFoundError: Where it does not exist.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file")
    return path


def existing_logs(paths: list[Path]) -> list[Path]:
    """Check that all logs exist, before anything heavy is loaded.

    Returns:
        The paths.

    Raises:
        FileNotFoundError: For the first that does not exist.
    """
    return [existing_log(path) for path in paths]


def known_observer(name: str | None) -> str | None:
    """Check the name of an observer.

    Args:
        name: The name; None passes.

    Returns:
        The same.

    Raises:
        ValueError: For an unknown name; the message lists those that there are.
    """
    names = (*ESTIMATORS, *STATE_ESTIMATORS)
    if name is not None and name not in names:
        raise ValueError(f"unknown observer {name!r}; choose one of {', '.join(names)}")
    return name


def only_by_smooth(value: bool | float | None) -> bool | float | None:
    """Refuse an option that `smooth` has, where a user looks for it at `estimate`.

    Args:
        value: What was given; False and None pass.

    Returns:
        The same.

    Raises:
        ValueError: One line that names the command.
    """
    if value is not None and value is not False:
        raise ValueError(
            "estimate knows the rows before each only; `covariant smooth MODEL LOG`, with --lag SECONDS or all rows "
            "after each, writes smoothed estimates and those of the filter beside them"
        )
    return value


Model = Annotated[
    str,
    typer.Argument(
        help="Model file (.toml), robot (.urdf or .xml), module:attribute, or the name of a system or a robot.",
        callback=existing_model,
    ),
]
LogFile = Annotated[
    Path,
    typer.Argument(
        help="Log with stamps, positions or attitudes, inputs: .csv, .txt, .parquet, .mcap, a rosbag2.",
        callback=existing_log,
    ),
]
Observer = Annotated[
    str | None,
    typer.Option(
        help=f"One of: {', '.join(ESTIMATORS)}; intrinsic by default. For a state-space model: "
        f"{', '.join(STATE_ESTIMATORS)}.",
        callback=known_observer,
    ),
]
Filter = Annotated[
    str | None,
    typer.Option(
        "--observer",
        help=f"One of: {', '.join(SMOOTHED)}; intrinsic-kalman by default, covariance-ekf for a state-space model.",
        callback=known_observer,
    ),
]
Smoothed = Annotated[bool, typer.Option("--smooth", hidden=True, callback=only_by_smooth)]
Lagged = Annotated[float | None, typer.Option("--lag", hidden=True, callback=only_by_smooth)]
Override = Annotated[list[str], typer.Option("--set", help="Override a value of the model file, as table.key=value.")]
Every = Annotated[int, typer.Option(help="Use each k-th row only.", min=1)]
From = Annotated[float | None, typer.Option("--from", help="Use the log from this time on only [s since its start].")]
Until = Annotated[float | None, typer.Option(help="Use the log up to this time only [s since its start].")]
Time = Annotated[str | None, typer.Option("--t", help="Column of the stamps.")]
Positions = Annotated[str | None, typer.Option("--q", help="Columns of the coordinates, separated by commas.")]
Inputs = Annotated[str | None, typer.Option("--u", help="Columns of the inputs, separated by commas.")]
Velocities = Annotated[str | None, typer.Option("--v", help="Columns of logged velocities, only compared with.")]
Truth = Annotated[str | None, typer.Option("--truth", help="Columns of true velocities, to score against.")]
By = Annotated[
    Engine,
    typer.Option("--engine", help="What computes: compiled C, JAX, or C where it pays (auto)."),
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object for machines.")]
Anyway = Annotated[bool, typer.Option("--anyway", help="Go on although the log does not fit the model at all.")]
Report = Annotated[Path | None, typer.Option(help="Write an interactive page (.html) and PNG figures beside it.")]


class Rows(NamedTuple):
    """Options that choose rows of a log.

    Attributes:
        every: Use each k-th row.
        start: Use the log from this time [s] since its first row.
        until: Use the log up to this time [s] since its first row.
    """

    every: Every = 1
    start: From = None
    until: Until = None


class ColumnNames(NamedTuple):
    """Options that name columns of a log.

    Attributes:
        t: Column of the stamps.
        q: Columns of the coordinates, separated by commas.
        u: Columns of the inputs, separated by commas.
    """

    t: Time = None
    q: Positions = None
    u: Inputs = None


class Compared(NamedTuple):
    """Options that name columns of a log that results are only compared with.

    Attributes:
        v: Columns of logged velocities, separated by commas.
        truth: Columns of true velocities, separated by commas.
    """

    v: Velocities = None
    truth: Truth = None


def with_shared_options(command: Callable[..., None]) -> Callable[..., None]:
    """Decorate a command so that its parameters of the types `Rows`, `ColumnNames` and `Compared` become options.

    Typer reads the options of a command from its signature, so each group is written out there, an option for each of
    its fields.

    Args:
        command: The command.

    Returns:
        A function that collects the options into the groups and calls the command.
    """
    signature = inspect.signature(command, eval_str=True)  # annotations as types, not as texts
    groups = {p.name: p.annotation for p in signature.parameters.values() if p.annotation in SHARED}
    options: list[inspect.Parameter] = []
    for parameter in signature.parameters.values():
        group = groups.get(parameter.name)
        if group is None:
            # Keyword-only: those with and without a default may then stand in any order.
            options.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))
            continue
        for name, kind in get_type_hints(group, include_extras=True).items():
            default = group._field_defaults[name]
            options.append(inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind))

    @functools.wraps(command)
    def call(**values: Any) -> None:
        for name, group in groups.items():
            values[name] = group(**{field: values.pop(field) for field in group._fields})
        command(**values)

    call.__signature__ = signature.replace(parameters=options)  # pyright: ignore[reportAttributeAccessIssue]
    call.__annotations__ = {option.name: option.annotation for option in options}
    return call


SHARED = (Rows, ColumnNames, Compared)
"""Groups of options that several commands share."""
