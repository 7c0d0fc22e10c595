# SPDX-License-Identifier: GPL-3.0-or-later
"""prt.relight: the light of this moment as a colour attribute, for materials, renders and exporters."""

from __future__ import annotations

import bpy
import numpy as np

from ..prt_addon.blender.fingerprint import RELIT_ATTRIBUTE
from ..prt_addon.blender.own_colours import can_show, own_corners, write_own_colours
from ..prt_addon.blender.stored import baked_mesh
from ..prt_addon.blender.visibility import find_objects
from ..prt_addon.errors import PRTError, StorageError
from ..prt_addon.storage.files import save_arrays
from .arguments import path_of
from .polls import refuse, why_not_read
from .properties import session
from .relit import radiance_arrays, read_all, relit

ATTRIBUTE = RELIT_ATTRIBUTE


class PRT_OT_relight(bpy.types.Operator):
    """Write the light that leaves all baked objects now into the colour attribute "PRT Light" of the meshes that carry
    their bakes (scene-linear, albedo included): for Color Attribute nodes, renders and exporters. Costs milliseconds.
    Highlights are those seen along the normals"""

    bl_idname = "prt.relight"
    bl_label = "Apply to Color Attribute"
    bl_options = {"REGISTER", "UNDO"}

    environment: bpy.props.StringProperty(
        name="Environment", subtype="FILE_PATH", options={"HIDDEN", "SKIP_SAVE"},
        description="An equirectangular picture in place of the World; empty takes the World",
    )
    rotate: bpy.props.FloatProperty(
        name="Rotate", options={"HIDDEN", "SKIP_SAVE"},
        description="Degrees by which the environment is turned, as a Z rotation in the World's Mapping node does",
    )
    use_scene_lights: bpy.props.BoolProperty(
        name="Scene's Lights", default=True, options={"HIDDEN", "SKIP_SAVE"},
        description="With Suns, and lamps where they were baked, beside the environment",
    )
    window: bpy.props.BoolProperty(
        name="Soften Ringing", options={"HIDDEN", "SKIP_SAVE"},
        description="As in the panel, which counts unless this is given",
    )
    filepath: bpy.props.StringProperty(
        name="File", subtype="FILE_PATH", options={"HIDDEN", "SKIP_SAVE"},
        description="Where arrays of the light go (.npz, as the command writes them), in place of the attribute",
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return refuse(cls, why_not_read(context))

    def execute(self, context: bpy.types.Context) -> set[str]:
        scene = context.scene
        try:
            baked = read_all(scene, scene.name)
            window = self.window if self.properties.is_property_set("window") else scene.prt.window
            lit = relit(scene, baked, path_of(self.environment) if self.environment else None, self.rotate,
                        self.use_scene_lights, window, by_directions=scene.prt.lamps_by_directions)
            if self.filepath:
                save_arrays(path_of(self.filepath), radiance_arrays(baked, lit))
            objects = dict(zip(baked, find_objects(list(baked), scene), strict=True))
            for name, transfer in ({} if self.filepath else baked).items():
                radiance = lit.radiance(name, transfer)
                write_colours(baked_mesh(objects[name]), radiance)
                if can_show(objects[name]):
                    write_own_colours(objects[name].data, radiance[own_corners(objects[name], transfer)])
        except PRTError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        for warning in lit.warnings:
            self.report({"WARNING"}, warning)
        if self.filepath:
            self.report({"INFO"}, f"Wrote {path_of(self.filepath)}")
            return {"FINISHED"}
        carriers = [name for name in baked if baked_mesh(objects[name]) != objects[name].data]
        text = f"Lit {len(baked)} object{'' if len(baked) == 1 else 's'}"
        if carriers:
            text += f"; of {', '.join(carriers)} in full on the hidden receiver mesh, and as fine as their own mesh is"
        self.report({"INFO"}, text)
        if session(context).preview:
            context.view_layer.update()
        return {"FINISHED"}


def write_colours(mesh: bpy.types.Mesh, radiance: np.ndarray) -> None:
    """Put radiance (points, 3) into the attribute, which is made where it is missing. Raises StorageError where
    something else has its name."""
    check_free(mesh)
    attribute = mesh.attributes.get(ATTRIBUTE) or mesh.color_attributes.new(ATTRIBUTE, "FLOAT_COLOR", "POINT")
    colours = np.ones((len(radiance), 4), np.float32)
    colours[:, :3] = radiance
    attribute.data.foreach_set("color", colours.ravel())
    mesh.update_tag()


def check_free(mesh: bpy.types.Mesh) -> None:
    """Raises StorageError where the attribute can't be written."""
    if mesh.library is not None:
        raise StorageError(mesh.name, "it is linked from another file", "Make it local")
    attribute = mesh.attributes.get(ATTRIBUTE)
    if attribute is not None and (attribute.data_type, attribute.domain) != ("FLOAT_COLOR", "POINT"):
        raise StorageError(mesh.name, f"an attribute named {ATTRIBUTE} of another kind is in the way",
                           "Rename or remove it")
