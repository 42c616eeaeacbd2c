"""What takes long of `test_printed.py`."""

import pytest
from test_printed import GIVEN, PENDULUM, changed, pendulum

from covariant import certificates, models
from covariant.certificates import certify, check
from covariant.observers import Intrinsic


def test_a_recipe_by_another_name_of_the_same_model_is_as_good():
    """Defaults may be written out: what counts is the model that is built."""
    recipe = changed(PENDULUM, gravity=9.81)
    certificate = certify(Intrinsic(pendulum(), 10.0, 50.0), recipe=recipe, **GIVEN)
    assert certificate.statement.proved
    assert "mass = [1.0]" in str(certificate.statement)


def test_numbers_that_are_exchanged_after_the_proof_are_refused(tmp_path):
    certificate = certify(Intrinsic(pendulum(), 10.0, 50.0), recipe=PENDULUM, **GIVEN)
    with pytest.raises(ValueError, match=r"mass is \[7.0\]"):
        certificate._replace(recipe=changed(PENDULUM, mass=[7.0])).save(tmp_path / "heavy.json")
    path = certificate.save(tmp_path / "proved.json")
    with pytest.raises(ValueError, match=r"proved.json: recipe: .*mass is \[1.0\] in the recipe, and \[7.0\]"):
        check(path, model=models.pendulum_chain((7.0,), (0.5,)))
    document = certificates.parse(path)
    with pytest.raises(ValueError, match="mass"):
        certificates.check_observer(document, Intrinsic(models.pendulum_chain((7.0,), (0.5,)), 10.0, 50.0))
    with pytest.raises(ValueError, match=r"alpha = 10, beta = 50; the observer has 10, 50.00000000000001"):
        certificates.check_observer(document, Intrinsic(pendulum(), 10.0, 50.00000000000001))
    with pytest.raises(ValueError, match="curvature = True, and the observer has False"):
        certificates.check_observer(document, Intrinsic(pendulum(), 10.0, 50.0, curvature=False))
    certificates.check_observer(document, Intrinsic(pendulum(), 10.0, 50.0))


MADE = """
from covariant import models

def spring(stiffness=1.0):
    return models.oscillator(stiffness=stiffness)

soft = spring(2.0)
"""


def test_code_is_compared_where_it_has_been_run(tmp_path, monkeypatch):
    (tmp_path / "springs_of_mine.py").write_text(MADE)
    monkeypatch.syspath_prepend(tmp_path)
    observer = Intrinsic(models.oscillator(stiffness=2.0), 10.0, 50.0)
    hard, soft = (models.recipe("springs_of_mine:spring", {"parameters.stiffness": k}) for k in (7.0, 2.0))
    with pytest.raises(ValueError, match=r"stiffness is 7.0 in the recipe, and 2.0"):
        certify(observer, recipe=hard, **GIVEN)
    with pytest.raises(ValueError, match="code that a recipe names is not run"):
        certify(observer, recipe=dict(soft), **GIVEN)
    path = certify(observer, recipe=soft, **GIVEN).save(tmp_path / "soft.json")
    assert check(path, model="springs_of_mine:spring").statement.proved
    assert check(path, model="springs_of_mine:soft").statement.proved
    with pytest.raises(ValueError, match=r"stiffness is 2.0 in the recipe, and 7.0 of the model that was given"):
        check(path, model=models.oscillator(stiffness=7.0))


def test_a_statement_without_a_tube_is_not_checked(tmp_path):
    certificate = certify(Intrinsic(models.oscillator(), 10.0, 50.0), recipe={"system": "oscillator"}, **GIVEN)
    document = certificates.parse(certificate.save(tmp_path / "proved.json"))
    with pytest.raises(ValueError, match="the statement does not follow"):
        check(document._replace(radius=0.0))
