"""The house in one picture: every room on a floor above those that it imports, drawn from the imports themselves."""

import ast
import textwrap
from html import escape
from pathlib import Path
from typing import NamedTuple

BOX, HEIGHT, GAP, LINE = 264, 74, 26, 40  # pixels: width and height of a room, between rooms, characters of its text
FLOOR = HEIGHT + 38
NARROW = 30  # of a line that passes a floor


class House(NamedTuple):
    """What each room says it is, the rooms that it imports, and the private files that all may use."""

    about: dict[str, str]
    imports: dict[str, set[str]]
    common: list[str]


def read(source: Path) -> House:
    """The rooms of a package from its text alone."""
    about, imports = {}, {}
    for path in sorted(source.rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        room = path.relative_to(source).parts[0].removesuffix(".py")
        if path.parent == source or (path.parent.parent == source and path.name == "__init__.py"):
            about[room] = _first_sentence(ast.get_docstring(tree) or "")
        imports.setdefault(room, set()).update(_imported(tree) - {room})
    rooms = [name for name in about if not name.startswith("_")]
    common = [name for name in about if name.startswith("_") and name != "__init__"]
    return House({r: about[r] for r in rooms}, {r: imports[r] & {*rooms} for r in rooms}, common)


def _first_sentence(text: str) -> str:
    return text.split("\n\n")[0].replace("\n", " ").replace("`", "").split(". ")[0].removesuffix(".")


def _imported(tree: ast.Module) -> set[str]:
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    return {name.split(".")[1] for name in names if name.startswith("covariant.")}


def below(imports: dict[str, set[str]], room: str) -> set[str]:
    """Every room that a room rests on, directly or through others."""
    found, rest = set(), [room]
    while rest:
        new = imports[rest.pop()] - found
        found |= new
        rest += new
    return found


def lines(imports: dict[str, set[str]]) -> dict[str, set[str]]:
    """The imports without those that follow from others."""
    under = {room: below(imports, room) for room in imports}
    return {room: {r for r in under[room] if not any(r in under[o] for o in under[room])} for room in imports}


def floors(drawn: dict[str, set[str]]) -> dict[str, int]:
    """The floor of each room: above all it rests on, and else as close as may be below those that rest on it."""
    floor: dict[str, int] = {}
    while len(floor) < len(drawn):
        floor |= {r: max((floor[o] for o in drawn[r]), default=-1) + 1 for r in drawn if drawn[r] <= floor.keys()}
    for room in sorted(drawn, key=floor.__getitem__, reverse=True):
        users = [floor[other] for other in drawn if room in drawn[other]]
        floor[room] = min(users) - 1 if users else floor[room]
    return floor


def paths(drawn: dict[str, set[str]], floor: dict[str, int]) -> list[list[tuple[str, int]]]:
    """Every line as the places (name, floor) that it goes through, from the top; between rooms it has its own name."""
    found = []
    for room in sorted(drawn):
        for other in sorted(drawn[room]):
            between = [(f"{room}>{other}", k) for k in range(floor[room] - 1, floor[other], -1)]
            found.append([(room, floor[room]), *between, (other, floor[other])])
    return found


def arranged(floor: dict[str, int], ways: list[list[tuple[str, int]]]) -> dict[tuple[str, int], float]:
    """The middle of every place on its floor [pixels]: rooms stand near those that they are joined to."""
    places = {*floor.items(), *(place for way in ways for place in way)}
    rows = [sorted(p for p in places if p[1] == k) for k in range(max(floor.values()) + 1)]
    joined = {p: [q for way in ways for q in way if p in way and abs(way.index(p) - way.index(q)) == 1] for p in places}
    middle: dict[tuple[str, int], float] = {}
    for row in rows:
        _put(row, middle)
    for _ in range(8):
        for row in [*rows, *reversed(rows)]:
            wish = {p: sum(middle[q] for q in joined[p]) / max(len(joined[p]), 1) for p in row}
            row.sort(key=lambda p: (wish[p], p))
            _put(row, middle)
    return middle


def _put(row: list[tuple[str, int]], middle: dict[tuple[str, int], float]) -> None:
    """Side by side, the floor in the middle."""
    widths = [NARROW if ">" in name else BOX for name, _ in row]
    x = -(sum(widths) + GAP * (len(row) - 1)) / 2
    for place, width in zip(row, widths, strict=True):
        middle[place] = x + width / 2
        x += width + GAP


def drawing(source: Path) -> str:
    """The picture as SVG."""
    house = read(source)
    drawn = lines(house.imports)
    floor = floors(drawn)
    ways = paths(drawn, floor)
    middle = arranged(floor, ways)
    half = max(abs(x) for x in middle.values()) + BOX / 2 + GAP
    top = max(floor.values())

    def at(place: tuple[str, int]) -> tuple[float, float]:
        return half + middle[place], 70 + (top - place[1]) * FLOOR

    parts = [_line([at(place) for place in way]) for way in ways]
    parts += [_room(room, house.about[room], *at((room, floor[room]))) for room in sorted(floor)]
    ground = 70 + (top + 1) * FLOOR
    parts.append(_ground(house.common, half, ground - 14))
    title = "A room uses the rooms that its lines lead down to and whatever those rest on, never one above."
    parts.append(f'<text x="{half:g}" y="34" font-size="15" text-anchor="middle">{title}</text>')
    return _svg(2 * half, ground + 44, parts)


def _svg(width: float, height: float, parts: list[str]) -> str:
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" '
        'font-family="system-ui, sans-serif" fill="#1b2733">'
    )
    return "\n".join([head, f'<rect width="{width:g}" height="{height:g}" fill="#ffffff"/>', *parts, "</svg>", ""])


def _line(points: list[tuple[float, float]]) -> str:
    """From the foot of the first room to the head of the last, straight past the floors between."""
    (x, y), *between, (end, foot) = points
    path, y = [f"M{x:g} {y + HEIGHT:g}"], y + HEIGHT
    stops = [(px, h) for px, py in between for h in (py, py + HEIGHT)]
    for nx, ny in [*stops, (end, foot)]:
        bend = (y + ny) / 2
        path.append(f"C{x:g} {bend:g} {nx:g} {bend:g} {nx:g} {ny:g}" if nx != x else f"L{nx:g} {ny:g}")
        x, y = nx, ny
    return f'<path d="{" ".join(path)}" fill="none" stroke="#7a8ca0" stroke-width="1.6"/>'


def _room(name: str, about: str, x: float, y: float) -> str:
    text = textwrap.wrap(about, LINE, max_lines=3, placeholder=" …")
    rows = [f'<tspan x="{x:g}" dy="{14 if k else 0}">{escape(row)}</tspan>' for k, row in enumerate(text)]
    return "\n".join(
        [
            f'<rect x="{x - BOX / 2:g}" y="{y:g}" width="{BOX}" height="{HEIGHT}" rx="6" '
            'fill="#eef3f8" stroke="#4a6784"/>',
            f'<text x="{x:g}" y="{y + 19:g}" font-size="15" font-weight="600" text-anchor="middle">{name}</text>',
            f'<text x="{x:g}" y="{y + 36:g}" font-size="11.5" text-anchor="middle">{"".join(rows)}</text>',
        ]
    )


def _ground(common: list[str], half: float, y: float) -> str:
    return (
        f'<rect x="{GAP}" y="{y:g}" width="{2 * half - 2 * GAP:g}" height="34" rx="6" fill="#f6efe2" '
        f'stroke="#8a7550"/>\n<text x="{half:g}" y="{y + 22:g}" font-size="13" text-anchor="middle">'
        f"for every room: {' · '.join(common)}</text>"
    )
