"""Run every numbered script of the gallery and check that each draws its figure: `python gallery/run_all.py`.

The figures go to `gallery/out`, each under the name of its script. Exits with 1 where a script fails.
The notebooks draw no files; `tests/pages/long_notebooks.py` runs them.
"""

import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

GALLERY = Path(__file__).resolve().parent


def main() -> int:
    """Run the scripts, two at a time, with one line each; returns the exit code."""
    scripts = sorted(GALLERY.glob("[0-9][0-9]_*.py"), reverse=True)  # later ones take longer, and go first
    with ThreadPoolExecutor(2) as pool:
        failures = sum(not fine for fine in pool.map(run, scripts))
    print(f"{len(scripts) - failures} of {len(scripts)} scripts ran; figures in {os.path.relpath(GALLERY / 'out')}")
    return min(failures, 1)


def run(script: Path) -> bool:
    """Run one script in a process of its own; True where it ended well and drew a figure."""
    figure = GALLERY / "out" / f"{script.stem}.png"
    figure.unlink(missing_ok=True)  # so that an old one cannot pass for it
    began = time.perf_counter()
    environment = {"JAX_PLATFORMS": "cpu", **os.environ}
    done = subprocess.run([sys.executable, script], env=environment, capture_output=True, text=True, check=False)
    wrong = f"exit code {done.returncode}" if done.returncode else "" if figure.exists() else f"no {figure.name}"
    print(f"{script.name:<36}{time.perf_counter() - began:6.1f} s  {wrong or 'ok'}", flush=True)
    if wrong:
        print(done.stdout + done.stderr, flush=True)
    return not wrong


if __name__ == "__main__":
    sys.exit(main())
