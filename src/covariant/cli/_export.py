"""`covariant export`: an observer as C, or as a functional mock-up unit."""

import json
import re
import sys
from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from covariant import certificates, models
from covariant.audit import audit
from covariant.cli._console import working
from covariant.cli._export_states import of_states, with_fixed_steps
from covariant.cli._parse import above_zero, bytes_of
from covariant.cli._planned import Asked, Planned
from covariant.codegen import (
    ROWS,
    Facts,
    Program,
    Recipe,
    export_texts,
    fmu,
    of_family,
    program,
    with_open_numbers,
    write_fmu,
    write_folder,
)
from covariant.design import ESTIMATORS, estimators, observer_gains, tuned_estimators, with_gains
from covariant.lowering import LoweringError
from covariant.observers import REGISTRY, AbstractObserver, Delayed, chooses_substeps, with_fixed_substeps
from covariant.workflow._inputs import data_sheet

GEOMETRY = ("*rotation", "*place", "*turn", "*slide", "coordinates", "motors", "joints", "base*")
"""Arrays of a robot that say how it is put together: as constants they save nine tenths of the work."""
STORED = ("low", "high", "spacing", "factors")
"""Arrays of a metric on a grid, a table that the code looks up."""
REALS = ("double", "float")
VERSIONS = ("3.0", "2.0")
CENTRE, SWING = 0.7, 0.2
"""Where positions of the self-test are, and how far they swing, in units of the coordinates; circles start at π."""


def export(spec: str, overrides: tuple[str, ...], asked: Asked, out: Path, as_json: bool) -> None:
    """Write an observer of a model, by default the first that fits it: as C into a folder, or as a unit (.fmu)."""
    rate, unit = above_zero("--rate", asked.rate), out.suffix == ".fmu"
    flash = bytes_of("--flash", asked.flash)
    _check(asked, unit)
    family = _family(spec, overrides, asked.parameters)
    file = models.load(spec, overrides) if family is None else family.file
    planned = (_mechanical if file.mechanical else of_states)(spec, file, asked)
    kind, bare, design, measured = planned
    name = asked.name or _identifier(file.name)
    about = f"{kind} observer of {file.name}. {design}"
    proved = "" if asked.certificate is None else _certificate(asked.certificate, spec, overrides, kind, bare)
    # A unit takes steps of any length; firmware does the same work in every step.
    fixed = bare if unit else _of_fixed_length(planned, rate, file)
    late = float(np.max(file.delay)) > 0 and next(e for e in REGISTRY if e.name == kind).knows_model
    observer = Delayed(fixed, file.delay, rate) if late else fixed
    with working(f"writing {name}", quiet=as_json):
        made = _program(spec, observer, family, file, asked, measured[0], unit)
        found = _audited(bare) if asked.audited else ""
        if unit:
            warned, paths = _write_unit(made, name, about, rate, measured[0], asked, out), [out]
        else:
            facts = Facts(rate, getattr(fixed, "substeps", None), proved, found)
            texts = export_texts(made, name, about, measured, facts, flash)
            warned, paths = "", write_folder(texts, out, asked.overwrite)
    result: dict[str, Any] = {"model": spec, "observer": kind, "out": str(out), "design": design}
    result |= {"files": [str(path) for path in paths], "numbers": list(made.numbers)}
    result["operations"] = sum(node.op not in ("input", "constant") for node in made.step.graph.nodes)
    warnings = [warning for warning in (found, warned) if warning]
    if warnings:
        result["warning"] = "; ".join(warnings)
    for warning in warnings:
        print(f"covariant: warning: {warning}", file=sys.stderr)
    told = f"wrote {len(paths)} files into {out}; build and test them as its README.md says"
    print(json.dumps(result) if as_json else f"{about}\n{f'wrote {out}' if unit else told}")


def _check(asked: Asked, unit: bool) -> None:
    if asked.real not in REALS:
        raise ValueError(f"--real must be one of {', '.join(REALS)}; got {asked.real!r}")
    if asked.fmi is not None and not unit:
        raise ValueError("--fmi is for a unit: name a file that ends in .fmu by -o")
    if asked.fmi not in (None, *VERSIONS):
        raise ValueError(f"--fmi must be one of {', '.join(VERSIONS)}; got {asked.fmi!r}")
    if unit and asked.flash is not None:
        raise ValueError("--flash is for a microcontroller, and a unit is not for one; leave it out")
    if unit and asked.certificate is not None:
        raise ValueError("--certificate is for the data sheet, which a unit does not have; leave it out")


def _write_unit(made: Program, name: str, about: str, rate: float, y: np.ndarray, asked: Asked, out: Path) -> str:
    """Write a unit; returns a warning where it has no binary."""
    version: Any = asked.fmi or VERSIONS[0]
    unit = fmu(made, name, about, rate, y, version)
    write_fmu(unit, out, asked.overwrite)
    return f"the unit holds sources and no binary: {unit.without_binary}" if unit.without_binary else ""


def _mechanical(spec: str, file: models.ModelFile, asked: Asked) -> Planned:
    """An observer of a mechanical model, by default the first that fits it."""
    if asked.metric is not None:
        raise ValueError(f"--metric is for the observer riccati of a state-space model; {spec} is a mechanical one")
    model: Any = file.model
    return Planned(*_observer(spec, file, model, asked), _measured(model, file.dimension))


def _observer(
    spec: str, file: models.ModelFile, model: models.MechanicalSystem, asked: Asked
) -> tuple[str, AbstractObserver, str]:
    """The name of the observer, the observer, and a sentence on its numbers."""
    alpha, beta = asked.gains
    fitting = estimators(model)
    kind = asked.observer or fitting[0]
    if kind not in fitting:
        known = "does not fit" if kind in ESTIMATORS else "is no observer for"
        raise ValueError(f"--observer {kind} {known} {spec}; these do: {', '.join(fitting)}")
    if (alpha is None) != (beta is None):
        raise ValueError("--alpha and --beta belong together: give both or neither")
    if alpha is not None and beta is not None:
        made = with_gains(model, above_zero("--alpha", alpha), above_zero("--beta", beta))
        if kind not in made:
            raise ValueError(f"--alpha and --beta do not apply to {kind}; they do to {', '.join(made)}")
        return kind, made[kind], f"Given gains: alpha = {alpha:g} 1/s, beta = {beta:g} 1/s^2."
    sheet = data_sheet(file)
    made = tuned_estimators(model, file.dimension, sheet, asked.rate, names=(kind,))
    designed = observer_gains(sheet, asked.rate).summary.replace("²", "^2")
    return kind, made[kind], f"Designed {designed}." if _tuned_by_gains(kind) else "Tuned from its data sheet."


def _tuned_by_gains(kind: str) -> bool:
    return next(entry for entry in REGISTRY if entry.name == kind).tuned_by == "gains"


def _program(
    spec: str,
    observer: AbstractObserver,
    family: models.Family | None,
    file: models.ModelFile,
    asked: Asked,
    y: np.ndarray,
    loops: bool,
) -> Program:
    """The graphs of the observer, with the numbers of the model file open or, where there are none, its arrays."""
    recipe = of_family(observer, family) if family is not None else _recipe(observer, asked.parameters)
    try:
        return program(recipe, y, len(file.columns.u), asked.real, loops)  # pyright: ignore[reportArgumentType]
    except LoweringError as error:
        if asked.parameters == "none":
            raise ValueError(f"{spec}: no code can be written: {error}") from error
    try:
        return program(_usual(observer), y, len(file.columns.u), asked.real, loops)  # pyright: ignore[reportArgumentType]
    except LoweringError as error:
        raise ValueError(f"{spec}: no code can be written: {error}; try --parameters none") from error


def _family(spec: str, overrides: Sequence[str], given: str | None) -> models.Family | None:
    """The model with the numbers of its file open, or None where it has none or they stay as they are."""
    names = _open_numbers(models.recipe(spec, overrides).get("parameters", {}))
    if given == "none" or not names:
        return None
    chosen = names if given is None else tuple(part.strip() for part in given.split(","))
    return models.family(spec, chosen, overrides)


def _recipe(observer: AbstractObserver, given: str | None) -> Recipe:
    """The observer with its arrays open, as far as they are named or, by default, no geometry of a robot."""
    if given is None:
        return _usual(observer)
    if given == "none":
        return with_open_numbers(observer, ("*",))
    everything = with_open_numbers(observer)
    patterns = tuple(part.strip() for part in given.split(","))
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in everything.numbers):
            raise ValueError(f"--parameters: there is no {pattern!r}; there are: {', '.join(everything.numbers)}")
    closed = [n for n in everything.numbers if not any(fnmatchcase(n, pattern) for pattern in patterns)]
    return with_open_numbers(observer, closed)


def _usual(observer: AbstractObserver) -> Recipe:
    """The recipe that is open but for the geometry of a robot, and arrays of zeros, which cost nothing if closed."""
    zeros = [name for name, value in with_open_numbers(observer).numbers.items() if not np.any(value)]
    return with_open_numbers(observer, (*GEOMETRY, *STORED, *zeros))


def _open_numbers(parameters: dict[str, Any]) -> tuple[str, ...]:
    """Names of the numbers of a model file that are not zero: a first value of zero cannot be told from none."""

    def places(name: str, value: Any):
        if isinstance(value, bool) or not isinstance(value, int | float | list):
            return
        if isinstance(value, list):
            for k, inner in enumerate(value):
                yield from places(f"{name}[{k}]", inner)
        elif value != 0:
            yield name

    return tuple(found for key, value in parameters.items() for found in places(key, value))


def _of_fixed_length(planned: Planned, rate: float, file: models.ModelFile) -> AbstractObserver:
    """The observer with as many substeps as it needs: for friction, at the usual speed of the model file."""
    observer, q = planned.observer, planned.measured
    if not file.mechanical:
        return with_fixed_steps(observer, q, rate)
    if not chooses_substeps(observer):
        return observer
    sheet = data_sheet(file) if file.acceleration_std is not None and file.measurement_std is not None else None
    speed = 3.0 if sheet is None else np.broadcast_to(sheet.speeds, file.dimension)
    v = np.broadcast_to(speed, (len(q), file.dimension)) * np.sign(np.arange(len(q)) % 2 - 0.5)[:, None]
    inputs = jnp.zeros((len(q), len(file.columns.u)))
    return with_fixed_substeps(observer, rate, jnp.asarray(q), jnp.asarray(v), inputs)


def _measured(model: models.MechanicalSystem, n: int) -> np.ndarray:
    """Measurements (ROWS + 1, *n) for the self-test: a swing of every coordinate; circles are crossed at π."""
    k = np.arange(ROWS + 1)[:, None]
    swing = SWING * np.sin(k / (4.0 + np.arange(n)) + np.arange(n))
    manifold = model.manifold
    if manifold.commuting:
        return swing + np.where(np.isin(np.arange(n), manifold.circles), np.pi, CENTRE)
    return np.stack([np.asarray(manifold.retract(manifold.origin(), jnp.asarray(s))) for s in swing])


def _certificate(path: Path, spec: str, overrides: Sequence[str], kind: str, observer: Any) -> str:
    """Lines on what a saved certificate says of this observer; raises `ValueError` where it is of another."""
    document = certificates.parse(path)
    gains = tuple(float(getattr(observer, name, np.nan)) for name in ("alpha", "beta"))
    saved = tuple(float(document.observer[name]) for name in ("alpha", "beta"))
    if document.recipe != models.recipe(spec, overrides):
        raise ValueError(f"{path}: the certificate is for another model, or other numbers, than {spec}")
    if document.observer["kind"] != kind:
        raise ValueError(f"{path}: the certificate is for the observer {document.observer['kind']}, not for {kind}")
    if not np.allclose(gains, saved, rtol=1e-12):
        raise ValueError(
            f"{path}: the certificate is for alpha = {saved[0]:g}, beta = {saved[1]:g}; the observer has {gains[0]:g}, "
            f"{gains[1]:g}; give these by --alpha and --beta"
        )
    radius = "" if document.open else f", from distances up to {document.radius:g} in its metric"
    return (
        f"`{path.name}` states that the observer in continuous time converges at the rate {document.rate / 2:g} 1/s"
        f"{radius}, with the default numbers. Verify it by `covariant certify --check {path.name}`."
    )


def _audited(observer: Any) -> str:
    """A line where the observer breaks a law that its convergence rests on; nothing where it has no such laws."""
    if not all(name in getattr(observer, "__dataclass_fields__", {}) for name in ("alpha", "beta", "model")):
        return ""
    done = audit(observer, points=6)
    broken = [law.name for law in done.rows if law.verdict == "fails"]
    return "" if done.passed else f"the observer breaks laws of its audit: {', '.join(broken)}"


def _identifier(name: str) -> str:
    plain = re.sub(r"\W", "_", name, flags=re.ASCII).lower()
    return plain if plain[:1].isalpha() else f"observer_{plain}"
