"""An export as WebAssembly does what its C does, in Node, and says what is missing to make it: what takes long."""

import importlib
import json
import re
import shutil
import subprocess
from pathlib import Path

import browser_page
import numpy as np
import pytest
from run_page import blocks
from test_wasm import node, wasm

import covariant

ROOT = Path(__file__).parents[2]


MODEL = str(ROOT / "examples" / "demo_double_pendulum.toml")


ROWS, RATE = 400, 500.0


needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler, `cc`")


@needs_compiler
@pytest.mark.parametrize("real", ["double", "float"])
def test_it_does_in_node_what_its_c_does(wasm, real, tmp_path, monkeypatch):
    """Along a run with missing measurements, irregular steps and inputs; and its self-test passes."""
    folder, name = tmp_path / "arm", f"arm_{real}"
    options = {"real": real, "name": name, "python": True, "wasm": True}
    covariant.export(MODEL, folder, rate=RATE, **options)
    readme = (folder / "README.md").read_text(encoding="utf-8")
    assert f"`python/{name}`" in readme
    assert f"`node test/{name}_test.js`" in readme
    said = subprocess.run(["node", f"test/{name}_test.js"], cwd=folder, capture_output=True, text=True)
    assert said.stdout.startswith(f"{name}: ok, 40 steps, largest deviation 0."), said.stdout + said.stderr
    monkeypatch.syspath_prepend(folder / "python")
    made = importlib.import_module(name)
    t = np.cumsum(np.random.default_rng(0).uniform(0.5, 1.5, ROWS)) / RATE
    y = np.stack([0.5 * np.sin(3 * t), 0.3 * np.cos(5 * t)], axis=1)
    y[100] = y[200, 1] = np.nan
    u = 0.1 * np.sin(np.stack([t, 2 * t], axis=1))
    expected = made.run(t, y, u, params={"mass": [0.6, 0.55]})
    rows = json.dumps([t.tolist(), y.tolist(), u.tolist()]).replace("NaN", "null")
    (folder / "rows.json").write_text(rows)
    (folder / "made.json").write_text(node(_RUN.replace("@NAME@", name), folder))
    estimates, codes = json.loads((folder / "made.json").read_text())
    tolerance = {"double": 1e-12, "float": 2e-4}[real]
    np.testing.assert_allclose(np.array(estimates)[:, :2], expected.q[1:], rtol=0, atol=tolerance)
    np.testing.assert_allclose(np.array(estimates)[:, 2:], expected.v[1:], rtol=0, atol=tolerance)
    assert codes == expected.result[1:].tolist()
    check_odd_rows(made, folder, name)
    if real == "double":
        (use,) = (b for b in blocks((ROOT / "docs" / "browser.md").read_text(encoding="utf-8")) if b.language == "js")
        assert node(use.text.replace("./arm.js", f"./{name}.js"), folder) == "COASTED 2\n"


def check_odd_rows(made, folder: Path, name: str) -> None:
    """What no sensor should deliver: codes and states are those of the C, through starts, refusals and restarts."""
    random = np.random.default_rng(1)
    odd = [np.nan, np.inf, -np.inf, 0.0, -0.0, 5e-324, 1e308, -1e308, 1e-300, -0.7, 7.25]
    observer, rows, expected = made.Observer(), [], []
    for k in range(2000):
        row = np.array([0.3 * np.sin(k / 20), 0.2 * np.cos(k / 25), 0.1, -0.1, 1 / RATE])
        if random.random() < 0.1:
            row[random.integers(5)] = random.choice(odd)
        # An unstable step of 7 s leaves numbers that no rounding survives.
        row[4] = min(row[4], 0.02) if np.isfinite(row[4]) else row[4]
        expected.append([observer.step(row[:2], row[4], row[2:4]), *np.concatenate(observer.estimate())])
        rows.append([str(number) for number in row])
    (folder / "odd.json").write_text(json.dumps(rows).replace("inf", "Infinity"))
    found = np.array(json.loads(node(_ODD.replace("@NAME@", name), folder)), float)
    np.testing.assert_array_equal(found[:, 0], np.array(expected)[:, 0])
    assert len(set(found[:, 0])) >= 5, "outcomes"
    tolerance = 1e-9 if made.REAL.itemsize == 8 else 1e-2
    np.testing.assert_allclose(found[:, 1:], np.array(expected)[:, 1:], rtol=tolerance, atol=tolerance)


_ODD = """
const { load } = require("./@NAME@.js");
const rows = JSON.parse(require("fs").readFileSync("odd.json")).map((row) => row.map(Number));
load().then(({ Observer }) => {
    const observer = new Observer();
    const found = rows.map(([a, b, c, d, dt]) => {
        const code = observer.step([a, b], dt, [c, d]), { q, v } = observer.estimate();
        return [code, ...q, ...v].map(String);
    });
    console.log(JSON.stringify(found));
});
"""


_RUN = """
const { load } = require("./@NAME@.js");
const [t, y, u] = JSON.parse(require("fs").readFileSync("rows.json"));
const number = (value) => (value === null ? NaN : value);
load().then(({ Observer }) => {
    const observer = new Observer({ mass: [0.6, 0.55] }), other = new Observer();
    observer.start(y[0], t[0]);
    const estimates = [], codes = [];
    let snapshot = null;
    for (let k = 1; k < t.length; ++k) {
        codes.push(observer.step(y[k].map(number), t[k] - t[k - 1], u[k - 1]));
        other.step([1, 1], 0.002); // has a memory of its own
        const { q, v } = observer.estimate();
        if (snapshot !== null) snapshot.step(y[k].map(number), t[k] - t[k - 1], u[k - 1]);
        if (k === 150) snapshot = observer.copy();
        estimates.push([...q, ...v]);
    }
    if (String(snapshot.estimate().v) !== String(observer.estimate().v)) throw new Error("the snapshot differs");
    const wrongs = [() => observer.step([1], 0.1), () => new Observer({ weight: 1 }), () => new Observer({ mass: 1 })];
    for (const wrong of wrongs) {
        try { wrong(); } catch (error) { if (error instanceof RangeError) continue; }
        throw new Error("nothing was refused");
    }
    console.log(JSON.stringify([estimates, codes]));
});
"""


@pytest.mark.exhaustive
def test_the_page_of_the_site_is_one_small_file_whose_observers_run(wasm, tmp_path):
    """Its bench, without what draws, follows the pendulum."""
    page = browser_page.page()
    assert len(page.encode()) < 250_000
    assert not re.search(r"<(?!a )\w+[^>]*(src|href)=|https?://|@import|url\(|fetch\(", page)
    *exported, main = re.findall(r"<script>\n(.*?)</script>", page, re.DOTALL)
    assert len(exported) == 3
    (tmp_path / "bench.js").write_text(
        "\n".join(
            [*(f"{{ const module = undefined; {text} }}" for text in exported), main[: main.index("const colour")]]
        )
        + _BENCH
    )
    errors = json.loads(node("require('./bench.js')", tmp_path))
    assert max(errors["intrinsic"], errors["ekf"]) < 0.3, "rad/s, with a mass that is off by 10 %"
    assert errors["derivative"] > max(errors["intrinsic"], errors["ekf"])


_BENCH = """
(async () => {
    const kinds = {};
    for (const name of NAMES) kinds[name] = (await globalThis[name].load()).Observer;
    for (const [id, , , , , first] of SLIDERS) values[id] = first;
    const bench = new Bench(kinds);
    for (let k = 0; k < 8; ++k) bench.advance(1);
    console.log(JSON.stringify(Object.fromEntries(NAMES.map((name) => [name, errors(bench.window(), name)[0]]))));
})();
"""
