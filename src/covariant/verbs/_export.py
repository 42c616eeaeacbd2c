"""`export`: an observer as C for microcontrollers, as a Python package, as WebAssembly, or as a unit (.fmu)."""

import dataclasses
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from covariant import certificates, codegen, models
from covariant.models import Overrides
from covariant.observers import REGISTRY, SMOOTHED, AbstractObserver, Delayed, FixedLag, Gated, Unwrapped
from covariant.verbs.base.arguments import Amounts, above_zero, given_gains
from covariant.verbs.base.design import Design, design
from covariant.verbs.base.exported_program import exported_program, open_family
from covariant.verbs.base.inputs import Job, Loaded, densest_rate, describe_inputs, load, with_acting_inputs
from covariant.verbs.base.kinds import kind_of
from covariant.verbs.base.progress import Progress, notebook_line
from covariant.verbs.base.result import AbstractResult
from covariant.verbs.base.robot_file import FORMATS, RobotFileResult, write_robot
from covariant.verbs.base.sensors import reading_delays
from scalargraph import operations
from scalargraph.compiler import NO_COMPILER
from scalargraph.errors import InputError

REALS = ("double", "float")
VERSIONS = ("3.0", "2.0")
_ENTRIES = {entry.name: entry for entry in REGISTRY}
UNGATED = "It has no gate and refuses no measurement, as asked."


def export(
    model: Any,
    out: str | Path,
    *,
    rate: float,
    observer: str | None = None,
    alpha: Amounts | None = None,
    beta: Amounts | None = None,
    speed: Amounts | None = None,
    real: str = "double",
    name: str | None = None,
    parameters: Sequence[str] | None = None,
    certificate: str | Path | None = None,
    metric: str | Path | None = None,
    fmi: str | None = None,
    lag: float | None = None,
    step_per_sensor: bool = False,
    python: bool = False,
    wasm: bool = False,
    ros2: bool = False,
    gate: bool = True,
    log: Any = None,
    overwrite: bool = False,
    overrides: Overrides = (),
    progress: Progress = notebook_line,
) -> "ExportResult | RobotFileResult":
    """Write an observer as C99 for microcontrollers and controllers, or as a unit (.fmu) for simulators.

    It is the observer that `estimate` runs at this sampling rate, with its gate: outliers, holes and missing numbers
    have the same result codes. The gate judges by the noise of the model file and by the usual speed of the motion,
    which `estimate` reads from its log.

    Where `out` ends in .urdf, .xml or .json, the robot itself is written with the numbers of its model file, for
    simulators: its URDF file, an MJCF file, or a table of its servos for configurations of actuators. A file named
    JOINT.bam.json is the servo of that joint for BAM. Such files take no options of an observer.

    Args:
        model: A model file (.toml), a robot, `module:attribute`, the name of a system, a `ModelFile`, or a system.
        out: The folder to write, or a unit for simulators where it ends in .fmu, or the file of a robot.
        rate: Sampling rate [Hz] that the observer is made for, or steps in a second of a robot's simulation.
        observer: Name of the observer; by default the first that fits the model.
        alpha, beta, speed: As for `estimate`.
        real: Type of all numbers in C, "double" or "float".
        name: What all names in C begin with; that of the model by default.
        parameters: Numbers of the model that may be changed at run time; all by default, none for an empty list.
        certificate: A saved certificate (.json) of this observer, for the data sheet. With a certificate for sampled
            measurements, and doubles, every step also returns a proved bound of the error. The number of substeps is
            then that of the certificate, and all numbers are constants, since the proof holds only for them.
        metric: A metric on a grid (.zarr) for the observer riccati, as `design_metric` stores it.
        fmi: Version of FMI of a unit, "3.0" (the default) or "2.0".
        lag: Estimate each time this much later [s], from all samples up to then, as `smooth` with this lag does; of a
            filter with a covariance. None (default) for estimates of the present.
        step_per_sensor: Of a filter with sensors, write a step for each of them and for the configuration as well,
            for samples in which nothing else was read: less work, more code.
        python: Write a Python package that needs NumPy alone beside the C, and a wheel of it.
        wasm: Compile the observer to WebAssembly as well, with a script for pages and Node.
        ros2: Write a package of ROS 2 with a node in Python.
        gate: Write the gate of the observer, which refuses outliers.
        log: The log on which `estimate` runs, for the usual speed in the gate, for encoder ticks, and for sensors that
            it has no columns of, which are left out; by default the speed is the product of `motion_acceleration` and
            `motion_time` in the model file.
        overwrite: Replace files that exist.
        overrides: Values that replace those of the model file.
        progress: Called with a description of the work.

    Returns:
        What was written, with warnings.

    Raises:
        ValueError: For arguments that do not fit the model or each other, an observer that has no code, and a folder
            that is not empty.

    Example:
        >>> import covariant, tempfile
        >>> folder = tempfile.mkdtemp() + "/c"
        >>> result = covariant.export("oscillator", folder, rate=500.0, alpha=20.0, beta=200.0)
        >>> sorted(path.suffix for path in result.files)[:2]
        ['.c', '.c']
    """
    out = Path(out)
    above_zero("rate", rate)
    if out.suffix in FORMATS:
        options = {"observer": observer, "alpha": alpha, "beta": beta, "speed": speed, "name": name}
        options |= {"parameters": parameters, "certificate": certificate, "metric": metric, "fmi": fmi, "lag": lag}
        options |= {"step_per_sensor": step_per_sensor, "python": python, "wasm": wasm, "ros2": ros2, "log": log}
        options |= {"real": real != REALS[0], "gate": not gate}
        return write_robot(model, out, rate, overwrite, overrides, options)
    codegen.check_export(out, overwrite)
    gains, unit = given_gains(alpha, beta, speed), out.suffix == ".fmu"
    packages = [name for name, wanted in (("python", python), ("wasm", wasm), ("ros2", ros2)) if wanted]
    _check(real, fmi, unit, step_per_sensor, packages)
    if name is not None:  # before the work
        codegen.check_export_name(name, python or ros2, wasm)
    if wasm:  # so that nobody waits for a design that then cannot be written
        codegen.check_wasm_compiler()
    progress("reading the model")
    label = models.spec_name(model)
    file, family, logged = _read(model, overrides, parameters, log)
    _check_model(label, file, certificate)
    designed = design(file, observer, gains, rate, logged, metric=metric, spec=label)
    refusals, assumed = designed.explain_gate() if gate else (UNGATED, "")
    designed = designed if gate else designed.without_gate()
    measured, chosen = designed.self_test(rate), _plain(designed, gains)
    about = f"{designed.name} observer of {file.name}, for samples {1 / rate:.6g} s apart. {chosen} {refusals}"
    # As `estimate` runs it: it chooses its substeps in each sample, so that a hole is predicted as exactly as there.
    runs, proof = designed.observer, None
    if certificate is not None:
        proof = _verify_certificate(Path(certificate), model, overrides, designed, rate)
        runs = proof.proved(runs)
        about += (
            " Its gains are constant from the start on, as in the certificate; `estimate` has larger ones at first."
        )
        if proof.is_bound(real) and parameters:
            raise InputError("the certificate is about the numbers of the model as they are; leave out `parameters`")
    if step_per_sensor and not getattr(runs, "sensors", ()):
        raise InputError(f"step_per_sensor is for a filter with sensors; {designed.name} of {label} has none")
    whole, sentences = _as_sent_and_read(runs, designed, measured[0], rate, lag)
    proved = unbounded = ""
    if proof is not None:
        whole, start, proved, unbounded = proof.bound(runs, whole, real)
        sentences += start
    prefix = codegen.export_name(file.name, python or ros2, wasm) if name is None else name
    progress(f"writing {prefix}")
    # Other observers have no parameters of the model.
    opened = family if _ENTRIES[designed.name].knows_model and not whole.fixed_numbers else None
    program = exported_program(label, whole, opened, file, parameters, real, measured[0], step_per_sensor)
    read = tuple(name for part in designed.sensors for name in part.signals)
    units = {**program.units, **designed.units}
    program = program._replace(signals=kind_of(file).signals(program.u, read), units=units)
    substeps = getattr(runs, "observer", runs).substeps or None
    code = _Code(program, prefix, about + sentences, measured, codegen.Facts(rate, substeps, proved, refusals))
    files, lacks = _write_unit(code, out, fmi, overwrite) if unit else _write_folder(code, out, packages, overwrite)
    warnings = tuple(line for line in (assumed, unbounded, *lacks) if line)
    return ExportResult(label, designed.name, code.about, chosen, out, tuple(files), program, warnings, refusals)


@dataclass(frozen=True, repr=False)
class ExportResult(AbstractResult):
    """Files of an exported observer, and what they compute.

    Attributes:
        model_name: The model, by its path or name.
        observer_name: Name of the observer.
        about: A sentence on the observer and its numbers.
        design: A sentence on its numbers.
        out: The folder, or the unit.
        files: All files that were written.
        program: The graphs of the observer and its numbers.
        notes: The warnings.
        gate: Sentences on the gate, or why there is none.

    Example:
        >>> import covariant, tempfile
        >>> folder = tempfile.mkdtemp() + "/c"
        >>> noise = {"measurement.std": 1e-3, "uncertainty.acceleration": 1.0}
        >>> moves = {"uncertainty.motion_acceleration": 20.0, "uncertainty.motion_time": 0.1}
        >>> result = covariant.export("oscillator", folder, rate=500.0, overrides=noise | moves)
        >>> result.observer_name, result.operations > 100
        ('intrinsic', True)
        >>> result.gate.partition(". ")[0]
        'Its gate refuses outliers, by the noise 0.001 m and the usual speed 2 m/s'
        >>> result.out.name, len(result.files) > 3, result.warnings
        ('c', True, ())
    """

    model_name: str
    observer_name: str
    about: str
    design: str
    out: Path
    files: tuple[Path, ...]
    program: codegen.Program
    notes: tuple[str, ...]
    gate: str = ""

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences on what a gate lacks, and on missing binaries."""
        return self.notes

    @property
    def operations(self) -> int:
        """Number of arithmetic operations of a step, all turns of its loops counted."""
        return operations(self.program.step.graph.nodes)

    @property
    def headline(self) -> str:
        return f"{self.observer_name} observer of {self.model_name} in {self.out}, {self.operations} operations a step"

    @property
    def summary(self) -> dict[str, Any]:
        result: dict[str, Any] = {"model": self.model_name, "observer": self.observer_name, "out": str(self.out)}
        result |= {"design": self.design, "gate": self.gate, "files": [str(path) for path in self.files]}
        result |= {"numbers": list(self.program.numbers), "operations": self.operations}
        return result | ({"warning": "; ".join(self.notes)} if self.notes else {})

    def __str__(self) -> str:
        if self.files == (self.out,):
            return f"{self.about}\nwrote {self.out}"
        how = f"wrote {len(self.files)} files into {self.out}; build and test them as its README.md says"
        return f"{self.about}\n{how}"


def _check(real: str, fmi: str | None, unit: bool, step_per_sensor: bool, packages: Sequence[str]) -> None:
    """Check what needs the arguments alone."""
    if real not in REALS:
        raise InputError(f"real must be one of {', '.join(REALS)}; got {real!r}")
    if fmi is not None and not unit:
        raise InputError("fmi is for a unit: name a file that ends in .fmu by -o")
    if fmi not in (None, *VERSIONS):
        raise InputError(f"fmi must be one of {', '.join(VERSIONS)}; got {fmi!r}")
    if unit and step_per_sensor:
        raise InputError("step_per_sensor is for C, and a unit has one step for all; leave it out")
    if unit and packages:
        raise InputError(f"{packages[0]} is for a folder, and a unit is one file; name a folder by -o")


def _read(
    model: Any, overrides: Overrides, parameters: Sequence[str] | None, log: Any
) -> tuple[models.ModelFile, models.Family | None, Loaded | None]:
    """The model file, the family of its open numbers, and the log that `estimate` runs on."""
    file = models.load(model, overrides)
    family = open_family(model, overrides, parameters) if file.mechanical else None
    file = file if family is None else family.file
    if log is None:
        return file, family, None
    logged = load(Job(model, log, overrides), score=False)
    # None where positions in the log are no ticks.
    return file._replace(quantum=logged.file.quantum), family, logged


def _check_model(label: str, file: models.ModelFile, certificate: Any) -> None:
    """Raise `ValueError` for a state-space model with a certificate, or with readings that are late."""
    if not file.mechanical and certificate is not None:
        raise InputError(f"certificate is for mechanical models; {label} is a state-space model")
    if not kind_of(file).makes_up_for_delays and float(np.max(file.delay)) > 0:
        raise InputError(f"{label}: code for a state-space model takes no measurement.delay; leave it out")


def _as_sent_and_read(
    runs: AbstractObserver, designed: Design, y: np.ndarray, rate: float, lag: float | None
) -> tuple[AbstractObserver, str]:
    """The observer with readings that are late or periodic, a lag, and inputs as they are sent; sentences on these."""
    file, log, knows_model, about = designed.file, designed.log, _ENTRIES[designed.name].knows_model, ""
    # Only an observer with a model can predict from the time of a late reading to the present.
    delay = reading_delays(runs, file.delay, designed.sensors, y)
    late = knows_model and np.any(delay)
    # With a log the memory is as long as `estimate` has it there.
    stored = rate if log is None or not late else densest_rate(np.asarray(log.record.t), float(np.max(delay)))
    unwrapped = Unwrapped(runs, np.broadcast_to(file.period, file.dimension).tolist()) if np.any(file.period) else runs
    whole = Delayed(unwrapped, delay, stored) if late else unwrapped
    if lag is not None:
        whole, about = _late(whole, designed.name, lag, rate), f" Estimates are {lag:g} s late."
    sent = with_acting_inputs(whole, file, rate, log) if knows_model else whole
    return sent, about if sent is whole else f"{about} {describe_inputs(file)}"


class _Code(NamedTuple):
    """The graphs of an observer, the prefix of its names in C, a text on it, its self-test, and facts for its sheet."""

    program: codegen.Program
    prefix: str
    about: str
    measured: np.ndarray
    facts: codegen.Facts


def _write_unit(code: _Code, out: Path, fmi: str | None, overwrite: bool) -> tuple[list[Path], list[str]]:
    """Write a unit for simulators; returns its path, and a sentence if it holds no binary."""
    version: Any = fmi or VERSIONS[0]
    none = np.full(np.shape(code.measured[0]), np.nan)  # until the simulator sets a reading there is none
    unit = codegen.fmu(code.program, code.prefix, code.about, code.facts.rate, none, version)
    codegen.write_fmu(unit, out, overwrite)
    missing = unit.without_binary
    return [out], [f"the unit holds sources and no binary: {missing}"] if missing else []


def _write_folder(code: _Code, out: Path, packages: Sequence[str], overwrite: bool) -> tuple[list[Path], list[str]]:
    """Write C and the packages around it; returns all paths, and a sentence if the Python package has no library."""
    program, prefix, about, measured, facts = code
    python, wasm, ros2 = (name in packages for name in ("python", "wasm", "ros2"))
    run, lacks = codegen.vectors(program, measured, facts.rate), []
    texts = codegen.export_texts(program, prefix, about, measured, facts, run, python, wasm, ros2)
    more = codegen.python_files(program, texts, prefix, about, facts.rate) if python else {}
    if python and not any(path.endswith(".whl") for path in more):
        lacks.append(f"the Python package holds sources and no library: {NO_COMPILER}")
    more |= codegen.ros_files(program, texts, prefix, about, facts.rate) if ros2 else {}
    more |= codegen.wasm_files(program, texts, prefix, about, facts.rate, run) if wasm else {}
    return codegen.write_folder({**texts, **more}, out, overwrite), lacks


def _late(observer: AbstractObserver, name: str, lag: float, rate: float) -> FixedLag:
    """The observer with estimates that are some samples late."""
    samples = above_zero("lag", lag) * rate
    if round(samples) < 1:
        raise InputError(f"lag {lag:g} is less than half a sample of {1 / rate:g} s; leave it out")
    if isinstance(observer, Delayed):
        raise InputError("lag is for positions that are read in time, not for late ones (measurement.delay)")
    if name not in SMOOTHED:
        raise InputError(f"lag is for filters with a covariance: {', '.join(SMOOTHED)}; {name} is none")
    return FixedLag(observer, round(samples))


class _Proof(NamedTuple):
    """A verified certificate of the observer, and its statement as lines."""

    certificate: certificates.ContractionCertificate
    statement: str

    @property
    def substeps(self) -> int | None:
        """Number of Runge–Kutta steps in each prediction that is proved; None if the observer chooses it."""
        return None if self.certificate.sampling is None else self.certificate.sampling.substeps

    def proved(self, observer: Any) -> AbstractObserver:
        """The observer as its proof has it: the substeps of a prediction, and constant gains from the start on."""
        if isinstance(observer, Gated):
            return dataclasses.replace(observer, observer=self.proved(observer.observer), fast_start=False)
        return observer if self.substeps is None else dataclasses.replace(observer, substeps=self.substeps)

    def is_bound(self, real: str) -> bool:
        """Whether errors are proved: those of predictions only for doubles and a fixed number of substeps."""
        return self.substeps is not None and real == "double"

    def bound(
        self, runs: AbstractObserver, whole: AbstractObserver, real: str
    ) -> tuple[AbstractObserver, str, str, str]:
        """The observer with a proved bound, a sentence on its start, the whole statement, and why there is no bound."""
        if self.certificate.sampling is None:
            return whole, "", self.statement, ""
        if self.is_bound(real) and whole is runs:
            bounded = self.certificate.bounded(runs, radius=self.certificate.radius)
            values = (f"- {int(each)}: {each.message}" for each in certificates.Premise)
            statement = "\n".join([self.statement, "", "Values of `premise`:", "", *values])
            return bounded, f" {_describe_start(self.certificate)}", statement, ""
        reason = "is about measurements without delays and periods, and inputs that act as they are sent"
        if self.substeps is None:
            reason = "is about an observer that chooses its substeps, of which the errors of predictions are not proved"
        elif real != "double":
            reason = "is about doubles"
        unbounded = f"no bound of the error is a part of the step, since the certificate {reason}"
        return whole, "", f"{self.statement}\n\nIn this code {unbounded}.", unbounded


def _describe_start(certificate: certificates.ContractionCertificate) -> str:
    """Describe which initial errors the bound in generated code assumes."""
    where = certificate.start or f"within {certificate.radius:.4g} in the metric of the certificate"
    reasons = ", ".join(f"{int(each)} {each.name.lower()}" for each in certificates.Premise if each > 0)
    return (
        "position_bound and velocity_bound are proved bounds of the errors of the estimate while premise is 0, else "
        "infinite, and not a number before the first step; they assume that the errors of the first estimate are "
        f"within these, all at once: {where}. Other values of premise say what is not known to hold: {reasons}."
    )


def _verify_certificate(path: Path, model: Any, overrides: Overrides, designed: Design, rate: float) -> _Proof:
    """Check a saved certificate of this observer; raises `ValueError`."""
    document, name = certificates.parse(path), models.spec_name(model)
    if not isinstance(model, str | os.PathLike) or document.recipe != (recipe := models.recipe(name, overrides)):
        raise InputError(f"{path}: the certificate is for another model, or other numbers, than {name}")
    if (kind := document.observer["kind"]) != designed.name:
        raise InputError(f"{path}: the certificate is for the observer {kind}, not for {designed.name}")
    certificates.check_observer(document._replace(recipe=recipe), designed.inner)
    sampling = document.sampling
    time = "in continuous time" if sampling is None else "with sampled measurements"
    if sampling is not None:
        shortest, longest = sampling.interval.tolist()
        if not shortest <= 1 / rate <= longest:
            raise InputError(
                f"{path}: the certificate is for samples {shortest:g} to {longest:g} s apart, and at {rate:g} Hz they "
                f"are {1 / rate:g} s apart"
            )
    # Code that is trusted: the exported model was just built with it.
    attribute = (document.recipe or {}).get("attribute")
    checked = certificates.check(document, model=attribute)
    lines = [
        f"All {checked.leaves} leaves of `{path.name}` were verified when this was written. It is about the observer "
        f"{time}, with the default numbers:",
        "",
        *(f"    {line}" for line in str(checked.statement).splitlines()),
    ]
    if designed.inner is not designed.observer:
        lines += ["", beyond_proof(0 if sampling is None else sampling.lost)]
    certificate = certificates.ContractionCertificate.load(path, model=attribute)
    return _Proof(certificate._replace(verified=True), "\n".join(lines))


def beyond_proof(lost: int) -> str:
    """What a certificate says of samples that a gate refuses, up to `lost` of which it covers in a row."""
    covered = f"which it covers up to {lost} in a row" if lost else "which it does not cover"
    return (
        "The gate is no part of what is proved. Where a step returns OK it changed nothing, and the statement holds. A "
        f"measurement that is refused as a whole (OUTLIER) is a lost one, {covered}; of one that is refused in part, "
        "and after RESTARTED or ASTRAY, nothing is proved until a new start within its radius."
    )


def _plain(designed: Design, gains: dict[str, Any] | None) -> str:
    """How an observer was designed, in characters that stand in a comment of C."""
    constant = "gains", "gains and force", "gains and speed", "state noise"
    if gains is None and _ENTRIES[designed.name].tuned_by not in constant:
        return "Tuned from its data sheet."  # the note is on gains that it does not have
    return designed.notes.replace("²", "^2").replace("±", "+-")
