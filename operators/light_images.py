# SPDX-License-Identifier: GPL-3.0-or-later
"""prt.light_images: the light of this moment as images, of objects baked at texels, with the UV map that shows them."""

from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

from ..prt_addon.blender.read_scene import transform_rows
from ..prt_addon.blender.stored import baked_mesh
from ..prt_addon.blender.visibility import find_objects
from ..prt_addon.errors import PRTError, StorageError
from ..prt_addon.relighting.texel_light import atlas_picture
from ..prt_addon.storage.container import HEADER_PROPERTY, BakedTransfer
from ..prt_addon.storage.texels import ATLAS_PROPERTY
from .export_atlas import RINGS
from .polls import refuse, why_not_read
from .relit import read_all, relit

UV_MAP = "PRT Atlas"
IMAGE = "PRT {}"
SAME_PLACE = 1e-4  # of the surface's size


class PRT_OT_light_images(bpy.types.Operator):
    """Write the light that leaves objects baked at texels into images, one for each, and a UV map "PRT Atlas" on their
    meshes that lays them on the surface: for Image Texture nodes, renders and exporters. Costs milliseconds, and 16
    bytes a texel in the file"""

    bl_idname = "prt.light_images"
    bl_label = "Apply to Images"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        meshes = [baked_mesh(o) for o in context.scene.objects]
        none = "" if any(m is not None and ATLAS_PROPERTY in m for m in meshes) else (
            "Nothing is baked at texels: choose Receivers: Texels and bake")
        return refuse(cls, why_not_read(context) or none)

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            baked = read_all(context.scene, context.scene.name)
            lit = relit(context.scene, baked, window=context.scene.prt.window,
                        by_directions=context.scene.prt.lamps_by_directions)
            objects = dict(zip(baked, find_objects(list(baked), context.scene), strict=True))
            at_texels = {name: b for name, b in baked.items() if b.texels is not None}
            unmapped = [name for name, b in at_texels.items() if not write_uv_map(objects[name], b)]
            for name, b in at_texels.items():
                write_image(IMAGE.format(name), atlas_picture(b.texels, lit.radiance(name, b), RINGS))
        except PRTError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        for warning in lit.warnings:
            self.report({"WARNING"}, warning)
        text = f"Wrote {len(at_texels)} image{'' if len(at_texels) == 1 else 's'}"
        if unmapped:
            text += f"; no UV map on {', '.join(unmapped)}: modifiers, sharing or edit mode are in the way"
        self.report({"INFO"}, text)
        return {"FINISHED"}


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
    layer = layers.get(UV_MAP) or layers.new(name=UV_MAP, do_init=False)
    if layer is None or layer.name != UV_MAP:
        return False
    if len(layers) > 1 and layers[active].name != UV_MAP:
        layers.active_index = active
    layer.uv.foreach_set("vector", places.astype(np.float32).ravel())
    mesh.update_tag()
    return True


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
