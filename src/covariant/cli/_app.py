"""All commands. Each is in its own module, loaded when it runs, so that help is quick."""

from typing import Annotated

import typer

from covariant.cli._commands_for_design import design
from covariant.cli._commands_on_logs import on_logs
from covariant.cli._commands_on_models import on_models

app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode=None)
app.add_typer(on_logs)
app.add_typer(on_models)
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
