"""Names that are looked up among known ones, with a suggestion where there is none."""

import difflib
from collections.abc import Collection


def did_you_mean(name: str, known: Collection[str]) -> str:
    """Suggest the nearest known name, as a sentence after a blank; empty if none is near."""
    lists = (each.partition("[")[0] for each in known)  # com[0] and com[1] are meant by com
    nearest = difflib.get_close_matches(name, [*known, *lists], 1)
    return f" Did you mean {nearest[0]!r}?" if nearest else ""


def unknown(what: str, name: str, known: Collection[str]) -> str:
    """Message for an unknown name: one line that suggests the nearest known name and lists all."""
    return f"unknown {what} {name!r}.{did_you_mean(name, known)} Known: {', '.join(known) or 'none'}"


def refuse_unknown(what: str, name: str, known: Collection[str]) -> None:
    """Raise `ValueError` for a name that is not a known one."""
    if name not in known:
        raise ValueError(unknown(what, name, known))
