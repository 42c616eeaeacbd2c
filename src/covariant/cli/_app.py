"""The commands and their options. Each command is in its own module, loaded when it runs, so that help is quick."""

from pathlib import Path
from typing import Annotated

import typer

from covariant.cli._names import CERTIFIED, ESTIMATORS, PAPERS, STATE_ESTIMATORS, WRITTEN

app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode=None)
design = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Design what an observer needs.")
app.add_typer(design, name="design")


def _version(asked: bool) -> bool:
    if asked:
        from importlib.metadata import version

        print(f"covariant {version('covariant')}")
        raise typer.Exit
    return asked


@app.callback()
def covariant(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Say which version this is.")
    ] = False,
) -> None:
    """Velocities and states from measured positions: observers, their proofs, their comparison."""


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
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object for machines.")]
Anyway = Annotated[bool, typer.Option("--anyway", help="Go on although the log does not fit the model at all.")]
Report = Annotated[Path | None, typer.Option(help="Write an interactive page (.html) and PNG figures beside it.")]


@app.command()
def estimate(
    model: Model,
    log: LogFile,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help=f"Write the estimate here ({', '.join(WRITTEN)}).")
    ] = None,
    observer: Annotated[
        str | None,
        typer.Option(
            help=f"One of: {', '.join(ESTIMATORS)}; intrinsic by default. For a state-space model: "
            f"{', '.join(STATE_ESTIMATORS)}."
        ),
    ] = None,
    alpha: Annotated[float | None, typer.Option(help="Gain α [1/s] in place of the designed one.")] = None,
    beta: Annotated[float | None, typer.Option(help="Gain β [1/s²] in place of the designed one.")] = None,
    override: Override = [],  # noqa: B006  typer copies it
    every: Every = 1,
    start: From = None,
    until: Until = None,
    t: Time = None,
    q: Positions = None,
    u: Inputs = None,
    v: Velocities = None,
    truth: Truth = None,
    score: Annotated[
        bool,
        typer.Option("--score", help="Score the velocities too, against slopes of the positions."),
    ] = False,
    report: Report = None,
    anyway: Anyway = False,
    json: Json = False,
) -> None:
    """Estimate velocities from the positions or attitudes in a log."""
    from covariant.cli import _estimate
    from covariant.cli._job import Job

    job = Job(
        model, log, tuple(override), every, until, {"t": t, "q": q, "u": u, "v": v, "truth": truth}, anyway, start
    )
    _estimate.estimate(job, out, observer, alpha, beta, score, report, json)


@app.command()
def compare(
    model: Model,
    log: LogFile,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Write the table here (.csv).")] = None,
    override: Override = [],  # noqa: B006  typer copies it
    every: Every = 1,
    start: From = None,
    until: Until = None,
    t: Time = None,
    q: Positions = None,
    u: Inputs = None,
    v: Velocities = None,
    truth: Truth = None,
    report: Report = None,
    anyway: Anyway = False,
    json: Json = False,
) -> None:
    """Run all estimators on a log, tuned from the same data sheet, and rank them."""
    from covariant.cli import _compare
    from covariant.cli._job import Job

    job = Job(
        model, log, tuple(override), every, until, {"t": t, "q": q, "u": u, "v": v, "truth": truth}, anyway, start
    )
    _compare.compare(job, out, report, json)


@app.command()
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
    from covariant.cli import _check
    from covariant.cli._job import Job

    _check.check(Job(model, log, tuple(override), every, until, {"t": t, "q": q, "u": u}, True, start), json)


@app.command()
def fit(
    model: Model,
    log_files: Annotated[
        list[Path],
        typer.Argument(
            metavar="LOG...", help="Logs to fit; the last of several, or the last third of one, is held out."
        ),
    ],
    parameters: Annotated[
        str, typer.Option(help="Numbers to fit, by commas: mass, com[0] of [parameters], or inputs.lag.")
    ],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Write the model file with the fitted numbers here (.toml).")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Let --out replace a file that exists.")] = False,
    horizon: Annotated[
        float | None, typer.Option(help="Length of predictions [s]; by default as the motion suggests.")
    ] = None,
    override: Override = [],  # noqa: B006  typer copies it
    every: Every = 1,
    start: From = None,
    until: Until = None,
    t: Time = None,
    q: Positions = None,
    u: Inputs = None,
    anyway: Anyway = False,
    json: Json = False,
) -> None:
    """Fit numbers of a model to logs: with standard errors, and with names for what the logs do not determine.

    Exit code 1 where the fitted model predicts worse than before what is held out; it is not written then.
    """
    from covariant.cli import _fit
    from covariant.cli._job import Job

    columns = {"t": t, "q": q, "u": u, "v": None, "truth": None}
    jobs = [Job(model, log, tuple(override), every, until, columns, anyway, start) for log in log_files]
    _fit.fit_model(jobs, parameters, out, overwrite, horizon, json)


@app.command()
def tune(
    model: Model,
    log_files: Annotated[
        list[Path], typer.Argument(metavar="LOG...", help="Logs; the last third of each is held out to judge by.")
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", "--write", help="Write the model file with the tuned numbers here (.toml)."),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Let --out replace a file that exists.")] = False,
    override: Override = [],  # noqa: B006  typer copies it
    every: Every = 1,
    until: Until = None,
    t: Time = None,
    q: Positions = None,
    u: Inputs = None,
    report: Report = None,
    anyway: Anyway = False,
    json: Json = False,
) -> None:
    """Tune noise and gains to logs by the likelihood of their innovations, and judge them on what was held out."""
    from covariant.cli import _tune
    from covariant.cli._job import Job

    columns = {"t": t, "q": q, "u": u, "v": None, "truth": None}
    jobs = [Job(model, log, tuple(override), every, until, columns, anyway) for log in log_files]
    _tune.tune_model(jobs, out, overwrite, report, json)


@app.command()
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
    from covariant.cli import _init

    _init.init(log, out, {"t": t, "q": q, "u": u, "v": v}, json)


@app.command()
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
    noise: Annotated[float, typer.Option(help="Standard deviation of the position noise.")] = 0.0,
    quantum: Annotated[float, typer.Option(help="Encoder step.")] = 0.0,
    jitter: Annotated[float, typer.Option(help="Standard deviation of the sampling instants [s].")] = 0.0,
    dropout: Annotated[float, typer.Option(help="Probability that a sample is missing.")] = 0.0,
    seed: Annotated[int, typer.Option(help="Seed of noise, jitter and dropouts.", min=0)] = 0,
    override: Override = [],  # noqa: B006  typer copies it
    json: Json = False,
) -> None:
    """Simulate a model and its sensors, and write the log with the true state beside the measurements."""
    from covariant.cli import _simulate

    scenario = _simulate.Scenario(duration, rate, q0, v0, amplitude, frequency, noise, quantum, jitter, dropout, seed)
    _simulate.simulate(model, tuple(override), out, scenario, json)


@app.command("model")
def show_model(
    model: Model,
    samples: Annotated[int, typer.Option(help="Number of configurations to measure the geometry at.", min=1)] = 200,
    seed: Annotated[int, typer.Option(help="Seed of the configurations.", min=0)] = 0,
    override: Override = [],  # noqa: B006  typer copies it
    json: Json = False,
) -> None:
    """Say what a model is made of: the tree of a robot, what of its file is used, and how curved its metric is."""
    from covariant.cli import _model

    _model.show(model, tuple(override), samples, seed, json)


@app.command()
def reproduce(
    paper: Annotated[str, typer.Argument(help=f"One of: {', '.join(PAPERS)}.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Write the paper's figure here (.png).")] = None,
    report: Report = None,
    json: Json = False,
) -> None:
    """Reproduce a paper's numbers and figures."""
    from covariant.cli import _reproduce

    _reproduce.reproduce(paper, out, report, json)


@app.command()
def audit(
    model: Model,
    observer: Annotated[
        str | None, typer.Option(help="intrinsic, intrinsic2, geodesic or copy; intrinsic by default.")
    ] = None,
    alpha: Annotated[float | None, typer.Option(help="Gain α [1/s]; √2 by default.")] = None,
    beta: Annotated[float | None, typer.Option(help="Gain β [1/s²]; 1 by default.")] = None,
    box: Annotated[str | None, typer.Option(help="Where to draw positions from, as r=0.1:2,theta=-1:1.")] = None,
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
    from covariant.cli import _audit

    look = _audit.Look(box, speed, points, seed)
    _audit.audit(model, tuple(override), observer, (alpha, beta), look, out, json)


@app.command()
def export(
    model: Model,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write.")],
    rate: Annotated[float, typer.Option(help="Sampling rate [Hz] that it is made for.")],
    observer: Annotated[
        str | None, typer.Option(help=f"One of: {', '.join(ESTIMATORS)}; intrinsic by default.")
    ] = None,
    alpha: Annotated[float | None, typer.Option(help="Gain α [1/s] in place of the designed one.")] = None,
    beta: Annotated[float | None, typer.Option(help="Gain β [1/s²] in place of the designed one.")] = None,
    real: Annotated[str, typer.Option(help="Type of all numbers: double or float.")] = "double",
    name: Annotated[str | None, typer.Option(help="What all names in C begin with; the model's by default.")] = None,
    parameters: Annotated[
        str | None,
        typer.Option(help="Numbers of the model that may be changed at run time, by commas; all by default, or none."),
    ] = None,
    certificate: Annotated[
        Path | None, typer.Option(help="Saved certificate of this observer, for the data sheet (.json).")
    ] = None,
    audit: Annotated[bool, typer.Option("--audit/--no-audit", help="Measure the laws of the observer first.")] = True,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace files in the folder.")] = False,
    override: Override = [],  # noqa: B006  typer copies it
    json: Json = False,
) -> None:
    """Write an observer as C99, with self-test, build files and data sheet, for microcontrollers and controllers."""
    from covariant.cli import _export

    asked = _export.Asked(observer, (alpha, beta), rate, real, name, parameters, certificate, audit, overwrite)
    _export.export(model, tuple(override), asked, out, json)


@app.command()
def certify(
    model: Annotated[
        str | None, typer.Argument(help="Model file (.toml), robot (.urdf or .xml), module:attribute, or a system.")
    ] = None,
    velocity: Annotated[
        str | None, typer.Option(help="Bound of the true velocities, one or one each by commas; required.")
    ] = None,
    error: Annotated[
        str | None, typer.Option(help="How far estimated positions may be off, one bound or one each; required.")
    ] = None,
    box: Annotated[
        str | None, typer.Option(help="Ends of the positions, as r=-0.3:0.3,theta=-1:1; rotations need none.")
    ] = None,
    observer: Annotated[str | None, typer.Option(help=f"One of: {', '.join(CERTIFIED)}.")] = None,
    alpha: Annotated[float | None, typer.Option(help="Gain α [1/s]; designed from the data sheet by default.")] = None,
    beta: Annotated[float | None, typer.Option(help="Gain β [1/s²].")] = None,
    sampling: Annotated[float | None, typer.Option(help="Sampling rate that gains are designed for [Hz].")] = None,
    input: Annotated[str | None, typer.Option(help="Bound of the inputs, one or one each; zero by default.")] = None,
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
    boxes: Annotated[
        int, typer.Option(help="Effort: boxes that may be evaluated, the same on every machine.")
    ] = 200_000,
    seconds: Annotated[float | None, typer.Option(help="A limit of time besides [s], for each of the proofs.")] = None,
    processes: Annotated[int | None, typer.Option(help="Processes; as many as processors by default.", min=1)] = None,
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
    from covariant.cli import _certify

    asked = _certify.Asked(
        observer,
        alpha,
        beta,
        sampling,
        box,
        velocity,
        error,
        input,
        rate,
        q,
        noise,
        disturbance,
        boxes,
        seconds,
        processes,
    )
    if given is not None and check is None:
        raise ValueError("--model goes with --check FILE; the model to certify is the first argument")
    if check is not None and model is None:
        _certify.check_file(check, given, processes, json)
    elif model is not None and check is None:
        _certify.certify_model(model, tuple(override), asked, out, figure, json)
    else:
        raise ValueError("give a model to certify, or --check FILE to verify a saved certificate")


@design.command()
def metric(
    model: Model,
    out: Annotated[Path, typer.Option("--out", "-o", help="Store to write, or to go on with (.zarr).")],
    grid: Annotated[
        str,
        typer.Option(help="Points of each axis, one count or one each by commas; four at least to interpolate."),
    ],
    box: Annotated[
        str | None, typer.Option(help="Ends of the axes, as x1=0:1,x2=1:1.5; those not named are the model's own.")
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
        str | None, typer.Option(help="Where the model holds, as --box; the past is followed no further.")
    ] = None,
    input: Annotated[str | None, typer.Option(help="Constant inputs, by commas; zeros by default.")] = None,
    block: Annotated[int, typer.Option(help="Points that a worker computes at a time.", min=1)] = 4096,
    workers: Annotated[int | None, typer.Option(help="Threads; as many as processors by default.", min=1)] = None,
    scheduler: Annotated[str | None, typer.Option(help="Address of a Dask scheduler whose workers compute.")] = None,
    override: Override = [],  # noqa: B006  typer copies it
    json: Json = False,
) -> None:
    """Compute a contraction metric at every point of a grid of states; a run that was stopped goes on where it was."""
    from covariant.cli import _design

    task = _design.Task(box, grid, rate, window, process_cov, measurement_cov, start, tolerance, domain, input)
    crew = _design.Crew(block, workers, scheduler)
    _design.metric(model, tuple(override), out, task, crew, json)
