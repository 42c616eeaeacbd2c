"""Writes estimates as a Rerun recording: curves, results of the samples, and the moving bodies of a robot."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from covariant._optional import load_optional

MOST_ROWS_OF_VIEWS = 3
"""Largest number of coordinates whose views are placed one below the other; views of more are on tabs."""
RADIUS = 0.015
"""Radius [m] with which links are drawn."""
AXES = 0.1
"""Length [m] of the axes of a body's frame, which show how a last link rotates."""


class PlottedCurve(NamedTuple):
    """A curve: its view, as ("velocity", "q1"), label with unit, values (T,), colour, width, and if it is points.

    Example:
        >>> import numpy as np
        >>> from covariant.report import PlottedCurve
        >>> PlottedCurve(("velocity", "q1"), "v1 [rad/s]", np.zeros(3), "#0072b2").points
        False
    """

    view: tuple[str, str]
    label: str
    values: np.ndarray
    color: str
    width: float = 1.5
    points: bool = False


class MovingBody(NamedTuple):
    """A body of a robot: its joint's label and position (3,), line segments (k, 2, 3) [m], and its poses (R, 4, 4).

    Example:
        A rod of half a metre that does not move:

        >>> import numpy as np
        >>> from covariant.report import MovingBody
        >>> rod = np.array([[[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]]])
        >>> MovingBody("rod", "q1", np.zeros(3), rod, np.eye(4)[None]).segments.shape
        (1, 2, 3)
    """

    name: str
    label: str
    joint: np.ndarray
    segments: np.ndarray
    poses: np.ndarray


def write_rerun(
    path: Path,
    title: str,
    t: np.ndarray,
    curves: Sequence[PlottedCurve],
    results: Mapping[float, str],
    bodies: Sequence[MovingBody] = (),
    body_times: np.ndarray | None = None,
) -> None:
    """Write a recording (.rrd) with an arrangement of views; `results` are states, by the stamp [s] of their start."""
    rr = load_optional("rerun", use=f"{path}: recordings are written with", extra="live")
    partial = path.with_name(f"{path.name}.partial")
    with rr.RecordingStream("covariant", send_properties=False) as recording:
        recording.send_recording_name(title)
        recording.save(partial, default_blueprint=_arrangement(rr, curves, bodies))
        times = [rr.TimeColumn("t", duration=np.asarray(t, float))]
        for curve in curves:
            entity = rr.new_entity_path([*curve.view, curve.label])
            look = {"names": curve.label, "colors": _rgba(curve.color)}
            line = rr.SeriesPoints(marker_sizes=curve.width, **look) if curve.points else None
            style = line or rr.SeriesLines(widths=curve.width, **look)
            recording.log(entity, style, static=True)
            recording.send_columns(entity, times, rr.Scalars.columns(scalars=np.asarray(curve.values, float)))
        starts, names = [rr.TimeColumn("t", duration=list(results))], list(results.values())
        changes = rr.StateChange.columns(state=names) if _is_recent(rr) else rr.TextLog.columns(text=names)
        recording.send_columns("result", starts, changes)
        for body in bodies:
            _send_body(rr, recording, body, [rr.TimeColumn("t", duration=body_times)])
        recording.flush()
        recording.disconnect()
    partial.replace(path)


def _is_recent(rr: ModuleType) -> bool:
    """Whether Rerun has lanes of states. Older releases get messages instead, and choose the camera themselves."""
    return hasattr(rr, "StateChange")


def _rgba(color: str) -> int:
    """A colour "#RRGGBB" as Rerun's number, opaque."""
    return int(color[1:], 16) << 8 | 0xFF


def _send_body(rr: ModuleType, recording: Any, body: MovingBody, times: list[Any]) -> None:
    entity = rr.new_entity_path(["robot", body.name])
    recording.log(f"{entity}/link", rr.LineStrips3D(body.segments, radii=RADIUS, colors=_rgba("#56B4E9")), static=True)
    if body.label:
        joint = rr.Points3D([body.joint], radii=1.5 * RADIUS, labels=[body.label], colors=_rgba("#FFFFFF"))
        recording.log(f"{entity}/joint", joint, static=True)
    axes = rr.Arrows3D(vectors=AXES * np.eye(3), colors=255 * np.eye(3, dtype=np.uint8))
    recording.log(f"{entity}/axes", axes, static=True)
    columns = rr.Transform3D.columns(translation=body.poses[:, :3, 3], mat3x3=body.poses[:, :3, :3])
    recording.send_columns(entity, times, columns)


def _arrangement(rr: ModuleType, curves: Sequence[PlottedCurve], bodies: Sequence[MovingBody]) -> Any:
    """The robot on the left, curves by quantity and coordinate on the right, and results of the samples below."""
    rrb = load_optional("rerun.blueprint", use="recordings are written with", extra="live")
    views: dict[str, list[Any]] = {}
    for quantity, name in dict.fromkeys(curve.view for curve in curves):
        origin = rr.new_entity_path([quantity, name])
        views.setdefault(quantity, []).append(rrb.TimeSeriesView(origin=origin, name=f"{quantity} {name}"))
    few = max(map(len, views.values())) <= MOST_ROWS_OF_VIEWS
    columns = [(rrb.Vertical if few else rrb.Grid)(*each, name=quantity) for quantity, each in views.items()]
    plots = rrb.Horizontal(*columns) if few else rrb.Tabs(*columns)
    lanes = rrb.StateTimelineView if _is_recent(rr) else rrb.TextLogView
    results = lanes(origin="/result", name="result of each sample")
    right = rrb.Vertical(plots, results, row_shares=[5, 1])
    if not bodies:
        return rrb.Blueprint(right, collapse_panels=True)
    places = np.concatenate([_places(body) for body in bodies])
    middle, size = (places.min(0) + places.max(0)) / 2, np.ptp(places, axis=0).max() + 10 * RADIUS
    place = {"position": middle + size * np.array([1.3, 0.9, 0.4]), "look_target": middle, "eye_up": [0, 0, 1]}
    eye = rrb.EyeControls3D(**place) if _is_recent(rr) else None
    robot = rrb.Spatial3DView(origin="/robot", name="robot", eye_controls=eye)
    return rrb.Blueprint(rrb.Horizontal(robot, right, column_shares=[1, 2]), collapse_panels=True)


def _places(body: MovingBody) -> np.ndarray:
    """Positions (R(2k + 1), 3) of the origin and of the segment ends of a body."""
    points = np.concatenate([np.zeros((1, 3)), body.segments.reshape(-1, 3)])
    return (points @ body.poses[:, :3, :3].mT + body.poses[:, None, :3, 3]).reshape(-1, 3)
