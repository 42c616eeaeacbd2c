"""Which works are behind an observer and a model."""

import json
import re

import pytest
from typer.testing import CliRunner

from covariant import workflow
from covariant.cli._app import app
from covariant.observers import REGISTRY
from covariant.workflow._cite import all_works, works_in


@pytest.mark.parametrize("entry", REGISTRY, ids=lambda entry: entry.name)
def test_every_work_that_a_source_names_is_listed(entry):
    years = re.findall(r"\b(?:19|20)\d\d\b", entry.source)
    assert [work.fields["year"] for work in works_in(entry.source)] == years
    assert years or entry.source == "common practice"


def test_every_listed_work_is_named_by_a_source_or_is_one_of_the_four_papers():
    named = {work for entry in REGISTRY for work in works_in(entry.source)}
    assert {work.label for work in set(all_works()) - named} <= {"Jouffroy & Fossen 2004"}
    keys = {re.match(r"@\w+\{(\w+),", work.bibtex)[1] for work in all_works()}
    assert len(keys) == len(all_works())


@pytest.mark.parametrize("work", all_works(), ids=lambda work: work.label)
def test_an_entry_has_the_fields_of_its_kind_and_balanced_braces(work):
    entry = work.bibtex
    kind = re.match(r"@(\w+)\{", entry)[1]
    needed = {"article": "journal", "inproceedings": "booktitle", "book": "publisher", "misc": "eprint"}[kind]
    assert {"author", "title", "year", needed} <= set(re.findall(r"^  (\w+) =", entry, re.MULTILINE))
    assert entry.count("{") == entry.count("}")
    assert work.label in str(work)


def test_the_observer_that_would_run_and_the_numbers_of_the_model_are_cited():
    cited = workflow.cite("examples/dfki_double_pendulum.toml")
    assert cited.observer_name == "intrinsic"
    assert [work.label for work in cited.works][:1] == ["Aghannan & Rouchon 2003"]
    assert cited.numbers == ("DFKI RIC double_pendulum, design_A.0/model_2.0",)
    with pytest.raises(ValueError, match="riccati does not fit examples/dfki_double_pendulum"):
        workflow.cite("examples/dfki_double_pendulum.toml", observer="riccati")


def test_the_command_writes_the_entries(tmp_path):
    out = tmp_path / "works.bib"
    done = CliRunner().invoke(app, ["cite", "lorenz", "--observer", "riccati", "--json", "-o", str(out)])
    assert done.exit_code == 0
    printed = json.loads(done.stdout)
    assert printed["bibtex"] + "\n" == out.read_text(encoding="utf-8")
    assert "@inproceedings{sanfelice2015" in printed["bibtex"]
    with pytest.raises(ValueError, match=r"must end in \.bib"):
        workflow.cite("lorenz").save(tmp_path / "works.txt")
