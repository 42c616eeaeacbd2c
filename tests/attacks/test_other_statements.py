"""Random systems for every kind of statement but that of `certify`: what is said to hold is never contradicted.

What a system really does is found by other means than what is said of it: eigenvalues, exponentials of matrices, and
simulation in NumPy. `COVARIANT_ATTACKS=200` draws as many of each kind.
"""

import numpy as np

from covariant.certificates import common_metric


def test_a_metric_that_the_solver_gets_wrong_is_not_proved(monkeypatch):
    from covariant.certificates.theory import _lmi

    f = np.array([[[-1.0, 3.0], [0.0, -1.0]]])
    assert common_metric(f, 0.5).statement.proved
    monkeypatch.setattr(_lmi, "_solved", lambda f, h, rate, effort: (np.eye(2), np.zeros((2, 0)), 1.0))
    found = common_metric(f, 0.5).statement
    assert (found.verdict, found.hypotheses[1].place) == ("undecided", "Jacobian 1")
    monkeypatch.setattr(_lmi, "_solved", lambda f, h, rate, effort: (-np.eye(2), np.zeros((2, 0)), 1.0))
    # All lengths are negative, and grow: only the first hypothesis sees it.
    found = common_metric(np.eye(2), 1.0).statement
    assert [premise.verdict for premise in found.hypotheses] == ["undecided", "holds", "holds"]
    assert found.verdict == "undecided"
