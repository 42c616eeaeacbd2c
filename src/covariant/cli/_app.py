"""The application: each command with its options, made for typer."""

import inspect
from collections.abc import Callable
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from covariant.cli._command import Command
from covariant.cli._commands import COMMANDS
from covariant.cli._signature import signature
from scalargraph.errors import InputError

WIDEST = 120
"""Columns of the help in a terminal that has as many; longer lines are hard to read."""
NO_LAWS = "an export does not measure laws of the observer; leave it out"
SMOOTH = "`covariant smooth MODEL LOG`, with --lag SECONDS or all rows after each, writes smoothed estimates"
REMOVED = {
    "audit": "the laws are tests of the library; `covariant certify` proves that an observer converges",
    "cite": "CITATION.cff and the page of each paper say what to cite",
    "compare --force": "`covariant estimate` writes forces; benchmarks/forces.py compares estimators of them",
    "estimate --lag": SMOOTH,
    "estimate --smooth": SMOOTH,
    "export --audit": NO_LAWS,
    "export --flash": "compile with -Os where memory is small, and keep `--parameters` few; see docs/firmware.md",
    "export --no-audit": NO_LAWS,
}
"""Commands and options that are gone, and what replaces them."""


class Grouped(TyperGroup):
    """A group whose help lists its commands by what they are for, each with its whole first sentence."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        command, *rest = args
        for name in (command, *(f"{command} {word.partition('=')[0]}" for word in rest)):
            if name in REMOVED:
                raise InputError(f"`{name}` is gone: {REMOVED[name]}")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        listed = {name: self.commands[name] for name in self.list_commands(ctx)}
        rows = {name: each.get_short_help_str(limit=10**6) for name, each in listed.items()}
        widest = max(map(len, rows))
        for group in dict.fromkeys(GROUPS.get(name, "Commands") for name in rows):
            with formatter.section(group):
                parts = {name: text for name, text in rows.items() if GROUPS.get(name, "Commands") == group}
                # The longest name of all commands sets the column, so that the texts of all groups begin in one.
                formatter.write_dl([(name.ljust(widest), text) for name, text in parts.items()])


app = typer.Typer(
    cls=Grouped,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"max_content_width": WIDEST},
)
design = typer.Typer(
    cls=Grouped,
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Design what an observer needs: a metric, an injection, or a motion that shows numbers of a robot.",
)


def _function(command: Command) -> Callable[..., None]:
    """Function from whose signature typer makes the command."""

    def call(**values: Any) -> None:
        raise typer.Exit(command(values))

    parameters = [option.parameter() for option in command.options]
    call.__doc__ = "\n\n".join(filter(None, (signature(command.verb).summary, command.note)))
    call.__signature__ = inspect.Signature(parameters)  # pyright: ignore[reportFunctionMemberAccess]
    call.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return call


def _epilog(command: Command) -> str:
    """The end of the help: a line to try, and the page that explains it. The mark \\b keeps their lines apart."""
    return f"\b\nExample:  covariant {command.example}\nPage:     {command.page}"


GROUPS = {(command.name or command.verb).partition(" ")[0]: command.group for command in COMMANDS}
for command in COMMANDS:
    group, _, name = (command.name or command.verb).rpartition(" ")
    if group and group not in {each.name for each in app.registered_groups}:
        app.add_typer(design, name=group)
    (design if group else app).command(name, epilog=_epilog(command))(_function(command))


def _version(asked: bool) -> bool:
    if asked:
        from importlib.metadata import version

        print(f"covariant {version('covariant')}")
        raise typer.Exit
    return asked


@app.callback()
def covariant(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Say which version this is.")
    ] = False,
) -> None:
    """Velocities and states from measured positions: observers, their proofs, their comparison."""
