"""What takes long of `test_files.py`."""

import json
import os
import random
import re
import sys
from pathlib import Path

import pytest
from forging import forged, mended, put
from test_files import BEAM, TOP, Watched, both, code, command, no_programs_are_kept, refused, system, warm

from covariant.certificates import parse
from covariant.certificates.checking._check import follows
from covariant.models.files import _systems


def runs(folder: Path) -> dict:
    return code("os:system", command=f"touch {folder / 'marker'}")


def test_a_file_does_not_run_a_program(tmp_path):
    path = forged(BEAM, tmp_path, put("recipe", runs(tmp_path)))
    both(path, "recipe: the model is 'os:system', code that a recipe does not run")
    assert not (tmp_path / "marker").exists()


def test_the_command_does_not_run_a_program_either(tmp_path, monkeypatch, capsys):
    path = forged(BEAM, tmp_path, put("recipe", runs(tmp_path)))
    code, out, _ = command(monkeypatch, capsys, path)
    assert code == 1
    assert out.startswith("Refused: ")
    assert "--model module:attribute" in out
    assert not (tmp_path / "marker").exists()


def test_a_file_does_not_import_a_module_that_lies_beside_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lies_here.py").write_text("import pathlib\npathlib.Path('marker').touch()\nmodel = None\n")
    path = forged(BEAM, tmp_path, put("recipe", code("lies_here:model")))
    both(path, "recipe: the model is 'lies_here:model'")
    assert "lies_here" not in sys.modules
    assert not (tmp_path / "marker").exists()


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
    bombs = ["[" * rng.choice([1, 9, 100_000]), '{"a":' * 5000, "9" * 5000, "1e999", "-", "NaN", "\\u0000", '"']
    return text[:k] + rng.choice([*bombs, "\ufeff", "💥" * 50, "\x00", "\r\n", ",", ":"]) + text[k:]


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
