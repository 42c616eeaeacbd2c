"""The commands that need a model alone, and their options."""

import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from covariant import workflow
from covariant.cli._console import progress_bar, show
from covariant.cli._names import CERTIFIED, FIGURES, PAPERS, WRITTEN, Checker
from covariant.cli._options import (
    Json,
    Model,
    Observer,
    Override,
    Report,
    existing_model,
    known_observer,
)
from covariant.cli._parse import byte_count, interval_map, name_list, number_list
from covariant.workflow import check_output

on_models = typer.Typer()


def certified_observer(name: str) -> str:
    """Check the name of an observer that can be certified.

    Returns:
        The name.

    Raises:
        ValueError: For another name; the message lists those that there are.
    """
    if name not in CERTIFIED:
        raise ValueError(f"unknown observer {name!r}; choose one of {', '.join(CERTIFIED)}")
    return name


def known_paper(name: str) -> str:
    """Check the name of a paper that is reproduced.

    Returns:
        The name.

    Raises:
        ValueError: For another name; the message lists those that there are.
    """
    if name not in PAPERS:
        raise ValueError(f"unknown paper {name!r}; choose one of {', '.join(PAPERS)}")
    return name


@on_models.command()
def simulate(
    model: Model,
    out: Annotated[Path, typer.Option("--out", "-o", help=f"Log to write ({', '.join(WRITTEN)}).")],
    duration: Annotated[float, typer.Option(help="Length [s].", min=0.0)] = 10.0,
    rate: Annotated[float, typer.Option(help="Samples a second [Hz].")] = 500.0,
    q0: Annotated[
        str | None,
        typer.Option(
            help="Initial positions, by commas, or exponential coordinates of a pose; the whole initial state of a "
            "state-space model; zeros by default."
        ),
    ] = None,
    v0: Annotated[str | None, typer.Option(help="Initial velocities, separated by commas; zeros by default.")] = None,
    amplitude: Annotated[str | None, typer.Option(help="Amplitudes of sinusoidal inputs, by commas.")] = None,
    frequency: Annotated[float, typer.Option(help="Frequency of the inputs [Hz].")] = 0.5,
    noise: Annotated[
        str, typer.Option(help="Standard deviation of the position noise, one or one each by commas.")
    ] = "0",
    quantum: Annotated[str, typer.Option(help="Encoder step, one or one each by commas; 0 for none.")] = "0",
    jitter: Annotated[float, typer.Option(help="Standard deviation of the sampling instants [s].")] = 0.0,
    dropout: Annotated[float, typer.Option(help="Probability that a sample is missing.")] = 0.0,
    seed: Annotated[int, typer.Option(help="Seed of noise, jitter and dropouts.", min=0)] = 0,
    push: Annotated[
        str | None,
        typer.Option(help="Largest force [N or N m] of pushes on each velocity, by commas; one begins every 2 s."),
    ] = None,
    override: Override = [],  # noqa: B006  typer copies it
    json: Json = False,
) -> None:
    """Simulate a model and its sensors, and write the log with the true state beside the measurements."""
    check_output(out, *WRITTEN)
    with progress_bar(quiet=json) as progress:
        result = workflow.simulate(
            model,
            duration=duration,
            rate=rate,
            q0=number_list("q0", q0),
            v0=number_list("v0", v0),
            amplitude=number_list("amplitude", amplitude),
            frequency=frequency,
            noise=number_list("noise", noise) or 0.0,
            quantum=number_list("quantum", quantum) or 0.0,
            jitter=jitter,
            dropout=dropout,
            seed=seed,
            push=number_list("push", push),
            overrides=override,
            progress=progress,
        )
    show(result, json, out)


@on_models.command("model")
def show_model(
    model: Model,
    samples: Annotated[int, typer.Option(help="Number of configurations to measure the geometry at.", min=1)] = 200,
    seed: Annotated[int, typer.Option(help="Seed of the configurations.", min=0)] = 0,
    override: Override = [],  # noqa: B006  typer copies it
    json: Json = False,
) -> None:
    """Say what a model is made of: the tree of a robot, what of its file is used, and how curved its metric is."""
    with progress_bar(json) as progress:
        result = workflow.describe_model(
            model, samples=samples, seed=seed, overrides=tuple(override), progress=progress
        )
    show(result, json)


@on_models.command()
def cite(
    model: Model,
    observer: Observer = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Write the BibTeX entries here (.bib).")] = None,
    override: Override = [],  # noqa: B006  typer copies it
    json: Json = False,
) -> None:
    """Say which works an observer and the numbers of a model are from, with BibTeX entries."""
    check_output(out, ".bib")
    show(workflow.cite(model, observer=observer, overrides=tuple(override)), json, out)


@on_models.command()
def doctor(json: Json = False) -> None:
    """Examine the installation: versions, extras, compiler, cache, threads, devices; exit code 1 on a problem."""
    result = workflow.doctor()
    show(result, json)
    raise SystemExit(1 if result.problems else 0)


@on_models.command()
def reproduce(
    paper: Annotated[str, typer.Argument(help=f"One of: {', '.join(PAPERS)}.", callback=known_paper)],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Write the paper's figure here (.png).")] = None,
    report: Report = None,
    json: Json = False,
) -> None:
    """Reproduce a paper's numbers and figures."""
    check_output(out, ".png")
    check_output(report, ".html")
    with progress_bar(json) as progress:
        result = workflow.reproduce_paper(paper, progress=progress)
    show(result, json, report=report, figure=out)


@on_models.command()
def audit(
    model: Model,
    observer: Annotated[
        str | None,
        typer.Option(
            help="intrinsic, intrinsic2, geodesic, implicit-geodesic or copy; intrinsic by default.",
            callback=known_observer,
        ),
    ] = None,
    alpha: Annotated[float | None, typer.Option(help="Gain α [1/s]; √2 by default.")] = None,
    beta: Annotated[float | None, typer.Option(help="Gain β [1/s²]; 1 by default.")] = None,
    region: Annotated[
        str | None, typer.Option("--region", "--box", help="Where to draw positions from, as r=0.1:2,theta=-1:1.")
    ] = None,
    speed: Annotated[float, typer.Option(help="Largest velocity of each coordinate.")] = 3.0,
    points: Annotated[int, typer.Option(help="Number of states.", min=1)] = 24,
    seed: Annotated[int, typer.Option(help="Seed of the states.", min=0)] = 0,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", "--html", help="Write a page (.html) or its figure (.png) here.")
    ] = None,
    override: Override = [],  # noqa: B006  typer copies it
    json: Json = False,
) -> None:
    """Measure the laws that an observer's convergence rests on; exit code 1 where one is broken."""
    check_output(out, ".html", *FIGURES)
    with progress_bar(json) as progress:
        result = workflow.audit_observer(
            model,
            observer=observer,
            alpha=alpha,
            beta=beta,
            region=interval_map("region", region),
            speed=speed,
            points=points,
            seed=seed,
            overrides=tuple(override),
            progress=progress,
        )
    page, figure = (out, None) if out is not None and out.suffix == ".html" else (None, out)
    show(result, json, report=page, figure=figure)
    raise SystemExit(0 if result.passed else 1)


@on_models.command()
def export(
    model: Model,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write, or a unit for simulators (.fmu).")],
    rate: Annotated[float, typer.Option(help="Sampling rate [Hz] that it is made for.")],
    observer: Observer = None,
    alpha: Annotated[float | None, typer.Option(help="Gain α [1/s] in place of the designed one.")] = None,
    beta: Annotated[float | None, typer.Option(help="Gain β [1/s²] in place of the designed one.")] = None,
    real: Annotated[str, typer.Option(help="Type of all numbers: double or float.")] = "double",
    name: Annotated[str | None, typer.Option(help="What all names in C begin with; the model's by default.")] = None,
    parameters: Annotated[
        str | None,
        typer.Option(help="Numbers of the model that may be changed at run time, by commas; all by default, or none."),
    ] = None,
    flash: Annotated[
        str | None,
        typer.Option(
            help="Most bytes of code and constants, such as 64k: where straight C is estimated to take more, like "
            "statements become loops over tables, which take more time."
        ),
    ] = None,
    certificate: Annotated[
        Path | None, typer.Option(help="Saved certificate of this observer, for the data sheet (.json).")
    ] = None,
    metric: Annotated[
        Path | None, typer.Option(help="Metric on a grid for riccati, as `design metric` stores it (.zarr).")
    ] = None,
    fmi: Annotated[str | None, typer.Option(help="Version of FMI of a .fmu: 3.0, the default, or 2.0.")] = None,
    lag: Annotated[
        float | None,
        typer.Option(help="Time [s] after which each estimate comes, from all samples up to then, of a filter."),
    ] = None,
    step_per_sensor: Annotated[
        bool,
        typer.Option("--step-per-sensor", help="Of a filter with sensors, a step for each of them alone as well."),
    ] = False,
    python: Annotated[
        bool, typer.Option("--python", help="Write a Python package beside the C, with a wheel; it needs NumPy alone.")
    ] = False,
    wasm: Annotated[
        bool, typer.Option("--wasm", help="Compile it to WebAssembly as well, with a script for pages and Node.")
    ] = False,
    gate: Annotated[
        bool, typer.Option("--gate/--no-gate", help="Write the gate of the observer, which refuses outliers.")
    ] = True,
    log: Annotated[
        Path | None,
        typer.Option(
            help="Log that `estimate` runs on, for the usual speed in the gate, and for ticks and sensors; by default "
            "the speed is motion_acceleration times motion_time of the model file."
        ),
    ] = None,
    audit: Annotated[bool, typer.Option("--audit/--no-audit", help="Measure the laws of the observer first.")] = True,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace files that are there.")] = False,
    override: Override = [],  # noqa: B006  typer copies it
    json: Json = False,
) -> None:
    """Write an observer as C99 for microcontrollers and controllers, or as a unit (.fmu) for Simulink and Modelica."""
    with progress_bar(json) as progress:
        result = workflow.export(
            model,
            out,
            rate=rate,
            observer=observer,
            alpha=alpha,
            beta=beta,
            real=real,
            name=name,
            parameters=() if parameters == "none" else name_list(parameters),
            flash=byte_count("flash", flash),
            certificate=certificate,
            metric=metric,
            fmi=fmi,
            lag=lag,
            step_per_sensor=step_per_sensor,
            python=python,
            wasm=wasm,
            gate=gate,
            log=log,
            audit=audit,
            overwrite=overwrite,
            overrides=tuple(override),
            progress=progress,
        )
    # On standard error, so that --json prints its object alone.
    for warning in result.warnings:
        print(f"covariant: warning: {warning}", file=sys.stderr)
    show(result, json)


@on_models.command()
def certify(
    model: Annotated[
        str | None,
        typer.Argument(
            help="Model file (.toml), robot (.urdf or .xml), module:attribute, or a system.", callback=existing_model
        ),
    ] = None,
    velocity: Annotated[
        str | None, typer.Option(help="Bound of the true velocities, one or one each by commas; required.")
    ] = None,
    error: Annotated[
        str | None, typer.Option(help="How far estimated positions may be off, one bound or one each; required.")
    ] = None,
    region: Annotated[
        str | None,
        typer.Option("--region", "--box", help="Ends of the positions, as r=-0.3:0.3,theta=-1:1; rotations need none."),
    ] = None,
    observer: Annotated[
        str, typer.Option(help=f"One of: {', '.join(CERTIFIED)}.", callback=certified_observer)
    ] = CERTIFIED[0],
    alpha: Annotated[float | None, typer.Option(help="Gain α [1/s]; designed from the data sheet by default.")] = None,
    beta: Annotated[float | None, typer.Option(help="Gain β [1/s²].")] = None,
    sampling: Annotated[float | None, typer.Option(help="Sampling rate that gains are designed for [Hz].")] = None,
    input: Annotated[str | None, typer.Option(help="Bound of the inputs, one or one each; zero by default.")] = None,
    times: Annotated[
        str | None, typer.Option(help="First and last time [s], by commas, where the force depends on time.")
    ] = None,
    rate: Annotated[
        float | None, typer.Option(help="Rate λ of squared lengths to prove [1/s]; half of Q's by default.")
    ] = None,
    q: Annotated[str | None, typer.Option(help="Metric Q as a,c,b; the best conditioned one by default.")] = None,
    noise: Annotated[
        str | None, typer.Option(help="Bound of the error of each measured position: one number or one each.")
    ] = None,
    disturbance: Annotated[
        str | None, typer.Option(help="Bound of the force that the model does not know: one number or one each.")
    ] = None,
    interval: Annotated[
        str | None,
        typer.Option(help="Shortest and longest time between samples [s], by commas; continuous time without it."),
    ] = None,
    lost: Annotated[int, typer.Option(help="With --interval, how many samples in a row may be lost.", min=0)] = 0,
    boxes: Annotated[
        int, typer.Option(help="Effort: boxes that may be evaluated, the same on every machine.")
    ] = 200_000,
    seconds: Annotated[float | None, typer.Option(help="A limit of time besides [s], for each of the proofs.")] = None,
    processes: Annotated[int | None, typer.Option(help="Processes; as many as processors by default.", min=1)] = None,
    checker: Annotated[
        Checker,
        typer.Option(help="Give what is proved to the checker: for as long as the proof took, all, or not."),
    ] = "auto",
    find: Annotated[
        str | None,
        typer.Option(
            help="Search the largest that is proved, beginning with what is given: error (a multiple of it), rate, or "
            "interval (its longest time)."
        ),
    ] = None,
    runs: Annotated[int, typer.Option(help="With --find, how many certificates are tried at most.", min=1)] = 10,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Write the certificate here (.json).")] = None,
    figure: Annotated[Path | None, typer.Option(help="Draw region, tube, distances and gains here (.png).")] = None,
    check: Annotated[Path | None, typer.Option("--check", help="Verify this saved certificate instead.")] = None,
    given: Annotated[
        str | None,
        typer.Option("--model", help="With --check: the module:attribute of a model that is not covariant's own."),
    ] = None,
    override: Override = [],  # noqa: B006  typer copies it
    json: Json = False,
) -> None:
    """Prove that an observer converges: on which region, at which rate, from how far. Angles are in radians.

    Exit code 0 proved or verified, 1 wrong, undecided or refused, 2 bad input.
    """
    if given is not None and check is None:
        raise ValueError("--model goes with --check FILE; the model to certify is the first argument")
    if (model is None) == (check is None):
        raise ValueError("give a model to certify, or --check FILE to verify a saved certificate")
    if check is not None:
        if not check.exists():
            raise ValueError(f"{check} does not exist; give the path of a saved certificate")
        with progress_bar(json) as progress:
            checked = workflow.check_certificate(
                check, model=given, processes=processes or os.cpu_count() or 1, progress=progress
            )
        show(checked, json)
        raise SystemExit(0 if checked.verified else 1)
    check_output(out, ".json")
    check_output(figure, *FIGURES)
    if figure is not None and interval is not None:
        raise ValueError("--figure is for certificates in continuous time; leave --interval out")
    with progress_bar(json) as progress:
        result = workflow.certify(
            model,
            velocity=number_list("velocity", velocity),
            error=number_list("error", error),
            region=interval_map("region", region),
            observer=observer,
            alpha=alpha,
            beta=beta,
            sampling=sampling,
            input=number_list("input", input) or 0.0,
            times=number_list("times", times),
            rate=rate,
            q=number_list("q", q),
            noise=number_list("noise", noise) or 0.0,
            disturbance=number_list("disturbance", disturbance) or 0.0,
            interval=number_list("interval", interval),
            lost=lost,
            boxes=boxes,
            seconds=seconds,
            processes=processes or os.cpu_count() or 1,
            checker=checker,
            find=find,
            runs=runs,
            overrides=tuple(override),
            progress=progress,
        )
    show(result, json, None if result.wrong else out, figure=figure)
    raise SystemExit(0 if result.holds else 1)
