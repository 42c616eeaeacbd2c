"""`covariant check`: what is wrong with a log, or with the model file for it, before anybody estimates from it."""

import json
from typing import Any

from covariant import models
from covariant.cli._console import working
from covariant.diagnosis import Diagnosis, Finding, diagnose
from covariant.workflow import Job, load


def check(job: Job, as_json: bool) -> None:
    """Compare a log with a model and print the findings; leaves with exit code 1 where one of them is wrong."""
    with working(f"comparing {job.log} with {job.model}", quiet=as_json):
        loaded = load(job, score=False, why="logs are compared with")
        # The quantum as the model file has it: loading leaves it out where positions are no such ticks.
        done = diagnose(loaded.file, loaded.log.record, models.load(job.model, job.overrides).quantum)
    head = f"{job.log}: {len(loaded.log.record.t)} rows at {loaded.rate:.4g} Hz, compared with {job.model}"
    result = {"model": job.model, "log": str(job.log), "rows": len(loaded.log.record.t), "wrong": done.wrong}
    result |= {"findings": [finding._asdict() for finding in done.findings], "looked_for": done.looked_for}
    print(json.dumps(result) if as_json else "\n".join([head, *_text(done)]))
    if done.wrong:
        raise SystemExit(1)


def _text(done: Diagnosis) -> list[str]:
    looked = f"looked for: {', '.join(done.looked_for)}"
    if not done.findings:
        return [f"nothing found; {looked}"]
    lines: list[Any] = []
    for finding in done.findings:
        lines += ["", *_lines(finding)]
    verdict = "the log is not what the model file says it is" if done.wrong else "nothing is wrong"
    return [*lines, "", f"{verdict}; {looked}"]


def _lines(finding: Finding) -> list[str]:
    mark = "WRONG" if finding.wrong else "note"
    name = f"{finding.what} of {finding.where}" if finding.where else finding.what
    return [f"{mark:<6}{name}", f"      {finding.evidence}", *([f"      -> {finding.line}"] if finding.line else [])]
