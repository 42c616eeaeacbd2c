"""Runs verbs over many logs, and observers over a grid of simulated cases.

A verb of `covariant.verbs` takes one log. The verbs `check`, `estimate` and `smooth` here also take a list of logs.
"""

from scalargraph.rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
