"""Lists the robots that come with the library: URDF files, and MJCF files of robots with closed loops.

The files contain no shapes, and each states the source of its numbers.
"""

from pathlib import Path

FOLDER = Path(__file__).parent / "files"
_FILES = {path.stem: path for path in FOLDER.iterdir() if path.suffix in (".urdf", ".xml")}
ROBOTS = tuple(sorted(_FILES))
"""Names of the robots that come with the library; `load` and every command accept a name in place of a path."""


def located(path: str | Path) -> Path:
    """Path of a robot's file.

    The verbs and `load` resolve names themselves. Use it if another program needs the file, such as a viewer. A path
    that is not the name of a robot is returned unchanged, whether or not the file exists.

    Args:
        path: A path, or a name in `ROBOTS`, which stands for the file of that robot.

    Returns:
        The path.

    Example:
        >>> from covariant import models
        >>> models.robots.located("panda").name
        'panda.urdf'
    """
    return _FILES.get(str(path), Path(path))
