"""Files that somebody made to be believed, or to run something: each is refused in one line, and runs nothing."""

import contextlib
import dataclasses
import json
import os
import random
import re
import sys
from pathlib import Path

import jax
import pytest
from jax.experimental.compilation_cache import compilation_cache

from covariant import models
from covariant._door import CERTIFICATE
from covariant.certificates import ContractionCertificate, check, parse
from covariant.certificates.checking._check import follows
from covariant.cli import main
from covariant.models.files import _systems
from covariant.proofs import digest
from covariant.proofs._file import MOST_VALUES

SHIPPED = Path(__file__).parents[2] / "examples/certificates"
BEAM = (SHIPPED / "ball_and_beam.json").read_text(encoding="utf-8")
TOP = (SHIPPED / "heavy_top.json").read_text(encoding="utf-8")


@pytest.fixture(scope="module", autouse=True)
def no_programs_are_kept():
    """Where somebody keeps compiled programs in a folder, that they are read from there would be seen as well."""
    kept = jax.config.jax_enable_compilation_cache  # pyright: ignore[reportAttributeAccessIssue]
    for enabled in (False, kept):
        jax.config.update("jax_enable_compilation_cache", enabled)
        compilation_cache.reset_cache()
        if not enabled:
            yield


# What happens while a file is read, as the interpreter sees it.

DOES = ("os.system", "os.exec", "os.fork", "os.posix_spawn", "os.spawn", "subprocess.Popen", "pty.spawn", "exec")
TOUCHES = ("os.remove", "os.rename", "os.mkdir", "os.rmdir", "os.chmod", "os.link", "os.symlink", "os.truncate")
REACHES = (
    "socket.connect",
    "socket.bind",
    "socket.getaddrinfo",
    "urllib.Request",
    "ctypes.dlopen",
    "pickle.find_class",
)
WATCHED = {"import", "open", *DOES, *TOUCHES, *REACHES}
WRITERS = {"beartype"}
"""It writes the checks of types that the tests switch on, and runs those."""
seen: list[tuple] | None = None


def hook(event, arguments):
    if seen is not None and event in WATCHED:
        caller = sys._getframe(1).f_globals.get("__name__", "")
        written = event == "exec" and caller.partition(".")[0] in WRITERS
        # Lines for a traceback, of modules and of the program that was started.
        lines = str(arguments[0]).endswith(".py") or caller == "tokenize"
        source = event == "open" and lines and arguments[1] == "r"
        if not (written or source):
            seen.append((event, *map(repr, arguments), caller))


sys.addaudithook(hook)  # which cannot be taken away again, and does nothing while `seen` is None


class Watched:
    """The events while it is open, but for opening one file to read it."""

    def __init__(self, path=None):
        self.path = path

    def __enter__(self):
        global seen
        self.modules = set(sys.modules)
        seen = self.events = []
        return self

    def __exit__(self, *_):
        global seen
        seen = None
        reading = ("open", repr(str(self.path)), "'r'")
        self.reads = sum(event[:3] == reading for event in self.events)
        self.events = [event for event in self.events if event[:3] != reading]
        self.opened = {name for name in set(sys.modules) - self.modules if name.partition(".")[0] not in OURS | WRITERS}


OURS = {"jax", "jaxlib", "numpy", "equinox", "covariant"}
"""Whose parts may be loaded when they are first used."""


@pytest.fixture(scope="module", autouse=True)
def warm():
    """What JAX and this library load when a model is made for the first time is loaded."""
    for name in _systems.SYSTEMS:
        with contextlib.suppress(ValueError):  # some need parameters
            jax.tree.map(lambda leaf: leaf, models.from_recipe({"system": name, "parameters": {}}))
    for text in (BEAM, TOP):
        follows(parse("warm.json", text.encode()))


def refused(call, path: Path, key: str) -> str:
    """The one line with which a file is refused: it names the file, and the key."""
    with pytest.raises(ValueError) as found:  # noqa: PT011  the line is looked at here
        call()
    line = str(found.value)
    assert len(line.splitlines()) == 1
    assert len(line) < 1500
    assert path.name in line
    assert re.search(key, line), line
    return line


def both(path: Path, key: str) -> None:
    """Refused by those who check and by those who load, and nothing is run, written or imported."""
    before = sorted(path.parent.iterdir())
    with Watched(path) as watched:
        refused(lambda: check(path), path, key)
        refused(lambda: ContractionCertificate.load(path), path, key)
    assert watched.events == []
    assert not watched.opened
    assert watched.reads <= 2  # once each
    assert sorted(path.parent.iterdir()) == before


def mended(document: dict) -> str:
    return json.dumps(document | {"digest": digest(document)}, ensure_ascii=False)


def put(*path_and_value):
    *path, last, value = path_and_value

    def change(document):
        target = document
        for key in path:
            target = target[key]
        target[last] = value(target[last]) if callable(value) else value

    return change


def drop(*path):
    *path, last = path

    def change(document):
        target = document
        for key in path:
            target = target[key]
        target.pop(last)

    return change


def forged(change, folder: Path, text: str = BEAM) -> Path:
    """A certificate that was changed, with the digest that goes with it."""
    document = json.loads(text)
    change(document)
    path = folder / "forged.json"
    path.write_text(mended(document), encoding="utf-8")
    return path


def runs(folder: Path) -> dict:
    return {"attribute": "os:system", "parameters": {"command": f"touch {folder / 'marker'}"}}


@pytest.mark.long
def test_a_file_does_not_run_a_program(tmp_path):
    path = forged(lambda document: document.update(recipe=runs(tmp_path)), tmp_path)
    both(path, "recipe: the model is 'os:system', code that a recipe does not run")
    assert not (tmp_path / "marker").exists()


def test_the_command_does_not_run_a_program_either(tmp_path, monkeypatch, capsys):
    path = forged(lambda document: document.update(recipe=runs(tmp_path)), tmp_path)
    code, out, _ = command(monkeypatch, capsys, path)
    assert code == 1
    assert out.startswith("Refused: ")
    assert "--model module:attribute" in out
    assert not (tmp_path / "marker").exists()


def test_a_file_does_not_import_a_module_that_lies_beside_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lies_here.py").write_text("import pathlib\npathlib.Path('marker').touch()\nmodel = None\n")
    path = forged(put("recipe", {"attribute": "lies_here:model", "parameters": {}}), tmp_path)
    both(path, "recipe: the model is 'lies_here:model'")
    assert "lies_here" not in sys.modules
    assert not (tmp_path / "marker").exists()


# Text that is no certificate.


def deep(text):
    return text.replace('"rate": 0.1', '"rate": ' + "[" * 100_000 + "]" * 100_000)


def raw(old, new):
    """Another text in the place of one; the digest is that of what it says, where it says anything."""

    def change(text):
        assert text.count(old) >= 1
        made = text.replace(old, new, 1)
        try:
            return mended(json.loads(made)) if new.endswith(("NaN", "Infinity")) else made
        except ValueError:
            return made

    return change


TEXTS = {
    "empty": (lambda text: "", "not JSON"),
    "blank": (lambda text: " \n ", "not JSON"),
    "a word": (lambda text: "certificate", "not JSON: Expecting value at line 1, column 1"),
    "a number": (lambda text: "1", "must be a certificate with a format; found 1"),
    "null": (lambda text: "null", "must be a certificate"),
    "a list": (lambda text: f"[{text}]", "must be a certificate"),
    "nothing in it": (lambda text: "{}", "must be a certificate with a format"),
    "half of it": (lambda text: text[: len(text) // 2], "not JSON"),
    "twice": (lambda text: text + text, "not JSON: Extra data"),
    "something behind it": (lambda text: text + "x", "not JSON: Extra data"),
    "byte order mark": (lambda text: "\ufeff" + text, "not JSON"),
    "bytes of no text": (lambda text: text.encode() + b"\xff\xfe", "no text in UTF-8, at byte"),
    "UTF-16": (lambda text: text.encode("utf-16"), "no text in UTF-8, at byte 0"),
    "zero bytes": (lambda text: b"\0" * 1000, "not JSON"),
    "single quotes": (lambda text: text.replace('"', "'"), "not JSON"),
    "comment": (lambda text: "// holds\n" + text, "not JSON"),
    "comma too many": (raw('"rate": 0.1,', '"rate": 0.1,,'), "not JSON"),
    "100 000 brackets": (deep, "nested more than 8 deep"),
    "brackets never closed": (lambda text: "[" * 100_000, "nested more than 8 deep"),
    "100 000 objects": (lambda text: '{"a":' * 100_000, "nested more than 8 deep"),
    "objects in a parameter": (raw('"parameters": {}', '"parameters": {"mass": [[[[[[1]]]]]]}'), "nested more than 8"),
    "a string never closed": (lambda text: text + '"' + "[" * 50, "not JSON"),
    "too many values": (raw('"rate": 0.1', '"rate": [' + "0," * MOST_VALUES + "0]"), "more than 2000000 values"),
    "key twice": (raw('"rate": 0.1', '"rate": 9, "rate": 0.1'), "the key 'rate' is there twice"),
    "key of the box twice": (raw('"box": {', '"box": {"low": [], '), "the key 'low' is there twice"),
    "key in disguise": (raw('"rate"', '"r\\u0061te"'), "backslash on line"),
    "half a letter": (raw('"measured"', '"\\ud800"'), "backslash on line"),
    "line break in a string": (raw('"measured"', '"meas\nured"'), "not JSON: Invalid control character"),
    "not a number": (raw('"rate": 0.1', '"rate": NaN'), "rate must be a finite number.*found nan"),
    "infinite radius": (raw('"radius": 0.009042911779015596', '"radius": Infinity'), "radius must be .*found inf"),
    "infinite bound": (raw("0.22000000000000003", "Infinity"), r"box\.(low|high)\[0\] must be"),
    "more than a double holds": (raw('"rate": 0.1', '"rate": 1e999'), "digest|rate must be"),
    "5000 digits": (raw('"rate": 0.1', '"rate": ' + "9" * 5000), "digest|rate must be"),
    "a digit changed": (raw('"rate": 0.1', '"rate": 0.2'), "digest must be .*it was changed since it was saved"),
}


@pytest.mark.parametrize("name", TEXTS)
def test_text_that_is_no_certificate_is_refused(name, tmp_path):
    change, key = TEXTS[name]
    made = change(BEAM)
    path = tmp_path / "forged.json"
    path.write_bytes(made if isinstance(made, bytes) else made.encode("utf-8"))
    both(path, key)


@pytest.mark.parametrize("digits", ["1e999", "-1e400", "9" * 5000, "1" + "0" * 300])
def test_numbers_without_bounds_are_refused_by_their_key(digits, tmp_path):
    document = json.loads(BEAM)
    document["rate"] = float(digits)
    path = tmp_path / "forged.json"
    path.write_text(re.sub('"rate": [^,]*', f'"rate": {digits}', mended(document)), encoding="utf-8")
    both(path, "rate must be a finite number")


def test_what_is_no_file_is_refused(tmp_path):
    both(tmp_path / "nowhere.json", "No such file or directory; give the path of a saved certificate")
    (tmp_path / "folder.json").mkdir()
    both(tmp_path / "folder.json", "is a folder; give the path")
    os.mkfifo(tmp_path / "pipe.json")
    both(tmp_path / "pipe.json", "is no file; write what it delivers")
    (tmp_path / "loop.json").symlink_to(tmp_path / "loop.json")
    both(tmp_path / "loop.json", "loop.json")
    both(tmp_path / ("long" * 100 + ".json"), "long")


def test_a_file_that_may_not_be_read_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "secret.json"
    path.write_text(BEAM)

    def forbidden(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", forbidden)
    refused(lambda: check(path), path, "Permission denied; give the path")
    refused(lambda: ContractionCertificate.load(path), path, "Permission denied; give the path")


def test_a_file_that_is_too_large_is_refused_unread(tmp_path):
    path = tmp_path / "large.json"
    with path.open("wb") as file:
        file.truncate(CERTIFICATE.most_bytes + 1)
    both(path, "larger than a certificate may be, 64 MiB")


@pytest.mark.parametrize("unit", ["[],", '"",', '"a":{},', '"\\",', " ", "[", '"'])
def test_large_files_of_nothing_are_refused_soon(unit, tmp_path):
    path = tmp_path / "bomb.json"
    path.write_text("[" + unit * (2**23 // len(unit)), encoding="utf-8")
    both(path, "bomb")


# Certificates with values that are none, each with the digest that goes with them.


def claims(change):
    return put("claims", change)


def levels(change, claim=0):
    return put("claims", claim, "levels", change)


def parameters(**values):
    return put("recipe", "parameters", values)


NAMED = {
    "format of old": (put("format", "covariant certificate 1"), "format must be 'covariant certificate 2'"),
    "format in a list": (put("format", ["covariant certificate 2"]), "format must be"),
    "statement": (put("statement", "it is safe"), "the key 'statement' is not known"),
    "verdict": (put("verdict", "holds"), "the key 'verdict' is not known"),
    "counter-example": (put("counterexample", None), "the key 'counterexample' is not known"),
    "open boxes": (put("open_count", 0), "the key 'open_count' is not known"),
    "names of variables": (put("variables", ["r"]), "the key 'variables' is not known"),
    "key of other letters": (put("rаte", 0.1), "the key 'rаte' is not known"),  # a Cyrillic а
    "key of no letters": (put("\x7f", 0), r"the key '\\x7f' is not known"),
    "no rate": (drop("rate"), "the key 'rate' is missing"),
    "no graph": (drop("graph"), "the key 'graph' is missing"),
    "rate that is true": (put("rate", True), "rate must be a finite number.*found True"),
    "rate in words": (put("rate", "0.1"), "rate must be a finite number"),
    "rate in a list": (put("rate", [0.1]), "rate must be a finite number"),
    "rate zero": (put("rate", 0.0), "rate must be a positive number; found 0.0"),
    "rate below zero": (put("rate", -0.1), "rate must be a positive number"),
    "rate null": (put("rate", None), "rate must be a finite number.*found None"),
    "radius below zero": (put("radius", -1.0), "radius must be a positive number"),
    "radius zero": (put("radius", 0), "radius must be a positive number; found 0"),
    "radius too large": (put("radius", 1e200), "radius must be a finite number"),
    "radius true": (put("radius", True), "radius must be a finite number"),
    "radius of twice the size": (put("radius", 0.018), "box: r may be .* which its box"),
    "recipe null": (put("recipe", None), "recipe must be an object"),
    "recipe a name": (put("recipe", "ball_and_beam"), "recipe must be an object"),
    "recipe of both": (put("recipe", "attribute", "os:system"), r"recipe\.'system' is not known"),
    "attribute of nothing": (put("recipe", {"attribute": ":", "parameters": {}}), r"recipe\.attribute must be module"),
    "attribute twice removed": (
        put("recipe", {"attribute": "os:path:x", "parameters": {}}),
        "must be module:attribute",
    ),
    "attribute of a list": (put("recipe", {"attribute": ["os:system"], "parameters": {}}), r"recipe\.attribute must"),
    "system that is none": (put("recipe", "system", "ball_and_beem"), "recipe: unknown system 'ball_and_beem'"),
    "system of a module": (put("recipe", "system", "os:system"), "recipe: unknown system 'os:system'"),
    "system in a file": (put("recipe", "system", "model.toml"), "recipe: unknown system 'model.toml'"),
    "system in a folder": (put("recipe", "system", "../../etc/passwd"), "recipe: unknown system"),
    "system with a line break": (put("recipe", "system", "a\u2028b"), r"recipe\.system must be a text"),
    "system of a dunder": (put("recipe", "system", "__class__"), "recipe: unknown system '__class__'"),
    "system null": (put("recipe", "system", None), r"recipe\.system must be a text"),
    "system of another kind": (
        put("recipe", "system", "lorenz"),
        r"observer\.frame 'coordinates' needs a mechanical system",
    ),
    "system on a group": (
        put("recipe", "system", "heavy_top"),
        r"observer\.frame 'coordinates' .* makes a model in body",
    ),
    "system of another size": (
        put("recipe", "system", "oscillator"),
        "box: the model has 4 variables; the box bounds 8",
    ),
    "parameters in a list": (put("recipe", "parameters", []), r"recipe\.parameters must be an object"),
    "parameter that is none": (parameters(mas=1.0), "recipe: unknown parameter of ball_and_beam 'mas'"),
    "parameter of a dunder": (parameters(__class__=1.0), "recipe: unknown parameter"),
    "parameter of no name": (put("recipe", "parameters", {"": 1.0}), "the name of a parameter in recipe"),
    "parameter that is true": (
        parameters(mass=True),
        "recipe: parameter mass of ball_and_beam must be float; got True",
    ),
    "parameter in words": (parameters(mass="1.0"), "recipe: parameter mass of ball_and_beam must be float"),
    "parameter in a list": (parameters(mass=[1.0]), "recipe: parameter mass of ball_and_beam must be float"),
    "parameter null": (parameters(mass=None), r"recipe\.parameters\.mass must be a finite number"),
    "parameter an object": (parameters(mass={"value": 1}), "recipe: parameter mass of ball_and_beam must be float"),
    "words in an object": (parameters(mass={"a": "1"}), r"recipe\.parameters\.mass\.a must be a finite number"),
    "an object in an object": (
        parameters(mass={"a": {"b": 1}}),
        r"recipe\.parameters\.mass\.a must be a finite number",
    ),
    "truth in a parameter's list": (parameters(mass=[True]), r"recipe\.parameters\.mass\[0\] must be a finite number"),
    "too many parameters": (
        put("recipe", "parameters", {f"a{k}": 1 for k in range(65)}),
        r"recipe\.parameters must be an object of 64 values at most",
    ),
    "parameter too long": (parameters(mass="m" * 300), r"recipe\.parameters\.mass must be a text of 200"),
    "links that do not fit": (
        put("recipe", {"system": "pendulum_chain", "parameters": {"mass": [1.0], "length": [1.0, 2.0]}}),
        "recipe: pendulum_chain: length needs",
    ),
    "a joint that is none": (
        put("recipe", {"system": "pendulum_chain", "parameters": {"actuated": [7]}}),
        "recipe: pendulum_chain: actuated",
    ),
    "a satellite of 100 wheels": (
        put("recipe", {"system": "satellite", "parameters": {"axes": [[1.0, 0.0, 0.0]] * 100}}),
        r"recipe\.parameters\.axes must be a list of 0 to 17 entries",
    ),
    "axes of nothing": (put("recipe", {"system": "satellite", "parameters": {"axes": []}}), "recipe: satellite: axes"),
    "observer null": (put("observer", None), "observer must be an object"),
    "observer of no kind": (drop("observer", "kind"), "observer must be an object with the kind"),
    "observer of another kind": (put("observer", "kind", "ekf"), r"observer\.kind must be one of 'intrinsic'"),
    "observer in the body": (put("observer", "frame", "body"), r"box\.low must be a list of"),
    "gain below zero": (put("observer", "alpha", -1.0), r"observer\.alpha must be a positive number"),
    "gain true": (put("observer", "beta", True), r"observer\.beta must be a finite number"),
    "gain too large": (put("observer", "beta", 1e151), r"observer\.beta must be a finite number"),
    "no gain": (drop("observer", "beta"), r"the key observer\.'beta' is missing"),
    "order 3": (put("observer", "order", 3), r"observer\.order must be one of 1, 2"),
    "order true": (put("observer", "order", True), r"observer\.order must be one of 1, 2; found True"),
    "order 1.0": (put("observer", "order", 1.0), r"observer\.order must be one of 1, 2; found 1.0"),
    "curvature 1": (put("observer", "curvature", 1), r"observer\.curvature must be one of True, False"),
    "coefficients guessed": (put("observer", "coefficients", "guessed"), r"observer\.coefficients must be one of"),
    "a budget": (put("observer", "budget", 1), r"the key observer\.'budget' is not known"),
    "a model in the observer": (put("observer", "model", "os:system"), r"the key observer\.'model' is not known"),
    "Q of 3 rows": (put("q", [[1, 0], [0, 1], [0, 0]]), "q must be a list of 2 entries"),
    "Q of 3 columns": (put("q", [[1, 0, 0], [0, 1, 0]]), r"q\[0\] must be a list of 2 entries"),
    "Q not symmetric": (put("q", 0, 1, 0.0), "q must be a positive definite matrix"),
    "Q indefinite": (put("q", [[1.0, 2.0], [2.0, 1.0]]), "q must be a positive definite matrix"),
    "Q singular": (put("q", [[1.0, 1.0], [1.0, 1.0]]), "q must be a positive definite matrix"),
    "Q negative": (put("q", [[-1.0, 0.0], [0.0, -1.0]]), "q must be a positive definite matrix"),
    "Q of truths": (put("q", [[True, 0], [0, True]]), r"q\[0\]\[0\] must be a finite number"),
    "no velocities": (put("velocity", []), "velocity must be a list of 1 to 17 entries"),
    "velocity zero": (put("velocity", [0.0, 0.5]), "velocity must be positive numbers"),
    "velocity below zero": (put("velocity", 0, -0.5), r"velocity\[0\] must be 0 or larger"),
    "a velocity too many": (put("velocity", [0.5] * 3), r"box\.low must be a list of 12 to 18 entries"),
    "18 velocities": (put("velocity", [0.5] * 18), "velocity must be a list of 1 to 17"),
    "velocity a number": (put("velocity", 0.5), "velocity must be a list"),
    "given null": (put("given", None), "given must be an object"),
    "no noise": (drop("given", "noise"), r"the key given\.'noise' is missing"),
    "noise below zero": (put("given", "noise", 0, -1e-9), r"given\.noise\[0\] must be 0 or larger"),
    "noise of one": (put("given", "noise", [0.0]), r"given\.noise must be a list of 2 entries"),
    "noise that nothing is said of": (put("given", "noise", 0, 0.01), "claims: one about a disturbance must be there"),
    "disturbance that nothing is said of": (
        put("given", "disturbance", 1, 0.01),
        "claims: one about a disturbance must be there",
    ),
    "times in disorder": (put("given", "times", [1.0, 0.0]), r"given\.times must be two times, the earlier"),
    "one time": (put("given", "times", [1.0]), r"given\.times must be a list of 2"),
    "positions in disorder": (put("given", "positions", "low", 0, 9.0), r"given\.positions\.high\[0\] must be 9 or"),
    "a position too many": (
        together := lambda document: [document["given"]["positions"][side].append(0.0) for side in ("low", "high")],
        r"given\.positions: the model has 2; bounds are there of 3",
    ),
    "a position without end": (put("given", "positions", "high", [0.2]), r"given\.positions\.high must be a list of 2"),
    "no inputs": (put("given", "inputs", {"low": [], "high": []}), r"given\.inputs: the model has 1; bounds are there"),
    "inputs in disorder": (put("given", "inputs", "high", 0, -0.2), r"given\.inputs\.high\[0\] must be -0\.1 or"),
    "box null": (put("box", None), "box must be an object"),
    "box in disorder": (put("box", "high", 3, -100.0), r"box\.high\[3\] must be"),
    "box of a word": (put("box", "low", 0, "-0.22"), r"box\.low\[0\] must be a finite number"),
    "box of one bound less": (put("box", "high", lambda side: side[:-1]), r"box\.high must be a list of 8"),
    "box of other names": (put("box", "names", []), r"the key box\.'names' is not known"),
    "no claims": (claims([]), "claims must be a list of 1 to 7 entries"),
    "claims null": (claims(None), "claims must be a list"),
    "a claim less": (claims(lambda rows: rows[:-1]), "claims must be contraction, and reach of rows 0 to 3"),
    "contraction alone": (claims(lambda rows: rows[:1]), "claims must be contraction, and reach of rows 0 to 3"),
    "a claim twice": (
        claims(lambda rows: [*rows[:-1], rows[1]]),
        r"claims\[4\]\.row must be a whole number from 3 to 3",
    ),
    "claims in disorder": (claims(lambda rows: rows[::-1]), r"claims\[0\]\.kind must be one of 'contraction'"),
    "a claim too many": (claims(lambda rows: [*rows, rows[1]]), r"claims\[5\] must be the last claim"),
    "100 000 claims": (claims(lambda rows: rows[:1] * 100_000), "claims must be a list of 1 to 7 entries"),
    "claim null": (claims(lambda rows: [None, *rows[1:]]), r"claims\[0\] must be an object"),
    "claim of a kind that is none": (put("claims", 1, "kind", "safety"), r"claims\[1\]\.kind must be one of 'reach'"),
    "claim with a box": (put("claims", 0, "low", [0.0]), r"the key claims\[0\]\.'low' is not known"),
    "row that is false": (put("claims", 1, "row", False), r"claims\[1\]\.row must be a whole number from 0 to 0"),
    "row that is no whole number": (put("claims", 2, "row", 1.0), r"claims\[2\]\.row must be a whole number"),
    "square zero": (put("claims", 1, "square", 0.0), r"claims\[1\]\.square must be a positive number"),
    "square true": (put("claims", 1, "square", True), r"claims\[1\]\.square must be a finite number"),
    "limit below zero": (put("claims", 1, "limit", -0.02), r"claims\[1\]\.limit must be a positive number"),
    "limit beyond the box": (put("claims", 1, "limit", 1.0), r"claims\[1\]\.limit: row 0 reaches .* of room"),
    "disturbance of nothing": (
        claims(lambda rows: [*rows, {"kind": "disturbance", "square": 0.0, "levels": ["."]}]),
        r"claims\[5\]\.square must be a positive number",
    ),
    "disturbance where there is none": (
        claims(lambda rows: [*rows, {"kind": "disturbance", "square": 1.0, "levels": ["."]}]),
        "claims: one about a disturbance must be there, if there is any",
    ),
    "slopes without noise": (
        put("given", "slopes", 0, [1.0, 0.0]),
        r"given\.slopes: they must be 0 where there is no noise",
    ),
    "slopes of one": (put("given", "slopes", [[0.0, 0.0]]), r"given\.slopes must be a list of 2"),
    "slopes below zero": (put("given", "slopes", 1, [0.0, -1.0]), r"given\.slopes\[1\]\[1\] must be 0 or larger"),
    "levels in one string": (levels("."), r"claims\[0\]\.levels must be a list"),
    "no levels": (levels([]), r"claims\[0\]\.levels must be a list of 1 to 400 entries"),
    "level a number": (levels(lambda rows: [*rows[:-1], 0]), r"claims\[0\]\.levels\[5\] must be"),
    "level null": (levels(lambda rows: [None, *rows[1:]]), r"claims\[0\]\.levels\[0\] must be 1 of the letters"),
    "letter of no variable": (levels(["z"]), r"levels\[0\] must be 1 of the letters a to h, dots and question marks"),
    "letter of another alphabet": (levels(["а", ".."]), r"levels\[0\] must be 1 of the letters"),  # Cyrillic
    "leaf dropped": (levels(lambda rows: [*rows[:-1], rows[-1][:-1]]), r"claims\[0\]\.levels\[5\] must be"),
    "leaf added": (levels(lambda rows: [*rows[:-1], rows[-1] + "."]), r"claims\[0\]\.levels\[5\] must be"),
    "leaf halved": (levels(lambda rows: [*rows[:-1], rows[-1][:-1] + "a", "."]), r"levels\[6\] must be 2 of the"),
    "level dropped": (levels(lambda rows: rows[:-1]), r"claims\[0\]\.levels must be levels down to the last boxes"),
    "level behind the last": (levels(lambda rows: [*rows, ""]), None),
    "two roots": (levels([".."]), r"claims\[0\]\.levels\[0\] must be 1 of"),
    "401 levels": (levels(["a", *["a."] * 400]), r"levels must be a list of 1 to 400 entries"),
    "open, with a radius": (levels(["?"]), "radius must be 0 where a claim has open leaves"),
    "graph null": (put("graph", None), "graph must be an object"),
    "graph of an unknown operation": (put("graph", "nodes", [["exec", 0]]), r"graph\.nodes\[0\] must be \[operation"),
    "graph that points ahead": (
        put("graph", "nodes", [["input", 0], ["add", 0, 1]]),
        r"graph\.nodes\[1\] must be \[operation, numbers of earlier rows",
    ),
    "graph that points back too far": (
        put("graph", "nodes", [["input", 0], ["neg", -1]]),
        r"graph\.nodes\[1\] must be \[operation",
    ),
    "graph that points at a truth": (
        put("graph", "nodes", [["input", 0], ["neg", False]]),
        r"graph\.nodes\[1\] must be \[operation",
    ),
    "graph of a sum of one": (
        put("graph", "nodes", [["input", 0], ["add", 0]]),
        r"graph\.nodes\[1\] must be \[operation",
    ),
    "graph of a word": (put("graph", "nodes", [["constant", "1"]]), r"graph\.nodes\[0\] must be"),
    "graph of a row too long": (put("graph", "nodes", [["select", 0, 0, 0, 0]]), r"graph\.nodes\[0\] must be"),
    "graph of an empty row": (put("graph", "nodes", [[]]), r"graph\.nodes\[0\] must be"),
    "output that is none": (put("graph", "outputs", [10**6]), r"graph\.outputs\[0\] must be a whole number"),
    "graph of something else": (
        put("graph", {"nodes": [["constant", 1.0]], "outputs": [0]}),
        "graph: it must be the one that the observer has",
    ),
}


@pytest.mark.exhaustive("100 000 claims")
@pytest.mark.parametrize("name", NAMED)
def test_a_value_that_is_none_is_refused_by_its_key(name, tmp_path):
    change, key = NAMED[name]
    if key is None:  # an empty level says nothing that is wrong
        assert parse(forged(change, tmp_path)).claims
        return
    both(forged(change, tmp_path), key)


@pytest.mark.parametrize("value", [1, "x", None, [], {}, True])
def test_a_digest_that_is_none_is_refused(value, tmp_path):
    path = tmp_path / "forged.json"
    path.write_text(json.dumps(json.loads(BEAM) | {"digest": value}))
    both(path, "digest must be")


ON_GROUPS = {
    "observer in coordinates": (
        put("observer", "frame", "coordinates"),
        r"box\.low must be a list of 12 to 18 entries",
    ),
    "another frame": (put("observer", "frame", "space"), r"observer\.frame must be one of 'coordinates', 'body'"),
    "a third order": (put("observer", "order", 3), r"observer\.order must be one of 1, 2"),
    "curved in words": (put("observer", "curvature", "no"), r"observer\.curvature must be one of True"),
    "a matrix entry less": (
        lambda document: [document["given"]["positions"][side].pop() for side in ("low", "high")],
        r"given\.positions: the model has 9; bounds are there of 8",
    ),
    "an axis of no length": (parameters(axis=[0.0, 0.0]), "recipe"),
    "an inertia that is none": (parameters(inertia=[1.0]), "recipe"),
    "a system in coordinates": (
        put("recipe", "system", "ball_and_beam"),
        r"observer\.frame 'body' needs a mechanical system",
    ),
}


@pytest.mark.parametrize("name", ON_GROUPS)
def test_the_same_on_groups(name, tmp_path):
    change, key = ON_GROUPS[name]
    both(forged(change, tmp_path, TOP), key)


def test_brackets_in_a_string_are_letters(tmp_path):
    change = put("recipe", {"system": "pendulum_chain", "parameters": {"source": "[" * 30 + "{" * 30}})
    assert parse(forged(change, tmp_path)).recipe["parameters"]["source"].startswith("[[")


# What is read, but not verified.


def test_open_leaves_are_read_and_not_verified(tmp_path):
    def opened(document):
        document["claims"] = document["claims"][:1]
        document["claims"][0]["levels"] = ["a", ".?"]
        document["radius"] = 0

    path = forged(opened, tmp_path)
    refused(lambda: check(path), path, r"claims\[0\] must have no open leaves")
    found = ContractionCertificate.load(path)
    assert (found.statement.verdict, found.radius, found.verified) == ("undecided", 0.0, False)
    assert found.open.shape == (1, 2, 8)
    assert found.open[0, 0, 0] == 0
    assert found.open[0, 1, 0] == pytest.approx(0.22, rel=1e-15)
    again = found.save(tmp_path / "again.json")
    assert parse(again).open


def test_the_text_is_computed_and_not_read(tmp_path):
    found = ContractionCertificate.load(forged(lambda document: None, tmp_path))
    assert found.domain.names[:2] == ("r", "theta")
    assert found.statement.evidence == "claimed"
    assert "read from a file, not verified again" in found.statement.claim


def test_a_counter_example_is_not_saved(tmp_path):
    found = ContractionCertificate.load(SHIPPED / "ball_and_beam.json")
    wrong = found.claims[0].proof._replace(verdict="fails", counterexample=found.domain.low[None].repeat(2, axis=0))
    failed = found._replace(claims=(dataclasses.replace(found.claims[0], proof=wrong),))
    with pytest.raises(ValueError, match="a counter-example is printed, not saved"):
        failed.save(tmp_path / "wrong.json")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("value", "key"),
    [
        ({"system": "ball_and_beam", "parameters": {"mass": 'a "quoted" word'}}, "backslash"),
        ({"system": "ball_and_beam", "parameters": {"mass": {1, 2}}}, "not JSON serializable"),
        ({"system": "ball_and_beam", "parameters": {"mass": float("nan")}}, "recipe.parameters.mass"),
    ],
)
def test_what_could_not_be_read_is_not_written(value, key, tmp_path):
    found = ContractionCertificate.load(SHIPPED / "ball_and_beam.json")._replace(recipe=value)
    with pytest.raises((ValueError, TypeError), match=key):
        found.save(tmp_path / "odd.json")
    assert not list(tmp_path.iterdir())


# The person who checks may give a model.


def beam():
    return models.ball_and_beam()


def mine(folder: Path) -> Path:
    return forged(put("recipe", {"attribute": "somebody:model", "parameters": {}}), folder)


@pytest.mark.parametrize("model", [beam, beam(), f"{__name__}:beam"], ids=["function", "model", "name"])
def test_whoever_checks_may_give_the_model(model, tmp_path):
    path = mine(tmp_path)
    refused(lambda: check(path), path, "`model=module:attribute`")
    assert ContractionCertificate.load(path, model=model).rate == 0.1
    assert follows(parse(path), model).about.names[0] == "r"


@pytest.mark.parametrize(
    "model", ["os", "os:", ":system", "no.such.module:x", "math:pi", 3, models.lorenz, heavy := "json:loads"]
)
def test_a_model_that_is_none_is_refused(model, tmp_path):
    path = mine(tmp_path)
    refused(lambda: check(path, model=model), path, "recipe|observer")


# The command.


def command(monkeypatch, capsys, path: Path, *more: str) -> tuple[int, str, str]:
    monkeypatch.setattr(sys, "argv", ["covariant", "certify", "--check", str(path), "--processes", "1", *more])
    with pytest.raises(SystemExit) as left:
        main()
    return (int(left.value.code or 0), *capsys.readouterr())


@pytest.mark.parametrize(
    "name", ["rate that is true", "row that is false", "statement", "leaf dropped", "system in a folder", "gain true"]
)
def test_the_command_refuses_in_one_line(name, tmp_path, monkeypatch, capsys):
    change, key = NAMED[name]
    code, out, error = command(monkeypatch, capsys, forged(change, tmp_path))
    assert (code, out.count("\n"), error.strip()) == (1, 1, "")
    assert re.search(key, out)
    code, out, error = command(monkeypatch, capsys, tmp_path / "forged.json", "--json")
    assert (code, json.loads(out)["verified"]) == (1, False)


@pytest.mark.parametrize("name", ["100 000 brackets", "empty", "not a number", "UTF-16"])
def test_the_command_refuses_text_in_one_line(name, tmp_path, monkeypatch, capsys):
    change, key = TEXTS[name]
    made = change(BEAM)
    (tmp_path / "forged.json").write_bytes(made if isinstance(made, bytes) else made.encode("utf-8"))
    code, out, error = command(monkeypatch, capsys, tmp_path / "forged.json")
    assert (code, out.count("\n"), error.strip()) == (1, 1, "")
    assert re.search(key, out)


def test_the_command_says_in_one_line_that_there_is_no_file(tmp_path, monkeypatch, capsys):
    for name in ("nowhere.json", "."):
        code, out, error = command(monkeypatch, capsys, tmp_path / name)
        assert (code, out, error.count("\n")) == (2, "", 1)


# Files changed at random.

HOSTILE = [
    *(None, True, False, 0, 1, -1, 2, 0.5, -0.0, 1e300, -1e300, 1e-320, 10**20, float("nan"), float("inf")),
    *("", ".", "?", "a", "os:system", "heavy_top", "lorenz", "é", "\u202e", "\ud7ff", "x" * 1000),
    *([], {}, [[]], [{}], [1.0], [True], {"low": [], "high": []}, {"system": "oscillator", "parameters": {}}),
    *({"attribute": "os:system", "parameters": {"command": "touch marker"}}, [["constant", 1.0]], [[[[[[[[[]]]]]]]]]),
]


def places(value, path=()):
    """The way to everything in a document."""
    yield path
    children = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, child in children:
        yield from places(child, (*path, key))


def swapped(rng: random.Random, text: str) -> str:
    """Some values exchanged for others, or for nothing, and the digest mended."""
    document = json.loads(text)
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        *path, last = rng.choice([place for place in places(document) if place])
        target = document
        for key in path:
            target = target[key]
        old, kind = target[last], rng.randrange(6)
        if kind == 0 and isinstance(old, float):
            target[last] = old * rng.choice([0.5, 0.999, 1.001, 2.0, -1.0, 1e9])
        elif kind == 1 and isinstance(old, str):
            k = rng.randrange(len(old) + 1)
            target[last] = old[:k] + rng.choice("abcz.?é[") + old[k + rng.randrange(2) :]
        elif kind == 2:
            del target[last]
        elif kind == 3 and isinstance(target, list):
            target.insert(last, old)
        elif kind == 4:
            target.update({rng.choice(["row", "", "__class__", "model"]): old}) if isinstance(target, dict) else None
        else:
            target[last] = rng.choice(HOSTILE)
    return mended(document)


def systems(rng: random.Random, text: str) -> str:
    """Another system, with parameters of all kinds."""
    document = json.loads(text)
    name = rng.choice(list(_systems.SYSTEMS))
    words = ["mass", "length", "inertia", "gravity", "chart", "axes", "axis", "moment", "actuated", "angles", "drag"]
    values = [*HOSTILE, [1.0, 2.0], [0.0] * 3, [[1.0, 0.0, 0.0]], "r", 2.0, [0], [-1e9, 1e9], [1e140] * 2]
    document["recipe"] = {"system": name, "parameters": {rng.choice(words): rng.choice(values) for _ in range(2)}}
    return mended(document)


def tokens(rng: random.Random, text: str) -> str:
    """Words, numbers and signs of the text exchanged for one another."""
    parts = re.findall(r'"[^"]*"|[-+.\w]+|\s+|.', text)
    for _ in range(rng.choice([1, 2, 4])):
        i, j = rng.randrange(len(parts)), rng.randrange(len(parts))
        parts[i], parts[j] = parts[j], parts[i]
    return "".join(parts)


def inserted(rng: random.Random, text: str) -> str:
    """Something that does not belong there, anywhere."""
    k = rng.randrange(len(text))
    bombs = [
        "[" * rng.choice([1, 9, 100_000]),
        '{"a":' * 5000,
        "9" * 5000,
        "1e999",
        "-",
        "NaN",
        "\\u0000",
        "\ufeff",
        '"',
    ]
    return text[:k] + rng.choice([*bombs, "💥" * 50, "\x00", "\r\n", ",", ":"]) + text[k:]


def flipped(rng: random.Random, text: str) -> bytes:
    """Some bits of the bytes, or their end cut off."""
    content = bytearray(text.encode())
    for _ in range(rng.choice([1, 3, 30])):
        content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    return bytes(content[: rng.choice([len(content), rng.randrange(len(content))])])


def with_digest(made: str | bytes) -> bytes:
    """What was made, its digest mended where that can be done, so that more than the digest is looked at."""
    content = made if isinstance(made, bytes) else made.encode("utf-8", "surrogatepass")
    try:
        document = json.loads(content)
        return mended(document).encode() if isinstance(document, dict) and document.get("digest") else content
    except (ValueError, RecursionError):
        return content


WAYS = [swapped, swapped, swapped, systems, tokens, inserted, flipped]
COUNT = int(os.environ.get("COVARIANT_FUZZ", "300"))


@pytest.mark.exhaustive
def test_files_changed_at_random_are_read_or_refused(tmp_path, monkeypatch):
    """`parse`, and the making of the model where that succeeds; COVARIANT_FUZZ=10000 tries as many."""
    monkeypatch.chdir(tmp_path)
    came = {"refused": 0, "read": 0, "follows": 0}
    odd, lines, where = set(), [], "somewhere.json"
    for seed in range(COUNT):
        rng = random.Random(seed)
        made = rng.choice(WAYS)(rng, TOP if seed % 8 == 0 else BEAM)
        content = with_digest(made) if rng.random() < 0.7 else made if isinstance(made, bytes) else made.encode()
        with Watched() as watched:
            try:
                document = parse(where, content)
                came["read"] += 1
                follows(document)
                came["follows"] += 1
            except ValueError as error:
                came["refused"] += 1
                lines.append(str(error))
        odd |= set(watched.events)
        assert not watched.opened, seed
    assert all(len(line.splitlines()) == 1 and line.startswith(where) for line in lines)
    assert odd == set()
    assert not list(tmp_path.iterdir())
    print(came)
    assert came["refused"] > COUNT / 2
    assert came["read"] > came["follows"] > 0
