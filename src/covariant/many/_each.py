"""Extends verbs of one log to lists of logs."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar, cast

from covariant import verbs
from covariant.many._over_logs import over_logs

Verb = TypeVar("Verb", bound=Callable[..., Any])


def each_log(verb: Verb) -> Verb:
    """Wrap a verb of one log so that it also takes a list of logs, which goes to `over_logs`."""

    @functools.wraps(verb)
    def call(model: Any, log: Any, **settings: Any) -> Any:
        if type(log) not in (list, tuple):  # a Record is a NamedTuple, which `isinstance` would match
            return verb(model, log, **settings)
        return over_logs(verb.__name__, model, log, **settings)

    return cast(Verb, call)


check = each_log(verbs.check)
estimate = each_log(verbs.estimate)
smooth = each_log(verbs.smooth)
