"""From a model and a log to an answer: one function for each verb of the command line, and the results they return.

Everything that happens between a model file, a log and an answer is here: units, lags, delays, encoder ticks, gates,
references and ranking. The command line turns words into arguments of these functions and prints their results; a
script or a notebook calls the same functions.
"""

from scalargraph.rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
