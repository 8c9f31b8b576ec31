"""A triangle mesh as a scene, ray-cast by Open3D."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.base.errors import FormatError
from eschorty_ros.core.optics import RangeModel
from eschorty_ros.simulation.scenes.open3d_module import load_open3d
from eschorty_ros.simulation.scenes.scene import UniformReflectance, sheet


class Mesh(UniformReflectance):
    """Triangles in metres in ``eschorty_base`` (x = range, y = stage, z = laser line).

    Open3D casts in float32: hits are accurate to about 1 um at 1 m.

    - ``vertices_m``: Shape (n, 3).
    - ``triangles``: Vertex indices, shape (m, 3).

    Raises ``FormatError`` when there is no triangle, and ``EschortyError`` without Open3D.
    """

    def __init__(self, vertices_m: ArrayLike, triangles: ArrayLike, name: str = "mesh") -> None:
        faces: NDArray[np.uint32] = np.ascontiguousarray(triangles, dtype=np.uint32)
        if faces.size == 0:
            raise FormatError(f"{name} has no triangles; give a triangle mesh in metres")
        o3d = load_open3d("a mesh scene")
        self._tensor: Any = o3d.core.Tensor
        self._caster: Any = o3d.t.geometry.RaycastingScene()
        self._caster.add_triangles(
            self._tensor(np.ascontiguousarray(vertices_m, dtype=np.float32)), self._tensor(faces)
        )

    @classmethod
    def from_file(cls, path: str | Path) -> Mesh:
        """Return the mesh of any file Open3D reads (.ply, .stl, .obj, .off, .gltf)."""
        o3d = load_open3d("a mesh scene")
        if not Path(path).is_file():
            raise FormatError(f"mesh {str(path)!r} does not exist; give the path of a mesh file")
        with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
            mesh = o3d.io.read_triangle_mesh(str(path))
        return cls(np.asarray(mesh.vertices), np.asarray(mesh.triangles), f"mesh {str(path)!r}")

    def range_mm(self, stage_mm: ArrayLike, columns: ArrayLike, model: RangeModel) -> Array:
        """Return ranges as a :class:`Scene`."""
        y, slope = sheet(stage_mm, columns, model)
        rays = np.zeros((y.size, slope.size, 6), dtype=np.float32)
        rays[..., 0] = -model.b_mm * 1e-3
        rays[..., 1] = y * 1e-3
        rays[..., 3] = 1.0
        rays[..., 5] = slope
        depth_m = self._caster.cast_rays(self._tensor(rays))["t_hit"].numpy().astype(np.float64)
        return np.where(np.isfinite(depth_m), depth_m * 1e3 - model.b_mm, np.nan)
