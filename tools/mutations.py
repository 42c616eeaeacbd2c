"""What can be changed in a source, one token at a time, so that the tests should notice.

Operators, comparisons, numbers with NaN and infinity, truth values, names that come in pairs (min and max, low and
high), the order of two arguments; signs and negations are dropped. Annotations, texts and errors are left as they are.
"""

import ast
import functools
import io
import itertools
import random
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src"
IN_COVARIANT = (
    *("geometry", "observers", "metrics", "certificates", "models", "logs", "simulation", "calibration", "codegen"),
    *("engine", "report", "cli", "verbs", "many"),
)
ROOMS = ("scalargraph", *(f"covariant/{room}" for room in IN_COVARIANT))

OPERATORS = {ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*"), ast.Pow: ("**", "*")}
OPERATORS |= {ast.FloorDiv: ("//", "/"), ast.BitAnd: ("&", "|"), ast.BitOr: ("|", "&")}
COMPARISONS = {ast.Lt: ("<", "<=", ">"), ast.LtE: ("<=", "<", ">="), ast.Gt: (">", ">=", "<")}
COMPARISONS |= {ast.GtE: (">=", ">", "<="), ast.Eq: ("==", "!="), ast.NotEq: ("!=", "==")}
COMPARISONS |= {ast.Is: ("is", "is not"), ast.IsNot: ("is not", "is"), ast.In: ("in", "not in")}
PAIRS = [("min", "max"), ("minimum", "maximum"), ("argmin", "argmax"), ("any", "all"), ("low", "high"), ("and", "or")]
TWINS = dict(PAIRS) | {b: a for a, b in PAIRS}
ORDERED = {"lie_bracket": -2, "connection": -2, "coadjoint": -2, "cross": -2, "curvature": -3}
"""Calls whose result changes when two neighbouring arguments change places, and where the first of the two is."""
UNSEEN = {"strict", "static", "dtype", "__all__"}
"""Keywords that assert something or settle a type, and a list of names: what they hold is not mutated."""


class Mutant(NamedTuple):
    """The bytes from `start` to `end` of a file replaced; `line` and `column` are for a person."""

    file: str
    line: int
    column: int
    new: str
    start: int
    end: int

    @property
    def id(self) -> str:
        return f"{self.file}:{self.line}:{self.column}:{self.new}"

    def apply(self, source: bytes) -> bytes:
        return source[: self.start] + self.new.encode() + source[self.end :]

    def diff(self) -> tuple[str, str]:
        """The line as it is and as the mutant has it."""
        source = (SOURCE / self.file).read_bytes()
        first, last = source.rfind(b"\n", 0, self.start) + 1, source.find(b"\n", self.end)
        changed = self.apply(source)
        return source[first:last].decode().strip(), changed[first : len(changed) - len(source) + last].decode().strip()


@functools.cache
def mutants_of(file: str) -> list[Mutant]:
    """Every mutant of a source file, in the order of its text."""
    source = (SOURCE / file).read_bytes()
    starts = [0, *(k + 1 for k, byte in enumerate(source) if byte == ord("\n"))]
    code = _without_comments(source, starts)

    def span(node: ast.AST) -> tuple[int, int]:
        return starts[node.lineno - 1] + node.col_offset, starts[node.end_lineno - 1] + node.end_col_offset

    def between(left: ast.AST, right: ast.AST, old: str) -> tuple[int, int]:
        start = code.index(old.encode(), span(left)[1], span(right)[0])
        return start, start + len(old)

    def changes(node: ast.AST) -> Iterator[tuple[tuple[int, int], str]]:
        match node:
            case ast.BinOp(left, op, right) if type(op) in OPERATORS and not _sequences(left, right):
                old, new = OPERATORS[type(op)]
                yield between(left, right, old), new
            case ast.AugAssign(target, op, value) if type(op) in OPERATORS and not _sequences(value):
                old, new = OPERATORS[type(op)]
                yield between(target, value, old + "="), new + "="
            case ast.Compare(left, ops, comparators):
                for a, op, b in zip([left, *comparators], ops, comparators, strict=False):
                    old, *news = COMPARISONS.get(type(op), ("",))
                    yield from ((between(a, b, old), new) for new in news)
            case ast.BoolOp(op, values):
                old = "and" if isinstance(op, ast.And) else "or"
                yield from ((between(a, b, old), TWINS[old]) for a, b in itertools.pairwise(values))
            case ast.UnaryOp(ast.USub() | ast.Invert() | ast.Not() as op):
                start = span(node)[0]
                yield (start, start + (4 if isinstance(op, ast.Not) else 1)), ""
            case ast.Constant(bool() | int() | float() as value):
                yield span(node), repr(_another(value))
            case ast.Attribute(attr="nan" | "inf") | ast.Call(ast.Name("float"), [ast.Constant("nan" | "inf")]):
                yield span(node), "0.0"
            case ast.Name(name, ast.Load()) | ast.Attribute(attr=name) if name in TWINS:
                end = span(node)[1]
                yield (end - len(name), end), TWINS[name]
            case ast.Call(ast.Name(name) | ast.Attribute(attr=name), [*_, _, _] as arguments) if name in ORDERED:
                pair = arguments[ORDERED[name] :][:2]
                (a, b), (c, d) = map(span, pair)
                if len(pair) == 2 and not any(isinstance(argument, ast.Starred) for argument in arguments):
                    yield (a, d), (source[c:d] + source[b:c] + source[a:b]).decode()

    found = set()
    for node in _computing(ast.parse(source)):
        for (start, end), new in changes(node):
            line = source.count(b"\n", 0, start) + 1
            found.add(Mutant(file, line, len(source[starts[line - 1] : start].decode()) + 1, new, start, end))
    return sorted(found)


def _computing(node: ast.AST) -> Iterator[ast.AST]:
    """The nodes that compute: no annotation, no decorator, nothing raised or asserted, no text, no type."""
    match node:
        case ast.Raise() | ast.Assert() | ast.JoinedStr() | ast.Import() | ast.ImportFrom():
            return
        case ast.keyword(arg=name) | ast.Assign([ast.Name(name)]) if name in UNSEEN:
            return
        case ast.Call(ast.Name("isinstance")) | ast.If(ast.Name("TYPE_CHECKING")):
            return
    yield node
    for field, value in ast.iter_fields(node):
        if field not in ("annotation", "returns", "decorator_list"):
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    yield from _computing(child)


def _sequences(*operands: ast.expr) -> bool:
    """Whether + and * join lists, of which most other operators make an error at once."""
    lists = (ast.List, ast.ListComp, ast.Tuple, ast.JoinedStr)
    return any(isinstance(o, lists) or (isinstance(o, ast.Constant) and isinstance(o.value, str)) for o in operands)


def _without_comments(source: bytes, starts: list[int]) -> bytes:
    code = bytearray(source)
    for token in tokenize.tokenize(io.BytesIO(source).readline):
        if token.type == tokenize.COMMENT:
            start = starts[token.start[0] - 1] + len(token.line[: token.start[1]].encode())
            code[start : start + len(token.string.encode())] = b" " * len(token.string.encode())
    return bytes(code)


def _another(value: bool | int | float) -> bool | int | float:
    """Another number, far enough to matter: limits and tolerances move by more than the next number."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return value + 1 if value < 100 else value // 10
    return 2 * value if 1e-6 < value < 1e6 else 1000 * value or 1.0


def draw(seed: int, count: int) -> list[Mutant]:
    """`count` of all mutants, from every room in proportion to the number it has."""
    rooms = {room: [m for file in _files(room) for m in mutants_of(file)] for room in ROOMS}
    ends = list(itertools.accumulate(map(len, rooms.values()), initial=0))
    shares = [round(count * b / ends[-1]) - round(count * a / ends[-1]) for a, b in itertools.pairwise(ends)]
    drawn = []
    for (room, mutants), share in zip(rooms.items(), shares, strict=True):
        # By room, and in an order that has nothing to do with the share: to change one room leaves the others' draw.
        shuffled = random.Random(f"{seed} {room}").sample(mutants, len(mutants))
        drawn += sorted(shuffled[:share])
    return drawn


def _files(room: str) -> list[str]:
    return [str(path.relative_to(SOURCE)) for path in sorted((SOURCE / room).rglob("*.py"))]
