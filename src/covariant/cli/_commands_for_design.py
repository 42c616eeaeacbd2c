"""The commands that design something: a metric, an injection, or a motion, and their options."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from covariant import workflow
from covariant.cli._console import progress_bar, show
from covariant.cli._names import FIGURES, TABLES
from covariant.cli._options import Json, Model, Override
from covariant.cli._parse import count_list, interval_map, number_list
from covariant.workflow import check_output

design = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Design what an observer needs: a metric, an injection, or a motion that shows numbers of a robot.",
)


@design.command()
def metric(
    model: Model,
    out: Annotated[Path, typer.Option("--out", "-o", help="Store to write, or to go on with (.zarr).")],
    grid: Annotated[
        str,
        typer.Option(help="Points of each axis, one count or one each by commas; four at least to interpolate."),
    ],
    region: Annotated[
        str | None,
        typer.Option(
            "--region", "--box", help="Ends of the axes, as x1=0:1,x2=1:1.5; those not named are the model's own."
        ),
    ] = None,
    rate: Annotated[float, typer.Option(help="Rate λ of the equation [1/s].")] = 0.0,
    window: Annotated[
        float | None, typer.Option(help="Choose λ from the Gramians of the past, up to this long [s].")
    ] = None,
    process_cov: Annotated[str | None, typer.Option(help="Diagonal of Q, one number a state, by commas.")] = None,
    measurement_cov: Annotated[
        str | None, typer.Option(help="Diagonal of R, one number an output, by commas; ones by default.")
    ] = None,
    start: Annotated[float, typer.Option(help="Metric before the past, as a multiple of the identity.")] = 1.0,
    tolerance: Annotated[float, typer.Option(help="How much the unknown past may change the metric.")] = 1e-8,
    domain: Annotated[
        str | None, typer.Option(help="Where the model holds, as --region; the past is followed no further.")
    ] = None,
    input: Annotated[str | None, typer.Option(help="Constant inputs, by commas; zeros by default.")] = None,
    block: Annotated[int, typer.Option(help="Points that a worker computes at a time.", min=1)] = 4096,
    workers: Annotated[int | None, typer.Option(help="Threads; as many as processors by default.", min=1)] = None,
    scheduler: Annotated[str | None, typer.Option(help="Address of a Dask scheduler whose workers compute.")] = None,
    override: Override = [],  # noqa: B006  typer copies it
    json: Json = False,
) -> None:
    """Compute a contraction metric at every point of a grid of states; a run that was stopped goes on where it was."""
    check_output(out, ".zarr", store=True)
    try:
        with progress_bar(json) as progress:
            result = workflow.design_metric(
                model,
                out,
                grid=count_list("grid", grid),
                region=interval_map("region", region),
                rate=rate,
                window=window,
                process_cov=number_list("process-cov", process_cov),
                measurement_cov=number_list("measurement-cov", measurement_cov),
                start=start,
                tolerance=tolerance,
                domain=interval_map("domain", domain),
                input=number_list("input", input),
                block=block,
                workers=workers,
                scheduler=scheduler,
                overrides=tuple(override),
                progress=progress,
            )
    except KeyboardInterrupt as stopped:
        print(f"covariant: {stopped}", file=sys.stderr)
        # 128 + 2, what shells report of a process that SIGINT ended.
        raise SystemExit(130) from None
    show(result, json)


@design.command()
def excitation(
    model: Model,
    parameters: Annotated[
        str,
        typer.Option(
            help="Numbers to determine, by commas, as for fit: friction, armature, payload, inertia, gravity, "
            "torque_constants, offsets, or of one joint or link: friction.elbow, armature.3."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help=f"Motion and torques to write ({', '.join(TABLES)}).")],
    duration: Annotated[float, typer.Option(help="Length [s], a whole number of periods.")] = 20.0,
    rate: Annotated[float, typer.Option(help="Rows in a second [Hz].")] = 500.0,
    frequency: Annotated[float, typer.Option(help="Frequency of the first harmonic [Hz].")] = 0.2,
    harmonics: Annotated[int, typer.Option(help="Number of harmonics, 2 or more.")] = 5,
    region: Annotated[
        str | None,
        typer.Option("--region", "--box", help="Ends of positions, as shoulder=-1:1; others as in the robot's file."),
    ] = None,
    velocity: Annotated[
        str | None,
        typer.Option(help="Largest speeds, one or one each by commas; those of the robot's file by default."),
    ] = None,
    effort: Annotated[str | None, typer.Option(help="Largest torques or forces, in the same way.")] = None,
    margin: Annotated[float, typer.Option(help="Fraction of all limits that is used.")] = 0.9,
    torque_noise: Annotated[
        str | None,
        typer.Option(
            help="Standard deviation of logged torques, as felt at the joints; 1 % of the largest by default."
        ),
    ] = None,
    starts: Annotated[int, typer.Option(help="Starts of the search.")] = 3,
    seed: Annotated[int, typer.Option(help="Seed of the starts.", min=0)] = 0,
    figure: Annotated[Path | None, typer.Option(help="Draw the motion and its limits here (.png).")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a file that exists.")] = False,
    override: Override = [],  # noqa: B006  typer copies it
    json: Json = False,
) -> None:
    """Design a motion of a robot, within its limits, whose log determines what is asked, but blind to collisions."""
    check_output(out, *TABLES, overwrite=overwrite)
    check_output(figure, *FIGURES)
    with progress_bar(json) as progress:
        result = workflow.design_excitation(
            model,
            parameters,
            duration=duration,
            rate=rate,
            frequency=frequency,
            harmonics=harmonics,
            region=interval_map("region", region),
            velocity=number_list("velocity", velocity),
            effort=number_list("effort", effort),
            margin=margin,
            torque_noise=number_list("torque-noise", torque_noise),
            starts=starts,
            seed=seed,
            overrides=override,
            progress=progress,
        )
    show(result, json, out, figure=figure, overwrite=overwrite)


@design.command()
def reduced_order(
    model: Model,
    rate: Annotated[float, typer.Option(help="Rate [1/s] at which squared distances decrease.")],
    region: Annotated[
        str | None,
        typer.Option("--region", "--box", help="Ends of the states, as x1=0:1; those not named are the model's own."),
    ] = None,
    inputs: Annotated[str | None, typer.Option(help="Ends of the inputs, as u1=-1:1; zero by default.")] = None,
    full: Annotated[bool, typer.Option("--full", help="Find a gain of the full observer as well.")] = False,
    override: Override = [],  # noqa: B006  typer copies it
    json: Json = False,
) -> None:
    """Design an observer of the states that are not measured, and prove that it converges from any distance."""
    with progress_bar(json) as progress:
        result = workflow.design_reduced_order(
            model,
            rate=rate,
            region=interval_map("region", region),
            inputs=interval_map("inputs", inputs),
            full=full,
            overrides=tuple(override),
            progress=progress,
        )
    show(result, json)
