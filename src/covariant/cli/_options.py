"""Options of a command: those that a verb's arguments make, and those that only the command line has."""

import ast
import functools
import inspect
import re
import shlex
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from covariant.cli import _parse
from covariant.cli._signature import REQUIRED, Argument, signature
from covariant.observers import OBSERVER_NAMES, STATE_OBSERVER_NAMES


class Kind(NamedTuple):
    """How the value of an option is read.

    Attributes:
        type: What typer converts the text to.
        parse: What then converts or checks that, called with the option and the value.
        metavar: What stands for the value in the help; by default the type.
        choices: What the shell completes.
    """

    type: Any
    parse: Callable[[str, Any], Any] | None = None
    metavar: str | None = None
    choices: tuple[str, ...] = ()


TEXT, PATH, FLAG = Kind(str), Kind(Path), Kind(bool)
NUMBERS = Kind(str, _parse.number_list, "<number,...>")
OBSERVER = Kind(str, _parse.observer_name, choices=(*OBSERVER_NAMES, *STATE_OBSERVER_NAMES))
KINDS = {
    "Amounts": NUMBERS,
    "Any": PATH,
    "CheckerName": TEXT,
    "LostRows": TEXT,
    "EngineName": TEXT,
    "Overrides": Kind(list[str]),
    "OverridesOfLogs": Kind(list[str]),
    "Scheduler": TEXT,
    "Region": Kind(str, _parse.interval_map, "<name=low:high,...>"),
    "Sequence[float | int]": NUMBERS,
    "Sequence[float]": NUMBERS,
    "Sequence[str]": Kind(str, _parse.name_list, "<name,...>"),
    "bool": FLAG,
    "float": Kind(float),
    "int": Kind(int),
    "int | Sequence[int]": Kind(str, _parse.count_list, "<count,...>"),
    "str": TEXT,
    "str | Path": PATH,
    "str | Sequence[str]": Kind(str, metavar="<name,...>"),
}
"""Kinds by the annotation of the argument."""


class Option(NamedTuple):
    """An option or a positional argument of a command.

    Attributes:
        name: Name of the argument of Python that it becomes.
        kind: How its value is read.
        help: Its help.
        default: Its value where it is absent; `REQUIRED` where it must be there.
        flags: How it is typed; empty for a positional argument.
        least: The least number.
        suffixes: Of a file to write, the endings that it may have.
    """

    name: str
    kind: Kind
    help: str = ""
    default: Any = None
    flags: tuple[str, ...] = ()
    least: int | None = None
    suffixes: tuple[str, ...] = ()

    @property
    def typed(self) -> str:
        """How messages name it."""
        return next((flag.partition("/")[0] for flag in self.flags if flag.startswith("--")), self.name)

    def read(self, value: object) -> Any:
        """Convert what typer read to the argument of Python; None, for an absent option, stays."""
        return value if self.kind.parse is None or value is None else self.kind.parse(self.typed, value)

    def parameter(self) -> inspect.Parameter:
        """Parameter from whose annotation typer makes the option."""
        made = functools.partial(typer.Option, *self.flags) if self.flags else typer.Argument
        choices = self.kind.choices
        setting = made(
            help=self.help,
            metavar=self.kind.metavar if self.flags or not choices else None,
            min=self.least,
            autocompletion=(lambda: list(choices)) if choices else None,
        )
        kind = self.kind.type | None if self.default is None else self.kind.type
        default = inspect.Parameter.empty if self.default is REQUIRED else self.default
        annotation = Annotated[kind, setting]
        return inspect.Parameter(self.name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


POSITIONAL = {
    "model": {
        "kind": Kind(str, _parse.model_name),
        "help": "Model file (.toml), robot (.urdf or .xml), module:attribute, or the name of a system or a robot.",
    },
    "log": {
        "kind": Kind(Path, _parse.log_path),
        "help": "Log with stamps, positions or attitudes, inputs: .csv, .txt, .parquet, .mcap, a rosbag2.",
    },
    "paper": {},
    "study": {"kind": Kind(Path, _parse.log_path)},
}
"""Arguments that are given by their position where they must be given, in the words of the command line."""
NAMED = {
    "log": {"kind": Kind(Path, _parse.log_path)},
    "out": {"flags": ("-o", "--out")},
    "overrides": {
        "default": [],
        "flags": ("--set",),
        "help": "Override a value of the model file, as table.key=value.",
    },
    "region": {"flags": ("--region", "--box")},
    "start": {"flags": ("--from",)},
    "store": {"flags": ("-o", "--out")},
}
"""Options that are typed otherwise than their arguments are named, or read otherwise than these are annotated."""
LEAST = {"every": 1, "samples": 1, "points": 1, "block": 1, "workers": 1, "processes": 1, "runs": 1} | {
    "duration": 0,
    "lost": 0,
    "seed": 0,
}
"""The least value of numbers by the name of their argument."""
COLUMNS = {
    "t": "Column of the stamps.",
    "q": "Columns of the coordinates, separated by commas.",
    "u": "Columns of the inputs, separated by commas.",
    "v": "Columns of logged velocities, only compared with.",
    "truth": "Columns of true velocities, to score against.",
}
"""Fields of the argument `columns`, each of which is an option."""


def of_verb(verb: str, changes: Mapping[str, Mapping[str, Any]]) -> list[Option]:
    """Make the options of a verb's arguments: one each, and for `columns` one for each field that its entry names.

    Args:
        verb: Name of a function of `covariant.verbs` or `covariant.many`.
        changes: Fields of options, by the name of their argument, that the command has otherwise.
    """
    made: list[Option] = []
    arguments = signature(verb).arguments
    for name, argument in arguments.items():
        if name == "columns":
            fields = re.findall(r"\w+", argument.text.partition("(")[2].partition(")")[0])
            made += [Option(field, TEXT, COLUMNS[field], flags=(f"--{field}",)) for field in fields]
        elif name in POSITIONAL and argument.default is REQUIRED:
            made.append(_option(name, argument)._replace(**{"flags": ()} | POSITIONAL[name] | changes.get(name, {})))
        else:
            made.append(_option(name, argument)._replace(**NAMED.get(name, {}) | changes.get(name, {})))
    flags = flags_of(made)
    return [option._replace(help=in_options(option.help, flags)) for option in made]


def _option(name: str, argument: Argument) -> Option:
    """Option as the argument alone makes it."""
    flag = name.replace("_", "-")
    names = tuple(re.findall(r'"([\w.-]+)"', argument.text))
    kind = OBSERVER if name == "observer" else KINDS[argument.annotation]
    if kind in (OBSERVER, TEXT) and len(names) > 1:
        kind = Kind(str, functools.partial(_parse.one_of, names=names), f"<{'|'.join(names)}>", names)
    default = argument.default
    if kind.type is str and default not in (None, REQUIRED):
        default = str(default)  # as it would be typed, where it is parsed like a text
    first_sentence = re.split(r"(?<=\.) (?=[A-Z])", argument.text)[0]
    flags = (f"--{flag}/--no-{flag}" if default is True else f"--{flag}",)
    return Option(name, kind, first_sentence, default, flags, LEAST.get(name))


def flags_of(options: Iterable[Option]) -> dict[str, str]:
    """How options are typed, by the arguments of Python that they become.

    Columns are always there: results name them for the next command.
    """
    flags = {f'columns["{field}"]': f"--{field}" for field in COLUMNS}
    for option in options:
        if option.flags:
            # By what is typed too: `--model` of one command is no argument of its own verb.
            flags |= {option.typed.removeprefix("--").replace("-", "_"): option.typed, option.name: option.typed}
    return flags


def in_options(text: str, flags: Mapping[str, str]) -> str:
    """Replace arguments of Python that stand in backquotes in a text by the options that become them.

    Args:
        text: A message or a docstring, which names arguments as `alpha`, `overwrite=True`, `columns["q"]`,
            `parameters=[]` or `overrides=['measurement.std=NUMBER']`.
        flags: Options by the names of arguments.

    Example:
        >>> in_options("give `start=2` or `overrides=['design.damping=1']`, not `q0`", {"start": "--from"})
        'give --from 2 or --set design.damping=1, not `q0`'
    """

    def option(match: re.Match[str]) -> str:
        name, value = match.groups()
        if name == "overrides" and value:
            return " ".join(f"--set {shlex.quote(setting)}" for setting in ast.literal_eval(value))
        if name not in flags:
            return match[0]
        typed = {None: "", "True": "", "[]": "none"}.get(value, value)
        return f"{flags[name]} {typed}".rstrip()

    return re.sub(r'`(\w+(?:\["\w+"\])?)(?:=([^`]*))?`', option, text)
