"""Numbers of a draft that nobody has replaced are named; those that somebody has are not."""

import numpy as np
import pandas
import pytest

from covariant import verbs
from covariant.verbs._fit import FitResult
from covariant.verbs.base.inputs import Job, load
from covariant.verbs.base.placeholders import drafted_names, placeholder_sentence, placeholders

T = np.arange(0.0, 4.0, 0.01)
TWO_ANGLES = {"t": T, "q1_rad": np.cos(3 * T), "q2_rad": np.sin(2 * T)}
CART_POLE = {"t": T, "cart_m": np.cos(3 * T), "pole_rad": np.sin(2 * T), "force_N": np.cos(T)}


@pytest.fixture
def draft(tmp_path):
    def save(columns, changes=()):
        path = verbs.init(pandas.DataFrame(columns)).save(tmp_path / "draft.toml")
        for old, new in changes:
            path.write_text(path.read_text().replace(old, new))
        return path

    return save


def test_all_numbers_of_a_draft_are_placeholders_but_the_length_of_the_last_link(draft):
    names = [f"{key}[{i}]" for key in ("mass", "length", "com", "inertia", "viscous", "coulomb") for i in (0, 1)]
    assert list(placeholders(draft(TWO_ANGLES), ())) == [name for name in names if name != "length[1]"]


def test_a_pole_on_a_cart_has_numbers_that_are_no_lists(draft):
    known = {"cart_mass": 1.0, "pole_mass": 0.1, "com": 0.15, "inertia": 0.001, "viscous[1]": 0.01}
    assert known.items() <= placeholders(draft(CART_POLE), ()).items()


def test_what_is_changed_overridden_or_confirmed_is_none(draft):
    changes = [("mass = [1.0, 1.0]", "mass = [1.0, 0.4]"), ("placeholder 0.15, 0.15; ", "")]
    path = draft(TWO_ANGLES, changes)
    named = placeholders(path, {"parameters.inertia": [0.01, 0.02], "parameters.viscous": [0.1, 0.1]})
    assert list(named) == ["mass[0]", "length[0]", "inertia[0]", "coulomb[0]", "coulomb[1]"]
    assert placeholders("oscillator", ()) == {}
    # What a fit is for by default does not depend on the numbers that somebody put there.
    assert drafted_names(path) == ["mass", "length", "inertia", "viscous", "coulomb"]
    assert drafted_names("oscillator") == []
    assert placeholder_sentence({}) == ""


def test_a_description_and_what_is_said_of_a_log_name_them(draft):
    path = draft({"t": T, "angle_rad": 0.5 * np.cos(3 * T)})
    sentence = placeholder_sentence(placeholders(path, ()))
    assert "mass[0] = 1" in sentence
    described = verbs.describe_model(path, samples=1)
    assert sentence in str(described)
    assert described.summary["placeholders"]["mass[0]"] == 1.0
    log = pandas.DataFrame({"t": T, "angle_rad": 0.5 * np.cos(3 * T)})
    assert load(Job(str(path), log, anyway=True)).note.endswith(sentence)


def test_a_fit_names_them_beside_what_is_not_determined():
    rows = {"parameters": [], "undetermined": ["com cannot be told from this log; it keeps its first value"]}
    result = FitResult([], {}, rows | {"better": True, "placeholders": {"com": 0.15}})
    assert result.warnings[1].startswith("Still placeholders of the draft: com = 0.15.")
    assert len(result.warnings) == 2
