"""Import of the optional packages for grids."""

import functools

from covariant._optional import load_optional

optional = functools.partial(load_optional, use="big grids need", extra="scale")
