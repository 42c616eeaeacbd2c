"""Files that somebody made to be believed, or to run something: each is refused in one line, and runs nothing."""

import contextlib
import dataclasses
import json
import os
import re
import sys
from pathlib import Path

import jax
import pytest
from forging import MISSING, forged, mended, put, together
from jax.experimental.compilation_cache import compilation_cache

from covariant import models
from covariant.certificates import ContractionCertificate, check, parse
from covariant.certificates.checking._check import follows
from covariant.cli import main
from covariant.models.files import _systems
from scalargraph.proofs._file import CERTIFICATE, MOST_VALUES

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
REACHES = ("socket.connect", "socket.bind", "socket.getaddrinfo", "urllib.Request", "ctypes.dlopen")
READS = ("pickle.find_class",)
WATCHED = {"import", "open", *DOES, *TOUCHES, *REACHES, *READS}
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


def code(attribute, **parameters) -> dict:
    return {"attribute": attribute, "parameters": parameters}


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


def written(made: str | bytes, folder: Path) -> Path:
    path = folder / "forged.json"
    path.write_bytes(made if isinstance(made, bytes) else made.encode("utf-8"))
    return path


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


@pytest.mark.core(4)
@pytest.mark.parametrize("name", TEXTS)
def test_text_that_is_no_certificate_is_refused(name, tmp_path):
    change, key = TEXTS[name]
    both(written(change(BEAM), tmp_path), key)


@pytest.mark.parametrize("digits", ["1e999", "-1e400", "9" * 5000, "1" + "0" * 300])
def test_numbers_without_bounds_are_refused_by_their_key(digits, tmp_path):
    text = mended(json.loads(BEAM) | {"rate": float(digits)})
    both(written(re.sub('"rate": [^,]*', f'"rate": {digits}', text), tmp_path), "rate must be a finite number")


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
    both(path, "larger than a saved certificate may be, 64 MiB")


@pytest.mark.core(2)
@pytest.mark.parametrize("unit", ["[],", '"",', '"a":{},', '"\\",', " ", "[", '"'])
def test_large_files_of_nothing_are_refused_soon(unit, tmp_path):
    path = tmp_path / "bomb.json"
    path.write_text("[" + unit * (2**23 // len(unit)), encoding="utf-8")
    both(path, "bomb")


# Certificates with values that are none, each with the digest that goes with them.


def system(name, **parameters) -> dict:
    return {"system": name, "parameters": parameters}


PARAMETERS = "recipe.parameters"
LEVELS = "claims[0].levels"
NODES = "graph.nodes"
UNSAID = "=claims: one about a disturbance must be there, if there is any"
FEW = {"kind": "disturbance", "square": 1.0, "levels": ["."]}
WRONG: list[tuple[str, list, str]] = [
    ("format", ["covariant certificate 1", ["covariant certificate 2"]], "must be 'covariant certificate 2'"),
    # A Cyrillic а, and a key of no letters.
    *(
        (key, [value], f"=the key {key!r} is not known")
        for key, value in (("statement", "it is safe"), ("verdict", "holds"), ("counterexample", None), ("rаte", 0.1))
    ),
    ("\x7f", [0.1], r"=the key '\\x7f' is not known"),
    ("rate", [MISSING], "=the key 'rate' is missing"),
    ("graph", [MISSING], "=the key 'graph' is missing"),
    ("rate", [True, "0.1", [0.1], None], "must be a finite number.*found"),
    ("rate", [0.0, -0.1], "must be a positive number"),
    ("radius", [-1.0, 0], "must be a positive number; found"),
    ("radius", [1e200, True], "must be a finite number"),
    ("radius", [0.018], "=box: r may be .* which its box"),
    ("recipe", [None, "ball_and_beam"], "must be an object"),
    ("recipe.attribute", ["os:system"], r"=recipe\.'system' is not known"),
    ("recipe", [code(":"), code("os:path:x")], r"=recipe\.attribute must be module:attribute"),
    ("recipe", [code(["os:system"])], r"=recipe\.attribute must be a text"),
    (
        "recipe.system",
        ["ball_and_beem", "os:system", "model.toml", "../../etc/passwd", "__class__"],
        "=recipe: unknown system '",
    ),
    ("recipe.system", ["a\u2028b", None], "must be a text"),
    ("recipe.system", ["lorenz"], r"=observer\.frame 'coordinates' needs a mechanical system"),
    ("recipe.system", ["heavy_top"], r"=observer\.frame 'coordinates' .* makes a model in body"),
    ("recipe.system", ["oscillator"], "=box: the model has 4 variables; the box bounds 8"),
    (PARAMETERS, [[], None], "must be an object"),
    (PARAMETERS, [{"mas": 1.0}, {"__class__": 1.0}], "=recipe: unknown parameter of ball_and_beam '"),
    (PARAMETERS, [{"": 1.0}], "=the name of a parameter in recipe"),
    (
        f"{PARAMETERS}.mass",
        [True, "1.0", [1.0], {"value": 1}],
        "=recipe: parameter mass of ball_and_beam must be float; got",
    ),
    (f"{PARAMETERS}.mass", [None], "must be a finite number"),
    (f"{PARAMETERS}.mass", [{"a": "1"}, {"a": {"b": 1}}], r"=recipe\.parameters\.mass\.a must be a finite number"),
    (f"{PARAMETERS}.mass", [[True]], r"=recipe\.parameters\.mass\[0\] must be a finite number"),
    (f"{PARAMETERS}.mass", ["m" * 300], "must be a text of 200"),
    (PARAMETERS, [{f"a{k}": 1 for k in range(65)}], "must be an object of 64 values at most"),
    ("recipe", [system("pendulum_chain", mass=[1.0], length=[1.0, 2.0])], "=recipe: pendulum_chain: length needs"),
    ("recipe", [system("pendulum_chain", actuated=[7])], "=recipe: pendulum_chain: actuated"),
    (
        "recipe",
        [system("satellite", axes=[[1.0, 0.0, 0.0]] * 100)],
        r"=recipe\.parameters\.axes must be a list of 0 to 17 entries",
    ),
    ("recipe", [system("satellite", axes=[])], "=recipe: satellite: axes"),
    ("observer", [None], "must be an object"),
    ("observer.kind", [MISSING], "=observer must be an object with the kind"),
    ("observer.kind", ["ekf"], "must be one of 'intrinsic'"),
    ("observer.frame", ["body"], r"=box\.low must be a list of"),
    ("observer.alpha", [-1.0], "must be a positive number"),
    ("observer.beta", [True, 1e151], "must be a finite number"),
    ("observer.beta", [MISSING], r"=the key observer\.'beta' is missing"),
    ("observer.order", [3, True, 1.0], "must be one of 1, 2; found"),
    ("observer.curvature", [1], "must be one of True, False"),
    ("observer.coefficients", ["guessed"], "must be one of"),
    ("observer.budget", [1], r"=the key observer\.'budget' is not known"),
    ("q", [[[1, 0], [0, 1], [0, 0]]], "must be a list of 2 entries"),
    ("q[0]", [[1, 0, 0]], "must be a list of 2 entries"),
    ("q[0][0]", [True], "must be a finite number"),
    (
        "q",
        [[[1.0, 0.2], [0.0, 1.0]], [[1.0, 2.0], [2.0, 1.0]], [[1.0, 1.0], [1.0, 1.0]], [[-1.0, 0.0], [0.0, -1.0]]],
        "must be a positive definite matrix",
    ),
    ("velocity", [[], [0.5] * 18, 0.5], "must be a list of 1 to 17 entries"),
    ("velocity", [[0.0, 0.5]], "must be positive numbers"),
    ("velocity[0]", [-0.5], "must be 0 or larger"),
    ("velocity", [[0.5] * 3], r"=box\.low must be a list of 12 to 18 entries"),
    ("given", [None], "must be an object"),
    ("given.noise", [MISSING], r"=the key given\.'noise' is missing"),
    ("given.noise[0]", [-1e-9], "must be 0 or larger"),
    ("given.noise", [[0.0]], "must be a list of 2 entries"),
    ("given.noise[0]", [0.01], UNSAID),
    ("given.disturbance[1]", [0.01], UNSAID),
    ("given.times", [[1.0, 0.0]], "must be two times, the earlier"),
    ("given.times", [[1.0]], "must be a list of 2"),
    ("given.positions.low[0]", [9.0], r"=given\.positions\.high\[0\] must be 9 or"),
    (
        "given.positions",
        [lambda old: {side: [*ends, 0.0] for side, ends in old.items()}],
        "=given.positions: the model has 2; bounds are there of 3",
    ),
    ("given.positions.high", [[0.2]], "must be a list of 2"),
    ("given.inputs", [{"low": [], "high": []}], "=given.inputs: the model has 1; bounds are there"),
    ("given.inputs.high[0]", [-0.2], r"must be -0\.1 or"),
    ("given.slopes[0]", [[1.0, 0.0]], "=given.slopes: they must be 0 where there is no noise"),
    ("given.slopes", [[[0.0, 0.0]]], "must be a list of 2"),
    ("given.slopes[1][1]", [-1.0], "must be 0 or larger"),
    ("box", [None], "must be an object"),
    ("box.high[3]", [-100.0], "must be"),
    ("box.low[0]", ["-0.22"], "must be a finite number"),
    ("box.high", [lambda side: side[:-1]], "must be a list of 8"),
    ("box.names", [[]], r"=the key box\.'names' is not known"),
    ("claims", [[], None, lambda rows: rows[:1] * 8], "must be a list of 1 to 7 entries"),
    ("claims", [lambda rows: rows[:-1], lambda rows: rows[:1]], "must be contraction, and reach of rows 0 to 3"),
    ("claims", [lambda rows: [*rows[:-1], rows[1]]], r"=claims\[4\]\.row must be a whole number from 3 to 3"),
    ("claims", [lambda rows: rows[::-1]], r"=claims\[0\]\.kind must be one of 'contraction'"),
    ("claims", [lambda rows: [*rows, rows[1]]], r"=claims\[5\] must be the last claim"),
    ("claims", [lambda rows: [*rows, FEW | {"square": 0.0}]], r"=claims\[5\]\.square must be a positive number"),
    ("claims", [lambda rows: [*rows, FEW]], UNSAID),
    ("claims[0]", [None], "must be an object"),
    ("claims[0].low", [[0.0]], r"=the key claims\[0\]\.'low' is not known"),
    ("claims[1].kind", ["safety"], "must be one of 'reach'"),
    ("claims[1].row", [False, 1.0], "must be a whole number from 0 to 0"),
    ("claims[1].square", [0.0], "must be a positive number"),
    ("claims[1].square", [True], "must be a finite number"),
    ("claims[1].limit", [-0.02], "must be a positive number"),
    ("claims[1].limit", [1.0], r"=claims\[1\]\.limit: row 0 reaches .* of room"),
    (LEVELS, [".", [], ["a", *["a."] * 400]], "must be a list of 1 to 400 entries"),
    (f"{LEVELS}[5]", [0, lambda row: row[:-1], lambda row: row + "."], "must be"),
    # A letter of no variable, one of another alphabet, and two roots.
    (f"{LEVELS}[0]", [None, "z", "а", ".."], "must be 1 of the letters a to h, dots and question marks"),
    (LEVELS, [lambda rows: [*rows[:-1], rows[-1][:-1] + "a", "."]], r"=levels\[6\] must be 2 of the"),
    (LEVELS, [lambda rows: rows[:-1]], "must be levels down to the last boxes"),
    (LEVELS, [["?"]], "=radius must be 0 where a claim has open leaves"),
    ("graph", [None], "must be an object"),
    (f"{NODES}[0]", [["exec", 0], ["constant", "1"], ["select", 0, 0, 0, 0], []], r"must be \[operation"),
    # To a row ahead, before the first and at a truth, and a sum of one.
    (
        NODES,
        [[["input", 0], row] for row in (["add", 0, 1], ["neg", -1], ["neg", False], ["add", 0])],
        r"=graph\.nodes\[1\] must be \[operation, numbers of earlier rows",
    ),
    ("graph.outputs", [[10**6]], r"=graph\.outputs\[0\] must be a whole number"),
    ("graph", [{"nodes": [["constant", 1.0]], "outputs": [0]}], "=graph: it must be the one that the observer has"),
]
"""A place in the file, what may stand there instead, and what is said about the place; after "=" the whole message."""


def message(place, words):
    return words[1:] if words.startswith("=") else f"{re.escape(place)} {words}"


@pytest.mark.core(36)
@pytest.mark.parametrize(("place", "values", "words"), WRONG, ids=[f"{k}-{row[0]}" for k, row in enumerate(WRONG)])
def test_a_value_that_is_none_is_refused_by_its_key(place, values, words, tmp_path):
    for value in values:
        both(forged(BEAM, tmp_path, put(place, value)), message(place, words))


def test_a_level_behind_the_last_says_nothing_that_is_wrong(tmp_path):
    assert parse(forged(BEAM, tmp_path, put(LEVELS, lambda rows: [*rows, ""]))).claims


@pytest.mark.parametrize("value", [1, "x", None, [], {}, True])
def test_a_digest_that_is_none_is_refused(value, tmp_path):
    path = tmp_path / "forged.json"
    path.write_text(json.dumps(json.loads(BEAM) | {"digest": value}))
    both(path, "digest must be")


ON_GROUPS = [
    ("observer.frame", "coordinates", r"=box\.low must be a list of 12 to 18 entries"),
    ("observer.frame", "space", "must be one of 'coordinates', 'body'"),
    ("observer.order", 3, "must be one of 1, 2"),
    ("observer.curvature", "no", "must be one of True"),
    (
        "given.positions",
        lambda old: {side: ends[:-1] for side, ends in old.items()},
        r"=given\.positions: the model has 9; bounds are there of 8",
    ),
    (PARAMETERS, {"axis": [0.0, 0.0]}, "=recipe"),
    (PARAMETERS, {"inertia": [1.0]}, "=recipe"),
    ("recipe.system", "ball_and_beam", r"=observer\.frame 'body' needs a mechanical system"),
]


@pytest.mark.parametrize(("place", "value", "words"), ON_GROUPS, ids=range(len(ON_GROUPS)))
def test_the_same_on_groups(place, value, words, tmp_path):
    both(forged(TOP, tmp_path, put(place, value)), message(place, words))


def test_brackets_in_a_string_are_letters(tmp_path):
    path = forged(BEAM, tmp_path, put("recipe", system("pendulum_chain", source="[" * 30 + "{" * 30)))
    assert parse(path).recipe["parameters"]["source"].startswith("[[")


# What is read, but not verified.


def test_open_leaves_are_read_and_not_verified(tmp_path):
    alone = put("claims", lambda rows: [rows[0] | {"levels": ["a", ".?"]}])
    path = forged(BEAM, tmp_path, together(alone, put("radius", 0)))
    refused(lambda: check(path), path, r"claims\[0\] must have no open leaves")
    found = ContractionCertificate.load(path)
    assert (found.statement.verdict, found.radius, found.verified) == ("undecided", 0.0, False)
    assert found.open.shape == (1, 2, 8)
    assert found.open[0, 0, 0] == 0
    assert found.open[0, 1, 0] == pytest.approx(0.22, rel=1e-15)
    again = found.save(tmp_path / "again.json")
    assert parse(again).open


def test_the_text_is_computed_and_not_read(tmp_path):
    found = ContractionCertificate.load(forged(BEAM, tmp_path, together()))
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


@pytest.mark.core(1)
@pytest.mark.parametrize(
    ("mass", "key"),
    [('a "quoted" word', "backslash"), ({1, 2}, "not JSON serializable"), (float("nan"), "recipe.parameters.mass")],
)
def test_what_could_not_be_read_is_not_written(mass, key, tmp_path):
    recipe = system("ball_and_beam", mass=mass)
    found = ContractionCertificate.load(SHIPPED / "ball_and_beam.json")._replace(recipe=recipe)
    with pytest.raises((ValueError, TypeError), match=key):
        found.save(tmp_path / "odd.json")
    assert not list(tmp_path.iterdir())


# The person who checks may give a model.


def beam():
    return models.ball_and_beam()


def mine(folder: Path) -> Path:
    return forged(BEAM, folder, put("recipe", code("somebody:model")))


@pytest.mark.core(1)
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


def in_one_line(monkeypatch, capsys, path: Path, key: str) -> None:
    code, out, error = command(monkeypatch, capsys, path)
    assert (code, out.count("\n"), error.strip()) == (1, 1, "")
    assert re.search(key, out)


@pytest.mark.core(2)
@pytest.mark.parametrize("name", ["100 000 brackets", "empty", "not a number", "UTF-16"])
def test_the_command_refuses_text_in_one_line(name, tmp_path, monkeypatch, capsys):
    change, key = TEXTS[name]
    in_one_line(monkeypatch, capsys, written(change(BEAM), tmp_path), key)


@pytest.mark.parametrize(
    ("place", "value"), [("rate", True), ("statement", "it is safe"), (f"{LEVELS}[5]", "."), ("recipe.system", "../x")]
)
def test_the_command_refuses_in_one_line(place, value, tmp_path, monkeypatch, capsys):
    path = forged(BEAM, tmp_path, put(place, value))
    in_one_line(monkeypatch, capsys, path, place.partition(".")[0].partition("[")[0])
    code, out, _ = command(monkeypatch, capsys, path, "--json")
    assert (code, json.loads(out)["verified"]) == (1, False)


def test_the_command_says_in_one_line_that_there_is_no_file(tmp_path, monkeypatch, capsys):
    for name in ("nowhere.json", "."):
        code, out, error = command(monkeypatch, capsys, tmp_path / name)
        assert (code, out, error.count("\n")) == (2, "", 1)


# Files changed at random.
