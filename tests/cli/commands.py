"""Running a command as a machine does."""

import base64
import gzip
import json
import re
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


def unpacked(page: str, name: str) -> str:
    """What a page holds compressed, in base 85 in other letters."""
    found = re.search(rf'id="{name}" data-bytes="(\d+)">([^<]*)<', page)
    return gzip.decompress(base64.b85decode(found[2].replace(",", "<"))[: int(found[1])]).decode()
