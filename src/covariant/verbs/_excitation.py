"""`design_excitation`: a motion of a robot, within its limits, whose log determines the numbers that are asked for."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from covariant import logs
from covariant.verbs.base.arguments import Amounts, Overrides, Region, above_zero
from covariant.verbs.base.outputs import TABLES, check_output
from covariant.verbs.base.progress import Progress, notebook_line
from covariant.verbs.base.result import AbstractTable
from scalargraph.errors import InputError

FEWEST_ROWS = 10
"""Least number of rows in a period of the highest harmonic."""
COLLISIONS = "Collisions are not looked at: see the motion in a simulation before the machine makes it."


def design_excitation(
    model: Any,
    parameters: str | Sequence[str],
    *,
    duration: float = 20.0,
    rate: float = 500.0,
    frequency: float = 0.2,
    harmonics: int = 5,
    region: Region | None = None,
    velocity: Amounts | None = None,
    effort: Amounts | None = None,
    margin: float = 0.9,
    torque_noise: Amounts | None = None,
    starts: int = 3,
    seed: int = 0,
    overrides: Overrides = (),
    progress: Progress = notebook_line,
) -> "ExcitationResult":
    """Design a motion of a robot, within its limits, whose log determines open numbers best.

    Each joint makes a Fourier series, which starts and ends each period at rest at the same place, so that the motion
    can be repeated. Positions, velocities and the torques of the model are within their limits. Collisions of links
    with each other, or with anything else, are not looked at. Of a robot with servos the inputs are commands that make
    them do the motion; slow reversals and steps follow it, a third of the periods.

    The standard errors are those of a fit that sees the whole log. `fit` holds out the last third of a single log: log
    the motion twice, and give it both.

    Args:
        model: A model file (.toml) of a robot, its URDF or MJCF file, or the name of a robot of the library; with
            [measurement] std or quantum.
        parameters: Names of the numbers, as for `fit`: "friction", "armature", "payload", "inertia", "gravity",
            "torque_constants", "offsets" or "servo", for all joints and links or for one. Several in a list, or by
            commas.
        duration: Length [s], a whole number of periods of `frequency`.
        rate: Rows in a second [Hz].
        frequency: Frequency [Hz] of the first harmonic.
        harmonics: Number of harmonics, 2 or more.
        region: Ends of the positions [rad or m] by joint, in place of those of the robot's file.
        velocity: Largest speeds [rad/s or m/s], one or one for each joint, in place of those of the robot's file.
        effort: Largest torques or forces [N m or N], in the same way; that of a servo is also limited by its own limit.
        margin: Fraction of all limits that is used.
        torque_noise: Standard deviation of logged torques, as felt at the joints [N m or N], one or one for each joint;
            1 % of `effort` by default. Servos log none.
        starts: Starts of the search.
        seed: Seed of the starts.
        overrides: Values that replace those of the model file, such as other first values.
        progress: Called with a description and a fraction as the work goes on.

    Returns:
        The motion as a table with the torques that it needs, and the standard errors that its log is expected to give,
        beside those of one sine a joint within the same limits.

    Raises:
        ValueError: For arguments or a model that cannot be used, a limit that is missing, or motors that cannot hold
            the robot still within the limits.

    Example:
        >>> import covariant
        >>> limits = {"region": {"shoulder": (-1.0, 1.0), "elbow": (-1.0, 1.0)}, "velocity": 6.0}
        >>> short = {"duration": 5.0, "frequency": 0.4, "harmonics": 3, "starts": 1}
        >>> noise = {"measurement.std": 1e-4}
        >>> result = covariant.design_excitation("double_pendulum", "armature", **limits, **short, overrides=noise)
        >>> list(result.columns)
        ['t', 'shoulder', 'elbow', 'v1', 'v2', 'a1', 'a2', 'u1', 'u2']
        >>> bool((result.standard_errors < 0.01).all())  # kg m²
        True
    """
    if not isinstance(model, str | PathLike):
        raise InputError(
            f"model: the robot is made anew with other numbers, so this takes a model file, a robot's file or a name, "
            f"and no finished {type(model).__name__}"
        )
    listed = parameters.split(",") if isinstance(parameters, str) else list(parameters)
    for name, value in {"duration": duration, "rate": rate, "frequency": frequency}.items():
        above_zero(name, value)
    _check_plan(duration, rate, frequency, harmonics, margin, starts)
    from covariant.calibration import ExcitationPlan  # what computes is loaded after the arguments are checked
    from covariant.verbs.base.designed_excitation import Limits, designed_excitation

    plan = ExcitationPlan(float(duration), float(frequency), harmonics, float(margin), starts, seed)
    names = [name for name in listed if name.strip()]
    limits = Limits(region or {}, velocity, effort, torque_noise)
    return ExcitationResult(*designed_excitation(str(model), names, overrides, limits, plan, float(rate), progress))


def _check_plan(duration: float, rate: float, frequency: float, harmonics: int, margin: float, starts: int) -> None:
    if harmonics < 2:
        raise InputError(f"harmonics: a motion that starts at rest needs 2 or more; got {harmonics}")
    if not 0 < margin <= 1:
        raise InputError(f"margin must be a fraction of the limits, above 0 and up to 1; got {margin:g}")
    if starts < 1:
        raise InputError(f"starts must be 1 or more; got {starts}")
    periods = duration * frequency
    if round(periods) < 1 or abs(periods - round(periods)) > 1e-9 * periods:
        nearest = [count / frequency for count in (math.floor(periods), math.ceil(periods)) if count]
        raise InputError(
            f"duration must be a whole number of periods of {1 / frequency:g} s; got {duration:g} s; give "
            f"{' or '.join(f'{each:g}' for each in nearest)}"
        )
    if rate < FEWEST_ROWS * harmonics * frequency:
        raise InputError(
            f"rate: harmonics up to {harmonics * frequency:g} Hz need {FEWEST_ROWS * harmonics * frequency:g} Hz or "
            f"more; got {rate:g}"
        )


@dataclass(frozen=True, repr=False)
class ExcitationResult(AbstractTable):
    """Motion of a robot whose log determines numbers of it: stamps, positions, velocities, accelerations, inputs.

    Attributes:
        layout: The `logs.Columns`: names of stamps, positions and inputs as the model file names them, and their units.
        si_columns: The columns in SI units and radians.
        si_units: Their units.
        details: All numbers and sentences as plain data, which `summary` returns.

    Example:
        >>> import numpy as np
        >>> from covariant import logs
        >>> from covariant.verbs._excitation import ExcitationResult
        >>> row = {"name": "armature.elbow", "unit": "kg m^2", "value": 0.0, "reference_error": 2e-3, "error": 5e-4}
        >>> details = {"model": "arm.toml", "rows": 2, "duration": 1.0, "parameters": [row], "undetermined": []}
        >>> columns = {"t": np.array([0.0, 1.0])}
        >>> result = ExcitationResult(logs.Columns(), columns, {"t": "s"}, details)
        >>> result
        <ExcitationResult: 2 rows over 1 s of arm, armature.elbow ± 0.0005>
        >>> result.standard_errors.tolist(), result.reference_errors.tolist()
        ([0.0005], [0.002])
    """

    layout: Any
    si_columns: dict[str, np.ndarray]
    si_units: dict[str, str]
    details: dict[str, Any]

    @property
    def standard_errors(self) -> np.ndarray:
        """Expected standard errors (p,) of the numbers; NaN where the log does not determine one by itself."""
        return np.array([row["error"] for row in self.details["parameters"]], float)

    @property
    def reference_errors(self) -> np.ndarray:
        """The same (p,) of one sine a joint within the same limits."""
        return np.array([row["reference_error"] for row in self.details["parameters"]], float)

    @property
    def columns(self) -> dict[str, np.ndarray]:
        # A factor converts the log's unit to the SI unit, so SI values are divided by it.
        factors = {name: logs.unit_factor(unit) for name, unit in self._stated.items()}
        return {name: column / factors.get(name, 1.0) for name, column in self.si_columns.items()}

    @property
    def units(self) -> dict[str, str]:
        return self.si_units | self._stated

    @property
    def _stated(self) -> dict[str, str]:
        """Units of the columns that the model file states."""
        fields = {"t": (self.layout.t,), "q": self.layout.q, "u": self.layout.u}
        stated = {
            name: self.layout.unit_of(field, i) for field, names in fields.items() for i, name in enumerate(names)
        }
        return {name: unit for name, unit in stated.items() if unit is not None}

    @property
    def headline(self) -> str:
        errors = [
            f"{row['name']} " + ("not determined" if row["error"] is None else f"± {row['error']:.2g}")
            for row in self.details["parameters"]
        ]
        rows = f"{self.details['rows']} rows over {self.details['duration']:g} s of {Path(self.details['model']).stem}"
        return ", ".join([rows, *errors])

    @property
    def summary(self) -> dict[str, Any]:
        return self.details

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences on what a log of the motion does not determine."""
        return tuple(f"Not determined: {sentence}." for sentence in self.details["undetermined"])

    def __str__(self) -> str:
        from covariant.report import table

        facts = self.details
        errors = [
            {
                "parameter": f"{row['name']} [{row['unit']}]",
                "value": f"{row['value']:.5g}",
                "± one sine a joint": "—" if row["reference_error"] is None else f"{row['reference_error']:.2g}",
                "± this motion": "—" if row["error"] is None else f"{row['error']:.2g}",
            }
            for row in facts["parameters"]
        ]
        used = [
            {
                "joint": row["name"],
                **{
                    f"largest {kind}": f"{row[kind]['largest']:.3g} of {row[kind]['limit']:.4g} {row[kind]['unit']}"
                    for kind in ("position", "velocity", "torque")
                },
            }
            for row in facts["joints"]
        ]
        noise = "; ".join(
            f"{row['name']} ± {row['noise']:.3g} {row['unit']}"
            + (f", ± {row['torque']['noise']:.3g} {row['torque']['unit']}" if "noise" in row["torque"] else "")
            for row in facts["joints"]
        )
        condition = {key: "—" if each is None else f"{each:.3g}" for key, each in facts["condition"].items()}
        return "\n".join(
            [
                f"{facts['rows']} rows over {facts['duration']:g} s: {facts['periods']} period"
                f"{'s' * (facts['periods'] > 1)} of {1 / facts['frequency']:.4g} s, {facts['harmonics']} harmonics",
                *self._parts,
                f"Standard errors to expect of a fit that sees all of its log, with the noise of rows {noise}:",
                "",
                table(errors),
                *self.warnings,
                f"Condition number of the regressor: {condition['reference']} of one sine a joint, "
                f"{condition['designed']} of this motion",
                "",
                table(used),
                COLLISIONS,
            ]
        )

    @property
    def _parts(self) -> list[str]:
        """A sentence on what is commanded of servos, and when."""
        if "moving" not in self.details:
            return []
        moving, rest = self.details["moving"], self.details["duration"] - self.details["moving"]
        return [f"{moving:g} s of it are a motion" + (f", {rest:g} s slow reversals and steps" if rest else "")]

    def save(self, path: str | Path, overwrite: bool = False) -> Path:
        """Write the motion: stamps, positions and inputs in the units of the model file, the rest in SI units.

        Args:
            path: The table to write (.csv, .txt, .tsv, .parquet).
            overwrite: Whether a file that exists may be replaced.

        Returns:
            The path.

        Raises:
            ValueError: For another suffix, a folder that does not exist, or a file that exists.
        """
        path = Path(path)
        check_output(path, *TABLES, overwrite=overwrite)
        logs.write(path, self.columns)
        return path

    def _figure(self) -> Any:
        """Positions, velocities and torques of one period, with their limits."""
        from covariant.report import new_figure

        joints, n = self.details["joints"], len(self.details["joints"])
        t, *rest = self.si_columns.values()
        shown = t <= t[0] + 1 / self.details["frequency"]
        kinds = dict(zip(("position", "velocity", "torque"), (rest[:n], rest[n : 2 * n], self._torques), strict=True))
        figure, axes = new_figure(n, 3, titles=tuple(kinds))
        for row, joint in enumerate(joints):
            for ax, (kind, columns) in zip(axes[row], kinds.items(), strict=True):
                ax.plot(t[shown], columns[row][shown])
                for end in joint[kind]["ends"]:
                    ax.axhline(end, color="0.5", linewidth=0.8, linestyle="--")
                ax.set_ylabel(f"{joint['name']} [{joint[kind]['unit']}]")
        for ax in axes[-1]:
            ax.set_xlabel("t [s]")
        return figure

    @property
    def _torques(self) -> list[np.ndarray]:
        """Torques (T,) of the joints: those of servos, or the inputs through the motors."""
        if "torques" in self.details:
            return [self.si_columns[name] for name in self.details["torques"]]
        u = np.stack([self.si_columns[name] for name in self.layout.u])
        return list(np.array(self.details["motors"]) @ u)
