"""The optional packages of figures and pages."""

import functools

from covariant._guests import load_guest

guest = functools.partial(load_guest, use="this figure needs", extra="report")
