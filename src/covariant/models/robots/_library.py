"""The robots that come with the library, each a URDF file without shapes that says where its numbers are from."""

from pathlib import Path

FOLDER = Path(__file__).parent / "files"
ROBOTS = tuple(sorted(path.stem for path in FOLDER.glob("*.urdf")))
"""Names of the robots that come with the library; `load` and every command take a name in place of a path."""


def located(path: str | Path) -> Path:
    """The path of a robot's file; a bare name of `ROBOTS` stands for the file of that robot."""
    return FOLDER / f"{path}.urdf" if str(path) in ROBOTS else Path(path)
