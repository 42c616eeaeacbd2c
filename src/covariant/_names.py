"""Names that are looked up among known ones, with a suggestion where there is none."""

import difflib
import re
from collections.abc import Collection

from scalargraph.errors import InputError


def did_you_mean(name: str, known: Collection[str]) -> str:
    """Suggest the nearest known name, as a sentence after a blank; empty if none is near."""
    # com means com[0] or another of its entries
    first = {each.partition("[")[0]: each for each in reversed(list(known))}
    nearest = difflib.get_close_matches(name, [*first, *known], 1)
    return f" Did you mean {first.get(nearest[0], nearest[0])!r}?" if nearest else ""


def unknown(what: str, name: str, known: Collection[str], others: Collection[str] = ()) -> str:
    """Message for an unknown name, or for one of `others`, which exist but are not covered: what to use instead."""
    if name in others:
        return f"{what} {name!r} is not covered; use one of {', '.join(known)}"
    return f"unknown {what} {name!r}.{did_you_mean(name, known)} Known: {', '.join(known) or 'none'}"


def refuse_unknown(what: str, name: str, known: Collection[str]) -> None:
    """Raise `ValueError` for a name that is not a known one."""
    if name not in known:
        raise InputError(unknown(what, name, known))


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sorting key by which numbers within names count as such."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"([0-9]+)", name) if part]
