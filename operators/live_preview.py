# SPDX-License-Identifier: GPL-3.0-or-later
"""What the viewport draws, and the handlers that make it follow the scene and its light.

Handlers only note that something changed; a timer does the work soon after, so that dragging a Sun stays smooth: it
waits at least as long as the last evaluation of the light took. Objects are kept by name: undo invalidates references,
and a renamed one is found anew.
"""

from __future__ import annotations

import time
from collections.abc import Hashable, Iterable
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import ClassVar

import bpy
import numpy as np
from bpy.app.handlers import persistent
from numpy.typing import NDArray

from ..gpu_shaders import viewport
from ..gpu_shaders.occluders import Occluder
from ..gpu_shaders.overlay import Marks
from ..gpu_shaders.render_data import DrawItem, LampScattering, transfer_signature
from ..prt_addon.blender.fingerprint import surroundings
from ..prt_addon.blender.image_albedo import surface_textures, textures_key
from ..prt_addon.blender.lights import distant_light
from ..prt_addon.blender.read_scene import read_object_triangles, read_triangles
from ..prt_addon.blender.stored import (
    baked_mesh,
    baked_objects,
    is_receiver,
    read_baked,
    stale,
    transform_since_bake,
)
from ..prt_addon.blender.stored_report import PROPERTY as REPORT_PROPERTY
from ..prt_addon.blender.stored_report import read_stored_report
from ..prt_addon.errors import PRTError
from ..prt_addon.lighting.distant_light import DistantLight
from ..prt_addon.lighting.local_lights import LocalLight
from ..prt_addon.relighting.moved_light import distant_light_in, is_turned
from ..prt_addon.relighting.scene_light import joined_light
from ..prt_addon.reporting.summary import summary
from ..prt_addon.scene.surface_textures import SurfaceTextures
from ..prt_addon.storage.columns import Columns
from ..prt_addon.storage.container import BakedTransfer
from .display import Display
from .distant_lamps import unlit_bakes
from .live_bodies import body_lines, lamp_light
from .live_materials import LiveMaterials
from .properties import assign, session
from .scene_lamps import SceneLamps, cloud_key, cloud_lines, lamps_signature, moved_lamps

SHORTEST_WAIT = 0.02  # seconds between a change and its evaluation
STALE_WAIT = 0.3  # the digest of a mesh costs more than a light and nobody watches it
STILL_SECONDS = 0.25  # after its last move a lamp counts as let go, and its soft shadows are refined
NOTE_WAIT = 1.0  # after a redraw was asked for, its outcome is known
OUTSIDE_LABEL = "outside the light cloud: no bounced light"
OUTLINES = ("BOUNDS", "WIRE")
SURFACE_TYPES = {"MESH", "CURVE", "SURFACE", "META", "FONT", "CURVES", "POINTCLOUD", "VOLUME", "GREASEPENCIL"}
SURFACE_DATA = (bpy.types.Material, bpy.types.Mesh)
UNLISTED = ("LIGHT", "CAMERA")  # objects that hold no bake
LISTED_TYPES = (bpy.types.Object, bpy.types.Scene, bpy.types.Collection)
LIGHT_TYPES = (bpy.types.World, bpy.types.Light, bpy.types.Image, bpy.types.NodeTree, bpy.types.Scene,
               bpy.types.Collection)


@dataclass
class Shown:
    """One baked object as it was read; the rest of its DrawItem is looked up on every redraw.

    moved: (4, 4) since its bake, while all that is around it came along; None where the bake is stale. owner: full name
    of the scene's object that shows it; local: (4, 4), where it stands relative to that if it is an instance.
    """

    baked: BakedTransfer
    key: Hashable
    owner: str
    local: NDArray[np.float64] | None = None
    stale: bool = False
    direct: NDArray[np.float32] | None = None
    scattering: LampScattering | None = None
    moved: NDArray[np.float64] | None = None
    textures: SurfaceTextures | None = None
    textures_key: Hashable = None


@dataclass
class Line:
    """What the panel lists of one object: the values of a `PRTBakedObject`."""

    name: str
    clusters: int = 0
    points: int = 0
    error: float = -1.0
    highlight_error: float = -1.0
    lamp_error: float = -1.0
    lamp_highlight_error: float = -1.0
    overdraw: float = 0.0
    overdraw_before: float = 0.0
    error_spent: float = 0.0
    receiver_errors: bool = False
    stale: str = ""


@dataclass
class Live:
    """Everything that the handlers share about one scene as one view layer shows it. shown, lines: by `name_full`."""

    shown: dict[str, Shown] = field(default_factory=dict)
    lines: list[Line] = field(default_factory=list)
    owners: set[str] = field(default_factory=set)
    known: Hashable = None
    geometry: int = 0  # counts changes of shapes
    around: dict[str, str] = field(default_factory=dict)
    message: str = ""
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
    stale_due: float = 0.0
    display: Display = field(default_factory=Display)
    materials: LiveMaterials = field(default_factory=LiveMaterials)
    materials_dirty: bool = True
    bakes_dirty: bool = True
    list_dirty: bool = True  # objects may have come or gone
    light_dirty: bool = True
    stale_dirty: bool = True
    working: ClassVar[bool] = False
    noting: ClassVar[bool] = False  # what was pending, just before working
    due: ClassVar[float] = 0.0  # of the timer


_lives: dict[Hashable, Live] = {}  # of what windows show


def _context_key() -> Hashable:
    return bpy.context.scene.session_uid, bpy.context.view_layer.name


class _OfContext:
    """The `Live` of the context's scene and view layer: two windows may show two scenes."""

    def __getattr__(self, name: str) -> object:
        return getattr(_lives.setdefault(_context_key(), Live()), name)

    def __setattr__(self, name: str, value: object) -> None:
        setattr(_lives.setdefault(_context_key(), Live()), name, value)


_live = _OfContext()


def bakes_changed() -> None:
    """Baked data was written or removed: read it again soon."""
    for live in _lives.values():
        live.bakes_dirty = live.light_dirty = live.stale_dirty = live.materials_dirty = True
        live.stale_due = 0.0
    _schedule(SHORTEST_WAIT)


def light_changed() -> None:
    """A setting of the light was changed: evaluate it again soon."""
    for live in _lives.values():
        live.light_dirty = True
    _schedule(SHORTEST_WAIT)


def enable() -> None:
    """Show baked objects in all viewports. Raises PRTError where their data or the light can't be read."""
    _read_bakes()
    _read_light()
    _read_materials()
    viewport.enable(draw_list, shows_everything, labels, occluders, marks)
    assign(session(), preview=True)
    _tell_panel()


def disable() -> None:
    """Back to Blender's own picture."""
    viewport.disable()
    assign(session(), preview=False, preview_message="", live_materials="")


def settled() -> bool:
    """Whether nothing is left to be done: what was noted is evaluated, no light fades, no soft shadow is coarse."""
    preview = session().preview
    return not any(live.bakes_dirty or live.stale_dirty or live.moving or
                   (preview and (live.light_dirty or live.materials_dirty)) for live in _lives.values())


def draw_list() -> list[DrawItem]:
    """What one region draws now: called on every redraw, so it only looks things up."""
    if _live.bakes_dirty or _live.light_dirty:  # a scene that no window showed until now
        _schedule(SHORTEST_WAIT)
    if _live.signature is None:
        return []
    space, exposure = bpy.context.space_data, 2.0 ** bpy.context.scene.prt.exposure
    colours = _live.display.colours_of(bpy.context.scene.prt.display, _bakes())
    items, owners = [], {name: found for found in bpy.context.view_layer.objects
                         if (name := found.name_full) in _live.owners}
    for name, shown in _live.shown.items():
        found = owners.get(shown.owner)
        if found is None or not _is_drawn(found, space):
            continue
        moved = transform_since_bake(found, shown.baked.header, _placed(found, shown.local))
        light = _light_on(shown, moved)
        painted, edited = colours.get(name), _live.materials.edited.get(name)
        key, baked, direct, scattering = (
            shown.key, shown.baked, shown.direct, shown.scattering) if edited is None else (
            edited.key, edited.baked, edited.with_direct(shown.direct), edited.with_scattering(shown.scattering))
        items.append(DrawItem(key, baked, moved, light, 1.0 if painted else exposure, shown.stale,
                              direct=direct, colours=painted, textures=shown.textures, scattering=scattering))
    if len(owners) < len(_live.owners):  # one was renamed or removed, which Blender may not tell
        _live.bakes_dirty = True
        _schedule(SHORTEST_WAIT)
    return items


def _light_on(shown: Shown, moved: NDArray[np.float64]) -> NDArray[np.float32]:
    """All light on an object in the columns of its bake."""
    basis = shown.baked.lighting_basis
    return joined_light(basis, _light_in(basis, moved), _live.lamps.cloud_light(shown.baked, shown.moved))


def _placed(owner: bpy.types.Object, local: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
    """Where an instance stands now; None for an object of the scene itself."""
    return None if local is None else np.array(owner.matrix_world, np.float64) @ local  # small


def _is_drawn(found: bpy.types.Object, space: bpy.types.SpaceView3D) -> bool:
    """Whether an object with a bake is shown lit: not while it is edited or painted, nor as wires."""
    return found.mode == "OBJECT" and found.display_type not in OUTLINES and found.visible_in_viewport_get(space)


def shows_everything() -> bool:
    """Whether every surface that this region shows is drawn by us: then Blender's depth is not needed (its floor grid
    and jittered samples are in it)."""
    space = bpy.context.space_data
    for found in bpy.context.view_layer.objects:
        has_surface = found.type in SURFACE_TYPES and found.display_type not in OUTLINES
        if (has_surface or found.instance_type != "NONE") and found.visible_in_viewport_get(space) and not (
                found.name_full in _live.shown and _is_drawn(found, space) and not found.particle_systems):
            return False
    return True


def occluders() -> list[Occluder]:
    """All meshes that this region shows and we do not draw: they may stand in front of those that we draw."""
    space, depsgraph = bpy.context.space_data, bpy.context.view_layer.depsgraph
    owners = bpy.context.view_layer.objects
    lit = {name for name, shown in _live.shown.items()
           if (owner := owners.get(shown.owner)) is not None and _is_drawn(owner, space)}
    found = []
    for instance in depsgraph.object_instances if depsgraph is not None else ():
        source = instance.object
        owner = (instance.parent if instance.is_instance else source).original
        names = {owner.name_full, f"{owner.name_full}/{source.original.name_full}"}
        if names & lit or not isinstance(source.data, bpy.types.Mesh) or not instance.show_self or (
                owner.display_type in OUTLINES or not owner.visible_in_viewport_get(space)):
            continue
        key = source.data.as_pointer(), _live.geometry
        # An instance's object is gone after this round; its mesh stays.
        read = partial(read_triangles, source.data) if instance.is_instance else partial(read_object_triangles, source)
        found.append(Occluder(key, np.array(instance.matrix_world), read))
    return found


def labels() -> list[tuple[str, tuple[float, ...]]]:
    """What is written beside lamps: those outside of the cloud."""
    outside = _live.lamps.outside if _live.shown else set()
    return [(OUTSIDE_LABEL, tuple(lamp.position)) for lamp in _live.lamps_read if lamp.name in outside]


def marks() -> Marks:
    """What is marked in the scene: lights of the cloud or patches of lit surfaces; and the legend of false colours."""
    moves = {name: shown.moved for name, shown in _live.shown.items()}
    return _live.display.marks(_bakes(), moves, bpy.context.scene.prt.show_cloud)


def _bakes() -> dict[str, BakedTransfer]:
    return {name: shown.baked for name, shown in _live.shown.items()}


def _light_in(basis: Columns, moved: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Distant light as a moved object sees it: its bake turns with the object, so the light turns the other way."""
    if _live.light is None or not is_turned(moved):
        return None if _live.light is None else _live.light.in_columns(basis)
    key = (basis.cubemap, moved[:3, :3].round(6).tobytes())
    if key not in _live.rotated:
        _live.rotated = {**dict(list(_live.rotated.items())[-63:]), key: distant_light_in(_live.light, basis, moved)}
    return _live.rotated[key]


Place = tuple[bpy.types.Object, bpy.types.Object, NDArray[np.float64] | None]


def _bakes_here() -> dict[str, Place]:
    """By name: an object with a bake, the scene's object that shows it, and for a collection's instance where it stands
    relative to that. Cheap where nothing is instanced."""
    found: dict[str, Place] = {o.name_full: (o, o, None) for o in baked_objects(bpy.context.scene)}
    layer = bpy.context.view_layer
    if not any(o.instance_type == "COLLECTION" and o.instance_collection for o in layer.objects):
        return found
    for instance in bpy.context.evaluated_depsgraph_get().object_instances:
        if not instance.is_instance or instance.parent.original.instance_type != "COLLECTION":
            continue
        source, owner = instance.object.original, instance.parent.original
        if baked_mesh(source) is not None and not is_receiver(source):
            local = np.linalg.pinv(np.array(owner.matrix_world)) @ np.array(instance.matrix_world)  # small
            found.setdefault(f"{owner.name_full}/{source.name_full}", (source, owner, local))
    return found


def _known(bakes: dict[str, Place]) -> Hashable:
    """Changes when bakes come, go, are renamed, get other data or leave edit mode."""
    layer = bpy.context.view_layer.objects
    return tuple((name, baked_mesh(found).session_uid, baked_mesh(found).is_editmode, owner.name in layer,
                  None if local is None else local.round(5).tobytes()) for name, (found, owner, local) in bakes.items())


def _read_bakes() -> None:
    """Read all baked objects of the scene; what can't be read is not shown, and the panel says why."""
    bakes = _bakes_here()
    _live.bakes_dirty, _live.shown, _live.lines, _live.known = False, {}, [], _known(bakes)
    _live.lamps.forget_geometry()
    layer = {found.name_full for found in bpy.context.view_layer.objects}
    for name, (found, owner, local) in bakes.items():
        line = Line(name)
        _live.lines.append(line)
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
        line.receiver_errors = baked.error is not None
        line.error_spent = spent / coherence["squared_error_before"] if coherence and spent > 0.0 else 0.0
        if owner.name_full in layer:
            key = _context_key(), name, transfer_signature(baked)
            _live.shown[name] = Shown(baked, key, owner.name_full, local)
    _live.owners = {shown.owner for shown in _live.shown.values()}
    _live.materials.read(_live.shown, _own_objects())
    _live.materials_dirty = True
    _read_stale()


def _own_objects() -> dict[str, bpy.types.Object]:
    """The scene's objects that are shown, by name, without instances."""
    layer = bpy.context.view_layer.objects
    return {name: layer[shown.owner] for name, shown in _live.shown.items()
            if shown.local is None and shown.owner in layer}


def _tell_panel() -> None:
    """Pass on to the panel what is known of the scene of this context."""
    state = session()
    assign(state, cloud="\n".join(_cloud_lines()), preview_message=_live.message if state.preview else "",
           live_materials=_live.materials.message if state.preview else "",
           last_bake=_last_bake(bpy.context.scene.get(REPORT_PROPERTY, "")) if _live.lines else "")
    if [line.name for line in state.objects] != [line.name for line in _live.lines]:
        state.objects.clear()
        for line in _live.lines:
            state.objects.add().name = line.name
    for told, line in zip(state.objects, _live.lines, strict=True):
        # Blender keeps floats in single precision.
        assign(told, **{name: float(np.float32(value)) if isinstance(value, float) else value
                        for name, value in vars(line).items()})


@lru_cache(maxsize=4)
def _last_bake(text: str) -> str:
    """The report of the scene's last bake as lines of kind, share and words for the panel; empty without a report."""
    try:
        report = read_stored_report(text, "the report")
    except PRTError:
        return ""  # the buttons that show it say what is wrong
    return "\n".join(f"{line.kind}\t{line.share:.3f}\t{line.text}" for line in summary(report)) if report else ""


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
    return lines + body_lines(_live.lamps, _live.shown)


def _errors_of(baked: BakedTransfer) -> tuple[float, ...]:
    """Measured errors of diffuse light, highlights, lamps' bounced light and highlights of that; -1 for what was not
    measured.

    The object's own errors; where it had too few points to measure one, those of the whole bake.
    """
    header, own = baked.header, baked.header.get("own_errors", {})
    only_lamps = header.get("settings", {}).get("lighting") == "local"
    keys = {"diffuse": None if only_lamps else "errors",
            "highlights": "highlight_errors" if len(baked.functions) > 1 else None,
            "bounced light of lamps": "errors" if only_lamps else "local_errors",
            "highlights of lamps": "local_highlight_errors" if len(baked.functions) > 1 else None}
    found = []
    for part, key in keys.items():
        mine = own.get("diffuse" if only_lamps and key == "errors" else part) if key else None
        whole = header.get(key, {}).get("total", -1.0) if key and not own else -1.0
        found.append(float(whole if mine is None else mine))
    return tuple(found)


def _read_stale() -> None:
    """Compare the baked objects with what they were baked from."""
    _live.stale_dirty = False
    started = time.perf_counter()
    depsgraph = bpy.context.evaluated_depsgraph_get()
    around = surroundings(depsgraph)
    followed = surroundings(depsgraph, follow=True) if _live.materials.present else around
    if followed != _live.around:  # a colour that is followed shadows nothing anew
        _live.around = followed
        _live.lamps.forget_geometry()
        _live.materials.forget_geometry()
        _live.materials_dirty = True
    bakes, changed = _bakes_here(), False
    for line in _live.lines:
        shown = _live.shown.get(line.name)
        if line.name not in bakes or shown is None:
            continue
        found, owner, local = bakes[line.name]
        matrix, before = _placed(owner, local), (shown.stale, shown.moved)
        try:
            follow = _live.materials.follows(line.name)
            line.stale = stale(found, depsgraph, followed if follow else around, matrix, follow) or ""
        except PRTError as error:
            line.stale = str(error)
        shown.stale = bool(line.stale)
        key = textures_key(found, depsgraph)
        if key != shown.textures_key:
            shown.textures_key, shown.textures = key, surface_textures(found, shown.baked, depsgraph)
        shown.moved = None if shown.stale else transform_since_bake(found, shown.baked.header, matrix)
        changed |= before[0] != shown.stale or not np.array_equal(before[1], shown.moved)
    if changed and any(shown.baked.cloud is not None for shown in _live.shown.values()):
        _live.lamps_signature, _live.light_dirty = None, True
    _live.stale_seconds = time.perf_counter() - started


def _read_light() -> None:
    """Evaluate the scene's light when it changed; the viewport redraws only then."""
    _live.light_dirty = False
    if not _live.shown:
        _live.signature, _live.light, _live.message = None, None, ""
        return
    started, depsgraph = time.perf_counter(), bpy.context.evaluated_depsgraph_get()
    name_lamps = all(shown.baked.cloud is None for shown in _live.shown.values()) and \
        not bpy.context.scene.prt.lamps_by_directions
    distant, warnings, signature = distant_light(
        bpy.context.scene, depsgraph, (shown.baked.lighting_basis for shown in _live.shown.values()),
        window=bpy.context.scene.prt.window, name_lamps=name_lamps)
    _read_lamps(depsgraph, warnings)
    _read_far_lamps(depsgraph, warnings)
    _live.light_seconds = time.perf_counter() - started
    _live.message = "\n".join(dict.fromkeys(warnings))
    if signature != _live.signature:
        _live.signature, _live.light, _live.rotated = signature, distant, {}
        _live.materials_dirty = True
        viewport.redraw()


def _read_lamps(depsgraph: bpy.types.Depsgraph, warnings: list[str]) -> None:
    """Let the lamps' light follow; while some of it still fades, ask for the next step."""
    now, baked = time.perf_counter(), {name: shown.baked for name, shown in _live.shown.items()}
    moves = {name: shown.moved for name, shown in _live.shown.items() if shown.moved is not None}
    lamps = _live.lamps.step(baked, depsgraph, warnings, now - _live.lamps_time, moves,
                             {name: shown.owner for name, shown in _live.shown.items()})
    _live.lamps_time = now
    warnings += [] if bpy.context.scene.prt.lamps_by_directions else unlit_bakes(baked, lamps)
    _note_moves(lamps, now)
    signature = lamps_signature(lamps), frozenset(_live.moving)
    fading = not _live.lamps.settled and any(shown.baked.links is not None for shown in _live.shown.values())
    if fading or signature != _live.lamps_signature or any(
            shown.direct is None and shown.baked.cloud is not None for shown in _live.shown.values()):
        _live.lamps_signature = signature
        for name, shown in _live.shown.items():
            shown.direct, shown.scattering = lamp_light(_live.lamps, name, shown, lamps, _live.moving)
        _live.materials_dirty = True
        viewport.redraw()
    if not _live.lamps.settled:
        _live.light_dirty = True
        viewport.redraw()


def _read_far_lamps(depsgraph: bpy.types.Depsgraph, warnings: list[str]) -> None:
    """Let lamps light bakes without columns of their own, where that is asked for."""
    settings, outside = bpy.context.scene.prt, []
    bakes = {name: shown.baked for name, shown in _live.shown.items() if shown.baked.cloud is None}
    if settings.lamps_by_directions and bakes:
        owners = {name: _live.shown[name].owner for name in bakes}
        outside = _live.lamps.far.step(bakes, depsgraph, warnings, owners)
    for name, baked in bakes.items():
        shown = _live.shown[name]
        direct = _live.lamps.far.direct(name, baked, outside, settings.window, shown.moved)
        if direct is not shown.direct:
            shown.direct, _live.materials_dirty = direct, True
            viewport.redraw()


def _read_materials() -> None:
    """Let bounced light follow the materials, where bakes kept what that needs."""
    _live.materials_dirty = False
    if not _live.materials.present or _live.signature is None:
        return
    owners = _own_objects()
    lights = {name: _light_on(_live.shown[name], transform_since_bake(found, _live.shown[name].baked.header))
              for name, found in owners.items()}
    if _live.materials.step(_live.shown, owners, lights, bpy.context.evaluated_depsgraph_get()):
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
    moving = [live for live in _lives.values() if live.moving]
    left = max((live.moved_time for live in moving), default=0.0) + STILL_SECONDS - time.perf_counter()
    if left > 0.0:
        return left
    if moving:
        light_changed()
    return None


def _schedule(wait: float) -> None:
    """Have `_catch_up` run after so many seconds, or earlier where it is due."""
    due = time.perf_counter() + wait
    if bpy.app.background or Live.noting or (bpy.app.timers.is_registered(_catch_up) and due >= Live.due):
        return
    if bpy.app.timers.is_registered(_catch_up):
        bpy.app.timers.unregister(_catch_up)
    Live.due = due
    bpy.app.timers.register(_catch_up, first_interval=wait, persistent=True)


def _catch_up() -> float | None:
    """Do what the handlers asked for; the seconds until more is to be done."""
    windows = bpy.context.window_manager.windows
    if not windows:
        return None
    _note_pending(windows)
    Live.working, waits, keys = True, [], set()
    assign(session(), preview=viewport.is_enabled())  # loading a file with its windows starts a new session
    try:
        for window in windows:
            with bpy.context.temp_override(window=window):
                if _context_key() not in keys:
                    keys.add(_context_key())
                    waits.append(_follow())
        with bpy.context.temp_override(window=windows[0]):
            _tell_panel()
    finally:
        Live.working = False
    for key in _lives.keys() - keys:  # no window shows it any more
        del _lives[key]
    viewport.redraw()
    waits = [wait for wait in waits if wait is not None]
    if waits:
        Live.due = time.perf_counter() + min(waits)
        return min(waits)
    if not bpy.app.timers.is_registered(_note_viewport):
        bpy.app.timers.register(_note_viewport, first_interval=NOTE_WAIT, persistent=True)
    return None


def _note_pending(windows: Iterable[bpy.types.Window]) -> None:
    """Have edits that Blender has not evaluated yet noted now: what is read below evaluates them too, and its updates
    are not noted, as reading makes some itself."""
    Live.noting = True
    try:
        for window in windows:
            with bpy.context.temp_override(window=window):
                bpy.context.view_layer.update()
    finally:
        Live.noting = False


def _follow() -> float | None:
    """Do for the scene of this context what is to be done; the seconds until there is more."""
    now = time.perf_counter()
    try:
        if _live.bakes_dirty or (_live.list_dirty and _live.known != _known(_bakes_here())):
            _live.light_dirty = True
            _read_bakes()
        _live.list_dirty = False
        if _live.stale_dirty and now >= _live.stale_due:
            _read_stale()
        if _live.light_dirty and session().preview:
            _read_light()
        if _live.materials_dirty and session().preview:
            _read_materials()
    except PRTError as error:
        _live.message = str(error)
    if _live.light_dirty and session().preview:  # light that fades
        return max(SHORTEST_WAIT, _live.light_seconds)
    return max(SHORTEST_WAIT, _live.stale_due - now) if _live.stale_dirty else None


def _note_viewport() -> None:
    """Pass on what the draw handlers ran into: they run while Blender draws and can't write properties themselves."""
    status = viewport.status()
    fallback = "" if status.colour_managed else f"Colours are approximate: {status.fallback}"
    assign(session(), viewport_message=status.error or fallback)


@persistent
def _on_depsgraph_update(_scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Note whether the light, a baked mesh or what is around it changed."""
    if not Live.working:
        _note(depsgraph)


def _note(depsgraph: bpy.types.Depsgraph, light: bool = False) -> None:
    """Note what a depsgraph's updates may have changed. light: whether that has changed for certain."""
    geometry = asked = reshaped = materials = False
    for update in depsgraph.updates:
        changed = update.id
        reshaped |= update.is_updated_geometry
        asked |= isinstance(changed, LISTED_TYPES) and getattr(changed, "type", "") not in UNLISTED
        if isinstance(changed, LIGHT_TYPES):
            light = True
        elif isinstance(changed, bpy.types.Object):
            light |= changed.type == "LIGHT"
            geometry |= changed.type in SURFACE_TYPES or changed.instance_type != "NONE"
            materials |= changed.type in SURFACE_TYPES  # another material in a slot
        elif isinstance(changed, SURFACE_DATA):
            geometry = True
            materials |= isinstance(changed, bpy.types.Material)
    now = time.perf_counter()
    for live in _lives.values():
        live.light_dirty |= light
        live.materials_dirty |= materials and live.materials.present
        live.list_dirty |= asked
        live.geometry += reshaped
        if geometry and not live.stale_dirty:
            live.stale_dirty, live.stale_due = True, now + max(STALE_WAIT, 4.0 * live.stale_seconds)
    if materials and session().preview and any(live.materials_dirty for live in _lives.values()):
        _schedule(max([SHORTEST_WAIT, *(live.materials.seconds for live in _lives.values())]))
    if light and session().preview:
        _schedule(max([SHORTEST_WAIT, *(live.light_seconds for live in _lives.values())]))
    elif geometry or asked:
        _schedule(max([STALE_WAIT, *(4.0 * live.stale_seconds for live in _lives.values())]))


@persistent
def _on_frame_change(_scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """What is animated moves without a depsgraph update of its own."""
    _note(depsgraph, light=True)


@persistent
def _on_data_replaced(*_arguments: object) -> None:
    """Undo replaced all data."""
    for live in _lives.values():
        live.signature = None
        live.geometry += 1
    bakes_changed()


@persistent
def _on_load(*_arguments: object) -> None:
    """A file was loaded: nothing of the last one counts."""
    _lives.clear()
    bakes_changed()


HANDLERS = (
    (bpy.app.handlers.depsgraph_update_post, _on_depsgraph_update),
    (bpy.app.handlers.frame_change_post, _on_frame_change),
    (bpy.app.handlers.undo_post, _on_data_replaced),
    (bpy.app.handlers.redo_post, _on_data_replaced),
    (bpy.app.handlers.load_post, _on_load),
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
    _lives.clear()
