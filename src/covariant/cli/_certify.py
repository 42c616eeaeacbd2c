"""`covariant certify`: proves that an observer converges, with region, rate and tube; or verifies a saved proof."""

import json
import math
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from covariant import models
from covariant.certificates import (
    ASSUMED,
    Checked,
    ContractionCertificate,
    Document,
    certify,
    check,
    check_sample,
    parse,
)
from covariant.cli import _parse
from covariant.cli._console import working
from covariant.design import observer_gains
from covariant.models import MechanicalSystem, input_count
from covariant.observers import Geodesic, Intrinsic
from covariant.proofs import read_file
from covariant.workflow._inputs import check_output, data_sheet, numbered

OBSERVERS = {"intrinsic": Intrinsic, "geodesic": Geodesic}
_KINDS = {"estimate": "estimate of", "velocity": "estimated velocity", "error": "position error", "force": "force"}


class Asked(NamedTuple):
    """The statement to prove, in the options of the command as the user gave them."""

    observer: str | None
    alpha: float | None
    beta: float | None
    sampling: float | None
    box: str | None
    velocity: str | None
    error: str | None
    input: str | None
    rate: float | None
    q: str | None
    noise: str | None
    disturbance: str | None
    boxes: int
    seconds: float | None
    processes: int | None


def certify_model(
    spec: str, overrides: tuple[str, ...], asked: Asked, out: Path | None, figure: Path | None, as_json: bool
) -> None:
    """Prove, write and draw; exits with code 1 where the statement is not proved."""
    check_output(out, ".json")
    check_output(figure, ".png", ".pdf", ".svg")
    if asked.velocity is None:
        raise ValueError(
            "--velocity is missing: no certificate exists without a bound of the velocity, because the tube in which "
            "estimates converge shrinks as the velocity grows; give one bound, or one for each velocity by commas"
        )
    if asked.error is None:
        raise ValueError("--error is missing: give how far an estimated position may be off, one bound or one each")
    file = models.load(spec, overrides)
    model = file.need_mechanical(spec, "certificates are about intrinsic observers of")
    settings, designed = _settings(spec, file, model, asked)
    recipe = models.recipe(spec, overrides)
    with _proving(quiet=as_json) as tell:
        found = certify(recipe=recipe, progress=tell, **settings)
    result = _result(spec, found)
    if out is not None:
        wrong = found.counterexample is not None  # a counter-example is printed, not saved
        result["out"] = None if wrong else str(found.save(out))
    if figure is not None:
        from covariant.report import draw_certificate

        with working("simulating and drawing", quiet=as_json):
            result["figure"] = str(draw_certificate(found, figure))
    print(json.dumps(result) if as_json else _text(result, found, designed))
    if found.summary.verdict != "holds":
        raise SystemExit(1)


def check_file(path: Path, model: str | None, processes: int | None, as_json: bool) -> None:
    """Verify a saved certificate, all leaves, and some again in ball arithmetic; exits with code 1 if it is refused.

    `model`: the `module:attribute` that the user gives for a model that is not of this library.
    """
    content = read_file(path)  # only once, so that both checks examine the same content
    try:
        document = parse(path, content)
        with _proving(quiet=as_json) as tell:
            found = check(
                document,
                model=model,
                processes=processes or os.cpu_count() or 1,
                progress=lambda done, total: tell("checking leaves", done / max(total, 1), done),
            )
        balls, more = _balls(document, model)
    except ValueError as refusal:
        print(json.dumps({"verified": False, "reason": str(refusal)}) if as_json else f"Refused: {refusal}")
        raise SystemExit(1) from refusal
    result = {"verified": True, **found._asdict(), "model": model, "balls": balls, "assumed": ASSUMED}
    print(json.dumps(result) if as_json else _verified(found, model, more))


def _balls(document: Document, model: str | None) -> tuple[int, str]:
    """The number of leaves found right in ball arithmetic, also in words."""
    try:
        balls = check_sample(document, model=model).leaves
    except ImportError as missing:
        return 0, f"none in ball arithmetic: {missing}"
    return balls, f"{balls} of them again in ball arithmetic"


def _verified(found: Checked, model: str | None, more: str) -> str:
    """What was verified, and what is still assumed, in words."""
    lines = [
        f"Verified: rate λ = {found.rate:.4g} 1/s, radius ε = {found.radius:.4g}; {found.leaves} leaves in "
        f"{found.seconds:.1f} s, {more}."
    ]
    if found.model_given:
        lines.append(
            f"The model is {model}, given by the person who checks; that the file means this one is not verified."
        )
    return "\n".join([*lines, "What remains assumed:", *(f"- {line}" for line in ASSUMED)])


def _settings(spec: str, file: models.ModelFile, model, asked: Asked) -> tuple[dict[str, Any], str]:
    """Arguments of `certify`, and a sentence on the origin of the gains."""
    n = file.dimension
    on_group = not model.manifold.commuting
    names = model.velocities if on_group else model.coordinates or numbered("q", n)
    inputs = numbered("u", input_count(model, n))
    name = asked.observer or "intrinsic"
    if name not in OBSERVERS:
        raise ValueError(f"unknown observer {name!r}; choose one of {', '.join(OBSERVERS)}")
    velocity = _parse.numbers("--velocity", asked.velocity, [f"d{k}/dt" for k in names], positive=True, one=True)
    error = _parse.numbers("--error", asked.error, names, positive=True, one=True)
    input_bounds = _amounts("--input", asked.input, inputs)
    alpha, beta, designed = _gains(file, asked)
    settings = {
        "observer": OBSERVERS[name](model, alpha, beta),
        "velocity": velocity,
        "error": error,
        "position": _matrix_bounds(model, asked.box) if on_group else _bounds(spec, names, asked.box),
        "input": input_bounds,
        "rate": None if asked.rate is None else _parse.above_zero("--rate", asked.rate),
        "q": _matrix(asked.q),
        "noise": _amounts("--noise", asked.noise, names),
        "disturbance": _amounts("--disturbance", asked.disturbance, names),
        "boxes": int(_parse.above_zero("--boxes", float(asked.boxes))),
        "seconds": None if asked.seconds is None else _parse.above_zero("--seconds", asked.seconds),
        "processes": asked.processes or os.cpu_count() or 1,
    }
    return settings, designed


def _amounts(option: str, text: str | None, names) -> np.ndarray:
    """Bounds that may be zero, and are zero by default."""
    found = _parse.numbers(option, text or "0", names, one=True)
    assert found is not None
    if found.min(initial=0.0) < 0:
        raise ValueError(f"{option}: bounds must not be negative; got {text!r}")
    return found


def _gains(file: models.ModelFile, asked: Asked) -> tuple[float, float, str]:
    if (asked.alpha is None) != (asked.beta is None):
        raise ValueError("--alpha and --beta belong together: give both or neither")
    if asked.alpha is not None and asked.beta is not None:
        alpha, beta = _parse.above_zero("--alpha", asked.alpha), _parse.above_zero("--beta", asked.beta)
        return alpha, beta, f"Given gains: alpha = {alpha:g} 1/s, beta = {beta:g} 1/s²."
    if file.measurement_std is None or file.acceleration_std is None:
        raise ValueError(f"{file.name} has no data sheet to design gains from; give --alpha and --beta")
    if asked.sampling is None:
        raise ValueError("gains are designed for a sampling rate; give --sampling HZ, or --alpha and --beta")
    gains = observer_gains(data_sheet(file), _parse.above_zero("--sampling", asked.sampling))
    return float(gains.alpha), float(gains.beta), f"Designed {gains.summary}."


def _bounds(spec: str, names: tuple[str, ...], text: str | None) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest positions; every coordinate must be named."""
    box = _parse.ends("--box", text, names, "coordinate", equal=True)
    missing = [name for name in names if name not in box]
    if missing:
        example = ",".join(f"{name}=LOW:HIGH" for name in names)
        raise ValueError(f"--box lacks {', '.join(missing)}; {spec} needs --box {example}")
    low, high = zip(*(box[name] for name in names), strict=True)
    return np.array(low), np.array(high)


def _matrix_bounds(model: MechanicalSystem, text: str | None) -> tuple[np.ndarray, np.ndarray] | None:
    """Least and largest entries of the matrices; None where nothing is given, as for rotations."""
    if text is None:
        return None
    order = model.manifold.origin().shape[0]
    names = [f"g{i + 1}{j + 1}" for i in range(order) for j in range(order)]
    box = _parse.ends("--box", text, names, "matrix entry", equal=True)
    missing = [name for name in names if name not in box]
    if missing:
        raise ValueError(f"--box lacks {', '.join(missing)}: on a group all entries of its matrices need bounds")
    low, high = zip(*(box[name] for name in names), strict=True)
    return np.reshape(low, (order, order)), np.reshape(high, (order, order))


def _matrix(text: str | None) -> np.ndarray | None:
    """Q from its entries a, c, b."""
    entries = _parse.numbers("--q", text, ("a", "c", "b"))
    if entries is None:
        return None
    a, c, b = entries
    if not (a > 0 and a * b > c * c):
        raise ValueError(f"--q: [[a, c], [c, b]] must be positive definite, a > 0 and ab > c²; got {text!r}")
    return np.array([[a, c], [c, b]])


@contextmanager
def _proving(quiet: bool) -> Iterator[Callable[[str, float, int], None]]:
    """A progress bar of the decided fraction; yields a function of the current proof, that fraction, and the boxes."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TextColumn("{task.fields[boxes]} boxes"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=Console(stderr=True, quiet=quiet), transient=True) as progress:
        task = progress.add_task("reading the model", total=1.0, boxes=0)

        def tell(what: str, share: float, boxes: int) -> None:
            progress.update(task, description=f"proving {what}", completed=share, boxes=boxes)

        yield tell


def _result(spec: str, found: ContractionCertificate) -> dict[str, Any]:
    """All results as JSON data."""
    summary, domain = found.summary, found.domain
    bounds = zip(domain.names, domain.low.tolist(), domain.high.tolist(), strict=True)
    wrong = None
    if found.counterexample is not None:
        wrong = dict(zip(domain.names, found.counterexample.mean(axis=0).tolist(), strict=True))
    return {
        "model": spec,
        "observer": type(found.observer).__name__,
        "verdict": summary.verdict,
        "evidence": summary.evidence,
        "statement": summary.statement,
        "alpha": float(found.observer.alpha),
        "beta": float(found.observer.beta),
        "q": found.q.tolist(),
        "rate": found.rate,
        "decay": found.decay,
        "radius": found.radius,
        "steady": found.steady if math.isfinite(found.steady) else None,
        "half_widths": found.half_widths.tolist() if summary.verdict == "holds" else None,
        "velocity": found.velocity.tolist(),
        "domain": {name: [low, high] for name, low, high in bounds},
        "boxes": found.boxes,
        "seconds": found.seconds,
        "open": len(found.open),
        "open_share": {claim.kind: claim.proof.open_share for claim in _undecided(found)},
        "counterexample": wrong,
    }


def _undecided(found: ContractionCertificate):
    return [claim for claim in found.claims if claim.proof.verdict == "undecided"]


def _text(result: dict[str, Any], found: ContractionCertificate, designed: str) -> str:
    verdict = found.summary.verdict
    said = {"holds": "proved", "fails": "wrong", "undecided": "not decided"}[verdict]
    (a, c), (_, b) = found.q
    lines = [
        f"{said}: {found.summary.statement}",
        designed,
        f"rate λ = {found.rate:.4g} 1/s of squared lengths, μ = {found.decay:.4g} 1/s of lengths, in the metric "
        f"Q = [[{a:.4g}, {c:.4g}], [{c:.4g}, {b:.4g}]]",
    ]
    names, units, n = found.domain.names, found.domain.units, len(found.velocity)
    if verdict == "holds":
        widths = found.half_widths
        lines.append(f"tube of the radius ε = {found.radius:.4g}: every estimate in it stays within")
        rates = [f"{unit}/s" if unit and not unit.endswith("/s") else unit for unit in units[:n]]
        turns = [unit.removesuffix("/s") for unit in units[:n]]
        lines += [
            f"  {w:.4g} {u} of {what} {name}{_degrees(w, u)}"
            for what, numbers, unit in (("position", widths[:n], turns), ("velocity", widths[n:], rates))
            for name, w, u in zip(names[:n], numbers, unit, strict=True)
        ]
    else:
        lines.append("no tube is proved")
    bounds = ", ".join(f"{v:.4g}" for v in found.velocity)
    lines.append(f"for true velocities up to {bounds}, and everywhere in the domain")
    domain = found.domain
    for kind, name, unit, low, high in zip(found.kinds, names, units, domain.low, domain.high, strict=True):
        lines.append(f"  {low:.4g} ≤ {_KINDS[kind]} {name} ≤ {high:.4g} {unit}".rstrip() + _degrees(high, unit, low))
    if found.counterexample is not None:
        lines.append("it is wrong at")
        point = found.counterexample.mean(axis=0)
        lines += [f"  {k} = {x:.6g} {u}".rstrip() + _degrees(x, u) for k, u, x in zip(names, units, point, strict=True)]
    for claim in _undecided(found):
        lines.append(
            f"{claim.kind}: {len(claim.proof.open)} boxes remain, {claim.proof.open_share:.2%} of the domain; more "
            "--boxes, smaller bounds or a lower --rate may decide it"
        )
    lines.append(f"{found.boxes} boxes, {found.seconds:.1f} s")
    lines += [f"wrote {result[key]}" for key in ("out", "figure") if result.get(key)]
    if "out" in result and result["out"] is None:
        lines.append("no certificate is written of a statement that is wrong")
    return "\n".join(lines)


def _degrees(value: float, unit: str, low: float | None = None) -> str:
    """An angle also in degrees, in brackets; empty for other units."""
    if unit not in ("rad", "rad/s"):
        return ""
    per = unit.removeprefix("rad")
    return f" ({math.degrees(value):.4g}°{per})" if low is None else f" ({_degree(low)} to {_degree(value)}°{per})"


def _degree(value: float) -> str:
    return f"{math.degrees(value):.4g}"
