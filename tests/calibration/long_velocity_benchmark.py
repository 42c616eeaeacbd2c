"""An estimator and a log are added as docs/velocity-benchmark.md says, and the benchmark runs over them, twice."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "velocity-benchmark.md"
TWIN = '''

def spring(seed: int = 0) -> Twin:
    """A mass on a spring that is a tenth stiffer than its model."""
    log = covariant.simulate(models.oscillator(3.3), duration=8.0, rate=100.0, q0=[1.0], noise=1e-3, seed=seed).record
    file = models.ModelFile("spring", models.oscillator(3.0), measurement_std=1e-3, acceleration_std=0.5)
    return Twin("spring", file, covariant.Record(*log[:3]), np.asarray(log.x)[:, 1:])


TWINS["spring"] = spring
'''


def test_the_page_adds_an_estimator_and_a_log(tmp_path):
    shutil.copytree(ROOT / "benchmarks", tmp_path / "benchmarks", ignore=shutil.ignore_patterns("__pycache__"))
    ((title, block),) = re.findall(r'```python title="(benchmarks/.*?)"\n(.*?)```', PAGE.read_text("utf-8"), re.DOTALL)
    (tmp_path / title).write_text(block, encoding="utf-8")
    with (tmp_path / "benchmarks" / "twins.py").open("a", encoding="utf-8") as file:
        file.write(TWIN)
    with (tmp_path / "benchmarks" / "velocity" / "logs.toml").open("a", encoding="utf-8") as file:
        file.write('\n[[twin]]\nname = "spring, too stiff"\ntwin = "spring"\n')
    first, second = (_run(tmp_path) for _ in range(2))
    tables = [re.findall(r"^\|.*", text, re.MULTILINE) for text in (first, second)]
    assert tables[0] == tables[1]
    assert any(row.startswith("| smoothed-difference |") for row in tables[0])
    assert len(tables[0]) > 12
    assert " in 0 s" in first
    assert " s\n" not in second  # nothing was computed again


def _run(folder: Path) -> str:
    command = [sys.executable, "-m", "benchmarks.velocity", "spring, too stiff"]
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=True).stdout
