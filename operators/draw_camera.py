# SPDX-License-Identifier: GPL-3.0-or-later
"""prt.draw_camera: the preview as a picture file, and the function that the command shares with it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import bpy

from ..prt_addon.blender.lights import environment_picture
from ..prt_addon.errors import BadArguments, PRTError
from .arguments import path_of, size_in, size_of
from .polls import refuse, why_not_drawn
from .relit import draw_lit, read_all, relit


def draw_to_file(scene: bpy.types.Scene, path: Path, size: tuple[int, int], environment: Path | None = None,
                 rotate: float = 0.0, window: bool = False, warn: Callable[[str], None] = lambda _: None,
                 by_directions: bool = False) -> None:
    """Draw the active camera's view of the bakes into a PNG, size (width, height); the sky behind them unless the
    scene's film is transparent. environment, rotate, window, by_directions: as for `relit`. Raises PRTError."""
    from ..gpu_shaders import offscreen  # a machine without a graphics driver can do all else

    baked = read_all(scene, scene.name)
    lit = relit(scene, baked, environment, rotate, True, window, by_directions=by_directions)
    for warning in lit.warnings:
        warn(warning)
    background = None
    if not scene.render.film_transparent:
        sky, rotation = environment_picture(scene, bpy.context.evaluated_depsgraph_get(), environment, rotate)
        background = offscreen.camera_background(scene, offscreen.environment_sampler(sky, rotation), *size)
    offscreen.write_png(path, draw_lit(scene, baked, lit, *size, background), scene)


class PRT_OT_draw_camera(bpy.types.Operator):
    """Draw the camera's view of the baked objects into a picture file, with the shaders of the viewport. Costs
    milliseconds"""

    bl_idname = "prt.draw_camera"
    bl_label = "Draw Camera View"

    filepath: bpy.props.StringProperty(
        name="File", subtype="FILE_PATH", options={"SKIP_SAVE"}, description="A name that ends in .png",
    )
    size: bpy.props.StringProperty(
        name="Size", options={"SKIP_SAVE"}, description="WIDTHxHEIGHT in pixels; empty takes the scene's",
    )
    environment: bpy.props.StringProperty(
        name="Environment", subtype="FILE_PATH", options={"SKIP_SAVE"},
        description="An equirectangular picture in place of the World; empty takes the World",
    )
    rotate: bpy.props.FloatProperty(
        name="Rotate", options={"SKIP_SAVE"},
        description="Degrees by which the environment is turned, as a Z rotation in the World's Mapping node does",
    )
    window: bpy.props.BoolProperty(
        name="Soften Ringing", options={"SKIP_SAVE"}, description="As in the panel, which counts unless this is given",
    )
    filter_glob: bpy.props.StringProperty(default="*.png", options={"HIDDEN", "SKIP_SAVE"})
    check_existing: bpy.props.BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return refuse(cls, why_not_drawn(context, "drawn"))

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        if not self.filepath:
            self.filepath = str(Path(bpy.data.filepath or "scene.blend").with_suffix(".png"))
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        scene, path = context.scene, path_of(self.filepath)
        try:
            if path.suffix.lower() != ".png":
                raise BadArguments(str(path), "the name does not end in .png", "Give a fitting name")
            size = size_of(self.size) if self.size else size_in(scene)
            window = self.window if self.properties.is_property_set("window") else scene.prt.window
            draw_to_file(scene, path, size, path_of(self.environment) if self.environment else None, self.rotate,
                         window, lambda warning: self.report({"WARNING"}, warning), scene.prt.lamps_by_directions)
        except PRTError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"Drawn to {path}")
        return {"FINISHED"}
