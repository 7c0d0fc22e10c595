# SPDX-License-Identifier: GPL-3.0-or-later
"""Where a bake is at home: a scene and its view layer, found again later under whatever name, whatever window shows."""

from __future__ import annotations

from dataclasses import dataclass

import bpy

from ..prt_addon.errors import BadScene


@dataclass(frozen=True)
class Place:
    """scene, view_layer: names; identity: the scene's session_uid, which renaming and undo leave as it is."""

    scene: str
    view_layer: str
    identity: int

    @staticmethod
    def of(source: bpy.types.Depsgraph | bpy.types.Context) -> Place:
        """That of an evaluated depsgraph, or of the window that a context is of."""
        return Place(source.scene.name, source.view_layer.name, source.scene.session_uid)

    @staticmethod
    def named(scene: str, view_layer: str) -> Place:
        """That of an earlier session. Raises BadScene where there is no such scene."""
        found = bpy.data.scenes.get(scene)
        if found is None:
            raise BadScene(scene, "there is no scene of this name any more", "Discard the interrupted bake")
        return Place(scene, view_layer, found.session_uid)

    def find(self) -> bpy.types.Scene:
        """The scene. Raises BadScene where it was deleted."""
        for scene in bpy.data.scenes:
            if scene.session_uid == self.identity:
                return scene
        raise BadScene(self.scene, "the scene was deleted, so that its bake has no place", "Undo that and bake again")

    def depsgraph(self) -> bpy.types.Depsgraph:
        """The scene's evaluated depsgraph. Raises BadScene."""
        scene = self.find()
        layer = scene.view_layers.get(self.view_layer) or scene.view_layers[0]
        if (scene, layer) == (bpy.context.scene, bpy.context.view_layer):
            return bpy.context.evaluated_depsgraph_get()
        with bpy.context.temp_override(scene=scene, view_layer=layer):
            return bpy.context.evaluated_depsgraph_get()
