"""Mutation run: change one token of the source, and see whether the tests that know the file notice.

    python tools/mutants.py --seed 1 --count 200 --out mutants.json

A mutant is one changed operator, comparison, number, truth value, name of a pair (min and max, low and high), dropped
sign or negation, or two exchanged arguments. Mutants are drawn at random, from every room in proportion to its size.
The working tree is never written to: the package is a folder of links to it, in which one file is the mutant's.

Every mutant runs in a fork of a process that has imported JAX but not started it, and shares one cache of compiled
programs with the unmutated run before it. It survives where every relevant test passes. A survivor is either a missing
test or equivalent: then it stands in `equivalent_mutants.toml` with the reason. Any other makes the exit status 1.
"""

import argparse
import fnmatch
import importlib
import itertools
import json
import os
import signal
import sys
import tempfile
import time
import tomllib
import traceback
import warnings
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import psutil
import pytest
from mutations import ROOMS, ROOT, SOURCE, Mutant, draw, mutants_of

EQUIVALENT = Path(__file__).parent / "equivalent_mutants.toml"
LIMIT = 240.0
"""Seconds for one mutant; to take longer tells something where the unmutated tests need less than half of it."""
MEMORY = 12 * 2**30
"""Bytes of memory at which a mutant is stopped. A limit of the system's would count what sanitizers only reserve."""
FAILED = {1, 2, 4, -signal.SIGSEGV, -signal.SIGABRT, -signal.SIGFPE}
"""Exit statuses of a mutant that fails a test, cannot be imported, or crashes; any other says nothing of it."""
LONG = ("test_", "long_", 1)
"""What takes long of a file of tests stands in another one beside it."""
WARM = "jax jax.numpy equinox scipy.linalg hypothesis pytest beartype"

FITTING = ("fit", "innovations", "least_squares", "predict", "windows")
"""Files of the room of calibration that fit a model to logs."""

RELEVANT = {
    "geometry/lie/_left_invariant.py": "geometry/test_left_invariant",
    "geometry/lie/*": "geometry/test_lie_groups geometry/test_lie_accuracy geometry/test_left_invariant",
    "models/robots/*": "models/test_robots models/test_mjcf",
    "models/marine/*": "models/test_marine reference/test_jouffroy_fossen",
    "geometry/_interpolated.py": "geometry/test_interpolated",
    "geometry/_[af]*.py": "geometry/test_metric geometry/test_spaces laws/test_geometry geometry/test_shooting",
    "geometry/_geodesics.py": "geometry/test_metric geometry/test_shooting geometry/test_frames laws/test_geometry",
    "geometry/_space.py": "geometry/test_frames geometry/test_metric laws/test_geometry",
    "geometry/_manifold.py": "geometry/test_frames models/test_lagrangian",
    "geometry/*": "geometry/test_spaces laws/test_geometry geometry/test_shooting",
    "observers/_contracting.py": "observers/test_contracting",
    "observers/_passive_ship.py": "observers/test_contracting reference/test_jouffroy_fossen",
    "observers/_riccati.py": "observers/test_kalman observers/test_riccati_observer reference/test_sanfelice_praly",
    "observers/_*ed_derivative.py": "observers/test_model_free_filters observers/test_sampled",
    "observers/_savitzky_golay.py": "observers/test_model_free_filters observers/test_sampled",
    "observers/_ekf.py": "observers/test_kalman observers/test_group",
    "observers/_intrinsic.py": "observers/test_sampled observers/test_group laws/test_observers",
    "observers/_geodesic.py": "observers/test_sampled observers/test_group laws/test_observers",
    "observers/_lagrangian_metric.py": "observers/test_lagrangian_metric",
    "observers/_salcudean.py": "observers/test_group calibration/test_estimators",
    "observers/_registry.py": "calibration/test_estimators laws/test_every_observer",
    "observers/_copy.py": "observers/test_sampled reference/test_aghannan_rouchon",
    "observers/_intrinsic_kalman.py": "observers/test_kalman observers/test_intrinsic_kalman",
    "observers/_slow.py": "observers/test_slow_states observers/test_external_force",
    "observers/_states.py": "observers/test_gains_of_a_sample observers/test_sampled laws/test_observers",
    "observers/_protocol.py": "observers/test_gains_of_a_sample observers/test_sampled laws/test_observers",
    "observers/_ticks.py": "observers/test_ticks",
    "observers/_ukf.py": "observers/test_kalman observers/test_ukf",
    "observers/_state_*.py": "observers/test_state_ekf",
    "observers/_gate*.py": "observers/test_gate observers/test_faults",
    "observers/_delayed.py": "observers/test_delays",
    "observers/_s[pq]*.py": "observers/test_kalman observers/test_ukf",
    "observers/_[hjlmpt]*.py": "observers/test_model_free_filters observers/test_sampled",
    "observers/*": "observers/test_gains_of_a_sample observers/test_sampled laws/test_observers",
    "metrics/_high_gain.py": "metrics/test_outcomes",
    "metrics/_metric_on_grid.py": "metrics/test_metric_grid",
    **{f"metrics/_{name}.py": "metrics/test_grids" for name in ("grid", "map", "optional", "store")},
    "metrics/*": "metrics/test_gramians metrics/test_outcomes metrics/test_laws metrics/test_analytic_metric",
    "scalargraph/_loops.py": "scalargraph/test_c",
    "scalargraph/_jax_forms.py": "scalargraph/test_jax_forms scalargraph/test_lowering",
    "scalargraph/_fingerprint.py": "scalargraph/test_fingerprint",
    **{f"scalargraph/_{name}.py": "scalargraph/test_to_c" for name in ("c_names", "to_c")},
    "scalargraph/_c*.py": "scalargraph/test_c scalargraph/test_lowering",
    "scalargraph/_peephole.py": "scalargraph/test_c",
    "scalargraph/_rounding.py": "scalargraph/test_c",
    "scalargraph/proofs/checker/*": "scalargraph/test_taylor_models certificates/test_check",
    "scalargraph/_file.py": "attacks/test_files certificates/test_check",
    "scalargraph/_saved.py": "attacks/test_files certificates/test_check",
    "scalargraph/_form.py": "certificates/test_contraction certificates/test_cascade",
    "scalargraph/proofs/*": "certificates/test_proofs",
    "scalargraph/[cft]*.py": "test_cache_folder test_atomic_files test_templates",
    "scalargraph/*": "scalargraph/test_lowering scalargraph/test_intervals",
    "models/fluid.py": "models/test_fluid",
    "models/systems/_satellite*.py": "models/test_group_systems",
    "models/files/*": "models/test_model_file models/test_family cli/test_model_command",
    "models/_state_space.py": "models/test_state_space",
    "models/*": "models/test_lagrangian models/test_pendulum_chain models/test_group_systems models/test_state_space",
    "logs/_bag*.py": "logs/test_messages",
    "logs/_table*.py": "logs/test_tables",
    "logs/*": "logs/test_logs logs/test_odd_logs logs/test_configurations logs/test_messages",
    "simulation/_backstepping.py": "simulation/test_backstepping",
    "simulation/_reference.py": "simulation/test_backstepping",
    "simulation/*": "simulation/test_simulate simulation/test_sensors",
    "calibration/_draft.py": "calibration/test_draft",
    **{f"calibration/_{name}.py": "calibration/test_fit" for name in FITTING},
    **{
        f"calibration/{files}.py": "calibration/test_diagnosis calibration/test_suggestions"
        for files in ("diagnosis/*", "_suggest")
    },
    "calibration/*": "calibration/test_estimators calibration/test_gain_rule calibration/test_speeds "
    "calibration/test_tune",
    "codegen/_fm*.py": "codegen/test_fmu",
    "codegen/templates/*": "codegen/test_python_package",
    "codegen/*": "codegen/test_export",
    "engine/_cache*.py": "engine/test_cache",
    "engine/*": "engine/test_engine engine/test_in_jax",
    "report/_certificate.py": "report/test_certificate_figure",
    "report/*": "report/test_report_html report/test_report_panels report/test_report_png report/test_report_table",
    "cli/_check.py": "cli/test_check_command",
    "cli/*": "cli/test_bad_input cli/test_commands cli/test_certify_command cli/test_design_command",
    "verbs/base/tune*.py": "verbs/test_refusals",
    "verbs/base/fit*.py": "verbs/test_fit_verb verbs/test_refusals cli/test_fit_command",
    "verbs/base/sheet.py": "cli/test_state_space_commands",
    "verbs/base/model_output.py": "cli/test_model_command",
    "verbs/_tune.py": "verbs/test_refusals",
    "verbs/_fit.py": "verbs/test_fit_verb verbs/test_refusals cli/test_fit_command",
    "verbs/_simulate.py": "verbs/test_refusals cli/test_commands",
    "verbs/_check.py": "cli/test_check_command",
    "verbs/_certify.py": "cli/test_certify_command",
    "verbs/_describe.py": "cli/test_model_command",
    "verbs/_metric.py": "cli/test_design_command",
    "verbs/_reproduce.py": "verbs/test_refusals cli/test_commands cli/test_bad_input",
    "verbs/_export*.py": "codegen/test_export",
    "many/*sweep*.py": "many/test_sweep",
    "many/*": "many/test_over_logs",
    "verbs/*": "verbs/test_arguments verbs/test_refusals verbs/test_results cli/test_commands cli/test_bad_input",
    "certificates/theory/_cascade.py": "certificates/test_cascade",
    "certificates/theory/_observability.py": "certificates/test_observability_conditions",
    "certificates/checking/_matrices.py": "certificates/test_check",
    "certificates/base/_document.py": "attacks/test_files certificates/test_check",
    "certificates/*/_sa*.py": "certificates/test_check",
    "certificates/proving/_figures.py": "report/test_certificate_figure",
    "certificates/proving/_simulated.py": "certificates/test_shipped_certificates report/test_certificate_figure",
    "certificates/proving/_c*.py": "certificates/test_check certificates/test_shipped_certificates",
    "certificates/checking/_check.py": "certificates/test_check certificates/test_shipped_certificates",
    "certificates/base/_force_bounds.py": "certificates/test_contraction certificates/test_check",
    "certificates/base/_in[et]*.py": "certificates/test_contraction certificates/test_check",
    "certificates/theory/_marine_cascade.py": "certificates/test_cascade",
    "certificates/base/_error_system.py": "certificates/test_contraction certificates/test_check",
    "certificates/*": "certificates/test_contraction certificates/test_cascade",
}
"""Test files of the sources that match a pattern, cheapest first; the first pattern that matches holds."""


def in_room(file: str) -> str:
    """A file by its room and name, without its sub-room: files move within a room."""
    path = Path(file.removeprefix("covariant/"))
    return f"{path.parts[0]}/{path.name}"


def relevant(file: str) -> list[str]:
    places = (file.removeprefix("covariant/"), in_room(file))
    names = next(tests for pattern, tests in RELEVANT.items() if any(fnmatch.fnmatch(p, pattern) for p in places))
    found = [place for name in names.split() for place in (f"tests/{name}.py", f"tests/{name.replace(*LONG)}.py")]
    return [place for place in found if (ROOT / place).exists()]


def accepted() -> dict[tuple[str, str, str], str]:
    """The reason for each mutant, by file, line and mutated line, that is taken to be equivalent."""
    entries = tomllib.loads(EQUIVALENT.read_text(encoding="utf-8")).get("mutant", [])
    return {(in_room(entry["file"]), entry["line"], entry["mutant"]): entry["reason"] for entry in entries}


class _Watch:
    """Plugin that takes the files in their order, and notes which test fails first and how long each file takes."""

    def __init__(self, package: Path, tests: list[str]):
        self.package, self.failed, self.seconds = package, "", Counter()
        self.files = [test.split("::")[0] for test in tests]

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items):
        # Pytest itself goes by the parameters of fixtures, from one file to another and back.
        items.sort(key=lambda item: self.files.index(item.nodeid.split("::")[0]))

    def pytest_collection_finish(self):
        found = importlib.import_module("covariant").__file__
        assert found == str(self.package / "covariant" / "__init__.py"), f"the tests import {found}"

    def pytest_runtest_logreport(self, report):
        self.seconds[report.nodeid.split("::")[0]] += report.duration
        if report.failed:
            self.failed = self.failed or report.nodeid

    def pytest_collectreport(self, report):
        if report.failed:
            self.failed = self.failed or f"{report.nodeid} (import)"


class Workshop:
    """A folder in which mutants are tested: links to the package, and a cache of compiled programs."""

    def __init__(self, folder: Path, options: Sequence[str] = ()):
        self.folder, self.package, self.stamp = folder, folder / "src", 0
        self.options = ["-q", *options]
        for path in SOURCE.rglob("*"):
            if path.is_file() and "__pycache__" not in path.parts:
                link = self.package / path.relative_to(SOURCE)
                link.parent.mkdir(parents=True, exist_ok=True)
                link.symlink_to(path)

    def test(self, tests: list[str], mutant: Mutant | None = None, limit: float = LIMIT) -> dict:
        """Run the tests, up to the first failure where there is a mutant."""
        note, began = self.folder / "note.json", time.monotonic()
        note.unlink(missing_ok=True)
        if mutant is not None:
            self._put(mutant.file, mutant.apply((SOURCE / mutant.file).read_bytes()))
        sys.stdout.flush()
        child = os.fork()
        if not child:
            self._run(tests, ["-x"] if mutant else [], note)
        status = None
        try:
            while status is None and time.monotonic() - began < limit and _resident(child) < MEMORY:
                time.sleep(0.05)
                ended, code = os.waitpid(child, os.WNOHANG)
                status = os.waitstatus_to_exitcode(code) if ended else None
        finally:
            if status is None:
                os.killpg(child, signal.SIGKILL)
                os.waitpid(child, 0)
        if mutant is not None:
            self._put(mutant.file, None)
        told = json.loads(note.read_text()) if note.exists() else {"failed": f"exit status {status}", "seconds": {}}
        return {"status": status, "total": time.monotonic() - began, **told}

    def _run(self, tests: list[str], options: list[str], note: Path) -> None:
        """In the fork: the tests, on the package in this folder."""
        status = os.EX_SOFTWARE
        try:
            os.setpgid(0, 0)
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            output = os.open(self.folder / "output.txt", os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
            os.dup2(output, 1), os.dup2(output, 2)
            sys.path.insert(0, str(self.package))
            os.environ["PYTHONPATH"] = str(self.package)
            watch = _Watch(self.package, tests)
            known = ["-W", "ignore::pytest.PytestAssertRewriteWarning"]  # some plugins are imported already
            status = int(pytest.main([*self.options, *known, *options, *tests], plugins=[watch]))
            note.write_text(json.dumps({"failed": watch.failed, "seconds": watch.seconds}))
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stderr.flush()
            os._exit(status)

    def _put(self, file: str, source: bytes | None) -> None:
        """A file of the mutant's own in the place of a link, or the link again."""
        path = self.package / file
        path.unlink()
        if source is None:
            path.symlink_to(SOURCE / file)
        else:
            path.write_bytes(source)
            self.stamp += 1
            os.utime(path, (self.stamp, self.stamp))  # compiled code is told apart by the time in whole seconds


def _resident(process: int) -> int:
    try:
        return psutil.Process(process).memory_info().rss
    except psutil.Error:
        return 0


def warm(cache: Path) -> None:
    """Import what does not depend on the package. No backend is started, so that a fork is safe."""
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    *_, jax = (importlib.import_module(name) for name in [*WARM.split(), "jax"])
    jax.config.update("jax_compilation_cache_dir", str(cache))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    warnings.filterwarnings("ignore", message=".*fork", category=RuntimeWarning)


def judge(mutant: Mutant, told: dict, expected: float, reasons: dict) -> str:
    """What became of a mutant, given the seconds its tests take without it."""
    status = told["status"]
    if status is None:
        return "timeout" if expected < LIMIT / 2 else "undecided"
    if status:
        return "killed" if status in FAILED else "undecided"
    return "equivalent" if (in_room(mutant.file), *mutant.diff()) in reasons else "survived"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=200, help="mutants drawn from all rooms")
    parser.add_argument("--only", nargs="*", default=["*"], metavar="GLOB", help="of those drawn, these files'")
    parser.add_argument("--ids", nargs="*", metavar="ID", help="these mutants instead of drawn ones")
    parser.add_argument("--tests", nargs="*", metavar="TEST", help="these tests instead of the relevant files")
    parser.add_argument("--short", action="store_true", help="without the long tests, as `make test` is")
    parser.add_argument("--list", action="store_true", help="only list the mutants")
    parser.add_argument("--programs", type=Path, help="folder that keeps compiled programs for the next run")
    parser.add_argument("--out", type=Path, help="file for a summary in JSON")
    options = parser.parse_args()
    chosen = _chosen(options)
    if options.list:
        for mutant in chosen:
            print(mutant.id, *mutant.diff(), sep="\n    ")
        return 0
    os.chdir(ROOT)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # and take the fork along
    with tempfile.TemporaryDirectory() as folder:
        suite = ["-m", "not long"] if options.short else ["-o", "python_files=test_*.py long_*.py"]
        return _run_all(chosen, Workshop(Path(folder), suite), options)


def _chosen(options: argparse.Namespace) -> list[Mutant]:
    if not options.ids:
        drawn = draw(options.seed, options.count)
        return [mutant for mutant in drawn if any(fnmatch.fnmatch(mutant.file, glob) for glob in options.only)]
    chosen = [m for file in sorted({i.split(":")[0] for i in options.ids}) for m in mutants_of(file)]
    chosen = [mutant for mutant in chosen if mutant.id in options.ids]
    if missing := set(options.ids) - {mutant.id for mutant in chosen}:
        raise SystemExit(f"no such mutant: {', '.join(sorted(missing))}; --list shows the ids")
    return chosen


def _run_all(chosen: list[Mutant], workshop: Workshop, options: argparse.Namespace) -> int:
    warm(options.programs or workshop.folder / "programs")
    tests = {mutant.file: options.tests or relevant(mutant.file) for mutant in chosen}
    reasons, results, began = accepted(), [], time.monotonic()
    unmutated = workshop.test(list(dict.fromkeys(itertools.chain(*tests.values()))), limit=float("inf"))
    for file, seconds in unmutated["seconds"].items():
        print(f"{seconds:6.1f} s  {file}")
    if unmutated["status"]:
        print(f"unmutated, {unmutated['failed']} fails:\n{(workshop.folder / 'output.txt').read_text()[-2000:]}")
        return 2
    for mutant in chosen:
        told = workshop.test(tests[mutant.file], mutant)
        expected = sum(unmutated["seconds"].get(test.split("::")[0], 0.0) for test in set(tests[mutant.file]))
        verdict, (old, new) = judge(mutant, told, expected, reasons), mutant.diff()
        by = f" by {told['failed'] or 'its import'}" if verdict == "killed" else ""
        word = verdict.upper() if verdict == "survived" else verdict
        print(f"{word:9} {told['total']:5.1f} s  {mutant.id}{by}", flush=True)
        entry = {"id": mutant.id, "verdict": verdict, "by": told["failed"], "seconds": told["total"]}
        results.append(entry | {"line": old, "mutant": new})
    left = [result for result in results if result["verdict"] in ("survived", "undecided")]
    for result in left:
        print(f"\n{result['id']}\n-   {result['line']}\n+   {result['mutant']}")
    rooms = {room: Counter(r["verdict"] for r in results if r["id"].startswith(f"{room}/")) for room in ROOMS}
    for room, verdicts in rooms.items():
        print(f"{room:22} " + ", ".join(f"{count} {verdict}" for verdict, count in verdicts.items()))
    summary = {"seed": options.seed, "seconds": time.monotonic() - began, "rooms": rooms, "mutants": results}
    if options.out:
        options.out.write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
    return 1 if left else 0


if __name__ == "__main__":
    sys.exit(main())
