"""The commands: each is a verb with what only the command line has, such as files to write."""

import os
import sys
from pathlib import Path
from typing import Any

from covariant import verbs
from covariant.cli import _parse
from covariant.cli._command import Command, Invocation
from covariant.cli._options import FLAG, PATH, TEXT, Kind, Option
from covariant.cli._signature import REQUIRED
from covariant.cli._terminal import say
from covariant.logs import WRITTEN
from covariant.observers import OBSERVER_NAMES, STATE_OBSERVER_NAMES
from covariant.verbs import FIGURES, TABLES, check_machine_files, check_model_output, check_output
from scalargraph.errors import InputError


def _fit(call: Invocation, out: Path | None, report: Path | None, overwrite: bool) -> Any:
    model, parameters = call.values["model"], call.values.get("parameters", "").split(",")
    inertias = any(name.strip().removeprefix("parameters.").split(".")[0] == "inertia" for name in parameters)
    urdf = inertias and not model.endswith(".xml")
    if out is not None and "each" in call.values:
        check_machine_files(model, out, call.values["log"], overwrite, urdf)
    else:
        check_model_output(model, out, overwrite, urdf)
    result = call()
    return call.show(result, out if result.better else None, report, overwrite=overwrite)


def _tune(call: Invocation, out: Path | None, report: Path | None, overwrite: bool) -> Any:
    check_model_output(call.values["model"], out, overwrite)
    return call.show(call(), out, report, overwrite=overwrite)


def _check(call: Invocation, out: Path | None, report: Path | None) -> Any:
    if out is not None:
        raise InputError(f"--out {out}: it is of many logs; give the name of a folder, or --report FILE")
    return call.show(call(), report=report)


def _init(call: Invocation, out: Path, overwrite: bool) -> Any:
    return call.show(call(), out, overwrite=overwrite)


def _export(call: Invocation) -> Any:
    result = call()
    # On standard error, so that --json prints its object alone.
    for warning in result.warnings:
        say(f"covariant: warning: {call.words(warning)}", sys.stderr)
    return call.show(result)


def _certify(
    call: Invocation, out: Path | None, report: Path | None, figure: Path | None, check: Path | None, given: str | None
) -> Any:
    if given is not None and check is None:
        raise InputError("--model goes with --check FILE; the model to certify is the first argument")
    if ("model" in call.values) == (check is not None):
        raise InputError("give a model to certify, or --check FILE to verify a saved certificate")
    if report is not None and check is not None:
        raise InputError("--report shows a certificate that is computed; leave --check out")
    if check is not None:
        if not check.exists():
            raise InputError(f"{check} does not exist; give the path of a saved certificate")
        return call.show(call("check_certificate", path=check, model=given))
    if figure is not None and "interval" in call.values:
        raise InputError("--figure is for certificates in continuous time; leave --interval out")
    result = call()
    return call.show(result, None if result.wrong else out, report, figure=figure)


def _is_estimate(columns: list[str]) -> bool:
    """Whether a table may be one of estimates, whose first column is the time."""
    return columns[:1] == ["t"]


def _to_store(call: Invocation, **places: Any) -> Any:
    check_output(call.values["store"], ".zarr", store=True)
    return call.show(call(), **places)


def _output(help: str, *suffixes: str, needed: bool = False, **more: Any) -> Option:
    """Option of the file to write."""
    help = f"{help} ({', '.join(suffixes)})."
    return Option("out", PATH, help, REQUIRED if needed else None, ("-o", "--out"), suffixes=suffixes)._replace(**more)


ESTIMATE = _output("", *WRITTEN)._replace(
    help=f"Write the estimate here ({', '.join(WRITTEN)}); of many logs, give a folder."
)
MODEL_FILE = _output("Write the model file with the new numbers here", ".toml", suffixes=())
REPORT = Option(
    "report",
    PATH,
    "Write an interactive page (.html) and PNG figures beside it.",
    flags=("--report",),
    suffixes=(".html",),
)
PAGE = REPORT._replace(help="Write a page (.html) of the numbers, and figures beside it where there are some.")
RERUN = Option(
    "rerun",
    PATH,
    "Write a recording for the Rerun viewer (.rrd): curves, bands, and the robot in motion.",
    flags=("--rerun",),
    suffixes=(".rrd",),
)
OVERWRITE = Option("overwrite", FLAG, "Let --out replace a file of another origin.", False, ("--overwrite",))
LISTED = {
    "observer": {
        "help": f"One of: {', '.join(OBSERVER_NAMES)}; intrinsic by default. For a state-space model: "
        f"{', '.join(STATE_OBSERVER_NAMES)}."
    }
}
"""The option `observer` of commands that take all of them."""
SEVERAL = {"kind": Kind(list[Path], _parse.log_paths, "LOG...")}
EACH = SEVERAL | {
    "help": "Log with stamps, positions or attitudes, inputs: .csv, .txt, .parquet, .mcap, a rosbag2; or many of them."
}

LOG, ROBOTS, EXPORT, PROOFS, HELP = "Your log", "Robots and models", "Export", "Proofs and papers", "This program"
"""Headings of the help."""
COMMANDS = (
    Command(
        "init",
        LOG,
        "init log.csv -o arm.toml",
        "docs/your-log.md",
        own=(_output("Model file to write", ".toml", needed=True), OVERWRITE),
        run=_init,
        note="What is guessed is said in its comments.",
    ),
    Command(
        "check",
        LOG,
        "check arm.toml log.csv",
        "docs/check.md",
        own=(Option("out", PATH, "Of many logs: folder for a table and a page.", None, ("-o", "--out")), PAGE),
        changes={"log": EACH},
        exit_code=lambda result: bool(result.wrong),
        run=_check,
        over_logs=True,
        note="Exit code 1 where something is wrong.",
    ),
    Command(
        "fit",
        LOG,
        "fit arm.toml log.csv --parameters com,viscous -o fitted.toml",
        "docs/identification.md",
        own=(
            MODEL_FILE._replace(help="Model file to write (.toml); a folder fits each log by itself."),
            PAGE,
            OVERWRITE,
        ),
        changes={"log": SEVERAL | {"help": "Logs to fit; the last of several, or the last third of one, is held out."}},
        run=_fit,
        over_logs=True,
        exit_code=lambda result: result.exit_code,
        note="Exit code 1 where the fitted model predicts worse than before what is held out; it is not written then.",
    ),
    Command(
        "tune",
        LOG,
        "tune arm.toml log.csv -o tuned.toml",
        "docs/tuning.md",
        own=(MODEL_FILE._replace(flags=("-o", "--out", "--write")), REPORT, OVERWRITE),
        changes={"log": SEVERAL | {"help": "Logs; the last third of each is held out to judge by."}},
        run=_tune,
    ),
    Command(
        "estimate",
        LOG,
        "estimate arm.toml log.csv -o velocity.csv --report page.html",
        "docs/your-log.md",
        own=(ESTIMATE, REPORT, RERUN, OVERWRITE),
        changes=LISTED | {"log": EACH},
        again=_is_estimate,
        over_logs=True,
    ),
    Command(
        "smooth",
        LOG,
        "smooth arm.toml log.csv -o smooth.csv",
        "docs/smoothing.md",
        own=(ESTIMATE, REPORT, RERUN, OVERWRITE),
        changes={"log": EACH},
        again=_is_estimate,
        over_logs=True,
    ),
    Command(
        "compare",
        LOG,
        "compare arm.toml log.csv",
        "docs/choose.md",
        own=(_output("Write the table here", ".csv"), REPORT),
    ),
    Command("describe_model", ROBOTS, "model panda", "docs/robots.md", "model"),
    Command(
        "simulate",
        ROBOTS,
        "simulate arm.toml --duration 10 --rate 500 -o log.csv",
        "docs/robots.md",
        own=(_output("Log to write", *WRITTEN, needed=True), OVERWRITE),
        note="The log has the true state beside the measurements.",
        again=lambda columns: any(name.startswith("true_") for name in columns),
    ),
    Command(
        "design_excitation",
        ROBOTS,
        "design excitation arm.toml --parameters friction -o excitation.csv --duration 5",
        "docs/fit-robots.md",
        "design excitation",
        own=(
            _output("Motion and torques to write", *TABLES, needed=True),
            Option(
                "figure", PATH, "Draw the motion and its limits here (.png).", flags=("--figure",), suffixes=FIGURES
            ),
            OVERWRITE,
        ),
        note="Collisions are not looked at.",
    ),
    Command(
        "design_metric",
        ROBOTS,
        "design metric unknown_frequency --grid 9 --rate 8 -o P.zarr",
        "docs/metrics.md",
        "design metric",
        changes={"start": {"flags": ("--start",)}},
        run=_to_store,
        note="A run that was stopped goes on where it was.",
    ),
    Command(
        "design_reduced_order",
        ROBOTS,
        "design reduced-order lorenz --rate 1",
        "docs/contracting.md",
        "design reduced-order",
    ),
    Command(
        "sweep",
        ROBOTS,
        "sweep basin.toml -o basin.zarr",
        "docs/many.md",
        own=(_output("Write the table here", ".csv", name="table", flags=("--table",)), PAGE),
        run=lambda call, table, report: _to_store(call, out=table, report=report),
        note="A run that was stopped goes on where it was.",
    ),
    Command(
        "export",
        EXPORT,
        "export arm.toml --rate 500 -o arm",
        "docs/firmware.md",
        changes=LISTED
        | {"parameters": {"help": "Numbers of the model that may be changed at run time; all by default, or none."}},
        run=_export,
    ),
    Command(
        "certify",
        PROOFS,
        "certify examples/heavy_top.toml --alpha 10 --beta 50 --velocity 1 --error 0.05 --rate 2",
        "docs/certificates.md",
        own=(
            _output("Write the certificate here", ".json"),
            PAGE,
            Option(
                "figure",
                PATH,
                "Draw region, tube, distances and gains here (.png).",
                flags=("--figure",),
                suffixes=FIGURES,
            ),
            Option("check", PATH, "Verify this saved certificate instead.", flags=("--check",)),
            Option(
                "given",
                TEXT,
                "With --check: the module:attribute of a model that is not covariant's own.",
                flags=("--model",),
            ),
        ),
        changes={"model": {"default": None}, "processes": {"default": os.cpu_count() or 1}},
        run=_certify,
        exit_code=lambda result: (
            not (result.verified if isinstance(result, verbs.CertificateCheckResult) else result.holds)
        ),
        note="Angles are in radians. Exit code 0 proved or verified, 1 wrong, undecided or refused, 2 bad input.",
    ),
    Command(
        "reproduce_paper",
        PROOFS,
        "reproduce maithripala",
        "docs/maithripala.md",
        "reproduce",
        own=(_output("Write the paper's figure here", ".png", name="figure"), PAGE),
    ),
    Command(
        "doctor",
        HELP,
        "doctor",
        "README.md",
        exit_code=lambda result: bool(result.problems),
        note="Exit code 1 on a problem.",
    ),
)
"""All commands, in the order of the help. A verb whose arguments are all that its command has is one line here."""
