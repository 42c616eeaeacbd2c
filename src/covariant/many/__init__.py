"""Many logs and many runs: a verb over a list of logs, and studies that run an observer over a grid of cases.

A verb of `covariant.verbs` takes one log. Here `check`, `estimate` and `smooth` take a list of them as well.
"""

from scalargraph.rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
