"""Names that are looked up among known ones, with a suggestion where there is none."""

import difflib
from collections.abc import Collection


def unknown(what: str, name: str, known: Collection[str]) -> str:
    """Message for an unknown name: one line that suggests the nearest known name and lists all."""
    nearest = difflib.get_close_matches(name, known, 1)
    suggestion = f" Did you mean {nearest[0]!r}?" if nearest else ""
    return f"unknown {what} {name!r}.{suggestion} Known: {', '.join(known) or 'none'}"


def refuse_unknown(what: str, name: str, known: Collection[str]) -> None:
    """Raise `ValueError` for a name that is not a known one."""
    if name not in known:
        raise ValueError(unknown(what, name, known))
