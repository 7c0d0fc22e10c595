# SPDX-License-Identifier: GPL-3.0-or-later
"""The traced scene: one triangle soup whose points are the receivers.

A vertex where normals, albedo or materials differ between its faces becomes one point per group of equal face corners,
so that a cube gets right edges and two materials meet in a sharp line. Triangles too coarse for per-point transfer are
refined. Nothing in later stages has to know about vertices, corners or objects again: M_p belongs to a point.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..errors import BadScene
from .object_mesh import ObjectMesh, bounding_diagonal, clean
from .orientation import outward
from .part import Part
from .refinement import Beside, EdgeLimit, refine
from .surface_material import DIFFUSE, SurfaceMaterial
from .tangents import UP, quiet_pole, smooth_tangents, tangent_frame
from .texel_receivers import TexelChoice, texel_part, wants_texels
from .texel_surface import TexelSurface, TracedSurface

# Corners of one vertex whose normals differ by less than 0.25 degrees, or albedos by less than half an 8-bit step, are
# one receiver: below what interpolation shows, above the noise of Blender's packed custom normals.
NORMAL_TOLERANCE = 0.0044
ALBEDO_TOLERANCE = 0.5 / 255.0
# Wanted tangents of one vertex that differ by less than 30 degrees are averaged: more than the faces of a coarse mesh
# differ along a smooth texture map, less than its pieces do across a seam.
TANGENT_TOLERANCE = 0.5


@dataclass(frozen=True)
class SceneObject:
    """An object's share of the scene: its points and triangles are contiguous.

    matches_source: the points are, one to one and in order, the vertices of the evaluated mesh.
    source_points: how many vertices the evaluated mesh has.
    """

    name: str
    is_target: bool
    points: slice
    triangles: slice
    matches_source: bool
    source_points: int
    matrix: NDArray[np.float64]


@dataclass(frozen=True)
class SceneMesh:
    """Every triangle that casts shadows or bounces light, and the receivers on it.

    points, normals: (p, 3) float64 world space; triangles: (t, 3) int32 into points; albedo: (p, 3) float32;
    loose: (p,) bool, points without a face (they keep their place, so that data fits the mesh, and get no transfer);
    material: (p,) int32 into materials; tangents: (p, 3) float64, unit, orthogonal to the normals; materials: each
    once (names aside), the first always DIFFUSE, which stands for all that only reflect diffusely;
    source: (t,) int32, which of its object's triangles, as they were read, each one is or is a part of;
    faces: (p, 3) float64 unit normal of the one triangle that a texel lies on, zero for vertices; None where there are
    no texels; surfaces: of each object, None for those whose points are vertices; () where all are;
    warnings: what was dropped or repaired, one line each.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    triangles: NDArray[np.int32]
    albedo: NDArray[np.float32]
    loose: NDArray[np.bool_]
    material: NDArray[np.int32]
    tangents: NDArray[np.float64]
    objects: tuple[SceneObject, ...]
    materials: tuple[SurfaceMaterial, ...] = (DIFFUSE,)
    warnings: tuple[str, ...] = ()
    source: NDArray[np.int32] | None = None
    faces: NDArray[np.float64] | None = None
    surfaces: tuple[TexelSurface | None, ...] = ()

    @cached_property
    def traced(self) -> TracedSurface | None:
        """What rays meet where some points are texels; None where it is the scene's own triangles."""
        if not any(self.surfaces):
            return None
        points, triangles, first = [], [], 0
        for scene_object, surface in zip(self.objects, self.surfaces, strict=True):
            own = self.points[scene_object.points] if surface is None else surface.points
            faces = (self.triangles[scene_object.triangles] - scene_object.points.start if surface is None else
                     surface.triangles)
            points.append(own)
            triangles.append(faces + first)
            first += len(own)
        counts = [len(faces) for faces in triangles]
        return TracedSurface(np.concatenate(points), np.concatenate(triangles).astype(np.int32),
                             np.concatenate([[0], np.cumsum(counts)]),
                             np.array([o.triangles.start for o in self.objects] + [len(self.triangles)]), self.surfaces)

    @property
    def shape(self) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        """Points and triangles of the true surface."""
        return (self.points, self.triangles) if self.traced is None else (self.traced.points, self.traced.triangles)

    @property
    def size(self) -> float:
        """Diagonal of the bounding box of the target objects, in metres."""
        return bounding_diagonal([self.points[o.points] for o in self.objects if o.is_target])

    @staticmethod
    def assemble(objects: list[ObjectMesh], spacing: float = 0.0, lamps: NDArray[np.float64] | None = None,
                 texels: TexelChoice | None = None, split_slots: bool = False) -> SceneMesh:
        """Join objects into one scene.

        spacing: longest edge that a triangle may have, as a fraction of the targets' bounding diagonal, and beyond
        that diagonal of the distance from them; 0 keeps the meshes as they are. lamps: (n, 3) places inside rooms,
        which stay wound inwards. texels: which targets get texels as receivers, so far apart (None: none). split_slots:
        a point belongs to one material slot, even where two slots look the same, so that one can be changed later.
        Raises BadScene, naming the object, where nothing can be baked.
        """
        if not any(o.is_target for o in objects):
            raise BadScene("scene", "no mesh object to bake", "Select a mesh object, or make one visible in renders")
        warnings: list[str] = []
        cleaned = [clean(o, warnings) for o in objects]
        cleaned = [outward(o, [c for c in cleaned if c is not o], warnings, lamps) for o in cleaned]
        targets = np.concatenate([o.positions for o in cleaned if o.is_target])
        diagonal = bounding_diagonal([targets])
        if diagonal <= 0.0:
            name = next(o.name for o in cleaned if o.is_target)
            raise BadScene(name, "all vertices lie in one point", "Give the object a size")
        limit = EdgeLimit(spacing * diagonal, targets.min(axis=0), targets.max(axis=0))
        materials, numbers = _number_materials(cleaned)
        parts = [_split(o, of_triangle, limit, warnings, texels if o.is_target else None, split_slots)
                 for o, of_triangle in zip(cleaned, numbers, strict=True)]
        return _join(cleaned, parts, materials, tuple(warnings))


def _number_materials(objects: list[ObjectMesh]) -> tuple[tuple[SurfaceMaterial, ...], list[NDArray[np.int32]]]:
    """The scene's materials, and per object the number of each triangle's (t,).

    Materials that are equal but for their names count as one, and whatever is only diffuse as DIFFUSE.
    """
    number = {DIFFUSE: 0}
    materials, numbers = [DIFFUSE], []
    for mesh in objects:
        table = []
        for material in mesh.materials:
            key = DIFFUSE if material.is_diffuse else replace(material, name="")
            if key not in number:
                number[key] = len(materials)
                materials.append(material)
            table.append(number[key])
        index = np.zeros(len(mesh.triangles), np.int32) if mesh.material_index is None else mesh.material_index
        numbers.append(np.array(table, np.int32)[index])
    return tuple(materials), numbers


def _corner_groups(mesh: ObjectMesh, material: NDArray[np.int32], tangent: NDArray[np.float64] | None,
                   ) -> tuple[NDArray[np.int64], int]:
    """The group of each corner (t * 3,) such that corners of one group share vertex, normal, albedo, material (t,) and
    tangent (t * 3, 3).

    Corners of a vertex are compared with the vertex's first ungrouped corner, round after round: one round for a
    smooth mesh, as many as the vertex has groups otherwise. Group g < v is the first group of vertex g.
    """
    vertex = mesh.triangles.ravel().astype(np.int64)
    normal = mesh.corner_normals.reshape(-1, 3)
    albedo = mesh.corner_albedo.reshape(-1, 3)
    several = len(material) > 0 and int(material.min()) != int(material.max())
    of_corner = np.repeat(material, 3)
    group = np.full(len(vertex), -1, np.int64)
    count = len(mesh.positions)
    pending = np.arange(len(vertex))
    first_round = True
    while len(pending):
        owners, leader_place = np.unique(vertex[pending], return_index=True)
        leader = np.zeros(len(mesh.positions), np.int64)
        leader[owners] = pending[leader_place]
        lead = leader[vertex[pending]]
        same = (np.abs(normal[pending] - normal[lead]).max(axis=1) <= NORMAL_TOLERANCE) & (
            np.abs(albedo[pending] - albedo[lead]).max(axis=1) <= ALBEDO_TOLERANCE)
        if several:
            same &= of_corner[pending] == of_corner[lead]
        if tangent is not None:
            same &= np.sum((tangent[pending] - tangent[lead]) ** 2, axis=1) <= TANGENT_TOLERANCE ** 2
        same |= pending == lead  # a corner without a finite normal still leads its own group
        number = np.zeros(len(mesh.positions), np.int64)
        if first_round:
            number[owners] = owners
        else:
            number[owners] = count + np.arange(len(owners))
            count += len(owners)
        group[pending[same]] = number[vertex[pending[same]]]
        pending = pending[~same]
        first_round = False
    return group, count


def _split(mesh: ObjectMesh, material: NDArray[np.int32], limit: EdgeLimit, warnings: list[str],
           texels: TexelChoice | None = None, split_slots: bool = False) -> Part:
    """Corner groups become points; triangles with an edge over the limit (of 0 = none) are refined, or get texels.

    material: (t,) number of each triangle's.
    """
    tangent = _unit_corner_tangents(mesh)
    apart = material
    if split_slots and mesh.material_index is not None:
        apart = material * np.int32(len(mesh.materials) + 1) + mesh.material_index.astype(np.int32)
    group, count = _corner_groups(mesh, apart, tangent)
    points = np.empty((count, 3))
    points[:len(mesh.positions)] = mesh.positions
    points[group] = mesh.positions[mesh.triangles.ravel()]
    normals = _mean_per_group(mesh.corner_normals.reshape(-1, 3), group, count)
    length = np.sqrt(np.sum(normals ** 2, axis=1))
    triangles = group.reshape(-1, 3).astype(np.int32)
    degenerate = ~(length >= 1e-6)  # NaN among them
    normals[~degenerate] /= length[~degenerate, None]
    _replace_normals(points, triangles, normals, degenerate)
    albedo = np.clip(_mean_per_group(mesh.corner_albedo.reshape(-1, 3), group, count), 0.0, 1.0)
    beside = Beside(np.zeros(count, np.int32), None, mesh.sources)
    beside.material[group] = np.repeat(material, 3)
    if tangent is not None:
        wanted = _mean_per_group(mesh.corner_tangents.reshape(-1, 3), group, count)
        beside.tangents = tangent_frame(wanted, normals, quiet_pole(normals))
    matches = count == len(mesh.positions)
    if texels is not None:
        whole = Part(points, normals, albedo.astype(np.float32), triangles, beside.material,
                     _point_tangents(beside, normals), False, beside.source)
        if wants_texels(texels, whole, limit.longest):
            made = texel_part(mesh.name, texels, whole, limit.longest)
            charts = f"{made.surface.charts} chart{'' if made.surface.charts == 1 else 's'}"
            warnings.append(f"{mesh.name}: {len(made.points)} texels in {charts} of an atlas of"
                            f" {made.surface.width} x {made.surface.height} ({made.surface.method})")
            return made
    if limit.longest > 0.0:
        before = len(points)
        points, normals, albedo, triangles = refine(points, normals, albedo, triangles, limit, mesh.name, beside)
        if len(points) != before:
            matches = False
            warnings.append(f"{mesh.name}: refined from {before} to {len(points)} receivers")
    return Part(points, normals, albedo.astype(np.float32), triangles, beside.material,
                _point_tangents(beside, normals), matches, beside.source)


def _point_tangents(beside: Beside, normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """The tangents that were asked for, else smooth ones."""
    if beside.tangents is not None:
        return beside.tangents
    # Of diffuse points nobody asks.
    return smooth_tangents(normals, quiet_pole(normals) if beside.material.any() else UP)


def _unit_corner_tangents(mesh: ObjectMesh) -> NDArray[np.float64] | None:
    """The wanted tangents (t * 3, 3) along the surface as unit vectors, zero where none is wanted; None if nowhere."""
    if mesh.corner_tangents is None or not mesh.corner_tangents.any():
        return None
    wanted = np.nan_to_num(mesh.corner_tangents.reshape(-1, 3).astype(np.float64), posinf=0.0, neginf=0.0)
    frame = tangent_frame(wanted, mesh.corner_normals.reshape(-1, 3).astype(np.float64))
    return np.where(wanted.any(axis=1, keepdims=True), frame, 0.0)


def _mean_per_group(values: NDArray[np.floating], group: NDArray[np.int64], count: int) -> NDArray[np.float64]:
    """Mean of values (corners, 3) per group (count, 3) float64; zero for a group without corners."""
    members = np.bincount(group, minlength=count)
    sums = np.stack([np.bincount(group, weights=values[:, axis], minlength=count) for axis in range(3)], axis=1)
    return sums / np.maximum(members, 1)[:, None]


def _replace_normals(points: NDArray[np.float64], triangles: NDArray[np.int32], normals: NDArray[np.float64],
                     which: NDArray[np.bool_]) -> None:
    """Give points without a usable shading normal the area-weighted normal of their faces; loose ones get up."""
    if not which.any():
        return
    corners = points[triangles]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = _mean_per_group(np.repeat(face, 3, axis=0), triangles.ravel().astype(np.int64), len(points))
    length = np.sqrt(np.sum(total ** 2, axis=1))
    usable = length > 0.0
    normals[which] = (0.0, 0.0, 1.0)
    both = which & usable
    normals[both] = total[both] / length[both, None]


def _join(objects: list[ObjectMesh], parts: list[Part], materials: tuple[SurfaceMaterial, ...],
          warnings: tuple[str, ...]) -> SceneMesh:
    """Concatenate the parts and number their points and triangles through."""
    scene_objects, first_point, first_triangle, triangles = [], 0, 0, []
    for mesh, part in zip(objects, parts, strict=True):
        end_point, end_triangle = first_point + len(part.points), first_triangle + len(part.triangles)
        scene_objects.append(SceneObject(mesh.name, mesh.is_target, slice(first_point, end_point),
                                         slice(first_triangle, end_triangle), part.matches_source,
                                         len(mesh.positions), np.asarray(mesh.matrix, np.float64)))
        triangles.append(part.triangles + first_point)
        first_point, first_triangle = end_point, end_triangle
    if first_point >= 2 ** 31:
        raise BadScene("scene", f"{first_point} receivers do not fit 32-bit indices", "Bake fewer objects at once")
    joined = np.concatenate(triangles).astype(np.int32)
    loose = np.ones(first_point, bool)
    loose[joined.ravel()] = False
    points, normals, albedo, material, tangents, source = (
        np.concatenate([getattr(p, name) for p in parts])
        for name in ("points", "normals", "albedo", "material", "tangents", "source"))
    scene = SceneMesh(points, normals, joined, albedo, loose, material, tangents, tuple(scene_objects), materials,
                      warnings, source)
    return with_surfaces(scene, tuple(part.surface for part in parts))


def with_surfaces(scene: SceneMesh, surfaces: tuple[TexelSurface | None, ...]) -> SceneMesh:
    """The scene, whose points are texels of these surfaces of its objects; itself where there are none."""
    if not any(surfaces):
        return scene
    faces = np.zeros_like(scene.points)
    for scene_object, surface in zip(scene.objects, surfaces, strict=True):
        if surface is not None:
            faces[scene_object.points] = surface.faces
    return replace(scene, faces=faces, surfaces=surfaces)
