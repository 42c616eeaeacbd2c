"""The notebooks of the gallery run from an empty folder, and are stored without their outputs."""

from pathlib import Path

import pytest

NOTEBOOKS = sorted((Path(__file__).parents[2] / "gallery").glob("*.ipynb"))


@pytest.mark.exhaustive
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_shows_pictures(path, tmp_path):
    nbformat = pytest.importorskip("nbformat")
    client = pytest.importorskip("nbclient")
    notebook = nbformat.read(path, as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells)
    client.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [
        output.get("data", {}).get("text/html", "") for cell in notebook.cells for output in cell.get("outputs", [])
    ]
    pictures = [text for text in shown if "<img" in text]
    assert pictures
    # Without a reference or a covariance there is no accuracy to tabulate.
    assert path.stem == "a_robot_from_its_urdf" or any("<table" in text for text in pictures)
    lines = [
        output.data["text/plain"] for cell in notebook.cells for output in cell.get("outputs", ()) if "data" in output
    ]
    assert "" in lines  # progress was shown, and has gone
    assert not any(line.startswith(("reading", "estimating")) for line in lines)
