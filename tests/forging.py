"""Saved certificates that somebody changed, each with the digest that goes with what it says."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from scalargraph.proofs import digest

MISSING = object()
Change = Callable[[dict], Any]


def put(place: str, value: Any = MISSING) -> Change:
    """Put a value at a place such as `claims[0].square`: one made from the value there, or none at all."""
    *path, last = (int(key) if re.fullmatch(r"-?\d+", key) else key for key in re.findall(r"[^.[\]]+", place))

    def change(document):
        target: Any = document
        for key in path:
            target = target[key]
        if value is MISSING:
            target.pop(last)
        else:
            target[last] = value(target[last]) if callable(value) else value

    return change


def together(*changes: Change) -> Change:
    return lambda document: [change(document) for change in changes]


def mended(document: dict) -> str:
    """The text of a certificate with the digest of what it says."""
    return json.dumps(document | {"digest": digest(document)}, ensure_ascii=False)


def forged(original: str | Path, folder: Path, change: Change, name: str = "forged.json") -> Path:
    """Write a certificate, given by its text or file, as somebody changed it."""
    document = json.loads(original if isinstance(original, str) else original.read_text(encoding="utf-8"))
    change(document)
    path = folder / name
    path.write_text(mended(document), encoding="utf-8")
    return path
