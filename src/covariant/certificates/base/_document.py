"""The file format of certificates: its required content, read into checked numbers, and written.

Nothing in a file is trusted: whether its numbers make a proof is decided by `check`.
"""

import json
import re
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from covariant._files import write_atomically
from covariant.certificates.base._sampling import Loss, Sampling, unit_reach
from covariant.proofs import (
    LETTERS,
    MOST_LETTERS,
    Field,
    digest,
    parse_file,
    read_file,
    saved_graph,
    saved_levels,
)

FORMAT = "covariant certificate 2"
MOST_PARTS = len(LETTERS) // 3
"""Largest number of velocities, so that each variable of a group has a letter; it also limits sizes of parameters."""
KEYS = [
    *("format", "recipe", "observer", "q", "rate", "radius", "velocity", "given", "box", "claims", "graph", "digest"),
]
OBSERVERS: dict[str, dict[str, Any]] = {
    "intrinsic": {"order": (1, 2), "coefficients": ("measured", "estimated"), "curvature": bool},
    "geodesic": {"curvature": bool},
}
"""The fields of each kind of observer beside the gains, with their possible values."""
MOST_LOST = 1000
"""Largest number of lost samples that a file may state."""
STEPS = ("step", "inner_step")
"""Names of the further variables of the claim "prediction": two lengths of a step."""
FRAMES = ("coordinates", "body")
"""Frames of the vectors. In the "body" frame the configuration is not a variable of the region."""
Kind = Literal["contraction", "reach", "disturbance", "correction", "missing", "prediction", "start"]
NUMBERS: dict[Kind, list[str]] = {
    "contraction": [],
    "reach": ["row", "square", "limit"],
    "disturbance": ["square"],
    "correction": ["row"],
    "missing": ["square", "limit"],
    "prediction": ["square"],
    "start": ["square"],
}
"""The numbers of each kind of claim, beside its tree of boxes; a correction with noise has `squares` as well."""


class Given(NamedTuple):
    """Bounds from which those of the force and of the measurements follow.

    Attributes:
        positions: least and largest positions (2, p), on a group the entries of its matrices.
        inputs: least and largest inputs (2, m).
        times: first and last time (2,) [s].
        noise: bounds (n,) of the error of each measured position.
        disturbance: bounds (n,) of each component of a force that the model lacks.
        slopes: bounds (n, n) of the derivatives of the force by the position; 0 where there is no noise.
    """

    positions: Float[np.ndarray, "2 p"]
    inputs: Float[np.ndarray, "2 m"]
    times: Float[np.ndarray, "2"]
    noise: Float[np.ndarray, "n"]
    disturbance: Float[np.ndarray, "n"]
    slopes: Float[np.ndarray, "n n"]


class Stated(NamedTuple):
    """A claim as stated in a file.

    Attributes:
        kind: "contraction", "reach" of a `row` by `square` up to `limit`, "disturbance" of `square`, "correction",
            "missing" of `square` and `limit`, or "start" of `square`.
        levels: its tree of boxes, one string for each level.
        row: index of the entry of (error, velocity), for "reach"; number of samples lost, for "correction".
        square: square of the bound, for "reach" and "disturbance".
        limit: largest half width that is allowed, for "reach".
        squares: for "correction" with noise, what the error of each measured position adds to a squared length.
    """

    kind: Kind
    levels: tuple[str, ...]
    row: int = 0
    square: float = 0.0
    limit: float = 0.0
    squares: tuple[float, ...] = ()

    @property
    def open(self) -> bool:
        """Whether some of its boxes are undecided."""
        return any("?" in level for level in self.levels)


class Document(NamedTuple):
    """The content of a certificate file, with checked types and sizes.

    Attributes:
        file: name of the file, for messages.
        recipe: {"system": name} or {"attribute": "module:attribute"}, and its "parameters". Names are not resolved yet.
        observer: "kind", "frame", "alpha" [1/s], "beta" [1/s²] and the options of that kind.
        q: the matrix (2, 2) of its metric.
        rate: rate λ [1/s] of squared lengths.
        radius: radius of the tube in the metric; 0 where a claim is open.
        velocity: bounds (n,) of the true velocities.
        given: bounds of positions, inputs, times, noise and disturbance.
        low, high: the box (d,) of all claims.
        claims: the claims, "contraction" first.
        graph: {"nodes": rows, "outputs": integers}, a graph of scalars in which every node follows its arguments.
        sampling: when measurements come, and the metric between them; None for an observer in continuous time.

    Example:
        >>> import numpy as np
        >>> from covariant.certificates import Document
        >>> entries = np.eye(2), 2.0, 0.1, np.ones(1), None, -np.ones(4), np.ones(4)
        >>> document = Document("proved.json", {"system": "oscillator"}, {"kind": "intrinsic"}, *entries, (), {})
        >>> document.rate, document.open
        (2.0, False)
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
    sampling: Sampling | None = None

    @property
    def joint_friction(self) -> bool:
        """Whether friction and its slopes are variables of the box, in continuous time."""
        return self.sampling is None and len(self.low) == 6 * len(self.velocity)

    @property
    def forces(self) -> slice:
        """Places of the force in the box."""
        n = len(self.velocity)
        start = first_velocity(len(self.low), n, self.sampling is not None) + 2 * n
        return slice(start, start + n)

    @property
    def open(self) -> bool:
        """Whether any claim has undecided boxes."""
        return any(claim.open for claim in self.claims)

    @property
    def reach_squares(self) -> Float[np.ndarray, "two_n"]:
        """Squares (2n,) of the claims on reach, positions first."""
        return np.array([claim.square for claim in self.claims if claim.kind == "reach"])

    @property
    def unit_reach(self) -> Float[np.ndarray, "n"]:
        """Bounds (n,) of each position error, for a curve of unit length, as the claims on reach state them."""
        return unit_reach(self.reach_squares.tolist())

    @property
    def loss(self) -> "Loss":
        """What the factor of the correction that runs takes from the rate; nothing where no claim bounds it."""
        claims = [claim for claim in self.claims if claim.kind == "missing"]
        if self.sampling is None or not claims:
            return Loss(0.0, 0.0)
        return Loss.of(self.sampling, self.q, self.rate, claims[0].square, claims[0].limit)

    def bounds(self, claim: Stated) -> tuple[Float[np.ndarray, "d"], Float[np.ndarray, "d"]]:
        """Bounds (d,) of the box of one claim, which is the whole box, or that of the ages of a correction.

        Args:
            claim: the claim.
        """
        return claim_bounds(self.sampling, claim.kind, claim.row, self.low, self.high, len(self.velocity))


def first_velocity(variables: int, n: int, sampled: bool = False) -> int:
    """Return the place of the first velocity in the box, behind the variables of the configuration.

    Args:
        variables: number of variables of the box.
        n: number of velocities.
        sampled: whether measurements are sampled.
    """
    # Without samples the coordinates are variables, but not on a group: velocities, errors and forces are 3n.
    return variables - (5 * n + 1) if sampled else n * (variables > 3 * n)


def prediction_places(variables: int, n: int) -> list[int]:
    """Return the places in the box of configuration, velocity, force of the input and age.

    Args:
        variables: number of variables of the box, of a system with samples.
        n: number of velocities.
    """
    count = first_velocity(variables, n, sampled=True)
    return [*range(count + n), *range(count + 2 * n, count + 3 * n), variables - 1]


def prediction_box(sampling: Sampling, n: int, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds of the variables of the claim "prediction".

    Args:
        sampling: the samples, with a number of steps.
        n: number of velocities.
        low, high: bounds (d,) of the whole box.
    """
    places, longest = prediction_places(len(low), n), sampling.longest_step
    return np.append(low[places], [0.0, 0.0]), np.append(high[places], [longest, longest])


def claim_bounds(
    sampling: Sampling | None, kind: Kind, row: int, low: np.ndarray, high: np.ndarray, n: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds (d,) of the box of one claim.

    Args:
        sampling: when measurements come; None in continuous time.
        kind: kind of the claim.
        row: its row, for a correction the number of samples lost.
        low, high: the whole box (d,), whose last variable is the age where measurements are sampled.
        n: number of velocities; needed for "prediction" alone.
    """
    if sampling is not None and kind == "prediction":
        return prediction_box(sampling, n, low, high)
    if sampling is None or kind not in ("correction", "missing"):
        return low, high
    first, last = sampling.ages[row]
    return np.append(low[:-1], first), np.append(high[:-1], last)


def parse(path: str | Path, content: bytes | None = None) -> Document:
    """Read a certificate file.

    Only types, sizes and the digest are checked here; whether its numbers are a proof is decided by `check`.

    Args:
        path: the file.
        content: its bytes, where it has been read already.

    Returns:
        The content, with checked types.

    Raises:
        ValueError: the file cannot be read or is no certificate; the message is one line.

    Example:
        >>> from covariant.certificates import parse
        >>> parse("proved.json", b'{"format": "other"}')
        Traceback (most recent call last):
        ...
        ValueError: proved.json: ...
    """
    top = parse_file(path, read_file(path) if content is None else content)
    top.need(isinstance(top.value, dict) and "format" in top.value, "a certificate with a format")
    top.at("format").need(top.value["format"] == FORMAT, f"{FORMAT!r}; this version reads no other")
    sampled = "sampling" in top.value
    fields = top.record([*KEYS, "sampling"] if sampled else KEYS)
    expected = digest(top.value)
    message = f"{expected} for what the file says; it was changed since it was saved"
    fields["digest"].need(fields["digest"].value == expected, message)
    observer, velocity = _observer(fields["observer"]), fields["velocity"].vector(1, MOST_PARTS, least=0.0)
    fields["velocity"].need((velocity > 0).all(), "positive numbers")
    n = len(velocity)
    sampling = _sampling(fields["sampling"]) if sampled else None
    in_coordinates = observer["frame"] == "coordinates"
    if sampled:  # on rotations those entries of the matrix are variables that the potential reads
        counts = [6 * n + 1] if in_coordinates else list(range(5 * n + 1, len(LETTERS) + 1))
    else:  # in coordinates friction and its slopes may be variables too, which their number says
        counts = [4 * n, 6 * n] if in_coordinates else [3 * n]
    fields["velocity"].need(
        bool(counts) and counts[0] <= len(LETTERS), f"fewer velocities: there are letters for {len(LETTERS)} variables"
    )
    low, high = fields["box"].pair(counts[0], counts[-1])
    variables = len(low)
    fields["box"].need(variables in counts, f"bounds of {' or '.join(map(str, counts))} variables")
    fields["velocity"].need(
        variables <= len(LETTERS), f"fewer velocities: there are letters for {len(LETTERS)} variables"
    )
    given = _given(fields["given"], n)
    claims = _claims(fields["claims"], n, variables, _last_kinds(observer, sampling, given), given)
    return Document(
        top.file,
        _recipe(fields["recipe"]),
        observer,
        _metric(fields["q"]),
        fields["rate"].positive(),
        _radius(fields["radius"], any(claim.open for claim in claims)),
        velocity,
        given,
        low,
        high,
        claims,
        saved_graph(fields["graph"]),
        sampling,
    )


def write(path: str | Path, document: dict[str, Any]) -> Path:
    """Write a certificate file.

    Args:
        path: the file.
        document: its content, as data for JSON.

    Returns:
        The path.

    Raises:
        ValueError: `parse` would not read the content; nothing is written then.
    """
    try:
        # What is written is parsed first, so that a file that was saved can always be read again.
        content = json.dumps(document, indent=1, ensure_ascii=False).encode("utf-8")
        parse(path, content)
    except (TypeError, ValueError) as error:
        raise ValueError(f"nothing is written, since it could not be read again: {error}") from error
    return write_atomically(path, lambda file: file.write(content))


def _recipe(field: Field) -> dict[str, Any]:
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


def _metric(field: Field) -> np.ndarray:
    q = np.stack([row.vector(2, 2) for row in field.rows(2, 2)])
    # Fractions decide positive definiteness of these very doubles, without rounding in a b > c².
    (a, c), (d, b) = [[Fraction(number) for number in row] for row in q.tolist()]
    field.need(c == d and a > 0 and a * b > c * c, "a positive definite matrix [[a, c], [c, b]]")
    return q


def _radius(field: Field, is_open: bool) -> float:
    if not is_open:
        return field.positive()
    field.need(field.number() == 0, "0 where a claim has open leaves")
    return 0.0


def _given(field: Field, n: int) -> Given:
    fields = field.record(["positions", "inputs", "times", "noise", "disturbance", "slopes"])
    times = fields["times"].vector(2, 2)
    fields["times"].need(times[0] <= times[1], "two times, the earlier one first")
    noise, disturbance = (fields[key].vector(n, n, least=0.0) for key in ("noise", "disturbance"))
    slopes = np.stack([row.vector(n, n, least=0.0) for row in fields["slopes"].rows(n, n)])
    return Given(fields["positions"].pair(1, 400), fields["inputs"].pair(0, 100), times, noise, disturbance, slopes)


def _sampling(field: Field) -> Sampling:
    fields = field.record(["interval", "lost", "slopes", "shear", "substeps"])
    interval = fields["interval"].vector(2, 2)
    fields["interval"].need(0 < interval[0] <= interval[1], "two positive times, the shorter one first")
    slopes = np.array([[row.vector(2, 2) for row in slope.rows(2, 2)] for slope in fields["slopes"].rows(0, 8)])
    slopes = slopes.reshape(-1, 2, 2)
    fields["slopes"].need((slopes == np.swapaxes(slopes, 1, 2)).all(), "symmetric matrices (2, 2)")
    lost, shear = fields["lost"].whole(0, MOST_LOST), fields["shear"].one_of((True, False))
    return Sampling(interval, lost, slopes, shear, fields["substeps"].whole(0, 10_000) or None)


def _last_kinds(observer: dict[str, Any], sampling: Sampling | None, given: Given) -> tuple[list[Kind], list[Kind]]:
    """The claims that follow those on reach, and those that may follow then.

    In continuous time "disturbance" may; whether it must is checked. With sampling, "disturbance" follows if there is
    any, "correction" for each number of lost samples, and "missing" where errors are those of first order. Errors of
    predictions are bounded by "prediction", or the statement lists them as not covered.
    """
    if sampling is None:
        return [], ["disturbance", "start"]
    force: list[Kind] = ["disturbance"] if given.disturbance.any() else []
    correction: list[Kind] = ["correction"]
    lacking: list[Kind] = ["missing"] if observer.get("order") == 1 else []
    predicted: list[Kind] = [] if sampling.substeps is None else ["prediction"]
    return [*force, *correction * (sampling.lost + 1), *lacking], [*predicted, "start"]


def _claims(
    field: Field, n: int, variables: int, last: tuple[list[Kind], list[Kind]], given: Given
) -> tuple[Stated, ...]:
    """Contraction, then "reach" for each of the 2n rows, then those of `_last_kinds`."""
    required, optional = last
    reach: list[Kind] = ["reach"]
    first: list[Kind] = ["contraction", *reach * (2 * n)]
    rows, needed = field.rows(1, len(first) + len(required) + len(optional)), len(first) + len(required)
    found: list[Kind] = [kind for kind in optional if any(_states(row, kind) for row in rows[needed:])]
    order: list[Kind] = [*first, *required, *found]
    rows[-1].need(len(rows) <= len(order), "the last claim")
    errors = int(np.count_nonzero(given.noise))
    claims = [_claim(row, k, n, variables, order, errors) for k, row in enumerate(rows)]
    if sum(len(level) for claim in claims for level in claim.levels) > MOST_LETTERS:
        raise ValueError(
            f"{field.file}: the levels of {field.key} hold more than {MOST_LETTERS} letters; ask for the file as it "
            "was saved, or certify again"
        )
    samples = required.count("correction")
    more = f", and correction after 0 to {samples - 1} lost samples, and what they lack" if samples else ""
    complete = len(rows) >= needed or (len(rows) == 1 and claims[0].open)
    field.need(complete, f"contraction, and reach of rows 0 to {2 * n - 1}{more}")
    return tuple(claims)


def _states(field: Field, kind: Kind) -> bool:
    return isinstance(field.value, dict) and field.value.get("kind") == kind


def _claim(field: Field, k: int, n: int, variables: int, order: list[Kind], errors: int) -> Stated:
    field.need(isinstance(field.value, dict) and "kind" in field.value, "an object with the kind of the claim")
    kind = order[k]
    field.at("kind").one_of((kind,))
    noisy = kind == "correction" and errors > 0
    fields = field.record(["kind", *NUMBERS[kind], *(["squares"] if noisy else []), "levels"])
    numbers: dict[str, Any] = {key: fields[key].positive() for key in NUMBERS[kind] if key != "row"}
    if kind == "reach":
        numbers["row"] = fields["row"].whole(k - 1, k - 1)
    if kind == "correction":
        lost = k - order.index("correction")
        numbers["row"] = fields["row"].whole(lost, lost)
    # Instead of errors, joint forces and slopes, a prediction has two lengths of its steps.
    variables = variables - 3 * n + 2 if kind == "prediction" else variables
    if noisy:
        squares = fields["squares"].vector(errors, errors, least=0.0)
        fields["squares"].need((squares > 0).all(), "positive numbers")
        numbers["squares"] = tuple(squares.tolist())
    return Stated(kind, saved_levels(fields["levels"], variables), **numbers)
