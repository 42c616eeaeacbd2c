"""The page on which exported observers run in the reader's browser, as one file that loads nothing else.

    python tools/browser_page.py site/browser-demo.html

It exports three observers of a double pendulum as WebAssembly, and puts their scripts into `tools/browser_page.html`.
Without a compiler for WebAssembly the page says what to install.
"""

import sys
import tempfile
from pathlib import Path

TEMPLATE = Path(__file__).with_suffix(".html")
RATE = 100.0
"""Rate [Hz] that decides the substeps of a step; on the page samples are at most a fiftieth of a second apart."""
OBSERVERS = {"intrinsic": "intrinsic", "ekf": "ekf", "derivative": "filtered-derivative"}
MODEL = """system = "pendulum_chain"

[parameters]
angles = "relative"
zero = "hanging"
gravity = 9.81
mass = [0.6, 0.4]
length = [0.3, 0.25]
com = [0.16, 0.14]
inertia = [0.005, 0.0026]
viscous = [0.004, 0.003]

[columns]
q = ["q1", "q2"]
u = ["tau1", "tau2"]

[measurement]
std = 2e-3

[uncertainty]
acceleration = 2.0
motion_acceleration = 75.0
motion_time = 0.05
"""


def scripts(folder: Path) -> dict[str, str]:
    """The scripts of the exported observers by name.

    Args:
        folder: An empty folder for the exports.

    Raises:
        ValueError: No compiler for WebAssembly is installed.
    """
    import covariant

    model = folder / "pendulum.toml"
    model.write_text(MODEL, encoding="utf-8")
    for name, observer in OBSERVERS.items():
        place, options = folder / name, {"rate": RATE, "observer": observer, "wasm": True}
        covariant.export(str(model), place, name=name, **options)
    return {name: (folder / name / f"{name}.js").read_text(encoding="utf-8") for name in OBSERVERS}


def page() -> str:
    """The text of the page."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            exported = scripts(Path(folder))
        except ValueError as error:
            return f"<!doctype html>\n<meta charset='utf-8'>\n<p>This page was not built: {error}</p>\n"
    texts = "".join(f"<script>\n{text}</script>\n" for text in exported.values())
    return TEMPLATE.read_text(encoding="utf-8").replace("@SCRIPTS@", texts)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    text = page()
    Path(sys.argv[1]).write_text(text, encoding="utf-8")
    print(f"wrote {sys.argv[1]}, {len(text.encode()) / 1000:.0f} kB")
