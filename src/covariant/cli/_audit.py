"""`covariant audit`: the laws of an observer, measured at random states."""

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from covariant import models
from covariant.audit import Audit, Law, audit as measure
from covariant.cli._console import working
from covariant.cli._parse import above_zero, ends
from covariant.design import estimators, with_gains
from covariant.observers import AbstractObserver
from covariant.proofs import Box
from covariant.workflow._inputs import check_output, coordinates, numbered

GAINS = math.sqrt(2), 1.0
"""Default α [1/s] and β [1/s²]: the laws hold with any gains."""


class Look(NamedTuple):
    """The states to audit, in the options of the command as the user gave them."""

    box: str | None
    speed: float
    points: int
    seed: int


def audit(
    spec: str,
    overrides: tuple[str, ...],
    observer: str | None,
    gains: tuple[float | None, float | None],
    look: Look,
    out: Path | None,
    as_json: bool,
) -> None:
    """Audit an observer of a model, by default the first that fits it, and print and draw the results."""
    check_output(out, ".html", ".png", ".pdf", ".svg")
    file = models.load(spec, overrides)
    name, chosen = _observer(spec, file, observer, *gains)
    domain = _domain(file, look.box)
    above_zero("--speed", look.speed)
    with working(f"auditing {name} on {file.name}", quiet=as_json):
        done = measure(chosen, domain=domain, speed=look.speed, points=look.points, seed=look.seed)
    result = {"model": spec, "observer": name, "passed": done.passed, "verdict": done.verdict, "domain": done.domain}
    result["laws"] = [_in_json(row) for row in done.rows]
    if out is not None:
        result["out"] = str(_draw(done, f"Audit of {file.name}", out))
    print(json.dumps(result) if as_json else "\n".join([str(done), *([f"wrote {out}"] if out is not None else [])]))
    if not done.passed:
        raise SystemExit(1)


def _observer(
    spec: str, file: models.ModelFile, name: str | None, alpha: float | None, beta: float | None
) -> tuple[str, AbstractObserver]:
    if (alpha is None) != (beta is None):
        raise ValueError("--alpha and --beta belong together: give both or neither")
    chosen = GAINS if alpha is None or beta is None else (alpha, beta)
    if not all(0 < gain < math.inf for gain in chosen):
        raise ValueError(f"--alpha and --beta must be positive numbers; got {chosen[0]:g} and {chosen[1]:g}")
    model = file.need_mechanical(spec, "the laws are those of observers of")
    made = with_gains(model, *chosen)
    name = name or estimators(model)[0]
    if name not in made:
        raise ValueError(f"--observer {name} does not fit {spec}, or has no gains; these do: {', '.join(made)}")
    return name, made[name]


def _domain(file: models.ModelFile, text: str | None) -> Box | None:
    """The given bounds of coordinates; on a group, of exponential coordinates."""
    names = numbered("x", file.dimension) if not file.model.manifold.commuting else coordinates(file)[0]
    found = ends("--box", text, names, "coordinate")
    if not found:
        return None
    low, high = np.array(list(found.values())).T
    return Box(tuple(found), ("",) * len(found), low, high)


def _in_json(row: Law) -> dict[str, Any]:
    """A row as JSON data, with None for a deviation that is no finite number."""
    return row._asdict() | {"deviation": row.deviation if math.isfinite(row.deviation) else None}


def _draw(done: Audit, title: str, out: Path) -> Path:
    from covariant.report import draw_audit, write_audit

    return write_audit(done, title, out) if out.suffix == ".html" else draw_audit(done, out)
