"""The application: each command with its options, made for typer."""

import inspect
from collections.abc import Callable
from typing import Annotated, Any

import typer

from covariant.cli._commands import COMMANDS, Command
from covariant.cli._signature import signature

app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode=None)
design = typer.Typer(
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


for command in COMMANDS:
    group, _, name = (command.name or command.verb).rpartition(" ")
    (design if group else app).command(name)(_function(command))
app.add_typer(design, name="design")


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
