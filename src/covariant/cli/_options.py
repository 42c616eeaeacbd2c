"""Arguments and options that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

from covariant.cli._names import Engine

Model = Annotated[
    str,
    typer.Argument(
        help="Model file (.toml), robot (.urdf or .xml), module:attribute, or the name of a system or a robot."
    ),
]
LogFile = Annotated[
    Path,
    typer.Argument(help="Log with stamps, positions or attitudes, inputs: .csv, .txt, .parquet, .mcap, a rosbag2."),
]
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
