"""`fit`: the numbers of a model file that predict logs best, with standard errors, judged on what is held out."""

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from covariant.verbs.base.among_logs import machine_of
from covariant.verbs.base.arguments import ColumnNames, Overrides, OverridesOfLogs
from covariant.verbs.base.model_output import as_logs, check_model_output, read_sources, urdf_beside, write_models
from covariant.verbs.base.model_text import WRITTEN_BY
from covariant.verbs.base.placeholders import drafted_names, placeholder_sentence
from covariant.verbs.base.progress import Progress, notebook_line
from covariant.verbs.base.result import AbstractTable
from scalargraph.errors import InputError


def fit(
    model: Any,
    log: Any,
    parameters: str | Sequence[str] | None = None,
    *,
    each: str | Sequence[str] | None = None,
    overrides: OverridesOfLogs = (),
    every: int = 1,
    start: float | None = None,
    until: float | None = None,
    columns: ColumnNames | None = None,
    anyway: bool = False,
    progress: Progress = notebook_line,
) -> "FitResult":
    """Fit parameters of a model to logs, with standard errors, and name what the logs do not determine.

    Where the model file does not say how inputs go from one stamp to the next, `inputs.between`, held and linear inputs
    are both tried, and those are used that explain the logs better.

    Args:
        model: A model file (.toml), `module:attribute`, or the name of a system or a robot of the library: a model that
            can be built anew with other numbers, mechanical or a `StateSpace`.
        log: A path, a `Record`, a DataFrame or an xarray Dataset, or a list of them, or a dictionary with the logs of
            each machine by its name. The last of several is held out to judge the fit by, or the last third of one. Of
            a folder, or a file with several episodes, those logs are fitted that tell most, and others judge; zeros,
            stiffness and friction of servos that change from log to log are named.
        parameters: Names of the numbers to fit: "mass" or "com[0]" of [parameters], or "inputs.lag"; of a robot
            "friction", "armature", "payload", "inertia", "gravity", "torque_constants", "offsets" or "servo", for all
            joints and links or for one, as in "friction.elbow" or "servo.elbow.delay". Several in a list, or by commas;
            see `models.robot_family`. By default, those that `covariant init` marked in the model file as placeholders;
            without any, those of all servos, friction and rotors of another robot, and of another machine all numbers
            of [parameters] that are not zero.
        each: Those of the parameters of which each machine has its own value, such as friction; the others are shared.
            Logs of one machine lie in a folder of their own. The last log of each machine with several is held out, and
            if none has several, the last third of each. Not for robots with servos.
        overrides: Values that replace those of the model file, such as other first values; or a list of such values,
            one for each log, of what is known to differ between them, such as the unit of a column, a delay, or a gain
            or a payload of a robot with servos.
        columns: Names of columns by field (t, q, u) that replace those of the model file.
        every, start, until, anyway, progress: As for `estimate`.

    Returns:
        The numbers before and after with their standard errors, and the errors on what is held out.

    Raises:
        MisfitError: Where the model explains nothing of the motion in a log.
        ValueError: For arguments, a model or a log that cannot be used.

    Example:
        >>> import covariant
        >>> heavy = {"parameters.stiffness": 1.3}
        >>> log = covariant.simulate("oscillator", duration=60.0, rate=20.0, q0=1.0, noise=1e-3, overrides=heavy)
        >>> result = covariant.fit("oscillator", log.record, "stiffness", overrides={"parameters.stiffness": 1.0})
        >>> bool(abs(result.values[0] - 1.3) < 0.01)
        True
    """
    if not isinstance(model, str | PathLike):
        raise InputError(
            f"model: a fit makes the model anew with other numbers, so it takes a model file, a name or "
            f"module:attribute, and no finished {type(model).__name__}"
        )
    by_machine = log if type(log) is dict else {}  # a Dataset is a mapping of another type
    logs = as_logs([one for own in by_machine.values() for one in as_logs(own)] if by_machine else log)
    given = len(log) if type(log) in (list, tuple, dict) else 1
    sources = read_sources(model)
    # What computes is loaded after the arguments are checked.
    from covariant.verbs.base.fit_logs import OwnNumbers
    from covariant.verbs.base.fit_to_logs import fit_to_logs
    from covariant.verbs.base.folder_logs import fit_folder
    from covariant.verbs.base.inputs import Job
    from covariant.verbs.base.open_numbers import open_numbers

    given_overrides: Any = () if _are_of_logs(overrides) else overrides
    # Whoever makes the family says which names there are.
    names = _names(parameters or ()) or drafted_names(model) or open_numbers(os.fspath(model), given_overrides)
    own = None
    if own_names := _names(each or ()):
        machines = [str(machine) for machine, its_logs in by_machine.items() for _ in as_logs(its_logs)]
        own = OwnNumbers(own_names, machines or _folders(logs))
    of_log = _of_each_log(overrides, len(logs))
    jobs = [
        Job(model, one, values, every, until, columns or {}, anyway, start)
        for one, values in zip(logs, of_log, strict=True)
    ]
    if len(logs) > given and own is None:
        jobs, contents, details = fit_folder(jobs, names, progress, sources)
    else:
        jobs, contents, details = fit_to_logs(jobs, names, progress, sources, own)
    if own is None:
        return FitResult(jobs, contents[""], details, sources)
    return FitResult(jobs, {}, details, sources, contents)


def _names(text: str | Sequence[str]) -> list[str]:
    """Names in a list, or separated by commas."""
    return [name for name in (text.split(",") if isinstance(text, str) else text) if name.strip()]


def _folders(logs: Sequence[Any]) -> list[str]:
    """The machine of each log: the name of its folder, or the path if several have that name."""
    if not all(isinstance(log, str | PathLike) for log in logs):
        raise InputError("each: a log in memory does not say of which machine it is; give {machine: logs} as the logs")
    folders = [machine_of(os.fspath(log)) for log in logs]
    names = {folder: Path(folder).resolve().name for folder in folders}
    unique = {folder for folder, name in names.items() if list(names.values()).count(name) == 1}
    return [names[folder] if folder in unique else folder.replace(os.sep, "_") for folder in folders]


def _files(path: Path, machines: Iterable[str]) -> list[Path]:
    """The model file of each machine with numbers of its own, where `path` is asked for."""
    return [path.with_stem(f"{path.stem}_{machine}".replace(os.sep, "_")) for machine in dict.fromkeys(machines)]


def check_machine_files(
    model: Any, path: Path, logs: Sequence[Any], overwrite: bool = False, urdf: bool = False
) -> None:
    """Check that the model file of each machine may be written, before anything is computed."""
    for each in _files(path, _folders(logs)):
        check_model_output(model, each, overwrite, urdf)


def _are_of_logs(overrides: Any) -> bool:
    """Whether each log has overrides of its own."""
    return not isinstance(overrides, Mapping) and any(isinstance(each, Mapping) for each in overrides)


def _of_each_log(overrides: Any, count: int) -> list[Overrides]:
    """The overrides of each log, which may be a list of their own."""
    if not _are_of_logs(overrides):
        return [overrides] * count
    if len(overrides) != count:
        raise InputError(f"overrides: there are {count} logs and values for {len(overrides)}; give a mapping for each")
    return list(overrides)


@dataclass(frozen=True, repr=False)
class FitResult(AbstractTable):
    """Parameters of a model fitted to logs: a table of their names, values before and after, and standard errors.

    Attributes:
        jobs: The model and the logs, a `Job` each.
        content: The content of the model file with the fitted numbers; empty if machines have numbers of their own.
        details: All numbers and sentences as plain data, which `summary` returns.
        sources: Files that the model was read from, as they were then; None where they are read at `save`.
        machines: The content of the model file of each machine, if they have numbers of their own.

    Example:
        >>> from covariant.verbs._fit import FitResult
        >>> row = {"name": "stiffness", "before": 1.0, "after": 1.3, "standard_error": 0.01, "determined": True}
        >>> result = FitResult([], {}, {"parameters": [row], "undetermined": [], "better": True})
        >>> result
        <FitResult: stiffness = 1.3 ± 0.01>
        >>> result.values.tolist(), result.standard_errors.tolist(), result.exit_code
        ([1.3], [0.01], 0)
    """

    jobs: list[Any]
    content: dict[str, Any]
    details: dict[str, Any]
    sources: Mapping[Path, bytes] | None = None
    machines: Mapping[str, dict[str, Any]] = field(default_factory=dict)

    @property
    def values(self) -> np.ndarray:
        """Fitted parameters (p,), in the units of the model file."""
        return self.columns["after"]

    @property
    def standard_errors(self) -> np.ndarray:
        """Standard errors (p,) of `values`, in their units; NaN where the logs do not show a parameter alone."""
        return self.columns["standard_error"]

    @property
    def better(self) -> bool:
        """Whether the fitted model predicts the held-out log at least as well as before, up to 1 % of the error, and no
        reversed input or delay explains the log much better."""
        return self.details["better"]

    @property
    def exit_code(self) -> int:
        """Exit code of the command: 1 where the fitted model is not `better`."""
        return 0 if self.better else 1

    @property
    def columns(self) -> dict[str, np.ndarray]:
        rows = self.details["parameters"]
        numbers = {key: np.array([row[key] for row in rows], float) for key in ("before", "after", "standard_error")}
        names = np.array([row["name"] for row in rows], dtype=object)
        return {"parameter": names, **numbers, "determined": np.array([row["determined"] for row in rows])}

    @property
    def row(self) -> dict[str, Any]:
        """Fitted parameters by name: the row of this log in a table of many."""
        row: dict[str, Any] = {}
        for name, value, std in zip(self.columns["parameter"], self.values, self.standard_errors, strict=True):
            row |= {name: float(value), f"{name}_std": float(std)}
        dated = {key: self.details[key] for key in ("t_counts_from",) if key in self.details}
        return row | {"better": "yes" if self.better else "no"} | dated

    @property
    def summary(self) -> dict[str, Any]:
        return self.details

    @property
    def headline(self) -> str:
        return ", ".join(
            f"{row['name']} = {row['after']:.5g}"
            + (" (not determined)" if row["standard_error"] is None else f" ± {row['standard_error']:.2g}")
            for row in self.details["parameters"]
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences on what the logs do not determine, on shared numbers that a machine contradicts, on numbers that
        are still placeholders of a drafted file, and one more where the fit is worse on the held-out log."""
        return (*self._on_numbers, *(() if self.better else (self._worse,)))

    @property
    def _on_numbers(self) -> tuple[str, ...]:
        rest = placeholder_sentence(self.details.get("placeholders", {}))
        said = (f"Not determined: {sentence}." for sentence in self.details["undetermined"])
        changed = (*self.details.get("changes", ()), *self.details.get("unlike", ()))
        return (*said, *(f"{sentence[0].upper()}{sentence[1:]}." for sentence in changed), *([rest] * bool(rest)))

    @property
    def _worse(self) -> str:
        """A sentence on a fit that is not written: a doubt about the log, or both errors; and what to do."""
        result = self.details
        if result.get("suspicion"):
            return f"{result['suspicion']}. The fitted numbers make up for it, so they are not written."
        before, after = (result["held_out_errors"][when]["position"] for when in ("before", "after"))
        columns = zip(result["coordinates"], result["units"], before, after, strict=True)
        errors = ", ".join(f"{name} {_size(new)} {unit} after {_size(old)} before" for name, unit, old, new in columns)
        return (
            f"The fitted model predicts {result['held_out']}, which it has not seen, worse than before (errors over "
            f"{result['horizon']:.3g} s: {errors}), so it is not written: look for columns, units or signs that are "
            "wrong, as `covariant check` does, or give longer logs, other first values, or fewer parameters."
        )

    def save(self, path: str | Path, overwrite: bool = False) -> Path:
        """Write the model file with the fitted numbers (.toml); comments and layout stay.

        Fitted inertias of a robot from a URDF file go to a new URDF file beside it, of the same name. If machines have
        numbers of their own, each has its file: `fitted_arm1.toml` and so on for `fitted.toml`.

        Args:
            path: The file to write.
            overwrite: Whether a file that exists may be replaced, the model file itself included.

        Returns:
            The path, or that of the first machine.

        Raises:
            ValueError: Where it may not be written, the file to replace was changed since it was read, or the fitted
                model is not `better`.
        """
        if not self.better:
            raise InputError(f"{path}: {self._worse}")
        contents = self._contents(path)
        files = {each: (self._head(machine), content) for each, (machine, content) in contents.items()}
        write_models(self.jobs[0].model, files, overwrite, self.sources)
        return next(iter(files))

    def written_files(self, path: str | Path) -> list[Path]:
        pairs = ((each, urdf_beside(content, each)) for each, (_, content) in self._contents(path).items())
        return [file for pair in pairs for file in pair if file is not None]

    def _contents(self, path: str | Path) -> dict[Path, tuple[str, dict[str, Any]]]:
        """The machine and the content of each model file."""
        paths = _files(Path(path), self.machines) or [Path(path)]
        return dict(zip(paths, (self.machines or {"": self.content}).items(), strict=True))

    def _head(self, machine: str) -> str:
        """Comment lines that say what has been fitted, how well it is known, and what is still a first value."""
        lines = [f"{WRITTEN_BY['fit']}{self.details['fitted_to']}; ± is one standard error:"]
        rows = [row for row in self.details["parameters"] if row["name"].partition("@")[2] in ("", machine)]
        for row in rows:
            error = row["standard_error"]
            lines.append(f"#   {row['name']} = {row['after']:.5g}" + (f" ± {error:.2g}" if error is not None else ""))
        rest = placeholder_sentence(self.details.get("placeholders", {}))
        said = [*self.details["undetermined"], *self.details.get("unlike", ())]
        of_others = [row["name"] for row in self.details["parameters"] if row not in rows]
        said = [sentence for sentence in said if not any(name in sentence for name in of_others)]
        remarks = [*(f"#   {sentence}." for sentence in said), *([f"# {rest}"] * bool(rest))]
        return "\n".join([*lines, *remarks, "", ""])

    @property
    def _numbers(self) -> list[dict[str, Any]]:
        """Rows of the fitted numbers."""
        return [
            {
                "parameter": row["name"],
                "before": f"{row['before']:.5g}",
                "after": f"{row['after']:.5g}",
                "± standard error": "—" if row["standard_error"] is None else f"{row['standard_error']:.2g}",
                "determined": row["determined"],
            }
            for row in self.details["parameters"]
        ]

    @property
    def _errors(self) -> list[dict[str, Any]]:
        """Rows of the errors on what is held out."""
        result = self.details
        return [
            {
                "coordinate": f"{name} [{unit}]" if unit else name,
                **{
                    f"{kind.replace('_', ' ')}, {when}": result["held_out_errors"][when][kind][i]
                    for kind in ("position", "velocity")
                    # Outputs of a state-space model have no velocities.
                    if any(result["held_out_errors"]["before"][kind])
                    for when in ("before", "after")
                },
                **({"stops within ± (stick band)": result["stick_band"][i]} if "stick_band" in result else {}),
            }
            for i, (name, unit) in enumerate(zip(result["coordinates"], result["units"], strict=True))
        ]

    @property
    def _judged(self) -> str:
        """What the errors are of."""
        result = self.details
        velocities = f", velocities against the {result['scored_against']} [unit/s]" * bool(result["scored_against"])
        return f"{_reach(result)} {result['held_out']}{velocities}"

    @property
    def _blocks(self) -> list[Any]:
        result = self.details
        inputs = result["inputs"]["sentence"]
        return [
            *([result["chosen"]] if result.get("chosen") else []),
            "# Parameters",
            self._numbers,
            "# Errors on held-out rows",
            f"Root mean square errors of predictions {self._judged}.",
            self._errors,
            *([inputs] if inputs else []),
            *(["# Each log by itself", self._each] if result.get("each") else []),
        ]

    @property
    def _each(self) -> list[dict[str, Any]]:
        """Rows of the numbers that each log of a folder shows by itself, with their standard errors."""
        rows = self.details["each"]
        names = dict.fromkeys(name for row in rows for name in row if f"{name}_std" in row)
        notes = {"odd": "odd", "failed": "not read"}
        return [
            {"log": Path(row["log"]).name}
            | {name: f"{row[name]:.4g} ± {row[f'{name}_std']:.2g}" if name in row else None for name in names}
            | {title: row.get(key) or None for key, title in notes.items() if any(each.get(key) for each in rows)}
            for row in rows
        ]

    def _figure(self) -> Any:
        """The numbers before in units of the fitted ones, and the errors on what is held out over those before."""
        from covariant.report import new_figure

        columns, result = self.columns, self.details
        before, after, error = (columns[name] for name in ("before", "after", "standard_error"))
        unit = np.where(after == 0, np.nan, np.abs(after))
        errors = {
            f"{kind} {name}": result["held_out_errors"]["after"][kind][i] / result["held_out_errors"]["before"][kind][i]
            for kind in ("position", "velocity")
            for i, name in enumerate(result["coordinates"])
            if result["held_out_errors"]["after"][kind][i] is not None and result["held_out_errors"]["before"][kind][i]
        }
        titles = ("Numbers over the fitted ones, ±2 standard errors", "RMS errors on held-out rows over those before")
        height = 0.8 + 0.3 * max(len(after), len(errors))
        figure, axes = new_figure(1, 2, panel=(4.8, height), titles=titles, sharex=False)
        left, right = axes[0]
        rows = np.arange(len(after))
        left.plot(before / unit, rows, "o", fillstyle="none", label="before")
        left.errorbar(after / unit, rows, xerr=2 * error / unit, fmt="o", capsize=3, label="fitted")
        left.set_yticks(rows, [str(name) for name in columns["parameter"]])
        left.invert_yaxis()
        left.legend()
        right.barh(list(errors), list(errors.values()))
        right.axvline(1.0, color="black", linewidth=0.8)
        right.invert_yaxis()
        return figure

    def _write_page(self, path: Path) -> list[Path]:
        from covariant.verbs.base.pages import write_result_page

        result = self.details
        model, logs = self.jobs[0].model_name, ", ".join(result["logs"])
        count = len(result["logs"])
        title = f"{Path(model).stem} fitted to {Path(logs).name if count == 1 else f'{count} logs'}"
        facts = {"model": model, "logs": logs, "fitted to": result["fitted_to"], "held out": result["held_out"]}
        return write_result_page(path, title, self, self._blocks, facts)

    def __str__(self) -> str:
        from covariant.report import table
        from covariant.verbs.base.fit_logs import NAMED

        result = self.details
        numbers, errors = self._numbers, self._errors
        if result.get("open_loop"):
            how = f"Predictions from the commands, over windows of {result['window']:.3g} s"
        elif "window" not in result:
            how = "All rows"
        else:
            how = f"Residual torques in windows of {result['window']:.3g} s"
        logs = result["logs"]
        lines = [
            f"{how} of {', '.join(logs) if len(logs) <= NAMED else f'{len(logs)} logs'}",
            *([result["chosen"]] if result.get("chosen") else []),
            *([result["inputs"]["sentence"]] if result["inputs"]["sentence"] else []),
            "",
            table(numbers),
            *self._on_numbers,
            f"Errors (RMS) of predictions {self._judged}:",
            "",
            table(errors),
            *(() if self.better else (self._worse,)),
        ]
        return "\n".join(lines)


def _reach(result: dict[str, Any]) -> str:
    if result.get("open_loop"):
        return "open loop, from the first row and the commands alone, of"
    return f"over {result['horizon']:.3g} s of"


def _size(error: float | None) -> str:
    return "infinite" if error is None else f"{error:.3g}"
