"""Imports the optional packages for figures and pages."""

import functools

from covariant._optional import load_optional

optional = functools.partial(load_optional, use="this figure needs", extra="report")
