"""The verbs: one function for each command, most of them from a model and one log to a result, and these results.

Everything between files and numbers happens here: units, lags, delays, encoder ticks, gates for outliers, references
for scores, and rankings. The command line parses options into arguments of these functions and prints their results; a
script or a notebook calls the same functions. The names come from `__init__.pyi`.
"""

from scalargraph.rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
