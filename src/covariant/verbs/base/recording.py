"""The Rerun recording of estimates: what their curves are, and how the bodies of a robot stand."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from covariant.models import Motion
from covariant.models.robots import robot_space
from covariant.report import PALETTE, MovingBody, PlottedCurve, write_rerun
from covariant.signals import StepCode
from covariant.verbs.base.outcome import slow_units

FRAME_SECONDS = 0.02
"""Least time [s] between two poses of a robot that are drawn; curves have every row."""
STUB = 0.1
"""Length [m] of a last link that is drawn, from its joint to the side on which its mass is."""
ESTIMATED, MEASURED, FILTERED, BAND = PALETTE[0], PALETTE[4], PALETTE[3], PALETTE[5]


def write_recording(path: Path, title: str, columns: dict[str, np.ndarray], result: Any) -> None:
    """Write the columns of a table, the measurements and results of an `EstimateResult`, and its robot."""
    kind, t = result.loaded.kind, result.t
    drawn = kind.drawn(np.asarray(result.loaded.record.y))
    measured = {} if drawn is None else dict(zip(kind.positions.names, np.asarray(drawn).T, strict=False))
    measured = result.loaded.file.columns.as_logged(measured)
    curves = []
    for name, values in measured.items():
        unit = result.units.get(name, "")
        curves.append(PlottedCurve(("position", name), _label("measured", unit), values, MEASURED, 1.0, points=True))
    units = result.units | slow_units(result.loaded)
    for name, values in columns.items():
        plain = name.removesuffix("_filtered")
        if name == "t" or name.endswith("_std"):
            continue
        quantity = _quantity(plain, kind, result.outcome.slow_names)
        unit = units.get(plain, "")
        label, color = ("filtered", FILTERED) if plain != name else ("estimated", ESTIMATED)
        std = columns.get(f"{name}_std")
        if std is not None:
            for sign, end in ((1, "+2σ"), (-1, "−2σ")):
                bound = values + sign * 2 * std
                named = _label(f"{label} {end}", unit)
                curves.append(PlottedCurve((quantity, plain), named, bound, BAND, 0.7))
        curves.append(PlottedCurve((quantity, plain), _label(label, unit), values, color, 3.0))
    codes = np.asarray(result.codes)
    changes = np.flatnonzero(np.r_[True, codes[1:] != codes[:-1]])
    results = {float(t[k]): StepCode(int(codes[k])).name.lower().replace("_", " ") for k in changes}
    rows = np.unique(np.floor((t - t[0]) / FRAME_SECONDS), return_index=True)[1]  # the first one of each frame
    write_rerun(path, title, t, curves, results, _bodies(result, rows), t[rows])


def _label(what: str, unit: str) -> str:
    return f"{what} [{unit}]" if unit else what


def _quantity(name: str, kind: Any, slow: tuple[str, ...]) -> str:
    if name in kind.estimates.names:
        return kind.what
    return "position" if name in kind.positions.names else "force" if name in slow else "other"


def _bodies(result: Any, rows: np.ndarray) -> list[MovingBody]:
    """The bodies of a robot, each in the frame of its first link, at its estimated configurations."""
    space = robot_space(result.loaded.model.space)
    if space is None:
        return []
    estimate = result.run.estimate
    on_group = isinstance(estimate, Motion)
    q = jnp.asarray(estimate.q if on_group else estimate[:, : len(result.loaded.model.coordinates)])[rows]
    tree, links = space.tree, space.links
    first = {body: i for i, body in reversed(list(enumerate(links.bodies)))}
    names = {body: links.names[i] for body, i in first.items()}
    poses = jax.jit(jax.vmap(lambda x: jnp.stack([space.pose(x, name) for name in names.values()])))(q)
    bodies = []
    for (body, i), pose in zip(first.items(), np.moveaxis(np.asarray(poses), 1, 0), strict=True):
        ends = [np.asarray(tree.place[k]) for k, parent in enumerate(tree.parents) if parent == body]
        ends += [np.asarray(links.place[k]) for k, of in enumerate(links.bodies) if of == body]
        ends = [end for end in ends if np.linalg.norm(end) > 0]
        first_moment = np.asarray(tree.first)[body]
        if not ends and body >= 0 and np.any(first_moment):  # how long a last link is no file says
            ends = [STUB * first_moment / np.linalg.norm(first_moment)]
        segments = np.stack([np.zeros((len(ends), 3)), np.reshape(ends, (-1, 3))], axis=1)
        # From the frame of the body, whose origin is on its joint, to that of the link: v @ R is Rᵀ v.
        segments = (segments - np.asarray(links.place[i])) @ np.asarray(links.rotation[i])
        joint = -np.asarray(links.place[i]) @ np.asarray(links.rotation[i])
        bodies.append(MovingBody(names[body], _joint(tree, result.loaded, body), joint, segments, pose))
    return bodies


def _joint(tree: Any, loaded: Any, body: int) -> str:
    """Names of the positions that move a body on its parent, as in the curves; "" where they are not by joint."""
    names = loaded.kind.positions.names
    if body < 0 or tree.coordinates.shape[1] != len(names):
        return ""
    return ", ".join(names[k] for k in np.flatnonzero(np.asarray(tree.coordinates[body])))
