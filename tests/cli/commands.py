"""Running a command as a machine does."""

import json
import sys

import pytest

from covariant.cli import main


def command(*arguments: str) -> dict:
    """Run a command with --json and return what it prints."""
    with pytest.MonkeyPatch.context() as patch:
        printed = []
        patch.setattr("builtins.print", lambda *text, **_: printed.append(text[0]))
        patch.setattr(sys, "argv", ["covariant", *arguments, "--json"])
        with pytest.raises(SystemExit) as left:
            main()
    assert left.value.code in (0, None), printed
    return json.loads(printed[-1])
