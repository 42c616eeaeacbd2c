"""The outermost tag of a robot's file, read so that the file can do no harm and open no other one."""

from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element


def parse(path: Path) -> Element:
    """The XML of a file. Raises `ValueError` for what is not readable, and for document types and entities."""
    data = path.read_bytes()
    if b"\0" in data:
        raise ValueError("is not text in UTF-8; save it as such")
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise ValueError("declares a document type or entities, which a robot description has no need of; remove them")
    try:
        return ElementTree.fromstring(data)
    except ElementTree.ParseError as error:
        raise ValueError(f"is not readable XML: {error}") from error
