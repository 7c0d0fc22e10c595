# SPDX-License-Identifier: GPL-3.0-or-later
"""Which objects a render would show, whatever the viewport hides at the moment."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import bpy

from ..errors import BadScene


def render_visible_objects(view_layer: bpy.types.ViewLayer) -> dict[str, bpy.types.Object]:
    """Original objects that renders of this view layer show, by full name, in the file's order.

    The object is not disabled for renders, nor, on at least one way down the tree of collections, is any collection.
    """
    visible: dict[str, bpy.types.Object] = {}
    pending = [view_layer.layer_collection]
    while pending:
        layer = pending.pop()
        if layer.exclude or layer.collection.hide_render:
            continue
        for scene_object in layer.collection.objects:
            if not scene_object.hide_render:
                visible.setdefault(scene_object.name_full, scene_object)
        pending.extend(reversed(layer.children))
    return visible


@contextmanager
def shown_as_in_render(depsgraph: bpy.types.Depsgraph) -> Iterator[dict[str, bpy.types.Object]]:
    """Within it, the depsgraph also evaluates what only the viewport hides; afterwards all switches stand as before.

    Blender leaves such objects out of the viewport's depsgraph, and offers scripts no depsgraph of a render. Yields
    `render_visible_objects`.
    """
    view_layer = depsgraph.view_layer
    visible = render_visible_objects(view_layer)
    undo: list[tuple[bpy.types.bpy_struct, str]] = []
    unhidden: list[bpy.types.Object] = []
    try:
        for holder in _viewport_switches(view_layer, visible):
            holder.hide_viewport = False
            undo.append((holder, "hide_viewport"))
        if undo:
            view_layer.update()
        for scene_object in visible.values():
            if scene_object.name in view_layer.objects and scene_object.hide_get(view_layer=view_layer):
                scene_object.hide_set(False, view_layer=view_layer)
                unhidden.append(scene_object)
        if undo or unhidden:
            depsgraph.update()
        yield visible
    finally:
        for scene_object in unhidden:
            scene_object.hide_set(True, view_layer=view_layer)
        for holder, name in undo:
            setattr(holder, name, True)
        if undo or unhidden:
            view_layer.update()


def _viewport_switches(view_layer: bpy.types.ViewLayer,
                       visible: dict[str, bpy.types.Object]) -> list[bpy.types.bpy_struct]:
    """Objects, collections and layer collections whose viewport switch hides a render-visible object."""
    holders: list[bpy.types.bpy_struct] = [o for o in visible.values() if o.hide_viewport]
    pending = [view_layer.layer_collection]
    while pending:
        layer = pending.pop()
        if layer.exclude or layer.collection.hide_render:
            continue
        holders.extend(holder for holder in (layer, layer.collection) if holder.hide_viewport)
        pending.extend(layer.children)
    return holders


def find_objects(names: list[str], scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """The scene's objects of these names. Raises BadScene naming the first that is missing."""
    by_name = {o.name_full: o for o in scene.objects} | {o.name: o for o in scene.objects if o.library is None}
    for name in names:
        if name not in by_name:
            raise BadScene(name, "there is no object of this name in the scene", "Check the spelling and the scene")
    return [by_name[name] for name in names]
