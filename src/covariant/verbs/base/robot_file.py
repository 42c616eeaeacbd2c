"""`export` of a robot itself, with its fitted numbers, as a file for simulators."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from covariant import models
from covariant.models import Overrides
from covariant.verbs.base.outputs import check_output
from covariant.verbs.base.result import AbstractResult
from scalargraph.errors import InputError
from scalargraph.files import utf8, write_together

FORMATS = {".urdf": "URDF", ".xml": "MJCF", ".bam.json": "BAM 1.0", ".json": "table of actuators"}
"""Formats of robot files by the end of their names."""
HEAD_NOTES = {
    ".urdf": "Positions of joints are those of the log.",
    ".xml": "Positions of joints are those of the log. There are no shapes, so nothing touches anything.",
    ".bam.json": "kt²/R is the sum of damping and back_emf; vin, kp, error_gain and max_pwm belong to kt and R.",
    ".json": "Positions of joints are those of the log. command_offsets are added to commands.",
}
"""Notes for the head of a file, by the end of its name."""


def write_robot(
    model: Any, out: Path, rate: float, overwrite: bool, overrides: Overrides, options: Mapping[str, Any]
) -> "RobotFileResult":
    """Write a robot in the format that the name of `out` ends in; `options` of an observer must not be set."""
    for name, value in options.items():
        if value is not None and value is not False:
            raise InputError(f"{name} is for an observer, and {out} is the file of a robot; leave it out")
    check_output(out, *FORMATS, overwrite=overwrite)
    label = models.spec_name(model)
    if model is not label and not isinstance(model, str | Path):
        raise InputError(f"{label}: a robot is written from its model file, its own file or its name")
    recipe = models.recipe(label, overrides)
    suffix = next(each for each in FORMATS if out.name.endswith(each))
    if recipe.get("system") != "robot":
        raise InputError(f"{label}: only a robot is written as {FORMATS[suffix]} ({suffix})")
    parameters, step = dict(recipe["parameters"]), 1 / rate
    about = [f"Written by covariant export from {Path(label).name}, for steps of {step:.6g} s."]
    about.append(HEAD_NOTES[suffix])
    text, left_out = models.robots.robot_text(out.name, parameters.pop("path"), step, about, **parameters)
    write_together({out: utf8(text)})
    return RobotFileResult(label, out, FORMATS[suffix], left_out)


@dataclass(frozen=True, repr=False)
class RobotFileResult(AbstractResult):
    """The file of a robot.

    Attributes:
        model_name: Path or name of the model.
        out: Path of the file.
        kind: Format of the file: URDF, MJCF, BAM 1.0, or a table of actuators.
        left_out: Numbers for which the format has no entry, one line for each joint.

    Example:
        >>> import covariant, tempfile
        >>> out = tempfile.mkdtemp() + "/arm.urdf"
        >>> friction = {"parameters.friction": {"elbow": {"viscous": 0.1}}}
        >>> covariant.export("double_pendulum", out, rate=500.0, overrides=friction).headline.partition(" in ")[0]
        'double_pendulum as URDF'
    """

    model_name: str
    out: Path
    kind: str
    left_out: tuple[str, ...] = ()

    @property
    def warnings(self) -> tuple[str, ...]:
        return tuple(f"{self.kind} has no entry for {line}" for line in self.left_out)

    @property
    def headline(self) -> str:
        return f"{self.model_name} as {self.kind} in {self.out}"

    @property
    def summary(self) -> dict[str, Any]:
        result = {"model": self.model_name, "out": str(self.out), "kind": self.kind}
        return result | ({"warning": "; ".join(self.warnings)} if self.warnings else {})

    def __str__(self) -> str:
        return f"{self.model_name} as {self.kind}\nwrote {self.out}"
