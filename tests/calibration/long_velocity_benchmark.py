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

def rod(seed: int = 0) -> Twin:
    """A rod that is a tenth heavier than in its model."""
    true, stated = (models.pendulum_chain((mass,), (0.5,), viscous=(0.02,)) for mass in (1.1, 1.0))
    log = covariant.simulate(true, duration=8.0, rate=100.0, q0=[1.0], noise=1e-3, amplitude=2.0, seed=seed).record
    file = models.ModelFile("rod", stated, measurement_std=1e-3, acceleration_std=0.5)
    return Twin("rod", file, covariant.Record(*log[:3]), np.asarray(log.x)[:, 1:])


TWINS["rod"] = rod
'''


def test_the_page_adds_an_estimator_and_a_log(tmp_path):
    shutil.copytree(ROOT / "benchmarks", tmp_path / "benchmarks", ignore=shutil.ignore_patterns("__pycache__"))
    ((title, block),) = re.findall(r'```python title="(benchmarks/.*?)"\n(.*?)```', PAGE.read_text("utf-8"), re.DOTALL)
    (tmp_path / title).write_text(block, encoding="utf-8")
    with (tmp_path / "benchmarks" / "twins.py").open("a", encoding="utf-8") as file:
        file.write(TWIN)
    with (tmp_path / "benchmarks" / "velocity" / "logs.toml").open("a", encoding="utf-8") as file:
        file.write('\n[[twin]]\nname = "rod, too heavy"\ntwin = "rod"\n')
    first, second = (_run(tmp_path) for _ in range(2))
    tables = [re.findall(r"^\|.*", text, re.MULTILINE) for text in (first, second)]
    assert tables[0] == tables[1]
    assert any(row.startswith("| smoothed-difference |") for row in tables[0])
    assert len(tables[0]) > 12
    assert " in 0 s" in first
    assert " s\n" not in second  # nothing was computed again


def _run(folder: Path) -> str:
    command = [sys.executable, "-m", "benchmarks.velocity", "rod, too heavy"]
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=True).stdout
