"""Every command and every Python example of the README and the pages runs as it stands, in the place of a user.

The first page that runs begins with an empty cache folder, as that of a new user is.
"""

import os
import re

import pytest
from page_runs import EXECUTED, PAGES, needs_checkout, over, run
from run_page import PARTS, blocks

each_page = over(EXECUTED)


@pytest.mark.exhaustive("fit-robots.md", "tuning.md")
@pytest.mark.core(1)  # the README
@each_page
def test_a_page_runs_from_an_empty_folder(page, tmp_path, home):
    run(page, tmp_path, home, os.defpath)


@each_page
def test_a_page_that_needs_a_checkout_says_so(page):
    prose = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert not needs_checkout(page) or "checkout" in prose


def test_every_block_is_run_or_says_why_not():
    """What is not run is a part of a larger program, or has its reason above it; there are few of these."""
    reasons = []
    for page in PAGES:
        for block in blocks(page.read_text(encoding="utf-8")):
            known = block.language in ("bash", "python", "toml", "text", *PARTS)
            assert known, f"{page.name}:{block.line}: what is a block of {block.language!r}?"
            reasons += [f"{page.name}:{block.line}: {block.reason}"] if block.reason else []
            assert not block.reason or len(block.reason.split()) > 3, f"{page.name}:{block.line}: why is it not run?"
    assert len(reasons) <= 8, "\n".join(reasons)
