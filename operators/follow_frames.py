# SPDX-License-Identifier: GPL-3.0-or-later
"""The colour attribute "PRT Light" that follows the frames: playback, F12 and animation renders show relit colours.

Blender evaluates the scene, runs the handlers of a frame change, and evaluates once more what they changed; only then
it draws or renders. What goes wrong is said in one line, in the console and the panel; a render goes on.

A render out of Blender's window runs in a thread beside it, where meshes can be changed only while the window is
locked (Render > Lock Interface); background renders have no such thread.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import bpy
import numpy as np
from bpy.app.handlers import persistent

from ..prt_addon.blender.fingerprint import surroundings
from ..prt_addon.blender.own_colours import can_show, own_corners, write_own_colours
from ..prt_addon.blender.stored import baked_mesh, baked_objects, read_baked, stale
from ..prt_addon.blender.world import needs_cycles
from ..prt_addon.errors import BadScene, PRTError
from ..prt_addon.storage.container import HEADER_PROPERTY, BakedTransfer
from .relight import check_free, write_colours
from .relit import relit
from .scene_lamps import SceneLamps

UNLOCKED = "the render would change meshes that Blender's window draws. Turn on Render > Lock Interface"


@dataclass
class _Follower:
    """What stays from frame to frame: bakes as they were read, and shadows as long as nothing moves."""

    baked: dict[str, tuple[int, str, BakedTransfer]] = field(default_factory=dict)
    corners: dict[str, tuple[BakedTransfer, np.ndarray]] = field(default_factory=dict)
    around: dict[str, str] | None = None
    lamps: SceneLamps = field(default_factory=SceneLamps)
    message: str = ""


_follower = _Follower()


def message() -> str:
    """What kept the attribute from following at the last frame; empty if nothing did."""
    return _follower.message


def switched(scene: bpy.types.Scene) -> None:
    """Following was switched on or off."""
    global _follower
    _follower = _Follower()
    if scene.prt_light.follow_frames and scene == bpy.context.scene:
        _follow(scene)


def write_frame(scene: bpy.types.Scene) -> list[str]:
    """Write the light of this moment into the attributes of all bakes that can show it; lines about the others.

    Raises PRTError where the light itself can't be read; then no attribute is touched.
    """
    if needs_cycles(scene):
        raise BadScene(f"World {scene.world.name}", "its nodes would have to be rendered for each frame",
                       "Use a color or an image with a Mapping node, and animate its strength or rotation")
    baked, notes = _readable(scene)
    if not baked:
        return notes or ["nothing is baked"]
    lit = relit(scene, baked, window=scene.prt.window, scene_lamps=_follower.lamps,
                by_directions=scene.prt.lamps_by_directions)
    colours = {name: lit.radiance(name, transfer) for name, transfer in baked.items()}
    for name, radiance in colours.items():
        if not np.isfinite(radiance).all():
            notes.append(f"{name}: its light is no number")
            continue
        write_colours(baked_mesh(scene.objects[name]), radiance)
        _write_own(scene.objects[name], baked[name], radiance)
    return notes


def _write_own(baked_object: bpy.types.Object, baked: BakedTransfer, radiance: np.ndarray) -> None:
    """The same on the object's own mesh where renders do not show the one that carries the bake."""
    if not can_show(baked_object):
        return
    corners = _follower.corners.get(baked_object.name)
    if corners is None or corners[0] is not baked or len(corners[1]) != len(baked_object.data.loops):
        corners = baked, own_corners(baked_object, baked)
        _follower.corners[baked_object.name] = corners
    write_own_colours(baked_object.data, radiance[corners[1]])


def _readable(scene: bpy.types.Scene) -> tuple[dict[str, BakedTransfer], list[str]]:
    """Bakes by object that fit the scene and can be written, and a line about each other one."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    around = surroundings(depsgraph)
    if around != _follower.around:
        _follower.around = around
        _follower.lamps.forget_geometry()
    found: dict[str, BakedTransfer] = {}
    notes: list[str] = []
    for baked_object in baked_objects(scene):
        try:
            why = stale(baked_object, depsgraph, around)
            if why:
                notes.append(f"{baked_object.name}: its bake is stale: {why}")
                continue
            check_free(baked_mesh(baked_object))
            found[baked_object.name] = _read(baked_object)
        except PRTError as error:
            notes.append(str(error))
    _follower.baked = {name: kept for name, kept in _follower.baked.items() if name in found}
    return found, notes


def _read(baked_object: bpy.types.Object) -> BakedTransfer:
    """The bake of an object, read again only when it was baked again."""
    mesh = baked_mesh(baked_object)
    header = mesh[HEADER_PROPERTY]
    kept = _follower.baked.get(baked_object.name)
    if kept is None or kept[:2] != (mesh.session_uid, header) or len(kept[2].cluster) != len(mesh.vertices):
        kept = mesh.session_uid, header, read_baked(baked_object)
        _follower.baked[baked_object.name] = kept
    return kept[2]


def _follow(scene: bpy.types.Scene) -> None:
    """Write the attributes; what went wrong becomes the message, and is printed when it is another one."""
    try:
        notes = write_frame(scene)
    except PRTError as error:
        notes = [str(error)]
    _say("; ".join(dict.fromkeys(notes)))


def _say(text: str) -> None:
    if text and text != _follower.message:
        print(f"prt: follow frames: {text}", flush=True)
    _follower.message = text


@persistent
def _on_frame_change(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """A frame begins, in the viewport or in a render."""
    if not scene.prt_light.follow_frames:
        return
    if depsgraph.mode == "RENDER" and not bpy.app.background and not scene.render.use_lock_interface:
        _say(UNLOCKED)
        return
    if scene != bpy.context.scene:
        _say(f"scene {scene.name} is not the one of the window, so its colors stay")
        return
    if depsgraph.mode == "RENDER":
        _catch_up(scene)
    _follow(scene)


def _catch_up(scene: bpy.types.Scene) -> None:
    """Have the window's depsgraph evaluate this frame: a render has one of its own, and what animation says reaches
    the data-blocks, from which World and switches are read, only through the window's, which is evaluated only if
    something in it is tagged."""
    first = next(iter(baked_objects(scene)), None)
    if first is not None:
        baked_mesh(first).update_tag()  # it will be tagged in any case


@persistent
def _on_load(*_arguments: object) -> None:
    """Another file: nothing of the last one is kept."""
    global _follower
    _follower = _Follower()


HANDLERS = ((bpy.app.handlers.frame_change_post, _on_frame_change), (bpy.app.handlers.load_post, _on_load))


def register() -> None:
    """Attach the handlers."""
    for handlers, handler in HANDLERS:
        handlers.append(handler)


def unregister() -> None:
    """Leave no handler behind."""
    for handlers, handler in HANDLERS:
        handlers.remove(handler)
    _on_load()
