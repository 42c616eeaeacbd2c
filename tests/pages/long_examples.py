"""What takes long of `test_examples.py`."""

import os

import pytest
from page_runs import run
from test_examples import each_page


@each_page
def test_a_page_runs_from_an_empty_folder(page, tmp_path, home):
    run(page, tmp_path, home, os.defpath)
