"""Build the library of xNAMEx from its C: `python -m xNAMEx`."""

from . import build

print(build())
