"""Reads and writes the files of certificates, and checks types and sizes of their content.

A file is not trusted: `check` decides whether its numbers form a proof.
"""

import dataclasses
import itertools
import json
import re
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.certificates.base._box import Given, first_velocity
from covariant.certificates.base._claims import CLAIMS, AbstractClaim, Setting, reach_squares
from covariant.certificates.base._error_system import ErrorSystem
from covariant.certificates.base._intrinsic import OBSERVERS, Intrinsics
from covariant.certificates.base._radius_recursion import Recursion
from covariant.certificates.base._remainder import Remainder
from covariant.certificates.base._sampling import Loss, Sampling, unit_reach
from covariant.certificates.base._steady import loss_of, steady_of
from scalargraph.errors import InputError
from scalargraph.files import write_atomically
from scalargraph.proofs import (
    LETTERS,
    MOST_LETTERS,
    Box,
    Field,
    Proof,
    digest,
    from_letters,
    parse_file,
    read_file,
    saved_graph,
)

FORMAT = "covariant certificate 2"
MOST_PARTS = len(LETTERS) // 3
"""Largest number of velocities, so that each variable of a group has a letter; it also limits sizes of parameters."""
KEYS = [
    *("format", "recipe", "observer", "q", "rate", "radius", "velocity", "given", "box", "claims", "graph", "digest"),
]
MOST_LOST = 1000
"""Largest number of lost samples that a file may state."""
FRAMES = ("coordinates", "body")
"""Frames of the vectors. In the "body" frame the configuration is not a variable of the region."""


class Document(NamedTuple):
    """The content of a certificate file, with checked types and sizes.

    Attributes:
        file: name of the file, for messages.
        recipe: {"system": name} or {"attribute": "module:attribute"}, and its "parameters". The names are not looked up
            yet. None for a model that only this process knows.
        observer: "kind", "frame", "alpha" [1/s], "beta" [1/s²] and the options of that kind.
        q: the matrix (2, 2) of its metric.
        rate: rate λ [1/s] of squared lengths.
        radius: radius of the tube in the metric; 0 if a claim is open.
        velocity: bounds (n,) of the true velocities.
        given: bounds of positions, inputs, times, noise and disturbance.
        low, high: the box (d,) of all claims.
        claims: the claims, "contraction" first.
        graph: {"nodes": rows, "outputs": integers}, a graph of scalars in which every node comes after its arguments.
        sampling: when measurements come, and the metric between them; None for an observer in continuous time.
        driven: places among (time, inputs) of the signals that the friction depends on, which are the last variables.

    Example:
        >>> import numpy as np
        >>> from covariant.certificates import Document
        >>> entries = np.eye(2), 2.0, 0.1, np.ones(1), None, -np.ones(4), np.ones(4)
        >>> document = Document("proved.json", {"system": "oscillator"}, {"kind": "intrinsic"}, *entries, (), {})
        >>> document.rate, document.open
        (2.0, False)
    """

    file: str
    recipe: dict[str, Any] | None
    observer: dict[str, Any]
    q: Float[np.ndarray, "2 2"]
    rate: float
    radius: float
    velocity: Float[np.ndarray, "n"]
    given: Given
    low: Float[np.ndarray, "d"]
    high: Float[np.ndarray, "d"]
    claims: tuple[AbstractClaim, ...]
    graph: dict[str, list]
    sampling: Sampling | None = None
    driven: tuple[int, ...] = ()

    @property
    def joint_friction(self) -> bool:
        """Whether friction and its slopes are variables of the box, in continuous time."""
        return self.sampling is None and not self.driven and len(self.low) == 6 * len(self.velocity)

    @property
    def forces(self) -> slice:
        """Places of the force in the box."""
        n = len(self.velocity)
        start = self.first_velocity + 2 * n
        return slice(start, start + n)

    @property
    def open(self) -> bool:
        """Whether any claim has undecided boxes."""
        return any(claim.open for claim in self.claims)

    @property
    def first_velocity(self) -> int:
        """Place of the first velocity in the box, after the variables of the configuration."""
        return first_velocity(len(self.low) - len(self.driven), len(self.velocity), self.sampling is not None)

    @property
    def unit_reach(self) -> Float[np.ndarray, "n"]:
        """Bounds (n,) of each position error for a curve of unit length, from the claims on reach."""
        return unit_reach(reach_squares(self.claims))

    @property
    def loss(self) -> Loss:
        """Loss of rate by the factor of the correction that runs; zero if no claim bounds it."""
        return loss_of(self.sampling, self.q, self.rate, self.claims)

    @property
    def remainder(self) -> Remainder:
        """What the exact observer loses against its approximation; nothing for any other."""
        return Remainder.of((self.observer["alpha"], self.observer["beta"]), self.q, self.claims, self.radius)

    @property
    def decay(self) -> float:
        """Rate [1/s] at which distances decrease."""
        return self.rate / 2 - self.loss.rate - self.remainder.rate

    @property
    def steady(self) -> float:
        """The largest distance that noise and disturbance alone can cause."""
        return steady_of(self.sampling, self.q, self.rate, self.given, self.claims)

    @property
    def drift(self) -> float:
        """The largest distance that errors of Runge–Kutta steps alone can cause; 0 if no claim bounds them."""
        sampling, claims = self.sampling, self.claims
        return 0.0 if sampling is None else Recursion.of(sampling, self.q, self.rate, None, claims).steady

    def bounds(self, claim: AbstractClaim) -> tuple[Float[np.ndarray, "d"], Float[np.ndarray, "d"]]:
        """Bounds (d,) of the box of one claim.

        Args:
            claim: the claim.
        """
        return claim.bounds(self.low, self.high, len(self.velocity), self.sampling)


class Resolved(NamedTuple):
    """A document with the observer that it describes.

    Attributes:
        document: the content of a file, or the content that a file would have.
        observer: the observer, with its model.
        about: observer and metric as functions of a box.
    """

    document: Document
    observer: Intrinsics
    about: ErrorSystem

    @property
    def domain(self) -> Box:
        """The box, with names and units of its variables."""
        return Box(self.about.names, self.about.units, self.document.low, self.document.high)

    def stated(self) -> "Resolved":
        """Take the trees of the file as proofs of its claims, without verification."""
        claims = tuple(self._stated(claim) for claim in self.document.claims)
        return self._replace(document=self.document._replace(claims=claims))

    def _stated(self, claim: AbstractClaim) -> AbstractClaim:
        low, high = self.document.bounds(claim)
        names, units = claim.variables(self.about.names, self.about.units, len(self.document.velocity))
        proof = Proof.stated(Box(names, units, low, high), from_letters(claim.levels))
        return dataclasses.replace(claim, proof=proof, letters=())


def parse(path: str | Path, content: bytes | None = None) -> Document:
    """Read a certificate file.

    Only types, sizes and the digest are checked here; `check` decides whether the numbers form a proof.

    Args:
        path: the file.
        content: its bytes, if it has already been read.

    Returns:
        The content, with checked types.

    Raises:
        ValueError: the file cannot be read or is not a certificate; the message is one line.

    Example:
        >>> from covariant.certificates import parse
        >>> parse("proved.json", b'{"format": "other"}')
        Traceback (most recent call last):
        ...
        scalargraph.errors.InputError: proved.json: ...
    """
    top = parse_file(path, read_file(path) if content is None else content)
    top.need(isinstance(top.value, dict) and "format" in top.value, "a certificate with a format")
    top.at("format").need(top.value["format"] == FORMAT, f"{FORMAT!r}; this version reads no other")
    fields = read_fields(top, [*KEYS, *[key for key in ("sampling", "driven") if key in top.value][:1]])
    sampled = "sampling" in fields
    observer, velocity = _observer(fields["observer"]), fields["velocity"].vector(1, MOST_PARTS, least=0.0)
    fields["velocity"].need((velocity > 0).all(), "positive numbers")
    n, driven = len(velocity), ()
    sampling = _sampling(fields["sampling"]) if sampled else None
    in_coordinates = observer["frame"] == "coordinates"
    if sampled:  # on rotations those entries of the matrix are variables that the potential reads
        counts = [6 * n + 1] if in_coordinates else list(range(5 * n + 1, len(LETTERS) + 1))
    elif "driven" in fields:
        driven = _driven(fields["driven"])
        counts = [(3 + in_coordinates) * n + len(driven)]
    else:  # in coordinates friction and its slopes may be variables too, which their number says
        counts = [4 * n, 6 * n] if in_coordinates else [3 * n]
    fewer = f"fewer velocities: there are letters for {len(LETTERS)} variables"
    fields["velocity"].need(bool(counts) and counts[0] <= len(LETTERS), fewer)
    low, high = fields["box"].pair(counts[0], counts[-1])
    variables = len(low)
    fields["box"].need(variables in counts, f"bounds of {' or '.join(map(str, counts))} variables")
    fields["velocity"].need(variables <= len(LETTERS), fewer)
    given = _read_bounds(fields["given"], n)
    claims = _claims(fields["claims"], Setting(low, high, n, sampling, given, observer.get("order")))
    return Document(
        top.file,
        read_recipe(fields["recipe"]),
        observer,
        read_metric(fields["q"]),
        fields["rate"].positive(),
        _radius(fields["radius"], any(claim.open for claim in claims)),
        velocity,
        given,
        low,
        high,
        claims,
        saved_graph(fields["graph"]),
        sampling,
        driven,
    )


def read_fields(top: Field, keys: list[str]) -> dict[str, Field]:
    """The fields of a certificate of any format, with its digest checked."""
    fields, expected = top.record(keys), digest(top.value)
    message = f"{expected} for what the file says; it was changed since it was saved"
    fields["digest"].need(fields["digest"].value == expected, message)
    return fields


def read_interval(field: Field) -> Float[np.ndarray, "2"]:
    """Read the shortest and longest time between two samples."""
    interval = field.vector(2, 2)
    field.need(0 < interval[0] <= interval[1], "two positive times, the shorter one first")
    return interval


def write(
    path: str | Path,
    document: dict[str, Any],
    check: Callable[[Any], None] = lambda _: None,
    read: Callable[[str | Path, bytes], Any] = parse,
) -> Path:
    """Write a certificate file.

    Args:
        path: the file.
        document: its content, as data for JSON.
        check: called with the content as `read` gives it; if it raises, no file is written.
        read: reads the content, as `parse` does for files of this format.

    Returns:
        The path.

    Raises:
        ValueError: `read` would reject the content; no file is written then.
    """
    try:
        # The content is parsed before it is written, so that a saved file can always be read again.
        content = json.dumps(document, indent=1, ensure_ascii=False).encode("utf-8")
        parsed = read(path, content)
    except (TypeError, ValueError) as error:
        raise InputError(f"nothing is written, since it could not be read again: {error}") from error
    check(parsed)
    return write_atomically(path, lambda file: file.write(content))


def read_recipe(field: Field) -> dict[str, Any]:
    """Read the recipe of a model."""
    field.need(isinstance(field.value, dict), "an object with a system, or an attribute, and its parameters")
    source = "attribute" if "attribute" in field.value else "system"
    fields = field.record([source, "parameters"])
    text = fields[source].text(200)
    if source == "attribute":
        fields[source].need(re.fullmatch(r"[^:]+:[^:]+", text), "module:attribute")
    parameters = fields["parameters"]
    parameters.need(
        isinstance(parameters.value, dict) and len(parameters.value) <= 64, "an object of 64 values at most"
    )
    for key in parameters.value:
        Field(field.file, f"the name of a parameter in {parameters.key}", key).need(key.isidentifier(), "a name")
    most_entries = MOST_PARTS if source == "system" else 100
    return {source: text, "parameters": {key: _parameter(parameters.at(key), most_entries) for key in parameters.value}}


def _parameter(field: Field, most_entries: int, depth: int = 2) -> Any:
    """A number, a truth value, a text, or numbers in a list, a list of lists or by names, of at most `most` entries."""
    if depth == 2 and isinstance(field.value, dict):
        field.need(len(field.value) <= 64, "an object of 64 values at most")
        names = [Field(field.file, f"a name in {field.key}", key).text(200) for key in field.value]
        return {name: _parameter(field.at(name), most_entries, 1) for name in names}
    if depth == 2 and isinstance(field.value, bool):
        return field.value
    if depth == 2 and isinstance(field.value, str):
        return field.text(200)
    if depth and isinstance(field.value, list):
        return [_parameter(row, most_entries, depth - 1) for row in field.rows(0, most_entries)]
    field.number()
    return field.value


def _observer(field: Field) -> dict[str, Any]:
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


def read_metric(field: Field) -> np.ndarray:
    """Read a matrix (2, 2) that is positive definite."""
    q = np.stack([row.vector(2, 2) for row in field.rows(2, 2)])
    # Fractions decide positive definiteness of exactly these doubles; the comparison a b > c² is not rounded.
    (a, c), (d, b) = [[Fraction(number) for number in row] for row in q.tolist()]
    field.need(c == d and a > 0 and a * b > c * c, "a positive definite matrix [[a, c], [c, b]]")
    return q


def _radius(field: Field, is_open: bool) -> float:
    if not is_open:
        return field.positive()
    field.need(field.number() == 0, "0 where a claim has open leaves")
    return 0.0


def _read_bounds(field: Field, n: int) -> Given:
    fields = field.record(["positions", "inputs", "times", "noise", "disturbance", "slopes"])
    times = fields["times"].vector(2, 2)
    fields["times"].need(times[0] <= times[1], "two times, the earlier one first")
    noise, disturbance = (fields[key].vector(n, n, least=0.0) for key in ("noise", "disturbance"))
    slopes = np.stack([row.vector(n, n, least=0.0) for row in fields["slopes"].rows(n, n)])
    return Given(fields["positions"].pair(1, 400), fields["inputs"].pair(0, 100), times, noise, disturbance, slopes)


def _driven(field: Field) -> tuple[int, ...]:
    """Read the places among (time, inputs) of the signals that the friction depends on, in rising order."""
    places = tuple(row.whole(0, 100) for row in field.rows(1, MOST_PARTS))
    field.need(all(a < b for a, b in itertools.pairwise(places)), "different places in rising order")
    return places


def _sampling(field: Field) -> Sampling:
    keys = ["interval", "lost", "slopes", "shear", "substeps"]
    missing_rows = isinstance(field.value, dict) and "missing_rows" in field.value
    fields = field.record([*keys, "missing_rows"] if missing_rows else keys)
    interval = read_interval(fields["interval"])
    slopes = np.array([[row.vector(2, 2) for row in slope.rows(2, 2)] for slope in fields["slopes"].rows(0, 8)])
    slopes = slopes.reshape(-1, 2, 2)
    fields["slopes"].need((slopes == np.swapaxes(slopes, 1, 2)).all(), "symmetric matrices (2, 2)")
    lost, shear = fields["lost"].whole(0, MOST_LOST), fields["shear"].one_of((True, False))
    if missing_rows:
        fields["missing_rows"].one_of((True,))
    return Sampling(interval, lost, slopes, shear, fields["substeps"].whole(0, 10_000) or None, missing_rows)


def _claims(field: Field, setting: Setting) -> tuple[AbstractClaim, ...]:
    """The claims, kind by kind: the required number of each, and the optional ones that the file has."""
    counts = {name: kind.count(setting) for name, kind in CLAIMS.items()}
    least, most = (sum(each) for each in zip(*counts.values(), strict=True))
    rows = field.rows(1, most)
    optional = [row.value.get("kind") for row in rows[least:] if isinstance(row.value, dict)]
    # The name decides whether a kind is present; its place is checked below.
    numbers = {name: b if name in optional else a for name, (a, b) in counts.items()}
    order = [name for name, count in numbers.items() for _ in range(count)]
    rows[-1].need(len(rows) <= len(order), "the last claim")
    places = enumerate(zip(rows, order, strict=False))
    claims = [_claim(row, name, k - order.index(name), setting) for k, (row, name) in places]
    if sum(len(level) for claim in claims for level in claim.levels) > MOST_LETTERS:
        raise InputError(
            f"{field.file}: the levels of {field.key} hold more than {MOST_LETTERS} letters; ask for the file as it "
            "was saved, or certify again"
        )
    samples = numbers["correction"]
    more = f", and correction after 0 to {samples - 1} lost samples, and what they lack" if samples else ""
    complete = len(rows) >= least or (len(rows) == 1 and claims[0].open)
    field.need(complete, f"contraction, and reach of rows 0 to {2 * setting.n - 1}{more}")
    return tuple(claims)


def _claim(field: Field, name: str, index: int, setting: Setting) -> AbstractClaim:
    field.need(isinstance(field.value, dict) and "kind" in field.value, "an object with the kind of the claim")
    field.at("kind").one_of((name,))
    return CLAIMS[name].read(field, index, setting)
