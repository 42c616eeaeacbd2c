"""`covariant init`: a first model file for a log, with the columns that its header names."""

import json
from pathlib import Path

from covariant import logs, models
from covariant._files import write_atomically
from covariant.identification import Draft, draft
from covariant.workflow import check_output


def init(log: Path, out: Path, columns: dict[str, str | None], as_json: bool) -> None:
    """Guess what the columns of a log are, and write a model file of a chain of pendulums that reads them."""
    check_output(out, ".toml", log=log)
    if out.exists():
        raise ValueError(f"{out}: there is such a file already, and it is not overwritten; give another name")
    given = {key: [n.strip() for n in names.split(",")] for key, names in columns.items() if names is not None}
    try:
        found = draft(logs.survey(log), given)
    except logs.LogError:
        raise
    except ValueError as error:
        raise ValueError(f"{log}: {error}") from error
    text = template(log.name, found)
    write_atomically(out, lambda file: file.write(text.encode()))
    models.load(str(out))
    guessed = {"t": found.t, "q": list(found.q), "u": list(found.u), "v": list(found.v)}
    units = {field: list(texts) for field, texts in found.units.items()}
    result = {"log": str(log), "out": str(out), "columns": guessed, "units": units, "left_out": list(found.left_out)}
    print(json.dumps(result) if as_json else _text(result))


def template(name: str, found: Draft) -> str:
    """The text of the model file."""
    n = len(found.q)
    spans = ", ".join(f"{q} {low:.3g} to {high:.3g}" for q, (low, high) in zip(found.q, found.span, strict=True))
    lines = [
        f"# Drafted from the log {name}: {found.rows} rows at {found.rate:.4g} Hz. The columns are guessed from their",
        "# names and their content; the numbers in [parameters] are places to put yours, not measurements.",
        "# Units: s, m, kg, rad, N m; those of the log are in [units] where they are others.",
        "",
        'system = "pendulum_chain"  # other machines: docs/models.md',
        "",
        "[parameters]",
        'angles = "relative"  # or "absolute": each link from the vertical',
        'zero = "hanging"  # or "upright": where the angles are 0',
        "gravity = 9.81",
        f"mass = {_list(1.0, n)}",
        f"length = {_list(0.3, n)}  # m, from joint to joint; that of the last link does not matter",
        f"com = {_list(0.15, n)}  # m, from joint to centre of mass",
        f"inertia = {_list(0.01, n)}  # kg m^2, about the centre of mass",
        f"viscous = {_list(0.01, n)}  # N m s/rad, friction in each joint",
        f"coulomb = {_list(0.01, n)}  # N m, times atan(100 v): dry friction, divided by pi/2",
    ]
    if len(found.u) < n:
        lines.append(
            f"actuated = {list(range(len(found.u)))}"
            + ("  # joints that the inputs drive, from 0: the first ones are guessed" if found.u else "")
        )
    lines += [
        "",
        "[columns]",
        f"t = {_quoted(found.t)}",
        f"q = {_names(found.q)}  # in this log {spans}",
        f"u = {_names(found.u)}" + ("" if found.u else "  # no input was found"),
        *([f"v = {_names(found.v)}  # only compared with, never used"] if found.v else []),
        *([f"# left out: {', '.join(found.left_out)}"] if found.left_out else []),
        *_units(found),
        "",
        "[measurement]",
        _sensor(found),
        "",
        "# Gains of observers are designed from how much acceleration the model leaves unexplained, which a log does",
        "# not tell before the model fits: set it after `covariant fit`, then take the marks of comments away.",
        "# [uncertainty]",
        "# acceleration = 2.0  # rad/s^2",
        "# correlation_time = 0.01  # s, over which it persists",
        "",
    ]
    return "\n".join(lines)


def _sensor(found: Draft) -> str:
    if found.quantum is not None:
        return f"quantum = {found.quantum:.6g}  # rad, the tick that positions of this log are multiples of"
    return f"std = {max(found.noise, 1e-12):.3g}  # rad, at most: from third differences of the positions"


def _units(found: Draft) -> list[str]:
    """The table of the units of the log, where these are not those of the file."""
    if not found.units:
        return []
    lines = ["", "[units]"]
    for field, texts in found.units.items():
        written = _quoted(texts[0]) if len(set(texts)) == 1 else _names(texts)
        why = (
            "guessed from the numbers: `covariant check` looks closer"
            if field in found.guessed
            else "as its header says"
        )
        lines.append(f"{field} = {written}  # {why}")
    return lines


def _list(value: float, n: int) -> str:
    return str([value] * n)


def _quoted(name: str) -> str:
    return json.dumps(name, ensure_ascii=False)


def _names(names: tuple[str, ...]) -> str:
    return "[" + ", ".join(map(_quoted, names)) + "]"


def _text(result) -> str:
    columns = result["columns"]
    lines = [f"stamps {columns['t']}, positions {', '.join(columns['q'])}"]
    lines[0] += f", inputs {', '.join(columns['u'])}" if columns["u"] else ", no inputs"
    lines[0] += f", velocities {', '.join(columns['v'])} to compare with" if columns["v"] else ""
    if result["units"]:
        lines.append(
            f"units {', '.join(f'{field}: ' + ', '.join(dict.fromkeys(t)) for field, t in result['units'].items())}"
        )
    if result["left_out"]:
        lines.append(f"left out: {', '.join(result['left_out'])}")
    return "\n".join([*lines, f"wrote {result['out']}; put first values of your machine into its [parameters]"])
