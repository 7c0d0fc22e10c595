# SPDX-License-Identifier: GPL-3.0-or-later
"""prt.light_images: the light of this moment as images, of objects baked at texels, with the UV map that shows them."""

from __future__ import annotations

import bpy

from ..prt_addon.blender.light_images import IMAGE, write_image, write_uv_map
from ..prt_addon.blender.stored import baked_mesh
from ..prt_addon.blender.visibility import find_objects
from ..prt_addon.errors import PRTError
from ..prt_addon.relighting.texel_light import atlas_picture
from ..prt_addon.storage.texels import ATLAS_PROPERTY
from .export_atlas import RINGS
from .polls import refuse, why_not_read
from .relit import read_all, relit


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
