# SPDX-License-Identifier: GPL-3.0-or-later
"""Baked transfer in the .blend file, as design/contract.md promises it: attributes and custom properties of a Mesh.

The data sits on the object's own mesh where its vertices are the receivers, else on a receiver mesh `PRT <object>`: a
hidden child of the object. The object points to that mesh, so that appending or linking the object brings the data
along and renaming anything breaks nothing. Beyond the contract: `prt_albedo` (FLOAT_COLOR), `prt_normal` and, where
transfer depends on the view, `prt_tangent` (FLOAT_VECTOR, in the object's space), where lamps light it, too,
`prt_material` (INT, places in the property `prt_kernels`), and `prt_error` (FLOAT), all POINT; on a receiver mesh
`prt_source` (INT, FACE): which triangle of the evaluated mesh each one is a part of.
"""

from __future__ import annotations

import json
from dataclasses import replace

import bpy
import numpy as np
from numpy.typing import NDArray

from ..errors import StorageError
from ..relighting.moved_light import similarity
from ..scene.tangents import tangent_frame
from ..scene.texel_surface import TexelSurface
from ..storage import container
from ..storage.container import BakedTransfer
from ..storage.lamp_surfaces import ENTRY as LAMP_SURFACES
from ..storage.subsurface_links import flatten_links
from ..storage.texels import (
    ATLAS_PROPERTY,
    TEXEL_ATTRIBUTE,
    TRIANGLE_ATTRIBUTE,
    flatten_surface,
    read_texels,
    texel_numbers,
)
from ..storage.texels import ENTRY as ATLAS
from .bake_set import changed_piece
from .fingerprint import RECEIVER_PROPERTY, fingerprint, geometry_digest, materials_as_baked, shows_relit
from .live_materials import clear_live, write_live
from .read_scene import is_flattened, normal_matrix, read_mesh, transform_rows

NORMAL_ATTRIBUTE, TANGENT_ATTRIBUTE = "prt_normal", "prt_tangent"
CARRIER_PROPERTY = "prt_carrier"  # on the object that carries a receiver mesh
RECEIVER_NAME = "PRT {}"
MOVED = "it was moved, turned or scaled since the bake, and not all that is around it came along"
MATRIX_TOLERANCE = 1e-5  # relative to the largest entry: rounding of parents and constraints, not a move
OURS = (container.CLUSTER_ATTRIBUTE, container.WEIGHTS_ATTRIBUTE, container.ALBEDO_ATTRIBUTE, NORMAL_ATTRIBUTE,
        TANGENT_ATTRIBUTE, container.MATERIAL_ATTRIBUTE, container.ERROR_ATTRIBUTE, container.SOURCE_ATTRIBUTE,
        TEXEL_ATTRIBUTE)


def write_baked(scene_object: bpy.types.Object, baked: BakedTransfer, digests: dict[str, str | None] | None = None,
                surroundings: dict[str, str] | None = None) -> bpy.types.Mesh:
    """Store a complete bake for an object, in place of its previous one; returns the Mesh that carries it.

    digests: `fingerprint` of the object when it was read (None: it is as it was read, take it now). surroundings: as
    `fingerprint.surroundings` gave it then; with it, `stale` also tells when something else moved. Raises StorageError
    where Blender can't store data for this object; its previous bake then stays.
    """
    if scene_object.library is not None or scene_object.override_library is not None:
        raise StorageError(scene_object.name, "it is linked from another file",
                           "Make it local, or bake it in that file")
    matrix = _bake_matrix(baked, scene_object)
    if is_flattened(matrix):
        raise StorageError(scene_object.name, "its scale is zero along an axis", "Give it a scale and bake it again")
    on_source = _fits_source(scene_object, baked)
    _check_shapes(scene_object.name, baked)
    header = _header(scene_object, baked, on_source, matrix, digests, surroundings)
    mesh = scene_object.data if on_source else _new_receiver_mesh(scene_object, baked, matrix)
    try:
        _fill(mesh, baked, header, matrix)
    except BaseException:
        if not on_source:
            bpy.data.meshes.remove(mesh)
        raise
    # Only now that the new bake is complete does the old one go.
    previous = scene_object.get(RECEIVER_PROPERTY)
    if on_source:
        _drop_receiver(scene_object, previous)
    else:
        if isinstance(scene_object.data, bpy.types.Mesh) and scene_object.data.users == 1:
            _clear_mesh(scene_object.data)
        _attach_receiver(scene_object, mesh, previous)
    mesh.update_tag()
    return mesh


def read_baked(scene_object: bpy.types.Object) -> BakedTransfer | None:
    """The bake stored for an object (or on a receiver object itself); None without one.

    Positions and normals are world space at bake time; `transform_since_bake` takes them to now. Raises StorageError
    where the data is broken, does not fit its mesh any more, or has a newer schema.
    """
    mesh = baked_mesh(scene_object)
    if mesh is None:
        return None
    if mesh.is_editmode:
        raise StorageError(scene_object.name, "its baked data can't be read in edit mode", "Leave edit mode")
    header = container.parse_header(mesh[container.HEADER_PROPERTY], scene_object.name)
    cluster = _read_attribute(mesh, container.CLUSTER_ATTRIBUTE, 1, scene_object.name)
    vectors = header["shape"][1] - 1
    weights = [_read_attribute(mesh, f"{container.WEIGHTS_ATTRIBUTE}{k}", 4, scene_object.name)
               for k in range(-(-vectors // 4))]
    albedo = _read_attribute(mesh, container.ALBEDO_ATTRIBUTE, 3, scene_object.name)[:, :3]
    normals = _read_attribute(mesh, NORMAL_ATTRIBUTE, 3, scene_object.name)[:, :3]
    bases = _read_bases(mesh, scene_object.name)
    matrix = _header_matrix(header, scene_object.name)
    arrays = read_mesh(mesh)
    world = transform_rows(arrays.positions, matrix[:3, :3]) + matrix[:3, 3]
    triangles = arrays.triangles[:, [0, 2, 1]] if _mirrors(matrix) else arrays.triangles
    geometry = (albedo, world, _unit_rows(transform_rows(normals, normal_matrix(matrix))), triangles)
    tangents = None
    if header["shape"][2] > 1:
        local = _read_attribute(mesh, TANGENT_ATTRIBUTE, 3, scene_object.name)[:, :3]
        tangents = tangent_frame(transform_rows(local, matrix[:3, :3]), geometry[2].astype(np.float64))
    cloud = _read_numbers(mesh, container.CLOUD_PROPERTY) if container.CLOUD_PROPERTY in mesh else None
    material = kernels = None
    if LAMP_SURFACES in header:
        material = _read_attribute(mesh, container.MATERIAL_ATTRIBUTE, 1, scene_object.name)
        kernels = _read_numbers(mesh, container.KERNELS_PROPERTY) if container.KERNELS_PROPERTY in mesh else None
    links = _read_numbers(mesh, container.LINKS_PROPERTY) if container.LINKS_PROPERTY in mesh else None
    baked = container.unpack(header, cluster, weights, bases, geometry, scene_object.name, tangents, cloud, material,
                             kernels, links)
    texels = _read_texels(mesh, header, triangles, scene_object.name)
    error = _read_optional(mesh, container.ERROR_ATTRIBUTE, "FLOAT", "POINT")
    source = _read_optional(mesh, container.SOURCE_ATTRIBUTE, "INT", "FACE")
    if source is None and header.get("source", {}).get("on_source_mesh"):
        source = np.arange(len(triangles), dtype=np.int32)
    return replace(baked, error=error, texels=texels,
                   source=source if source is None or len(source) == len(triangles) else None)


def baked_mesh(scene_object: bpy.types.Object) -> bpy.types.Mesh | None:
    """The Mesh that carries an object's bake: its receiver's, else its own; None without a bake. Cheap."""
    receiver = scene_object.get(RECEIVER_PROPERTY)
    if isinstance(receiver, bpy.types.Mesh) and container.HEADER_PROPERTY in receiver:
        return receiver
    mesh = scene_object.data
    return mesh if isinstance(mesh, bpy.types.Mesh) and container.HEADER_PROPERTY in mesh else None


def is_receiver(scene_object: bpy.types.Object) -> bool:
    """Whether this object only carries another one's bake, which may have been deleted."""
    parent = scene_object.parent
    carries = parent is not None and scene_object.data is not None and (
        parent.get(RECEIVER_PROPERTY) == scene_object.data)
    return carries or CARRIER_PROPERTY in scene_object


def baked_objects(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """The scene's objects that have a bake, without the receivers that carry it."""
    return [o for o in scene.objects if baked_mesh(o) is not None and not is_receiver(o)]


def clear_orphans(scene: bpy.types.Scene) -> None:
    """Remove the carriers of bakes whose objects were deleted, with their meshes."""
    for carrier in list(scene.objects):
        if CARRIER_PROPERTY in carrier and carrier.library is None and (
                carrier.parent is None or carrier.parent.get(RECEIVER_PROPERTY) != carrier.data):
            mesh = carrier.data
            bpy.data.objects.remove(carrier)
            _remove_if_unused(mesh, None)


def clear_baked(scene_object: bpy.types.Object) -> bool:
    """Remove an object's bake and its receiver; True if there was one. Other objects' bakes stay."""
    found = baked_mesh(scene_object) is not None
    _drop_receiver(scene_object, scene_object.get(RECEIVER_PROPERTY))
    if isinstance(scene_object.data, bpy.types.Mesh) and container.HEADER_PROPERTY in scene_object.data:
        _clear_mesh(scene_object.data)
    return found


def stored_header(scene_object: bpy.types.Object) -> dict | None:
    """The header of an object's bake without reading the rest; None without a bake. Raises StorageError if broken."""
    mesh = baked_mesh(scene_object)
    return None if mesh is None else container.parse_header(mesh[container.HEADER_PROPERTY], scene_object.name)


def transform_since_bake(scene_object: bpy.types.Object, header: dict,
                         matrix: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """(4, 4) from world space at bake time to world space now: identity where the object was not moved. matrix: (4, 4),
    where an instance of it stands."""
    then = _header_matrix(header, scene_object.name)
    now = np.array(scene_object.matrix_world if matrix is None else matrix, np.float64)
    return np.eye(4) if _same_place(now, then) else now @ np.linalg.inv(then)  # small


def stale(scene_object: bpy.types.Object, depsgraph: bpy.types.Depsgraph,
          surroundings: dict[str, str] | None = None, matrix: NDArray[np.float64] | None = None,
          follow: bool = False) -> str | None:
    """Why an object's bake no longer fits the scene, as a clause for the user; None while it does or without a bake.

    A bake fits as long as everything keeps its place relative to everything else (`transform_since_bake` tells where it
    went). surroundings: of now, from `fingerprint.surroundings`, if what else moved shall count too; without them a
    move of the object alone makes it stale. matrix: as for `transform_since_bake`. follow: edits of materials that live
    editing follows count as none, for whoever shows what it finds (surroundings then likewise). Raises StorageError
    where the header can't be read.
    """
    header = stored_header(scene_object)
    if header is None:
        return None
    digests = _stored_digests(header, scene_object.name)
    # A material that shows the relit colours says nothing about the images of the ones that were baked.
    images = (False, True) if shows_relit(scene_object) else (None,)
    geometry = [geometry_digest(scene_object, depsgraph, shown) for shown in images]
    if geometry[0] is not None and digests.get("geometry") not in geometry:
        return "its mesh or modifiers changed since the bake"
    if digests.get("materials") != materials_as_baked(scene_object, follow):
        return "its materials changed since the bake"
    moved, then = transform_since_bake(scene_object, header, matrix), digests.get("surroundings")
    stays = np.array_equal(moved, np.eye(4))
    if not stays and (then is None or surroundings is None or similarity(moved) is None):
        return MOVED
    if then is None or surroundings is None:
        return None
    try:
        changed = changed_piece(then, surroundings, moved)
        if stays and changed == scene_object.name_full and changed not in surroundings:  # hidden in renders itself
            changed = changed_piece({name: entry for name, entry in then.items() if name != changed}, surroundings,
                                    moved)
    except ValueError as error:
        raise StorageError(scene_object.name, f"the header of its baked data states no valid digests ({error})",
                           container.REBAKE) from error
    if changed is None:
        return None
    # A whole scene that moves together keeps its light; one object that moves alone does not.
    return f"{changed}, which can shadow or light it, changed since the bake" if stays else MOVED


def _stored_digests(header: dict, subject: str) -> dict:
    digests = header.get("digests", {})
    around = digests.get("surroundings") if isinstance(digests, dict) else ""
    if not isinstance(around, dict | None) or not all(isinstance(entry, str) for entry in (around or {}).values()):
        raise StorageError(subject, "the header of its baked data states no valid digests", container.REBAKE)
    return digests


def _same_place(now: NDArray[np.float64], then: NDArray[np.float64]) -> bool:
    return bool(np.abs(now - then).max() <= MATRIX_TOLERANCE * max(np.abs(then[:3]).max(), 1e-30))


def _bake_matrix(baked: BakedTransfer, scene_object: bpy.types.Object) -> NDArray[np.float64]:
    """The object's transform when it was baked, from the header, else as it is now."""
    if "matrix" in baked.header:
        return _header_matrix(baked.header, scene_object.name)
    return np.array(scene_object.matrix_world, np.float64)


def _header_matrix(header: dict, subject: str) -> NDArray[np.float64]:
    """(4, 4) from the header's 16 numbers, row by row."""
    numbers = header.get("matrix")
    valid = isinstance(numbers, list) and len(numbers) == 16 and all(type(n) in (int, float) for n in numbers)
    matrix = np.array(numbers if valid else [np.nan] * 16, np.float64).reshape(4, 4)
    if not np.isfinite(matrix).all() or is_flattened(matrix):
        raise StorageError(subject, "the header of its baked data states no valid transform", container.REBAKE)
    return matrix


def _mirrors(matrix: NDArray[np.float64]) -> bool:
    return bool(np.linalg.det(matrix[:3, :3] / np.abs(matrix[:3, :3]).max()) < 0.0)  # small


def _unit_rows(vectors: NDArray[np.float64]) -> NDArray[np.float32]:
    length = np.sqrt(np.sum(vectors ** 2, axis=1, keepdims=True))
    return (vectors / np.maximum(length, np.finfo(np.float64).tiny)).astype(np.float32)


def _fits_source(scene_object: bpy.types.Object, baked: BakedTransfer) -> bool:
    """Whether the object's own mesh can carry the bake: its vertices are the receivers and nobody else uses it."""
    mesh = scene_object.data
    return (bool(baked.header.get("source", {}).get("on_source_mesh"))
            and isinstance(mesh, bpy.types.Mesh) and mesh.library is None and mesh.users == 1
            and mesh.shape_keys is None and not mesh.is_editmode
            and not scene_object.modifiers and not scene_object.is_instancer
            and len(mesh.vertices) == len(baked.cluster))


def _check_shapes(name: str, baked: BakedTransfer) -> None:
    """Refuse a container that could not be read back, before anything is replaced."""
    clusters, representatives, rows, columns, channels = baked.bases.shape
    header = {**baked.header, "shape": [clusters, representatives, rows, columns, channels]}
    container.unpack(header, baked.cluster, container.pack_weights(baked.weights), baked.bases,
                     (baked.albedo, baked.positions, baked.normals, baked.triangles), name, baked.tangents,
                     container.flatten_cloud(baked.cloud) if baked.cloud is not None else None, baked.material,
                     baked.kernels, None if baked.links is None else flatten_links(baked.links))
    if baked.weights.shape[1] != representatives - 1:
        raise StorageError(name, "the baked weights and bases do not belong together", container.REBAKE)


def _header(scene_object: bpy.types.Object, baked: BakedTransfer, on_source: bool, matrix: NDArray[np.float64],
            digests: dict[str, str | None] | None, surroundings: dict[str, str] | None) -> dict:
    """The stored header: the bake's, with where it sits, what it was baked from, and the digests of that."""
    own = fingerprint(scene_object, bpy.context.evaluated_depsgraph_get()) if digests is None else digests
    stored = {**baked.header.get("digests", {}), **own}
    if surroundings is not None:
        stored["surroundings"] = surroundings
    source = {"object": scene_object.name, "mesh": getattr(scene_object.data, "name", None),
              "on_source_mesh": on_source}
    return {**baked.header, "shape": list(baked.bases.shape), "source": source, "digests": stored,
            "matrix": [float(v) for v in matrix.ravel()]}


def _fill(mesh: bpy.types.Mesh, baked: BakedTransfer, header: dict, matrix: NDArray[np.float64]) -> None:
    """Attributes and properties of a bake onto a mesh that has its points, in place of any previous ones."""
    _clear_mesh(mesh)
    inverse = np.linalg.inv(matrix)  # small
    local_normals = _unit_rows(transform_rows(baked.normals, normal_matrix(inverse)))
    opaque = np.concatenate([baked.albedo, np.ones((len(baked.albedo), 1), np.float32)], axis=1)
    _write_attribute(mesh, container.CLUSTER_ATTRIBUTE, "INT", baked.cluster)
    for index, packed in enumerate(container.pack_weights(baked.weights)):
        _write_attribute(mesh, f"{container.WEIGHTS_ATTRIBUTE}{index}", "FLOAT4", packed)
    _write_attribute(mesh, NORMAL_ATTRIBUTE, "FLOAT_VECTOR", local_normals)
    if baked.tangents is not None and baked.bases.shape[2] > 1:
        local_tangents = _unit_rows(transform_rows(baked.tangents, inverse[:3, :3]))
        _write_attribute(mesh, TANGENT_ATTRIBUTE, "FLOAT_VECTOR", local_tangents)
    _write_attribute(mesh, container.ALBEDO_ATTRIBUTE, "FLOAT_COLOR", opaque)
    mesh[container.BASES_PROPERTY] = np.ascontiguousarray(baked.bases, np.float32).ravel()
    if baked.cloud is not None:
        mesh[container.CLOUD_PROPERTY] = container.flatten_cloud(baked.cloud)
    if baked.lamp_surfaces is not None:
        _write_attribute(mesh, container.MATERIAL_ATTRIBUTE, "INT", baked.material)
        mesh[container.KERNELS_PROPERTY] = np.ascontiguousarray(baked.kernels, np.float32).ravel()
    write_live(mesh, baked.live)
    if baked.links is not None:
        mesh[container.LINKS_PROPERTY] = flatten_links(baked.links)
    if baked.error is not None:
        _write_attribute(mesh, container.ERROR_ATTRIBUTE, "FLOAT", baked.error)
    if baked.source is not None and not header["source"]["on_source_mesh"]:
        _write_attribute(mesh, container.SOURCE_ATTRIBUTE, "INT", baked.source, "FACE")
    if baked.texels is not None:
        _write_attribute(mesh, TEXEL_ATTRIBUTE, "INT", texel_numbers(baked.texels))
        _write_attribute(mesh, TRIANGLE_ATTRIBUTE, "INT", baked.texels.triangle)
        mesh[ATLAS_PROPERTY] = flatten_surface(baked.texels)
    mesh[container.HEADER_PROPERTY] = json.dumps(header)


MEMBERS = {"INT": ("value", 1, np.int32), "FLOAT": ("value", 1, np.float32), "FLOAT4": ("vector", 4, np.float32),
           "FLOAT_VECTOR": ("vector", 3, np.float32), "FLOAT_COLOR": ("color", 4, np.float32)}
NOTHING = ("", 0, np.float32)  # of an attribute that is not there, or of a kind that never was ours


def _write_attribute(mesh: bpy.types.Mesh, name: str, kind: str, values: NDArray, domain: str = "POINT") -> None:
    member, _, dtype = MEMBERS[kind]
    attribute = mesh.attributes.new(name, kind, domain)
    if attribute.name != name:
        taken = attribute.name
        mesh.attributes.remove(mesh.attributes[taken])
        raise StorageError(mesh.name, f"an attribute named {name} is in the way", "Rename or remove it")
    attribute.data.foreach_set(member, np.ascontiguousarray(values, dtype).ravel())


def _read_attribute(mesh: bpy.types.Mesh, name: str, least_width: int, subject: str) -> NDArray:
    """Values (p,) or (p, width); a conversion that keeps at least `least_width` numbers per point loses nothing."""
    attribute = mesh.attributes.get(name)
    member, width, dtype = MEMBERS.get(attribute.data_type, NOTHING) if attribute is not None else NOTHING
    fits = width >= least_width and (width > 1) == (least_width > 1)
    single = width == 1 and dtype != np.int32  # single values are numbers of clusters and materials
    if attribute is None or attribute.domain != "POINT" or not fits or single:
        raise StorageError(subject, f"the attribute {name} of its baked data is missing or was converted",
                           container.REBAKE)
    values = np.empty(len(attribute.data) * width, dtype)
    attribute.data.foreach_get(member, values)
    return values if width == 1 else values.reshape(-1, width)


def _read_optional(mesh: bpy.types.Mesh, name: str, kind: str, domain: str) -> NDArray | None:
    """Values (n,) that serve the display alone: None where an older bake has none, or something converted them."""
    attribute = mesh.attributes.get(name)
    if attribute is None or attribute.data_type != kind or attribute.domain != domain:
        return None
    member, _, dtype = MEMBERS[kind]
    values = np.empty(len(attribute.data), dtype)
    attribute.data.foreach_get(member, values)
    return values if values.dtype.kind == "i" or np.isfinite(values).all() else None


def _read_texels(mesh: bpy.types.Mesh, header: dict, triangles: NDArray[np.int32], subject: str) -> TexelSurface | None:
    """The atlas of a bake at texels; None of one at vertices. Raises StorageError where it is broken."""
    if ATLAS not in header:
        return None
    number, triangle = (_read_attribute(mesh, name, 1, subject) for name in (TEXEL_ATTRIBUTE, TRIANGLE_ATTRIBUTE))
    flat = _read_numbers(mesh, ATLAS_PROPERTY) if ATLAS_PROPERTY in mesh else None
    return read_texels(header, flat, number, triangle, triangles, subject, container.REBAKE)


def _read_bases(mesh: bpy.types.Mesh, subject: str) -> NDArray[np.float32]:
    """The flattened bases. Raises StorageError where the property is missing or was replaced by something else."""
    if container.BASES_PROPERTY not in mesh:
        raise StorageError(subject, "its baked data has no bases", container.REBAKE)
    bases = _read_numbers(mesh, container.BASES_PROPERTY)
    if bases is None:
        raise StorageError(subject, "the bases of its baked data are no numbers", container.REBAKE)
    return bases.astype(np.float32)


def _read_numbers(mesh: bpy.types.Mesh, name: str) -> NDArray | None:
    """A property of a list of numbers; None where it was replaced by something else."""
    try:
        numbers = np.array(mesh[name])
        return numbers if numbers.dtype.kind == "f" else numbers.astype(np.float64)
    except (TypeError, ValueError):
        return None


def _clear_mesh(mesh: bpy.types.Mesh) -> None:
    """Remove everything of ours from a mesh, and put back which colour the user had chosen."""
    active, default = mesh.color_attributes.active_color_name, mesh.color_attributes.default_color_name
    for name in [a.name for a in mesh.attributes if a.name.startswith(OURS)]:
        mesh.attributes.remove(mesh.attributes[name])
    for key in (container.HEADER_PROPERTY, container.BASES_PROPERTY, container.CLOUD_PROPERTY,
                container.KERNELS_PROPERTY, container.LINKS_PROPERTY, ATLAS_PROPERTY):
        if key in mesh:
            del mesh[key]
    clear_live(mesh)
    if active in mesh.color_attributes:
        mesh.color_attributes.active_color_name = active
    if default in mesh.color_attributes:
        mesh.color_attributes.default_color_name = default


def _new_receiver_mesh(scene_object: bpy.types.Object, baked: BakedTransfer,
                       matrix: NDArray[np.float64]) -> bpy.types.Mesh:
    """The receivers and their triangles as a mesh in the object's space."""
    inverse = np.linalg.inv(matrix)  # small
    local = (transform_rows(baked.positions, inverse[:3, :3]) + inverse[:3, 3]).astype(np.float32)
    triangles = baked.triangles[:, [0, 2, 1]] if _mirrors(matrix) else baked.triangles
    mesh = bpy.data.meshes.new(RECEIVER_NAME.format(scene_object.name))
    mesh.vertices.add(len(local))
    mesh.vertices.foreach_set("co", local.ravel())
    mesh.loops.add(3 * len(triangles))
    mesh.loops.foreach_set("vertex_index", np.ascontiguousarray(triangles, np.int32).ravel())
    mesh.polygons.add(len(triangles))
    mesh.polygons.foreach_set("loop_start", np.arange(0, 3 * len(triangles), 3, dtype=np.int32))
    mesh.update(calc_edges=True)
    return mesh


def _receiver_object(scene_object: bpy.types.Object, mesh: object) -> bpy.types.Object | None:
    """The child of an object that carries the mesh."""
    if not isinstance(mesh, bpy.types.Mesh):
        return None
    return next((child for child in scene_object.children if child.data == mesh), None)


def _attach_receiver(scene_object: bpy.types.Object, mesh: bpy.types.Mesh, previous: object) -> None:
    """Make the mesh the object's receiver: a child that neither renders nor shows, in the object's collections."""
    name = RECEIVER_NAME.format(scene_object.name)
    carrier = _receiver_object(scene_object, previous)
    if carrier is None:
        carrier = bpy.data.objects.new(name, mesh)
        carrier.parent = scene_object
        for collection in scene_object.users_collection:
            collection.objects.link(carrier)
    else:
        carrier.data = mesh
    carrier[CARRIER_PROPERTY] = True
    carrier.hide_render = carrier.hide_viewport = carrier.hide_select = True
    scene_object[RECEIVER_PROPERTY] = mesh
    _remove_if_unused(previous, mesh)
    mesh.name = carrier.name = name


def _drop_receiver(scene_object: bpy.types.Object, mesh: object) -> None:
    carrier = _receiver_object(scene_object, mesh)
    if RECEIVER_PROPERTY in scene_object:
        del scene_object[RECEIVER_PROPERTY]
    if carrier is not None and carrier.library is None:
        bpy.data.objects.remove(carrier)
    _remove_if_unused(mesh, None)


def _remove_if_unused(mesh: object, keep: bpy.types.Mesh | None) -> None:
    """Remove a receiver mesh that no object uses or points to any more (a copy of the object may still)."""
    if isinstance(mesh, bpy.types.Mesh) and mesh != keep and mesh.library is None and mesh.users == 0:
        bpy.data.meshes.remove(mesh)
