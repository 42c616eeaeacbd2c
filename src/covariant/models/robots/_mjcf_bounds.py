"""Limits what an MJCF file may request of MuJoCo, before compilation: copies, array sizes, and files to read."""

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from xml.etree.ElementTree import Element

from covariant._door import MESH, MOST_CELLS, MOST_ENTRIES, MOST_LINKS, check_count
from covariant.models.robots._xml import parse
from scalargraph.errors import InputError
from scalargraph.files import check_file

CELLS = {"hfield": ("nrow", "ncol"), "texture": ("width", "height"), "numeric": ("size",)}
"""Attributes that determine the size of an array, by entry."""
FOLDERS = ("meshdir", "texturedir", "assetdir")


def check_bounds(path: Path, outermost: Element) -> None:
    """Refuse an MJCF file that requests too many copies or too large arrays, or names an invalid or too large file.

    Included files are counted as part of it, and attached files each time.
    """
    files, attached = {path.resolve(): outermost}, dict[str, Element]()
    folders, todo, entries, bodies = {path.parent}, [(outermost, 1.0)], 0.0, 0.0
    while todo:
        entry, copies = todo.pop()
        copies *= _product(entry, ("count",))  # the count of `replicate` and similar entries
        entries, bodies = entries + copies, bodies + copies * (entry.tag in ("body", "composite"))
        check_count(bodies, MOST_LINKS, "bodies or more, with copies")
        check_count(entries, MOST_ENTRIES, "entries or more, with copies")
        if (cells := _product(entry, CELLS.get(entry.tag, ()))) > MOST_CELLS:
            raise InputError(f"<{entry.tag}> asks for an array of {cells:g} entries; {MOST_CELLS} are the most")
        folders |= {path.parent / entry.attrib[name] for name in FOLDERS if name in entry.attrib}
        todo += [(child, copies) for child in entry]
        if entry.tag == "attach" and entry.get("model") in attached:
            todo.append((attached[entry.get("model", "")], copies))
        for part in _parts(entry, folders):
            if entry.tag not in ("include", "model"):
                check_file(part, MESH)
                continue
            inner = files.setdefault(part.resolve(), parse(part))
            folders.add(part.parent)
            if entry.tag == "model":
                attached[entry.get("name") or inner.get("model") or part.stem] = inner
            todo.append((inner, copies))


def _parts(entry: Element, folders: set[Path]) -> Iterator[Path]:
    """Files that an entry names, in any folder to which the name may be relative."""
    names = [text for key, text in entry.attrib.items() if key.startswith("file")]
    places = {folder / each for folder in folders for name in names for each in (name, Path(name).name)}
    return filter(Path.exists, places)


def _product(entry: Element, keys: Iterable[str]) -> float:
    """Product of the numbers of attributes, 1 if there are none; MuJoCo itself refuses texts that are not numbers."""
    numbers = [number for key in keys for number in entry.get(key, "").split()]
    try:
        product = math.prod((max(float(number), 1.0) for number in numbers), start=1.0)
    except ValueError:
        return 1.0
    return product if product == product else math.inf
