"""Velocities of joints and bodies from positions: estimators on recorded and simulated logs, and which one is best.

`make velbench` runs all logs and prints the table; `python -m benchmarks.velocity "tossed cube"` runs one, with every
score of every estimator. What was computed before is kept in build/velocity and read again, unless something changed.
"""

import argparse
import concurrent.futures
import multiprocessing
import os
import sys

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from benchmarks.velocity import fetch, table
from benchmarks.velocity.cases import entries
from benchmarks.velocity.run import OUT, judge


def main() -> None:
    """Run the logs that are named, or all, and print what came out."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.velocity", description=__doc__)
    parser.add_argument("logs", nargs="*", help="names of logs in logs.toml; by default all that are not slow")
    parser.add_argument("--fetch", action="store_true", help="download the recorded logs that are not there")
    parser.add_argument("--all", action="store_true", help="run the slow logs too: robots of six and seven joints")
    parser.add_argument("--list", action="store_true", help="print the names of the logs")
    parser.add_argument("--page", action="store_true", help="write table and figure of docs/velocity-benchmark.md")
    asked = parser.parse_args()
    if asked.list:
        print("\n".join(entries()))
        return
    unknown = sorted(set(asked.logs) - set(entries()))
    if unknown:
        sys.exit(f"no log is called {', '.join(unknown)}; there are: {', '.join(entries())}")
    if asked.fetch:
        fetch.fetch(OUT / "data")
    names = asked.logs or [name for name, entry in entries().items() if asked.all or not entry.get("slow")]
    workers = min(len(names), os.cpu_count() or 1)
    with concurrent.futures.ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        results = dict(zip(names, pool.map(judge, names), strict=True))
    absent = [name for name, one in results.items() if one is None]
    if absent:
        print(f"Not recorded here (`--fetch`, or COVARIANT_DATA): {', '.join(absent)}.")
    there = [one for one in results.values() if one is not None]
    if asked.page and (asked.logs or absent):
        sys.exit("the page has all logs: run --page without names, with the recorded ones")
    if not there:
        return
    print(table.summary(there) if len(there) != 1 else table.details(there[0]))
    if asked.page:
        table.write_page(there)


if __name__ == "__main__":
    main()
