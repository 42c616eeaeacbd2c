"""The optional packages of grids."""

import functools

from covariant._guests import load_guest

guest = functools.partial(load_guest, use="big grids need", extra="scale")
