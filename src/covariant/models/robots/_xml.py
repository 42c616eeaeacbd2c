"""Parses XML of robots such that a file can do no harm and open no other file, and checks its numbers."""

import math
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, TreeBuilder, XMLParser

import numpy as np

from covariant._door import MOST_ENTRIES, ROBOT, check_count
from scalargraph.errors import InputError
from scalargraph.files import read_bytes


class Tag(Element):
    """A tag that remembers which of its attributes were asked for."""

    def __init__(self, tag: str, attrib: dict[str, str]):
        super().__init__(tag, attrib)
        self.asked: set[str] = set()

    def get(self, key: str, default: Any = None) -> Any:
        self.asked.add(key)
        return super().get(key, default)


def unread(entry: Element) -> list[str]:
    """Attributes of a tag that nobody asked for."""
    return [key for key in entry.attrib if key not in getattr(entry, "asked", ())]


def parse(path: Path) -> Element:
    """Outermost tag of an XML file; raises `ValueError` if it declares document types or entities."""
    data = read_bytes(path, ROBOT)
    # UTF-16 has NUL bytes between letters, which would hide the words searched below.
    if b"\0" in data:
        raise InputError("is not text in UTF-8; save it as such")
    # Entities can grow exponentially (billion laughs) or name files to read.
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise InputError("declares a document type or entities, which a robot description has no need of; remove them")
    check_count(data.count(b"<") - data.count(b"</"), MOST_ENTRIES, "entries")
    try:
        return ElementTree.fromstring(data, XMLParser(target=TreeBuilder(element_factory=Tag)))
    except ElementTree.ParseError as error:
        raise InputError(f"is not readable XML: {error}") from error


def vector(entry: Element | None, key: str, where: str, default: tuple[float, float, float]) -> np.ndarray:
    """Three finite numbers (3,) of an attribute, or the default if it is missing."""
    text = None if entry is None else entry.get(key)
    if text is None:
        return np.array(default)
    refuse_unexpanded(text, f"{where}: {key}")
    try:
        numbers = np.array([float(part) for part in text.split()])
    except ValueError:
        numbers = np.zeros(0)
    if numbers.shape != (3,) or not np.isfinite(numbers).all():
        raise InputError(f"{where}: {key} must be three finite numbers; got {text!r}")
    return numbers


def number(entry: Element, key: str, where: str, default: float | None = None) -> float:
    """Finite number of an attribute, or the default if it is missing; without a default it is required."""
    text = entry.get(key)
    if text is None:
        if default is None:
            raise InputError(f"{where}: <{entry.tag}> lacks {key!r}")
        return default
    return finite(text, f"{where}: {key} of <{entry.tag}>")


def refuse_unexpanded(text: str, what: str) -> None:
    """Raise `ValueError` for an expression of a xacro in place of a number."""
    if "${" in text or "$(" in text:
        raise InputError(f"{what} is {text!r}, of a xacro that was not expanded: xacro FILE > robot.urdf")


def finite(text: str, what: str) -> float:
    """The number in a text; raises `ValueError` if it is not a number, or not finite."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    refuse_unexpanded(text, what)
    if not math.isfinite(value):
        raise InputError(f"{what} must be a finite number; got {text!r}")
    return value


def attribute(entry: Element, key: str, where: str) -> str:
    """Text of an attribute; raises `ValueError` if it is missing or empty."""
    text = entry.get(key)
    if not text:
        raise InputError(f"{where}: a <{entry.tag}> lacks {key!r}")
    return text


def name_of(entry: Element) -> str:
    """Name of a tag, without its namespace."""
    return entry.tag.rpartition("}")[2] if isinstance(entry.tag, str) else "comment"
