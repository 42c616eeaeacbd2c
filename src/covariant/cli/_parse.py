"""Parsing of the values of options: lists of numbers, ends of named variables, sizes; and checks of names and paths.

Each function takes the option, for its message, and the text of its value.
"""

from pathlib import Path

from covariant import logs
from covariant._names import did_you_mean, unknown
from covariant._numbers import integer, number
from covariant.models import check_spec
from covariant.observers import OBSERVER_NAMES, STATE_OBSERVER_NAMES
from scalargraph.errors import InputError


def number_list(option: str, text: str) -> list[float]:
    """Parse numbers separated by commas.

    Example:
        >>> number_list("--velocity", "1,2.5")
        [1.0, 2.5]
    """
    try:
        return [number(part) for part in text.split(",")]
    except InputError:
        raise InputError(f"{option}: {text!r} is not a list of numbers separated by commas") from None


def count_list(option: str, text: str) -> list[int]:
    """Parse whole numbers separated by commas."""
    try:
        return [integer(part) for part in text.split(",")]
    except InputError:
        raise InputError(f"{option}: {text!r} is not a list of whole numbers separated by commas") from None


def interval_map(option: str, text: str) -> dict[str, tuple[float, float]]:
    """Parse low and high ends of variables, `name=low:high`, separated by commas.

    Example:
        >>> interval_map("--region", "r=0:1,theta=-1:1")
        {'r': (0.0, 1.0), 'theta': (-1.0, 1.0)}
    """
    ends: dict[str, tuple[float, float]] = {}
    for part in text.split(","):
        name, _, pair = (piece.strip() for piece in part.partition("="))
        try:
            low, high = map(number, pair.split(":"))
        except ValueError:
            raise InputError(f"{option}: {part!r} does not have the form NAME=LOW:HIGH") from None
        if name in ends:
            raise InputError(f"{option}: {name} is given twice; keep one of them")
        ends[name] = low, high
    return ends


def name_list(option: str, text: str) -> tuple[str, ...]:
    """Parse names separated by commas, or "none"."""
    return () if text == "none" else tuple(part.strip() for part in text.split(","))


def model_name(option: str, text: str) -> str:
    """Check that a model exists, as far as its name or path shows, before anything heavy is loaded."""
    check_spec(text)
    return text


def log_path(option: str, path: Path) -> Path:
    """Check that a log exists, before anything heavy is loaded."""
    if not logs.part_of(path)[0].exists():
        raise FileNotFoundError(f"{path}: no such file")
    return path


def log_paths(option: str, paths: list[Path]) -> list[Path]:
    """Check that a log exists: of many, one that is missing, or a broken link, is a row, and the others go on."""
    if not any(logs.part_of(path)[0].exists() for path in paths):
        log_path(option, paths[0])
    return paths


def each_log(option: str, paths: list[Path]) -> list[Path]:
    """Check that a log exists. A folder stands for the logs in it, and a file of several episodes for these."""
    strict = len(paths) == 1  # of many, one that is none is a row
    return [Path(each) for path in log_paths(option, paths) for each in logs.episodes(path, strict)]


def observer_name(option: str, text: str) -> str:
    """Check that there is an observer of this name."""
    return one_of(option, text, (*OBSERVER_NAMES, *STATE_OBSERVER_NAMES))


def one_of(option: str, text: str, names: tuple[str, ...]) -> str:
    """Check that a text is one of several names: of things that there are, or of values of a setting."""
    if text not in names:
        listed, thing = ", ".join(names), option.removeprefix("--")
        if thing in ("observer", "paper"):
            raise InputError(unknown(thing, text, names, (*OBSERVER_NAMES, *STATE_OBSERVER_NAMES)))
        raise InputError(f"{option} must be one of {listed}; got {text!r}.{did_you_mean(text, names)}".rstrip("."))
    return text
