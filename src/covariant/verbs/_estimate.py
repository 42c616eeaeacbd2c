"""`estimate`: velocities or states from a log, by one observer."""

from typing import Any

from covariant._names import refuse_unknown
from covariant.calibration import ESTIMATORS, STATE_ESTIMATORS
from covariant.engine import EngineName
from covariant.models import Overrides
from covariant.verbs.base.arguments import Amounts, given_gains
from covariant.verbs.base.design import default_observer
from covariant.verbs.base.determined import determined
from covariant.verbs.base.estimates import EstimateResult, choose_observer
from covariant.verbs.base.inputs import ColumnNames, Job, load, with_sensor_delays
from covariant.verbs.base.outcome import drive
from covariant.verbs.base.progress import Progress, notebook_line
from scalargraph.errors import InputError


def estimate(
    model: Any,
    log: Any,
    *,
    observer: str | None = None,
    alpha: Amounts | None = None,
    beta: Amounts | None = None,
    speed: Amounts | None = None,
    score: bool = False,
    overrides: Overrides = (),
    every: int = 1,
    start: float | None = None,
    until: float | None = None,
    columns: ColumnNames | None = None,
    anyway: bool = False,
    engine: EngineName = "auto",
    progress: Progress = notebook_line,
) -> EstimateResult:
    """Estimate velocities, or states of a state-space model, from the positions or outputs in a log.

    It is causal: a row of the result depends on the rows up to it, as in real time. Use `smooth` where later rows may
    be used too, and `Stream` of `covariant.engine` for samples that arrive one by one. The gains come from the noise in
    the model file, unless `alpha` and `beta` are given. Call `check` on a new log first: a wrong unit, sign or delay
    looks like a poor observer.

    Args:
        model: A model file (.toml), a robot (.urdf, .xml), `module:attribute`, the name of a system or a robot of the
            library, a `ModelFile`, or a system.
        log: A path (.csv, .txt, .tsv, .parquet, .mcap, a rosbag2), a `Record`, a DataFrame, or an xarray Dataset. With
            a list of them the verb goes over each by itself, as `over_logs` does, and returns a `LogsResult`.
        observer: Name of the observer; by default the first that fits the model, `intrinsic` for a mechanical one.
        alpha: Gain α [1/s] in place of the designed one, together with `beta`; for the observer
            "measured-coefficients" one for all coordinates or one each.
        beta: Gain β [1/s²] in place of the designed one, likewise, together with `alpha`.
        speed: With gains, bound of the true velocities [unit/s] for the observer "measured-coefficients", one for all
            or one each; by default none.
        score: Score velocities against slopes of the positions where the log has no true velocities.
        overrides: Values that replace those of the model file: `{"measurement.std": 1e-4}`, or
            `["measurement.std=1e-4"]`.
        every: Use each k-th row only.
        start: Use the log from this time on only [s since its first row].
        until: Use the log up to this time only [s since its first row].
        columns: Names of columns by field (t, q, u, v, truth) that replace those of the model file.
        anyway: Go on with a log that does not fit the model at all.
        engine: What computes: "c", "jax", or "auto" for C where it pays.
        progress: Called with a description and a fraction as the work goes on.

    Returns:
        The estimates with their standard deviations where the observer knows them, units, score and warnings.

    Raises:
        MisfitError: Where the model explains nothing of the motion in the log.
        ValueError: For bad arguments, a model or log that cannot be used, or an estimate that diverged.

    Example:
        >>> import covariant
        >>> log = covariant.simulate("oscillator", duration=2.0, noise=1e-4, q0=[1.0]).record
        >>> result = covariant.estimate("oscillator", log, alpha=40.0, beta=800.0)
        >>> result.velocity.shape
        (1001, 1)
    """
    if observer is not None:
        refuse_unknown("observer", observer, (*ESTIMATORS, *STATE_ESTIMATORS))
    gains = given_gains(alpha, beta, speed)
    job = Job(model, log, overrides, every, until, columns or {}, anyway, start)
    progress("reading the log")
    loaded = load(job, score, missing_inputs=True)
    observer = observer or default_observer(loaded.file, gains)
    chosen, notes = choose_observer(job, loaded, observer, gains)
    chosen = with_sensor_delays({observer: chosen}, loaded)[observer]
    progress(f"estimating with {observer}")
    outcome = drive(chosen, loaded, engine)
    if outcome.failed:
        raise InputError(f"{job.log_name}: {outcome.failure}, or lower the gains")
    return EstimateResult(job, loaded, observer, notes, outcome, engine, determined(chosen, loaded, outcome))
