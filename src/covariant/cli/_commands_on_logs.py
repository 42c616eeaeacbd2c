"""The commands that read a log, and their options."""

from pathlib import Path
from typing import Annotated

import typer

from covariant import workflow
from covariant.cli._console import progress_bar, show
from covariant.cli._names import WRITTEN
from covariant.cli._options import (
    Anyway,
    By,
    ColumnNames,
    Compared,
    Every,
    Filter,
    From,
    Inputs,
    Json,
    Lagged,
    LogFile,
    Model,
    Observer,
    Override,
    Positions,
    Report,
    Rows,
    Smoothed,
    Time,
    Until,
    Velocities,
    existing_logs,
    with_shared_options,
)
from covariant.workflow import check_model_output, check_output

on_logs = typer.Typer()


@on_logs.command()
@with_shared_options
def estimate(
    model: Model,
    log: LogFile,
    rows: Rows,
    names: ColumnNames,
    compared: Compared,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help=f"Write the estimate here ({', '.join(WRITTEN)}).")
    ] = None,
    observer: Observer = None,
    alpha: Annotated[float | None, typer.Option(help="Gain α [1/s] in place of the designed one.")] = None,
    beta: Annotated[float | None, typer.Option(help="Gain β [1/s²] in place of the designed one.")] = None,
    override: Override = [],  # noqa: B006  typer copies it
    score: Annotated[
        bool,
        typer.Option("--score", help="Score the velocities too, against slopes of the positions."),
    ] = False,
    report: Report = None,
    anyway: Anyway = False,
    engine: By = "auto",
    json: Json = False,
    smooth: Smoothed = False,
    lag: Lagged = None,
) -> None:
    """Estimate velocities from the positions or attitudes in a log."""
    check_output(out, *WRITTEN, log=log)
    check_output(report, ".html")
    with progress_bar(quiet=json) as progress:
        result = workflow.estimate(
            model,
            log,
            observer=observer,
            alpha=alpha,
            beta=beta,
            score=score,
            overrides=override,
            columns=names._asdict() | compared._asdict(),
            anyway=anyway,
            engine=engine,
            progress=progress,
            **rows._asdict(),
        )
    show(result, json, out, report)


@on_logs.command()
@with_shared_options
def smooth(
    model: Model,
    log: LogFile,
    rows: Rows,
    names: ColumnNames,
    compared: Compared,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help=f"Write the estimate here ({', '.join(WRITTEN)}).")
    ] = None,
    observer: Filter = None,
    lag: Annotated[
        float | None,
        typer.Option(
            help="Time after each row from which it is estimated [s], as rows at the median interval; all by default."
        ),
    ] = None,
    override: Override = [],  # noqa: B006  typer copies it
    score: Annotated[
        bool,
        typer.Option("--score", help="Score the velocities too, against slopes of the positions."),
    ] = False,
    report: Report = None,
    anyway: Anyway = False,
    json: Json = False,
) -> None:
    """Estimate velocities afterwards, from the rows before and after each."""
    check_output(out, *WRITTEN, log=log)
    check_output(report, ".html")
    with progress_bar(quiet=json) as progress:
        result = workflow.smooth(
            model,
            log,
            observer=observer,
            lag=lag,
            score=score,
            overrides=override,
            columns=names._asdict() | compared._asdict(),
            anyway=anyway,
            progress=progress,
            **rows._asdict(),
        )
    show(result, json, out, report)


@on_logs.command()
@with_shared_options
def compare(
    model: Model,
    log: LogFile,
    rows: Rows,
    names: ColumnNames,
    compared: Compared,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Write the table here (.csv).")] = None,
    force: Annotated[
        str | None,
        typer.Option(
            "--force", help="Columns of true external forces: estimates of these are compared, and not velocities."
        ),
    ] = None,
    override: Override = [],  # noqa: B006  typer copies it
    report: Report = None,
    anyway: Anyway = False,
    engine: By = "auto",
    json: Json = False,
) -> None:
    """Run all estimators on a log, tuned from the same data sheet, and rank them."""
    check_output(out, ".csv", log=log)
    check_output(report, ".html")
    if force is not None and report is not None:
        raise ValueError("--report: forces have no page; give -o TABLE.csv, or leave out --force")
    with progress_bar(quiet=json) as progress:
        columns = names._asdict() | compared._asdict()
        shared = {"overrides": override, "columns": columns, "anyway": anyway, "progress": progress, **rows._asdict()}
        if force is None:
            result = workflow.compare(model, log, engine=engine, **shared)
        else:
            result = workflow.compare_force(model, log, force, **shared)
    show(result, json, out, report)


@on_logs.command()
def check(
    model: Model,
    log: LogFile,
    override: Override = [],  # noqa: B006  typer copies it
    every: Every = 1,
    start: From = None,
    until: Until = None,
    t: Time = None,
    q: Positions = None,
    u: Inputs = None,
    json: Json = False,
) -> None:
    """Compare a log with a model: units, order, signs, delays, ticks, outliers; exit code 1 where one is wrong."""
    columns = {"t": t, "q": q, "u": u}
    with progress_bar(quiet=json) as progress:
        result = workflow.check(
            model, log, overrides=override, every=every, start=start, until=until, columns=columns, progress=progress
        )
    show(result, json)
    if result.wrong:
        raise SystemExit(1)


@on_logs.command()
@with_shared_options
def fit(
    model: Model,
    log_files: Annotated[
        list[Path],
        typer.Argument(
            callback=existing_logs,
            metavar="LOG...",
            help="Logs to fit; the last of several, or the last third of one, is held out.",
        ),
    ],
    rows: Rows,
    names: ColumnNames,
    parameters: Annotated[
        str,
        typer.Option(
            help="Numbers to fit, by commas: mass, com[0] of [parameters], or inputs.lag; of a robot friction, "
            "armature, payload, inertia, gravity, torque_constants, offsets, or of one joint or link: friction.elbow, "
            "armature.3."
        ),
    ],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Write the model file with the fitted numbers here (.toml).")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Let --out replace a file that exists.")] = False,
    horizon: Annotated[
        float | None, typer.Option(help="Length of predictions [s]; by default as the motion suggests.")
    ] = None,
    override: Override = [],  # noqa: B006  typer copies it
    anyway: Anyway = False,
    json: Json = False,
) -> None:
    """Fit numbers of a model to logs: with standard errors, and with names for what the logs do not determine.

    Exit code 1 where the fitted model predicts worse than before what is held out; it is not written then.
    """
    inertias = any(
        name.strip().removeprefix("parameters.").split(".")[0] == "inertia" for name in parameters.split(",")
    )
    check_model_output(model, out, overwrite, urdf=inertias and not model.endswith(".xml"))
    with progress_bar(quiet=json) as progress:
        result = workflow.fit(
            model,
            log_files,
            parameters,
            horizon=horizon,
            overrides=override,
            columns=names._asdict(),
            anyway=anyway,
            progress=progress,
            **rows._asdict(),
        )
    show(result, json, out if result.better else None, overwrite=overwrite)
    if result.exit_code:
        raise typer.Exit(result.exit_code)


@on_logs.command()
@with_shared_options
def tune(
    model: Model,
    log_files: Annotated[
        list[Path],
        typer.Argument(
            callback=existing_logs, metavar="LOG...", help="Logs; the last third of each is held out to judge by."
        ),
    ],
    rows: Rows,
    names: ColumnNames,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", "--write", help="Write the model file with the tuned numbers here (.toml)."),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Let --out replace a file that exists.")] = False,
    override: Override = [],  # noqa: B006  typer copies it
    report: Report = None,
    engine: By = "auto",
    anyway: Anyway = False,
    json: Json = False,
) -> None:
    """Tune noise and gains to logs by the likelihood of their innovations, and judge them on what was held out."""
    check_model_output(model, out, overwrite)
    check_output(report, ".html")
    with progress_bar(quiet=json) as progress:
        result = workflow.tune(
            model,
            log_files,
            overrides=override,
            columns=names._asdict(),
            anyway=anyway,
            engine=engine,
            progress=progress,
            **rows._asdict(),
        )
    show(result, json, out, report, overwrite=overwrite)


@on_logs.command()
def init(
    log: LogFile,
    out: Annotated[Path, typer.Option("--out", "-o", help="Model file to write (.toml); it must not exist.")],
    t: Time = None,
    q: Positions = None,
    u: Inputs = None,
    v: Velocities = None,
    json: Json = False,
) -> None:
    """Draft a model file from the header and the content of a log; what is guessed is said in its comments."""
    check_output(out, ".toml", log=log)
    if out.exists():
        raise ValueError(f"{out}: there is such a file already, and it is not overwritten; give another name")
    with progress_bar(quiet=json) as progress:
        result = workflow.init(log, columns={"t": t, "q": q, "u": u, "v": v}, progress=progress)
    show(result, json, out)
