"""Writes XML files of robots: numbers to the last digit, and a comment on what a format cannot represent."""

import re
from collections.abc import Iterable, Sequence
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from covariant._typing import Number
from covariant.models.robots._description import FrictionLaw, Joint, Servo
from scalargraph.errors import InputError

NOT_IN_XML = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")
"""Characters that XML 1.0 cannot contain, not even as references."""


def numbers_text(numbers: Iterable[Number]) -> str:
    """Numbers with all their digits, as an attribute."""
    return " ".join(repr(float(number) + 0.0) for number in numbers)


def xml_text(whole: Element, head: Sequence[str]) -> str:
    """Text of an XML file, with lines of a comment at its head."""
    for entry in whole.iter():
        for key, value in entry.attrib.items():
            if NOT_IN_XML.search(value):
                raise InputError(f"<{entry.tag}> has the {key} {value!r}, which XML cannot hold; rename it")
    ElementTree.indent(whole)
    # Two hyphens would end the comment.
    lines = [re.sub("-(?=-)", "- ", NOT_IN_XML.sub("?", line)) for line in head]
    comment = "<!--\n" + "".join(f"  {line}\n" for line in lines) + "-->\n" if lines else ""
    return f'<?xml version="1.0"?>\n{comment}{ElementTree.tostring(whole, encoding="unicode")}\n'


def numbers_left_out(joints: Iterable[Joint], of_servo: Sequence[str], of_law: Sequence[str]) -> tuple[str, ...]:
    """The numbers of servos and friction that a format cannot represent, one line for each joint that has some."""
    lines = []
    for joint in joints:
        servo, law = joint.servo or Servo(0.0), joint.law or FrictionLaw()
        values = {key: getattr(servo, key) for key in of_servo} | {key: getattr(law, key) for key in of_law}
        if not law.stribeck:
            values.pop("stribeck_velocity", None)
        stated = [f"{key} = {_text(value)}" for key, value in values.items() if _stated(key, value)]
        if stated:
            lines.append(f"{joint.name}: {', '.join(stated)}")
    return tuple(lines)


def _stated(key: str, value: float | bool) -> bool:
    return bool(np.isfinite(value)) and value != (1 if key in ("gain", "command_scale") else 0)


def _text(value: float | bool) -> str:
    return str(value).lower() if isinstance(value, bool) else f"{value:.6g}"
