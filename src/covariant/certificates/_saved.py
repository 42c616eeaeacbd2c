"""How a certificate is written down: an observer as plain numbers and names, and back."""

import dataclasses
import hashlib
import json
import string
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from covariant import models
from covariant.certificates._region import Intrinsics
from covariant.observers import Geodesic, Group, Intrinsic

FORMAT = "covariant certificate 1"
LETTERS = string.ascii_letters
"""One for each variable across whose middle a box is halved; a leaf is a dot."""
KINDS = {"intrinsic": Intrinsic, "geodesic": Geodesic, "group": Group}


def observer_document(observer: Intrinsics) -> dict[str, Any]:
    """An observer without its model: its kind, gains and options.

    Raises `ValueError` for a field that cannot be written down, as a budget that is not the usual one.
    """
    kind = next(name for name, cls in KINDS.items() if type(observer) is cls)
    usual = {field.name: field.default for field in dataclasses.fields(observer)}
    found: dict[str, Any] = {"kind": kind}
    for name in usual.keys() - {"model", "substeps"}:
        value = getattr(observer, name)
        if name in ("alpha", "beta"):
            found[name] = float(value)
        elif isinstance(value, bool | int | str):
            found[name] = value
        elif value != usual[name]:
            raise ValueError(f"an observer with {name} = {value!r} cannot be written into a certificate")
    return found


def observer_from(document: dict[str, Any]) -> tuple[Intrinsics, Float[np.ndarray, "2 2"]]:
    """The observer that a certificate is about, and the matrix Q of its metric.

    Raises `ValueError` naming what fails.
    """
    given = dict(document["observer"])
    kind = given.pop("kind", None)
    if kind not in KINDS:
        raise ValueError(f"the observer must be one of {', '.join(KINDS)}; the certificate says {kind!r}")
    model = models.from_recipe(document["model"])
    try:
        return KINDS[kind](model, **given), np.asarray(document["q"], float)
    except TypeError as error:
        raise ValueError(f"the observer of the certificate cannot be made: {error}") from error


def to_letters(levels: Sequence[np.ndarray]) -> list[str]:
    """A tree of boxes, one string a level: the letter of the variable that is halved, '.' proved, '?' open."""
    table = np.array([ord(c) for c in LETTERS + "?."], np.uint8)  # indices −1 and −2 are the last two
    return [table[codes].tobytes().decode("ascii") for codes in levels]


def from_letters(levels: Sequence[str]) -> list[np.ndarray]:
    """The tree that `to_letters` wrote, as whole numbers: −1 for proved, −2 for open."""
    codes = {letter: code for code, letter in enumerate(LETTERS)} | {".": -1, "?": -2}
    return [np.array([codes[letter] for letter in level], int) for level in levels]


def digest(document: dict[str, Any]) -> str:
    """SHA-256 of everything in a certificate but the digest itself, in one canonical spelling."""
    rest = {key: value for key, value in document.items() if key != "digest"}
    text = json.dumps(rest, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.sha256(text.encode("utf-8")).hexdigest()
