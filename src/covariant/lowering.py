"""The names of `scalargraph`, by the name that this package had here."""

from scalargraph import *  # noqa: F403
