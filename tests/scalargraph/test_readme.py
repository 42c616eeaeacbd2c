"""The examples of the package's README run as they stand, one after the other."""

import re
from pathlib import Path

import scalargraph

README = Path(scalargraph.__file__).parent / "README.md"


def test_the_examples_run():
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) == 6
    exec(compile("\n".join(blocks), README, "exec"), {"__name__": "readme"})
