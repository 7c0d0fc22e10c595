# SPDX-License-Identifier: GPL-3.0-or-later
"""The light of bakes at texels as images of the file, and as UV maps that lay them on the users' own meshes."""

from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

from ..errors import StorageError
from ..storage.container import HEADER_PROPERTY, BakedTransfer
from .fingerprint import ATLAS_UV_MAP
from .read_scene import transform_rows

IMAGE = "PRT {}"  # of an object's name
SAME_PLACE = 1e-4  # of the surface's size


def write_image(name: str, picture: NDArray[np.float32]) -> bpy.types.Image:
    """A picture (height, width, 3), row 0 the lowest, as a scene-linear image packed into the file; an earlier one of
    this name is replaced where it is ours. Raises StorageError where another image has the name."""
    height, width, _ = picture.shape
    image = bpy.data.images.get(name)
    if image is not None and HEADER_PROPERTY not in image:
        raise StorageError(name, "an image of this name is in the way", "Rename it")
    if image is None or tuple(image.size) != (width, height):
        fresh = bpy.data.images.new(name, width, height, float_buffer=True, is_data=False)
        if image is not None:
            image.user_remap(fresh)
            bpy.data.images.remove(image)
            fresh.name = name
        image = fresh
    image.colorspace_settings.name = "Linear Rec.709"
    image[HEADER_PROPERTY] = 1
    values = np.ones((height, width, 4), np.float32)
    values[..., :3] = picture
    image.pixels.foreach_set(values.ravel())
    image.update()
    image.pack()
    return image


def write_uv_map(scene_object: bpy.types.Object, baked: BakedTransfer) -> bool:
    """Lay the atlas on an object's own mesh; False where its faces are not those that were baked (modifiers) or it
    can't be written. The active UV maps stay as they are."""
    mesh = scene_object.data
    if not isinstance(mesh, bpy.types.Mesh) or mesh.library is not None or mesh.is_editmode or mesh.users > 1 or (
            scene_object.modifiers or scene_object.is_instancer):
        return False
    places = corner_places(mesh, baked)
    if places is None:
        return False
    layers, active = mesh.uv_layers, mesh.uv_layers.active_index
    layer = layers.get(ATLAS_UV_MAP) or layers.new(name=ATLAS_UV_MAP, do_init=False)
    if layer is None or layer.name != ATLAS_UV_MAP:
        return False
    if len(layers) > 1 and layers[active].name != ATLAS_UV_MAP:
        layers.active_index = active
    layer.uv.foreach_set("vector", places.astype(np.float32).ravel())
    mesh.update_tag()
    return True


def drop_light_images(scene_object: bpy.types.Object) -> None:
    """Remove an object's light image and the UV map that lays it on its mesh: its bake is cleared. Where something uses
    the image, both are the user's and stay."""
    image, mesh = bpy.data.images.get(IMAGE.format(scene_object.name_full)), scene_object.data
    if image is not None and HEADER_PROPERTY in image:
        if image.users > image.use_fake_user:
            return
        bpy.data.images.remove(image)
    layer = mesh.uv_layers.get(ATLAS_UV_MAP) if isinstance(mesh, bpy.types.Mesh) else None
    if layer is not None and mesh.library is None and not mesh.is_editmode:
        mesh.uv_layers.remove(layer)


def corner_places(mesh: bpy.types.Mesh, baked: BakedTransfer) -> NDArray[np.float64] | None:
    """(loops, 2) UVs of a mesh's face corners; None where the baked surface's triangles are not its."""
    surface = baked.texels
    mesh.calc_loop_triangles()
    loops = np.empty((len(mesh.loop_triangles), 3), np.int32)
    mesh.loop_triangles.foreach_get("loops", loops.ravel())
    if surface.source.max(initial=-1) >= len(loops):
        return None
    vertex, positions = np.empty(len(mesh.loops), np.int32), np.empty((len(mesh.vertices), 3), np.float32)
    mesh.loops.foreach_get("vertex_index", vertex)
    mesh.vertices.foreach_get("co", positions.ravel())
    matrix = np.array(baked.header["matrix"], np.float64).reshape(4, 4)
    world = transform_rows(positions, matrix[:3, :3]) + matrix[:3, 3]
    own, then = loops[surface.source], surface.points[surface.triangles]
    # Which corner is which: by place, as the winding may have been turned.
    away = np.sqrt(np.sum((then[:, :, None] - world[vertex[own]][:, None]) ** 2, axis=3))
    if float(away.min(axis=2).max()) > SAME_PLACE * float(np.ptp(then, axis=(0, 1)).max()):
        return None
    places = np.zeros((len(mesh.loops), 2))
    size = np.array([surface.width, surface.height])
    places[np.take_along_axis(own, away.argmin(axis=2), axis=1).ravel()] = (surface.places.reshape(-1, 2) + 0.5) / size
    return places
