"""What is not defined somewhere in the region proves nothing there, however much it cancels: what takes long."""

import pytest
from systems import Case, line, verdict


def safe_root(xp, x, v):
    """The root of a positive number and nought elsewhere, written so that neither is ever asked for what it is not."""
    return xp.where(v > 0, xp.sqrt(xp.where(v > 0, v, 1.0)), 0.0)


def test_the_safe_way_to_choose_is_proved_away_from_the_kink_alone():
    law = lambda xp, x, v: -v - safe_root(xp, x, v + 3)  # noqa: E731
    assert verdict(line(law), **Case(law).bounds()) == "holds"
    driving = lambda xp, x, v: -v + 3 * safe_root(xp, x, v)  # noqa: E731  its slope at rest has no bound
    assert verdict(line(driving), **Case(driving).bounds()) != "holds"
