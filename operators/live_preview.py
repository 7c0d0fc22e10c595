# SPDX-License-Identifier: GPL-3.0-or-later
"""What the viewport draws, and the handlers that make it follow the scene and its light.

Handlers only note that something changed; a timer does the work soon after, so that dragging a Sun stays smooth: it
waits at least as long as the last evaluation of the light took. Objects are kept by name: undo invalidates references.
"""

from __future__ import annotations

import time
from collections.abc import Hashable
from dataclasses import dataclass, field

import bpy
import numpy as np
from bpy.app.handlers import persistent
from numpy.typing import NDArray

from ..gpu_shaders import viewport
from ..gpu_shaders.render_data import DrawItem, transfer_signature
from ..prt_addon.blender.fingerprint import surroundings
from ..prt_addon.blender.lights import distant_light
from ..prt_addon.blender.stored import baked_objects, read_baked, stale, transform_since_bake
from ..prt_addon.errors import PRTError
from ..prt_addon.lighting.distant_light import DistantLight
from ..prt_addon.lighting.local_lights import LocalLight
from ..prt_addon.relighting.scene_light import joined_light
from ..prt_addon.storage.columns import Columns
from ..prt_addon.storage.container import BakedTransfer
from .properties import assign, session
from .scene_lamps import SceneLamps, cloud_key, cloud_lines, lamps_signature, moved_lamps

SHORTEST_WAIT = 0.02  # seconds between a change and its evaluation
STALE_WAIT = 0.3  # the digest of a mesh costs more than a light and nobody watches it
STILL_SECONDS = 0.25  # after its last move a lamp counts as let go, and its soft shadows are refined
NOTE_WAIT = 1.0  # after a redraw was asked for, its outcome is known
OUTSIDE_LABEL = "outside the light cloud: no bounced light"
SURFACE_TYPES = {"MESH", "CURVE", "SURFACE", "META", "FONT", "CURVES", "POINTCLOUD", "VOLUME", "GREASEPENCIL"}
LIGHT_TYPES = (bpy.types.World, bpy.types.Light, bpy.types.Image, bpy.types.NodeTree, bpy.types.Scene,
               bpy.types.Collection)


@dataclass
class Shown:
    """One baked object as it was read; the rest of its DrawItem is looked up on every redraw."""

    baked: BakedTransfer
    key: Hashable
    stale: bool = False
    direct: NDArray[np.float32] | None = None


@dataclass
class Live:
    """Everything that the handlers share."""

    shown: dict[str, Shown] = field(default_factory=dict)
    light: DistantLight | None = None
    lamps: SceneLamps = field(default_factory=SceneLamps)
    lamps_read: list[LocalLight] = field(default_factory=list)
    lamps_signature: Hashable = None
    lamps_time: float = 0.0
    moving: set[str] = field(default_factory=set)
    moved_time: float = 0.0
    signature: Hashable = None
    rotated: dict[Hashable, NDArray[np.float64]] = field(default_factory=dict)
    light_seconds: float = 0.0
    stale_seconds: float = 0.0
    bakes_dirty: bool = True
    light_dirty: bool = True
    stale_dirty: bool = True
    working: bool = False


_live = Live()


def bakes_changed() -> None:
    """Baked data was written or removed: read it again soon."""
    _live.bakes_dirty = _live.light_dirty = _live.stale_dirty = True
    _schedule(SHORTEST_WAIT)


def light_changed() -> None:
    """A setting of the light was changed: evaluate it again soon."""
    _live.light_dirty = True
    _schedule(SHORTEST_WAIT)


def enable() -> None:
    """Show baked objects in all viewports. Raises PRTError where their data or the light can't be read."""
    _read_bakes()
    _read_light()
    viewport.enable(draw_list, shows_everything, labels)
    assign(session(), preview=True, preview_message="")


def disable() -> None:
    """Back to Blender's own picture."""
    viewport.disable()
    assign(session(), preview=False, preview_message="")


def settled() -> bool:
    """Whether nothing is left to be done: what was noted is evaluated, no light fades, no soft shadow is coarse."""
    dirty = _live.bakes_dirty or _live.stale_dirty or (session().preview and _live.light_dirty)
    return not dirty and not _live.moving


def draw_list() -> list[DrawItem]:
    """What one region draws now: called on every redraw, so it only looks things up."""
    if _live.signature is None:
        return []
    space, exposure = bpy.context.space_data, 2.0 ** bpy.context.scene.prt.exposure
    items = []
    for name, shown in _live.shown.items():
        found = bpy.data.objects.get(name)
        if found is None or found.mode != "OBJECT" or not found.visible_in_viewport_get(space):
            continue
        moved = transform_since_bake(found, shown.baked.header)
        basis = shown.baked.lighting_basis
        light = joined_light(basis, _light_in(basis, moved), _live.lamps.cloud_light(shown.baked))
        items.append(DrawItem(shown.key, shown.baked, moved, light, exposure, shown.stale, direct=shown.direct))
    return items


def shows_everything() -> bool:
    """Whether every surface that this region shows is drawn by us: then Blender's depth is not needed (its floor grid
    and jittered samples are in it)."""
    space = bpy.context.space_data
    return all(found.name in _live.shown or found.type not in SURFACE_TYPES or not found.visible_in_viewport_get(space)
               or found.display_type in ("BOUNDS", "WIRE")
               for found in bpy.context.view_layer.objects)


def labels() -> list[tuple[str, tuple[float, ...]]]:
    """What is written beside lamps: those outside of the cloud."""
    outside = _live.lamps.outside if _live.shown else set()
    return [(OUTSIDE_LABEL, tuple(lamp.position)) for lamp in _live.lamps_read if lamp.name in outside]


def _light_in(basis: Columns, moved: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Distant light as a moved object sees it: its bake turns with the object, so the light turns the other way."""
    if _live.light is None:
        return None
    scale = np.sqrt((moved[:3, :3] ** 2).sum(axis=0))
    turn = moved[:3, :3] / np.where(scale > 0.0, scale, 1.0)
    if np.abs(turn - np.eye(3)).max() < 1e-5 or np.abs(turn.T @ turn - np.eye(3)).max() > 1e-3:  # small
        return _live.light.in_columns(basis)  # not turned, or sheared: then the bake is stale anyway
    key = (basis.cubemap, turn.round(6).tobytes())
    if key not in _live.rotated:
        _live.rotated = {**dict(list(_live.rotated.items())[-63:]), key: _live.light.in_columns(basis, turn.T)}
    return _live.rotated[key]


def _read_bakes() -> None:
    """Read all baked objects of the scene; what can't be read is not shown, and the panel says why."""
    scene, state = bpy.context.scene, session()
    _live.bakes_dirty, _live.shown = False, {}
    state.objects.clear()
    for found in baked_objects(scene):
        line = state.objects.add()
        line.name = found.name
        try:
            baked = read_baked(found)
        except PRTError as error:
            line.stale = str(error)
            continue
        if baked is None:
            continue
        line.clusters, line.points = int(baked.bases.shape[0]), len(baked.cluster)
        coherence = baked.header.get("coherence") or {}
        line.error, line.highlight_error, line.lamp_error, line.lamp_highlight_error = _errors_of(baked)
        line.overdraw = float(coherence.get("both", 0.0))
        line.overdraw_before = float(coherence.get("before", 0.0))
        spent = coherence.get("squared_error_after", 0.0) - coherence.get("squared_error_before", 0.0)
        line.error_spent = spent / coherence["squared_error_before"] if coherence and spent > 0.0 else 0.0
        _live.shown[found.name] = Shown(baked, (found.name, transfer_signature(baked)))
    assign(state, cloud="\n".join(_cloud_lines()))
    _read_stale()


def _cloud_lines() -> list[str]:
    """What the light clouds of the bakes are; with their objects where there are several."""
    owners: dict[str, list[str]] = {}
    for name, shown in _live.shown.items():
        if shown.baked.cloud is not None:
            owners.setdefault(cloud_key(shown.baked), []).append(name)
    lines = []
    for names in owners.values():
        if len(owners) > 1:
            lines.append(f"{names[0]}{f' and {len(names) - 1} more' if len(names) > 1 else ''}:")
        lines += cloud_lines(_live.shown[names[0]].baked.cloud).splitlines()
    return lines


def _errors_of(baked: BakedTransfer) -> tuple[float, ...]:
    """Measured errors of diffuse light, highlights, lamps' bounced light and highlights of that; -1 for what was not
    measured.

    The object's own errors; where it had too few points to measure one, those of the whole bake.
    """
    header, own = baked.header, baked.header.get("own_errors", {})
    only_lamps = header.get("settings", {}).get("lighting") == "local"
    keys = {"diffuse": None if only_lamps else "errors",
            "highlights": "highlight_errors" if baked.functions else None,
            "bounced light of lamps": "errors" if only_lamps else "local_errors",
            "highlights of lamps": "local_highlight_errors" if baked.functions else None}
    found = []
    for part, key in keys.items():
        mine = own.get("diffuse" if only_lamps and key == "errors" else part) if key else None
        whole = header.get(key, {}).get("total", -1.0) if key and not own else -1.0
        found.append(float(whole if mine is None else mine))
    return tuple(found)


def _read_stale() -> None:
    """Compare the baked objects with what they were baked from."""
    _live.stale_dirty = False
    _live.lamps.forget_geometry()
    started = time.perf_counter()
    depsgraph = bpy.context.evaluated_depsgraph_get()
    around = surroundings(depsgraph)
    for line in session().objects:
        found, shown = bpy.data.objects.get(line.name), _live.shown.get(line.name)
        if found is None or shown is None:
            continue
        why = stale(found, depsgraph, around) or ""
        shown.stale = bool(why)
        assign(line, stale=why)
    _live.stale_seconds = time.perf_counter() - started


def _read_light() -> None:
    """Evaluate the scene's light when it changed; the viewport redraws only then."""
    _live.light_dirty = False
    if not _live.shown:
        _live.signature = _live.light = None
        return
    started, depsgraph = time.perf_counter(), bpy.context.evaluated_depsgraph_get()
    name_lamps = all(shown.baked.cloud is None for shown in _live.shown.values())
    distant, warnings, signature = distant_light(
        bpy.context.scene, depsgraph, (shown.baked.lighting_basis for shown in _live.shown.values()),
        window=bpy.context.scene.prt.window, name_lamps=name_lamps)
    _read_lamps(depsgraph, warnings)
    _live.light_seconds = time.perf_counter() - started
    assign(session(), preview_message="\n".join(dict.fromkeys(warnings)))
    if signature != _live.signature:
        _live.signature, _live.light, _live.rotated = signature, distant, {}
        viewport.redraw()


def _read_lamps(depsgraph: bpy.types.Depsgraph, warnings: list[str]) -> None:
    """Let the lamps' light follow; while some of it still fades, ask for the next step."""
    now, baked = time.perf_counter(), {name: shown.baked for name, shown in _live.shown.items()}
    lamps = _live.lamps.step(baked, depsgraph, warnings, now - _live.lamps_time)
    _live.lamps_time = now
    _note_moves(lamps, now)
    signature = lamps_signature(lamps), frozenset(_live.moving)
    if signature != _live.lamps_signature or any(
            shown.direct is None and shown.baked.cloud is not None for shown in _live.shown.values()):
        _live.lamps_signature = signature
        for name, shown in _live.shown.items():
            shown.direct = _live.lamps.direct(name, shown.baked, lamps, _live.moving)
        viewport.redraw()
    if not _live.lamps.settled:
        _live.light_dirty = True
        viewport.redraw()


def _note_moves(lamps: list[LocalLight], now: float) -> None:
    """Find out which lamps are being dragged, and see to it that their soft shadows are refined afterwards."""
    moved = moved_lamps(lamps, _live.lamps_read)
    _live.lamps_read = lamps
    if moved:
        _live.moving, _live.moved_time = _live.moving | moved, now
        if not bpy.app.background and not bpy.app.timers.is_registered(_refine):
            bpy.app.timers.register(_refine, first_interval=STILL_SECONDS, persistent=True)
    elif now - _live.moved_time >= STILL_SECONDS:
        _live.moving = set()


def _refine() -> float | None:
    """Once no lamp moves any more, have their light evaluated as if none had; the seconds until it is to ask again."""
    left = _live.moved_time + STILL_SECONDS - time.perf_counter()
    if left > 0.0:
        return left
    if _live.moving:
        light_changed()
    return None


def _schedule(wait: float) -> None:
    if not bpy.app.background and not bpy.app.timers.is_registered(_catch_up):
        bpy.app.timers.register(_catch_up, first_interval=wait, persistent=True)


def _catch_up() -> float | None:
    """Do what the handlers asked for; the seconds until more is to be done."""
    windows = bpy.context.window_manager.windows
    if not windows:
        return None
    _live.working = True
    assign(session(), preview=viewport.is_enabled())  # loading a file with its windows starts a new session
    try:
        with bpy.context.temp_override(window=windows[0]):
            if _live.bakes_dirty:
                _read_bakes()
            if _live.stale_dirty:
                _read_stale()
            if _live.light_dirty and session().preview:
                _read_light()
    except PRTError as error:
        assign(session(), preview_message=str(error))
    finally:
        _live.working = False
    viewport.redraw()
    if _live.light_dirty and session().preview:  # light that fades
        return max(SHORTEST_WAIT, _live.light_seconds)
    if not bpy.app.timers.is_registered(_note_viewport):
        bpy.app.timers.register(_note_viewport, first_interval=NOTE_WAIT, persistent=True)
    return None


def _note_viewport() -> None:
    """Pass on what the draw handlers ran into: they run while Blender draws and can't write properties themselves."""
    status = viewport.status()
    fallback = "" if status.colour_managed else f"Colours are approximate: {status.fallback}"
    assign(session(), viewport_message=status.error or fallback)


@persistent
def _on_depsgraph_update(_scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Note whether the light or a baked mesh changed."""
    if _live.working or not _live.shown:
        return
    for update in depsgraph.updates:
        changed = update.id
        if isinstance(changed, LIGHT_TYPES):
            _live.light_dirty = True
        elif isinstance(changed, bpy.types.Object):
            _live.light_dirty |= changed.type == "LIGHT"
            _live.stale_dirty |= changed.type == "MESH"
    if _live.light_dirty and session().preview:
        _schedule(max(SHORTEST_WAIT, _live.light_seconds))
    elif _live.stale_dirty:
        _schedule(max(STALE_WAIT, 4.0 * _live.stale_seconds))


@persistent
def _on_frame_change(_scene: bpy.types.Scene, _depsgraph: bpy.types.Depsgraph) -> None:
    """An animated light moves without a depsgraph update of its own."""
    _live.light_dirty = True
    if session().preview:
        _schedule(max(SHORTEST_WAIT, _live.light_seconds))


@persistent
def _on_data_replaced(*_arguments: object) -> None:
    """A file was loaded, or undo replaced all data."""
    _live.signature = None
    bakes_changed()


HANDLERS = (
    (bpy.app.handlers.depsgraph_update_post, _on_depsgraph_update),
    (bpy.app.handlers.frame_change_post, _on_frame_change),
    (bpy.app.handlers.undo_post, _on_data_replaced),
    (bpy.app.handlers.redo_post, _on_data_replaced),
    (bpy.app.handlers.load_post, _on_data_replaced),
)


def register() -> None:
    """Attach the handlers."""
    for handlers, handler in HANDLERS:
        handlers.append(handler)
    bakes_changed()


def unregister() -> None:
    """Leave no handler, timer or GPU object behind."""
    for handlers, handler in HANDLERS:
        handlers.remove(handler)
    for timer in (_catch_up, _note_viewport, _refine):
        if bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)
    disable()
    _live.shown.clear()
