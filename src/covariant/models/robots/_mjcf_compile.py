"""Runs MuJoCo's compiler on an MJCF file, even if meshes are missing that do not affect inertias."""

from collections import Counter
from pathlib import Path
from types import ModuleType
from typing import Any

from scalargraph.errors import InputError

PLACEHOLDER_SIZE = 0.01
"""Radius [m] of the spheres that replace shapes without a meaning here."""


def compiled_model(mujoco: ModuleType, path: Path) -> tuple[Any, Counter[str]]:
    """The compiled model of a file, and the number of assets that were left out because they cannot be read."""
    try:
        return mujoco.MjModel.from_xml_path(str(path)), Counter()
    except ValueError as error:
        reason = " ".join(str(error).removeprefix("Error: ").split())
        try:
            spec = mujoco.MjSpec.from_file(str(path))
        except ValueError:
            raise InputError(f"MuJoCo cannot read it: {reason}") from error
        ignored, shaped = _leave_out_shapes(mujoco, spec)
        try:
            return spec.compile(), ignored
        except ValueError:
            more = f" and {len(shaped) - 1} more" if len(shaped) > 1 else ""
            remedy = f"; the inertia of {shaped[0]}{more} follows from a mesh: give an <inertial>" if shaped else ""
            raise InputError(f"MuJoCo cannot read it: {reason}{remedy}") from error


def _leave_out_shapes(mujoco: ModuleType, spec: Any) -> tuple[Counter[str], list[str]]:
    """Leave out all assets except meshes that determine an inertia; the bodies of those meshes are returned too."""
    ignored, shaped, needed = Counter(), [], set()
    for geom in spec.geoms:
        if not (geom.meshname or geom.hfieldname):
            continue
        if _has_inertia(mujoco, spec, geom):
            needed.add(geom.meshname)
            shaped.append(f"body {geom.parent.name!r}")
            continue
        # The geom is replaced and not removed, since a sensor or a pair of contacts may name it.
        geom.type, geom.meshname, geom.hfieldname = mujoco.mjtGeom.mjGEOM_SPHERE, "", ""
        geom.size = [PLACEHOLDER_SIZE] * 3
    for part in (*spec.geoms, *spec.sites, *spec.tendons):
        part.material = ""
    unused = {"asset/mesh": [mesh for mesh in spec.meshes if mesh.name not in needed], "asset/hfield": spec.hfields}
    unused |= {"skin": spec.skins, "asset/material": spec.materials, "asset/texture": spec.textures}
    for what, parts in unused.items():
        for part in list(parts):
            spec.delete(part)
            ignored[what] += 1
    return +ignored, sorted(set(shaped))


def _has_inertia(mujoco: ModuleType, spec: Any, geom: Any) -> bool:
    """Whether this shape determines the inertia of a body."""
    body, kinds = geom.parent, mujoco.mjtInertiaFromGeom
    low, high = spec.compiler.inertiagrouprange
    from_geoms = spec.compiler.inertiafromgeom
    if body.name == "world" or from_geoms == kinds.mjINERTIAFROMGEOM_FALSE:
        return False
    if from_geoms == kinds.mjINERTIAFROMGEOM_AUTO and body.explicitinertial:
        return False
    # A mass of NaN means that the density determines it.
    massless = geom.mass == 0 or (geom.mass != geom.mass and geom.density == 0)
    return low <= geom.group <= high and not massless
