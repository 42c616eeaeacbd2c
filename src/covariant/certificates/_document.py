"""A saved certificate is data: the one parser that reads it, and the writer.

A file may come from anybody. Here it is read once, and becomes a `Document` of checked numbers, or a `ValueError` of
one line that names the file and the key, what was found there and what was wanted. Nothing is run, imported or
believed: whether the numbers make a proof is for `check` to say. The digest tells damage, and not forgery, since
whoever changes a file can mend it.
"""

import functools
import hashlib
import json
import re
import reprlib
import string
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal, NamedTuple, NoReturn

import numpy as np
from jaxtyping import Float

from covariant._files import write_atomically
from covariant.lowering import FOLD

FORMAT = "covariant certificate 2"
LETTERS = string.ascii_letters
"""One for each variable across whose middle a box is halved; a leaf is a dot, an open one a question mark."""
MOST_BYTES, MOST_VALUES, DEEPEST = 64 * 2**20, 2_000_000, 8
"""Size of a file, values in it, and how deeply they are nested: looked at before anything is made of them."""
MOST_PARTS = len(LETTERS) // 3
"""Velocities of a system whose variables have a letter each; so its parameters are no longer, and it is soon made."""
CHUNK = 2**20
"""Bytes that are looked at together."""
MOST_LEVELS, MOST_LETTERS = 400, 10**7
"""Of a tree, and of all trees together."""
LARGEST = 1e150
"""The products of two numbers of a file, and sums of those, are finite."""
REMEDY = "ask for the file as it was saved, or certify again"

KEYS = [
    *("format", "recipe", "observer", "q", "rate", "radius", "velocity", "given", "box", "claims", "graph", "digest"),
]
OBSERVERS: dict[str, dict[str, Any]] = {
    "intrinsic": {"order": (1, 2), "coefficients": ("measured", "estimated"), "curvature": bool},
    "geodesic": {"curvature": bool},
}
"""Beside the gains, the fields of each kind of observer: what they may be, or a truth."""
FRAMES = ("coordinates", "body")
"""What vectors are written in. In the body the configuration is none of the variables of a region."""
ARGUMENTS = {op: range(n := getattr(fold, "nin", 3), n + 1) for op, fold in FOLD.items()}
ARGUMENTS |= {"either": range(4, 5), "stumpff": range(2, 3)}
"""Operations of a graph of scalars, and how many arguments they take."""


Kind = Literal["contraction", "reach", "disturbance"]
NUMBERS: dict[Kind, list[str]] = {"contraction": [], "reach": ["row", "square", "limit"], "disturbance": ["square"]}
"""What each kind of claim says beside its tree of boxes."""


class Given(NamedTuple):
    """What bounds the force and the measurements.

    - `positions` (2, p), `inputs` (2, m), `times` (2,) [s]: least and largest ones.
    - `noise`, `disturbance` (n,): bounds of the error of measured positions, and of a force that the model lacks.
    - `slopes` (n, n): bounds of the derivatives of the force by the position; 0 where there is no noise.
    """

    positions: Float[np.ndarray, "2 p"]
    inputs: Float[np.ndarray, "2 m"]
    times: Float[np.ndarray, "2"]
    noise: Float[np.ndarray, "n"]
    disturbance: Float[np.ndarray, "n"]
    slopes: Float[np.ndarray, "n n"]


class Stated(NamedTuple):
    """A claim as a file states it: "contraction", "reach" of a `row` by `square` up to `limit`, or "disturbance".

    `levels`: its tree of boxes, a string a level.
    """

    kind: Kind
    levels: tuple[str, ...]
    row: int = 0
    square: float = 0.0
    limit: float = 0.0

    @property
    def open(self) -> bool:
        """Whether boxes are left that nothing decides."""
        return any("?" in level for level in self.levels)


class Document(NamedTuple):
    """What a file says, of the right kinds and sizes.

    - `recipe`: {"system": name} or {"attribute": "module:attribute"}, and its "parameters": names, not yet looked up.
    - `observer`: "kind", "frame", "alpha", "beta" and the options of that kind; `q` (2, 2): the matrix of its metric.
    - `rate` [1/s], `radius`: the radius is 0 where a claim is open; `velocity` (n,).
    - `low`, `high` (d,): the box of all claims.
    - `graph`: {"nodes": rows, "outputs": whole numbers}, a graph of scalars that points backwards only.
    """

    file: str
    recipe: dict[str, Any]
    observer: dict[str, Any]
    q: Float[np.ndarray, "2 2"]
    rate: float
    radius: float
    velocity: Float[np.ndarray, "n"]
    given: Given
    low: Float[np.ndarray, "d"]
    high: Float[np.ndarray, "d"]
    claims: tuple[Stated, ...]
    graph: dict[str, list]

    @property
    def open(self) -> bool:
        """Whether any claim is open."""
        return any(claim.open for claim in self.claims)


def parse(path: str | Path) -> Document:
    """Read a certificate. Raises `ValueError`, one line, where it cannot be read or is not one."""
    return parse_bytes(path, read(path))


def read(path: str | Path) -> bytes:
    """The content of a file, which is read once. Raises `ValueError` where there is none, or too much."""
    file = name(path)
    try:
        if not Path(path).is_file():  # a pipe or a device may never end
            missing = "is no file" if Path(path).exists() else "does not exist"
            raise ValueError(f"{file} {missing}; give the path of a saved certificate")
        with Path(path).open("rb") as opened:
            content = opened.read(MOST_BYTES + 1)
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise ValueError(f"{file} cannot be read: {reason}; give the path of a saved certificate") from error
    if len(content) > MOST_BYTES:
        raise ValueError(f"{file} is larger than a certificate may be, {MOST_BYTES >> 20} MiB; {REMEDY}")
    return content


def name(path: str | Path) -> str:
    """A path in one line."""
    return str(path) if str(path).isprintable() else ascii(str(path))


def parse_bytes(path: str | Path, content: bytes) -> Document:
    """What the content of a file says. Raises `ValueError`, one line."""
    file = name(path)
    top = _Field(file, "", _values(file, content))
    top.need(isinstance(top.value, dict) and "format" in top.value, "a certificate with a format")
    top.at("format").need(top.value["format"] == FORMAT, f"{FORMAT!r}; this version reads no other")
    fields = top.record(KEYS)
    found = digest(top.value)
    wanted = f"{found} for what the file says; it was changed since it was saved"
    fields["digest"].need(fields["digest"].value == found, wanted)
    observer, velocity = _observer(fields["observer"]), fields["velocity"].vector(1, MOST_PARTS, least=0.0)
    fields["velocity"].need((velocity > 0).all(), "positive numbers")
    n = len(velocity)
    variables = n * (4 if observer["frame"] == "coordinates" else 3)
    low, high = fields["box"].pair(variables, variables)
    claims = _claims(fields["claims"], n, variables)
    return Document(
        file,
        _recipe(fields["recipe"]),
        observer,
        _metric(fields["q"]),
        fields["rate"].positive(),
        _radius(fields["radius"], any(claim.open for claim in claims)),
        velocity,
        _given(fields["given"], n),
        low,
        high,
        claims,
        _graph(fields["graph"]),
    )


def digest(document: dict[str, Any]) -> str:
    """SHA-256 of everything in a certificate but the digest itself, in one canonical spelling."""
    rest = {key: value for key, value in document.items() if key != "digest"}
    text = json.dumps(rest, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.sha256(text.encode("utf-8")).hexdigest()


def write(path: str | Path, document: dict[str, Any]) -> Path:
    """Write a certificate. Raises `ValueError` for what `parse` would not read, and then writes nothing."""
    try:
        content = json.dumps(document, indent=1, ensure_ascii=False).encode("utf-8")
        parse_bytes(path, content)
    except (TypeError, ValueError) as error:
        raise ValueError(f"nothing is written, since it could not be read again: {error}") from error
    return write_atomically(path, lambda file: file.write(content))


# From bytes to plain values.


def _values(file: str, content: bytes) -> Any:
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{file} is no text in UTF-8, at byte {error.start}; {REMEDY}") from error
    if "\\" in text:
        line = 1 + text.count("\n", 0, text.index("\\"))
        raise ValueError(f"{file} has a backslash on line {line}, and the strings of a certificate have none; {REMEDY}")
    if text.count(",") >= MOST_VALUES:
        raise ValueError(f"{file} holds more than {MOST_VALUES} values; {REMEDY}")
    if _depth(content) > DEEPEST:
        raise ValueError(f"{file} is nested more than {DEEPEST} deep; {REMEDY}")

    try:
        # Numbers beyond all bounds become infinite here, and are refused by the key that holds them.
        return json.loads(
            text, object_pairs_hook=functools.partial(_once, file), parse_constant=float, parse_int=_whole
        )
    except json.JSONDecodeError as error:
        where = f"line {error.lineno}, column {error.colno}"
        raise ValueError(f"{file} is not JSON: {error.msg} at {where}; {REMEDY}") from error


def _once(file: str, pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object, in which no key is twice."""
    found = dict(pairs)
    if len(found) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"{file}: the key {brief(twice)} is there twice; {REMEDY}")
    return found


def _depth(content: bytes) -> int:
    """How deeply brackets are nested, those in strings left out; a string that is not closed ends with the file."""
    depth, deepest, quoted = 0, 0, False
    for start in range(0, len(content), CHUNK):
        letters = np.frombuffer(content[start : start + CHUNK], np.uint8)
        inside = np.logical_xor.accumulate(np.append(quoted, letters == ord('"')))[1:]
        opened, closed = np.isin(letters, list(b"[{")) & ~inside, np.isin(letters, list(b"]}")) & ~inside
        depths = depth + np.cumsum(opened.astype(int) - closed)
        depth, deepest, quoted = int(depths[-1]), max(deepest, int(depths.max())), bool(inside[-1])
    return deepest


def _whole(digits: str) -> int | float:
    return int(digits) if len(digits) < 16 else float(digits)


def brief(value: Any) -> str:
    """A value in one short line."""
    short = reprlib.Repr()
    short.maxstring = short.maxother = short.maxlong = 60
    return short.repr(value)


# From plain values to checked ones.


class _Field(NamedTuple):
    """A value, and where it is: the file, and the key from the top, such as `claims[2].levels`."""

    file: str
    key: str
    value: Any

    def refuse(self, wanted: str) -> NoReturn:
        what = f"{self.file}: {self.key}" if self.key else self.file
        raise ValueError(f"{what} must be {wanted}; found {brief(self.value)}; {REMEDY}")

    def need(self, holds: Any, wanted: str) -> None:
        if not holds:
            self.refuse(wanted)

    def at(self, key: str) -> "_Field":
        return _Field(self.file, f"{self.key}.{key}" if self.key else key, self.value[key])

    def record(self, keys: list[str]) -> dict[str, "_Field"]:
        """The entries of an object that has these keys and no others."""
        self.need(isinstance(self.value, dict), f"an object with {', '.join(keys)}")
        for wrong, how in (
            (self.value.keys() - set(keys), "is not known"),
            (set(keys) - self.value.keys(), "is missing"),
        ):
            if wrong:
                key = f"{self.key}.{brief(min(wrong))}" if self.key else brief(min(wrong))
                raise ValueError(f"{self.file}: the key {key} {how}; wanted are {', '.join(keys)}; {REMEDY}")
        return {key: self.at(key) for key in keys}

    def rows(self, least: int, most: int) -> list["_Field"]:
        """The entries of a list."""
        several = f"{least}" if least == most else f"{least} to {most}"
        self.need(isinstance(self.value, list) and least <= len(self.value) <= most, f"a list of {several} entries")
        return [_Field(self.file, f"{self.key}[{k}]", value) for k, value in enumerate(self.value)]

    def number(self) -> float:
        """A number, which a truth is not."""
        self.need(_is_number(self.value), f"a finite number, below {LARGEST:g}")
        return float(self.value)

    def positive(self) -> float:
        found = self.number()
        self.need(found > 0, "a positive number")
        return found

    def whole(self, least: int, most: int) -> int:
        self.need(type(self.value) is int and least <= self.value <= most, f"a whole number from {least} to {most}")
        return self.value

    def text(self, most: int) -> str:
        fits = type(self.value) is str and len(self.value) <= most and self.value.isprintable()
        self.need(fits, f"a text of {most} letters at most")
        return self.value

    def one_of(self, choices: Any) -> Any:
        fits = any(type(self.value) is type(choice) and self.value == choice for choice in choices)
        self.need(fits, f"one of {', '.join(map(repr, choices))}")
        return self.value

    def vector(self, fewest: int, most: int, least: float = -LARGEST) -> np.ndarray:
        """Numbers, none of them below `least`."""
        numbers = self.rows(fewest, most)
        for number in numbers:
            number.need(number.number() >= least, f"{least:g} or larger")
        return np.array([number.number() for number in numbers], float)

    def pair(self, fewest: int, most: int) -> np.ndarray:
        """Bounds {"low", "high"} of some variables (2, k)."""
        fields = self.record(["low", "high"])
        low = fields["low"].vector(fewest, most)
        high = fields["high"].vector(len(low), len(low))
        for k, field in enumerate(fields["high"].rows(0, most)):
            field.need(low[k] <= high[k], f"{low[k]:g} or larger, as its lower bound")
        return np.stack([low, high])


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) <= LARGEST


def _recipe(field: _Field) -> dict[str, Any]:
    field.need(isinstance(field.value, dict), "an object with a system, or an attribute, and its parameters")
    source = "attribute" if "attribute" in field.value else "system"
    fields = field.record([source, "parameters"])
    words = fields[source].text(200)
    if source == "attribute":
        fields[source].need(re.fullmatch(r"[^:]+:[^:]+", words), "module:attribute")
    parameters = fields["parameters"]
    parameters.need(
        isinstance(parameters.value, dict) and len(parameters.value) <= 64, "an object of 64 values at most"
    )
    for key in parameters.value:
        _Field(field.file, f"the name of a parameter in {parameters.key}", key).need(key.isidentifier(), "a name")
    most = MOST_PARTS if source == "system" else 100
    return {source: words, "parameters": {key: _parameter(parameters.at(key), most) for key in parameters.value}}


def _parameter(field: _Field, most: int, deep: int = 2) -> Any:
    """A number, a truth, a text, or numbers in a list or in a list of lists, each of `most` entries."""
    if deep == 2 and isinstance(field.value, bool):
        return field.value
    if deep == 2 and isinstance(field.value, str):
        return field.text(200)
    if deep and isinstance(field.value, list):
        return [_parameter(row, most, deep - 1) for row in field.rows(0, most)]
    field.number()
    return field.value


def _observer(field: _Field) -> dict[str, Any]:
    field.need(isinstance(field.value, dict) and "kind" in field.value, "an object with the kind of the observer")
    kind = field.at("kind").one_of(tuple(OBSERVERS))
    schema = OBSERVERS[kind]
    fields = field.record(["kind", "frame", "alpha", "beta", *schema])
    frame = fields["frame"].one_of(FRAMES)
    options = {
        key: fields[key].one_of((True, False) if choices is bool else choices) for key, choices in schema.items()
    }
    gains = {key: fields[key].positive() for key in ("alpha", "beta")}
    return {"kind": kind, "frame": frame, **gains, **options}


def _metric(field: _Field) -> np.ndarray:
    q = np.stack([row.vector(2, 2) for row in field.rows(2, 2)])
    (a, c), (d, b) = [[Fraction(number) for number in row] for row in q.tolist()]
    field.need(c == d and a > 0 and a * b > c * c, "a positive definite matrix [[a, c], [c, b]]")
    return q


def _radius(field: _Field, is_open: bool) -> float:
    if not is_open:
        return field.positive()
    field.need(field.number() == 0, "0 where a claim has open leaves")
    return 0.0


def _given(field: _Field, n: int) -> Given:
    fields = field.record(["positions", "inputs", "times", "noise", "disturbance", "slopes"])
    times = fields["times"].vector(2, 2)
    fields["times"].need(times[0] <= times[1], "two times, the earlier one first")
    noise, disturbance = (fields[key].vector(n, n, least=0.0) for key in ("noise", "disturbance"))
    slopes = np.stack([row.vector(n, n, least=0.0) for row in fields["slopes"].rows(n, n)])
    return Given(fields["positions"].pair(1, 400), fields["inputs"].pair(0, 100), times, noise, disturbance, slopes)


def _claims(field: _Field, n: int, variables: int) -> tuple[Stated, ...]:
    """Contraction, then a reach of each of the 2n rows, then what noise and disturbance add, if there are any."""
    rows = field.rows(1, 2 * n + 2)
    claims = [_claim(row, k, n, variables) for k, row in enumerate(rows)]
    if sum(len(level) for claim in claims for level in claim.levels) > MOST_LETTERS:
        raise ValueError(f"{field.file}: the levels of {field.key} hold more than {MOST_LETTERS} letters; {REMEDY}")
    complete = len(rows) > 2 * n or (len(rows) == 1 and claims[0].open)
    field.need(complete, f"contraction, and reach of rows 0 to {2 * n - 1}")
    return tuple(claims)


def _claim(field: _Field, k: int, n: int, variables: int) -> Stated:
    field.need(isinstance(field.value, dict) and "kind" in field.value, "an object with the kind of the claim")
    kind: Kind = "contraction" if k == 0 else "reach" if k <= 2 * n else "disturbance"
    field.at("kind").one_of((kind,))
    fields = field.record(["kind", *NUMBERS[kind], "levels"])
    numbers: dict[str, Any] = {key: fields[key].positive() for key in NUMBERS[kind] if key != "row"}
    if kind == "reach":
        numbers["row"] = fields["row"].whole(k - 1, k - 1)
    return Stated(kind, _levels(fields["levels"], variables), **numbers)


def _levels(field: _Field, variables: int) -> tuple[str, ...]:
    """The levels of a tree that covers its box: both halves of each box that is halved are there."""
    rows, known, size = field.rows(1, MOST_LEVELS), set(LETTERS[:variables]) | {".", "?"}, 1
    for row in rows:
        fits = type(row.value) is str and len(row.value) == size and known >= set(row.value)
        row.need(fits, f"{size} of the letters a to {LETTERS[variables - 1]}, dots and question marks")
        size = 2 * (size - row.value.count(".") - row.value.count("?"))
    field.need(size == 0, f"levels down to the last boxes, of which {size} are missing")
    return tuple(row.value for row in rows)


def _graph(field: _Field) -> dict[str, list]:
    fields = field.record(["nodes", "outputs"])
    nodes, outputs = fields["nodes"], fields["outputs"]
    nodes.need(isinstance(nodes.value, list), "a list of rows")
    for k, row in enumerate(nodes.value):
        if not _is_node(row, k):
            wanted = "[operation, numbers of earlier rows ...], ['input', number] or ['constant', value]"
            _Field(field.file, f"{nodes.key}[{k}]", row).refuse(wanted)
    rows = outputs.rows(0, MOST_VALUES)
    return {"nodes": nodes.value, "outputs": [row.whole(0, len(nodes.value) - 1) for row in rows]}


def _is_node(row: Any, k: int) -> bool:
    """Whether this is row k of a graph: a constant, an input, or an operation on rows before it."""
    if not (type(row) is list and row and type(row[0]) is str):
        return False
    op, *arguments = row
    if op == "constant":
        return len(arguments) == 1 and (type(arguments[0]) is bool or _is_number(arguments[0]))
    if op == "input":
        return len(arguments) == 1 and type(arguments[0]) is int and 0 <= arguments[0] <= 9999
    known = op in ARGUMENTS and len(arguments) in ARGUMENTS[op]
    return known and all(type(argument) is int and 0 <= argument < k for argument in arguments)
