"""Scenes by name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.optics import RangeModel
from eschorty_ros.simulation.scenes.face import Face
from eschorty_ros.simulation.scenes.leaves import Leaves
from eschorty_ros.simulation.scenes.mesh import Mesh
from eschorty_ros.simulation.scenes.posts import Posts
from eschorty_ros.simulation.scenes.scene import Scene
from eschorty_ros.simulation.scenes.surfaces import Plane, Sphere, Steps
from eschorty_ros.simulation.scenes.within_range import within_range

RECEDING_MM = 900.0
"""Range of the scene ``receding`` with the stage at 0."""

_BUILDERS: dict[str, Callable[[], Scene]] = {
    "steps": Steps,
    "plane": Plane,
    "tilted": lambda: Plane(slope_stage=0.5, slope_column=0.25, pivot_mm=50.0),
    "sphere": Sphere,
    "leaves": Leaves,
    "face": Face,
    "posts": Posts,
    # A flat target on the stage: 1 mm farther away per mm of travel.
    "receding": lambda: Plane(RECEDING_MM, slope_stage=1.0),
}
NAMES = tuple(_BUILDERS)


def named(name_or_mesh_path: str | Path, model: RangeModel | None = None) -> Scene:
    """Return the scene of a name (one of ``NAMES``) or from a mesh file.

    With ``model``, a named scene that this build does not see whole is moved into its range. A mesh
    is in metres in ``eschorty_base`` (x = range); any format Open3D reads.

    Raises ``ArgumentError`` when the argument is neither a name nor an existing file,
    ``FormatError`` when the file has no triangles, and ``EschortyError`` when Open3D, needed for
    meshes, is not installed.
    """
    builder = _BUILDERS.get(str(name_or_mesh_path))
    if builder is not None:
        return builder() if model is None else within_range(builder(), model)
    path = Path(name_or_mesh_path)
    if not path.is_file():
        raise ArgumentError(
            f"scene {str(name_or_mesh_path)!r} is neither a name nor a file; "
            f"choose {', '.join(NAMES)} or the path of a mesh"
        )
    return Mesh.from_file(path)
