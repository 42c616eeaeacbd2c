"""What a command is: a verb with the options of the command line, and how it is called."""

import os
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from covariant import many
from covariant.cli._console import progress_bar, show
from covariant.cli._options import COLUMNS, FLAG, TEXT, Kind, Option, flags_of, in_options, of_verb
from covariant.cli._signature import function, signature
from covariant.cli._terminal import BUG, INTERNAL_ERROR, say
from covariant.verbs import check_output, columns_of
from scalargraph.errors import InputError

OVER_LOGS = (
    Option("workers", Kind(int), "Of many logs: processes, as many as processors by default.", None, ("--workers",)),
    Option(
        "scheduler", TEXT, "Of many logs: address of a Dask scheduler whose workers compute.", None, ("--scheduler",)
    ),
)
"""Options of commands that go over many logs."""


@dataclass(frozen=True)
class Command:
    """A command. Its options are the arguments of its verb, its own ones, and `--json`.

    Attributes:
        verb: Name of a function of `covariant.verbs` or `covariant.many`.
        group: Heading of the help under which it stands.
        example: A line to try, without the name of the program.
        page: The page of the documentation that explains it.
        name: Name of the command, with its group where it is in one; by default that of the verb.
        own: Options that the verb does not have. A file to write, with `suffixes`, is checked before the verb runs.
        changes: Fields of the options of the verb, by the name of the argument, that are otherwise here.
        run: What calls the verb and shows the result; gets an `Invocation` and the values of `own`.
        exit_code: The exit code of a result; a result that is false there gives 0.
        note: What the help says beside the first paragraph of the verb's docstring.
        again: Whether a table with these columns may be of an earlier run, which is replaced unasked; the result itself
            compares its columns in the end. By default none is.
        over_logs: Whether it goes over many logs, each by itself, where `--out` is a folder.
    """

    verb: str
    group: str
    example: str
    page: str
    name: str = ""
    own: tuple[Option, ...] = ()
    changes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    run: Callable[..., Any] = lambda call, **places: call.show(call(), **places)
    exit_code: Callable[[Any], int] = lambda result: 0
    note: str = ""
    again: Callable[[list[str]], bool] = lambda columns: False
    over_logs: bool = False

    @property
    def options(self) -> list[Option]:
        """All options in the order of the help."""
        json = Option("json", FLAG, "Print one JSON object for machines.", False, ("--json",))
        return [*of_verb(self.verb, self.changes), *self.own, *(OVER_LOGS if self.over_logs else ()), json]

    def __call__(self, values: dict[str, Any]) -> int:
        """Run the command with what typer read for each option; returns the exit code."""
        options = self.options
        flags = flags_of(options)
        try:
            read = {option.name: option.read(values[option.name]) for option in options}
            json, own = read.pop("json"), {option.name: read.pop(option.name) for option in self.own}
            if self.over_logs:
                crew = {option.name: read.pop(option.name) for option in OVER_LOGS}
                if self._is_folder(own["out"], read["log"]):
                    return self._over_logs(read, own, crew, json, flags)
                if any(each is not None for each in crew.values()):
                    raise InputError("`workers` and `scheduler` are for many logs; give --out FOLDER")
                if self.verb != "fit":
                    read["log"] = read["log"][0]
            for option in self.own:
                overwrite = option.name != "out" or own.get("overwrite", True) or self._is_of_earlier_run(own, read)
                if option.suffixes:
                    check_output(own[option.name], *option.suffixes, log=read.get("log"), overwrite=overwrite)
            given = {name: value for name, value in read.items() if value is not None}
            result = self.run(Invocation(self.verb, json, given, flags), **own)
            return int(self.exit_code(result))
        except KeyboardInterrupt as stopped:
            say(f"covariant: {str(stopped) or 'stopped'}", sys.stderr)
            raise SystemExit(130) from None  # 128 + 2, what shells report of a process that SIGINT ended
        except InputError as error:
            error.args = (in_options(str(error), flags),)
            raise

    def _is_of_earlier_run(self, own: dict[str, Any], read: dict[str, Any]) -> bool:
        """Whether the file to write may be of an earlier run: a table, and not one as the log is."""
        columns = None if own["out"] is None else columns_of(own["out"])
        log = read.get("log")
        is_log = isinstance(log, Path) and columns_of(log) == columns
        return columns is not None and self.again(columns) and not is_log

    def _is_folder(self, out: Path | None, logs: list[Path]) -> bool:
        """Whether each log is computed by itself."""
        if len(logs) > 1 and self.verb != "fit" and out is not None and out.suffix and not out.is_dir():
            raise InputError(f"--out {out}: of several logs it is a folder; give its name without a suffix")
        return (out is not None and (not out.suffix or out.is_dir())) or (len(logs) > 1 and self.verb != "fit")

    def _over_logs(self, read: Any, own: Any, crew: Any, json: bool, flags: Mapping[str, str]) -> int:
        asked = [option.typed for option in self.own if option.name != "out" and own[option.name]]
        if asked:
            raise InputError(f"{asked[0]} is for one log; of many, --out FOLDER has a page and a file of each")
        call = Invocation(self.verb, json, {name: value for name, value in read.items() if value is not None}, flags)
        if crew["scheduler"] is None and crew["workers"] is None:
            crew["workers"] = os.cpu_count()
        with progress_bar(json) as progress:
            arguments = call.arguments(self.verb)
            model, logs = arguments.pop("model"), arguments.pop("log")
            result = many.over_logs(self.verb, model, logs, out=own["out"], progress=progress, **crew, **arguments)
        call.show(result)
        for name, trace in result.bugs.items():
            say(f"{name}: {trace}", sys.stderr)
        if result.bugs:
            say(f"covariant: {BUG}", sys.stderr)
        return INTERNAL_ERROR if result.bugs else int(result.wrong)


@dataclass(frozen=True)
class Invocation:
    """A verb with the arguments that the command line gave.

    Attributes:
        verb: Name of the verb.
        json: Whether the result is printed as a JSON object.
        values: The arguments that were given, by name; a field of `columns` has its own name.
        flags: How the options of the command are typed, for messages.
    """

    verb: str
    json: bool
    values: dict[str, Any]
    flags: Mapping[str, str]

    def __call__(self, verb: str = "", **more: Any) -> Any:
        """Call the verb, or another one with those of the arguments that it has, and show the progress."""
        verb = verb or self.verb
        arguments = self.arguments(verb, **more)
        with progress_bar(self.json) as progress:
            if signature(verb).progress:
                arguments["progress"] = progress
            return function(verb)(**arguments)

    def arguments(self, verb: str, **more: Any) -> dict[str, Any]:
        """Those of the arguments that a verb has."""
        known = signature(verb).arguments
        arguments = {name: value for name, value in (self.values | more).items() if name in known}
        if "columns" in known:
            arguments["columns"] = {name: self.values[name] for name in COLUMNS if name in self.values}
        return arguments

    def show(self, result: Any, *places: Any, **named: Any) -> Any:
        """Print and save a result; returns it."""
        show(result, self.json, *places, words=self.words, **named)
        return result

    def words(self, text: str) -> str:
        """Text of the library in the words of the command line."""
        return in_options(text, self.flags)
