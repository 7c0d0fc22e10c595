# SPDX-License-Identifier: GPL-3.0-or-later
"""The steps of an artist who moves lamps after a bake: run by run.py, one step per timer call (driving.py).

What the viewport shows is compared with the core's own relighting on the CPU, vertex by vertex: the screenshot's pixel
at each vertex that the camera sees, against its radiance through sRGB.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Generator
from pathlib import Path

import bpy
import gpu
import numpy as np
from mathutils import Vector

sys.path.insert(0, str(Path(__file__).parent))  # Blender runs this file by its path

from comparing import core, levels
from driving import (
    DRAWN,
    SCENE,
    Step,
    area,
    baked_names,
    carrier,
    children,
    override,
    region,
    session,
    shoot,
    start,
    until,
    wait_for_bake,
    window,
)

OBJECTS = {"Floor", "Ceiling", "Back", "Left", "Right", "Box"}
WALLS = ("Floor", "Back", "Left", "Right")
# The job of the cancel tests: long enough in the lamps' stage to be met there.
LONG = "cloud_lights=500, merge_response=0, gather_directions=512, error_receivers=0"
LAMPS_STAGE = "Local lights"
# Levels of 255 that the picture may differ from the oracle in the mean, and all but a hundredth of the vertices: it is
# rounded to levels, and bends at a vertex within a pixel.
MEAN_LEVELS, MOST_LEVELS = 0.6, 4.0
OTHERS: set[Path] = set()
RIM = 0.35  # cosine
PATIENCE = 40.0  # seconds
FACES = ((-0.026, 0.133, 0.3), (0.367, -0.026, 0.3))  # of the box, towards the red wall and away from it


def lamp(name: str = "Lamp") -> bpy.types.Object:
    return bpy.data.objects[name]


def oracle() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """By name: positions (p, 3) and radiance (p, 3) towards the camera under the scene's light, from the CPU alone."""
    stored, scene_light = core("prt_addon.blender.stored"), core("prt_addon.relighting.scene_light")
    relit, lamps_of = core("prt_addon.relighting.exit_radiance"), core("operators.scene_lamps").SceneLamps()
    depsgraph = bpy.context.evaluated_depsgraph_get()
    baked = {o.name: stored.read_baked(o) for o in stored.baked_objects(bpy.context.scene)}
    lamps, result = lamps_of.step(baked, depsgraph, []), {}
    order = max(b.lighting_basis.order for b in baked.values())
    distant = core("prt_addon.blender.lights").light_coefficients(bpy.context.scene, depsgraph, order).coefficients \
        if order else None
    for name, transfer in baked.items():
        light = scene_light.joined_light(transfer.lighting_basis, distant, lamps_of.cloud_light(transfer))
        direct = lamps_of.direct(name, transfer, lamps)
        views = np.array(bpy.context.scene.camera.location) - transfer.positions
        # A curved rim is narrower than a pixel: left out as out of sight.
        facing = np.sum(views * transfer.normals, axis=1) / np.linalg.norm(views, axis=1)
        positions = np.where((facing < RIM)[:, None] & bool(transfer.functions), np.inf, transfer.positions)
        result[name] = positions, relit.view_radiance(transfer, light, views, direct)
    return result


def srgb(radiance: np.ndarray) -> np.ndarray:
    """Levels 0..255 of linear values."""
    clipped = np.clip(radiance, 0.0, 1.0)
    return 255.0 * np.where(clipped < 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1.0 / 2.4) - 0.055)


def seen(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which positions (p, 3) the camera sees inside the walls' edges, and where (n, 2): row and column, from the edge
    of the picture."""
    box, matrix = region(), np.array(area().spaces.active.region_3d.perspective_matrix)
    positions = np.where(np.isfinite(positions), positions, 99.0)
    clip = np.c_[positions, np.ones(len(positions))] @ matrix.T
    place = 0.5 * clip[:, :2] / clip[:, 3:] + 0.5
    column, row = box.x + place[:, 0] * box.width, 1000 - (box.y + place[:, 1] * box.height)
    inner = (np.abs(positions - (0.0, 0.0, 1.0)) < 0.9).sum(axis=1) >= 2  # edges show either wall
    eye, depsgraph = bpy.context.scene.camera.location, bpy.context.evaluated_depsgraph_get()
    for index in np.flatnonzero(inner):
        ray = Vector(positions[index]) - eye
        hit, where, *_ = bpy.context.scene.ray_cast(depsgraph, eye, ray)
        inner[index] = hit and (where - Vector(positions[index])).length < 0.01
    inner &= (column > box.x + 60) & (column < box.x + box.width - 330) & (row > 130) & (row < 985 - box.y)
    return inner, np.stack([row, column], axis=1)[inner]


def at_vertices(picture: np.ndarray) -> np.ndarray:
    """Levels (n, 3) of a picture at the walls' vertices in sight."""
    places = [seen(positions)[1] for name, (positions, _) in oracle().items() if name in WALLS]
    return levels(picture, np.concatenate(places))


def differences(picture: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Levels (n, 3) by which a screenshot is brighter than the oracle at these objects' vertices in sight."""
    found = []
    for name, (positions, radiance) in oracle().items():
        if name in names:
            inner, places = seen(positions)
            found.append(levels(picture, places) - srgb(radiance[inner]))
    return np.concatenate(found)


def check_picture(name: str, names: tuple[str, ...] = WALLS) -> Generator[float, None, np.ndarray]:
    """A screenshot NAME.png that shows what the oracle says, soon: software drawing on a loaded machine takes its
    time. names: of the objects that are looked at."""
    started, live = time.monotonic(), core("operators.live_preview")
    while True:
        settled = live.settled()
        yield 0.5
        picture = shoot(name)
        off = differences(picture, names)
        mean, most = float(np.abs(off).mean()), float(np.percentile(np.abs(off).max(axis=1), 99.0))
        right, seconds = settled and mean < MEAN_LEVELS and most < MOST_LEVELS, time.monotonic() - started
        if right or seconds > PATIENCE:
            break
    print(f"{name}: {len(off)} vertices, mean {off.mean():+.2f}, {mean:.2f} levels, 99 % below {most:.1f}, after "
          f"{seconds:.1f} s", flush=True)
    assert len(off) > 100, f"{name}: only {len(off)} vertices in sight"
    assert right, f"{name}: {mean:.2f} levels off in the mean, a hundredth {most:.1f} or more"
    return picture


def colour_at(picture: np.ndarray, place: tuple[float, float, float]) -> np.ndarray:
    """Mean colour (3,) of the 9 x 9 pixels around a point of the world."""
    box, matrix = region(), np.array(area().spaces.active.region_3d.perspective_matrix)
    clip = matrix @ (*place, 1.0)
    column = int(box.x + (0.5 * clip[0] / clip[3] + 0.5) * box.width)
    row = int(999 - (box.y + (0.5 * clip[1] / clip[3] + 0.5) * box.height))
    return picture[row - 4:row + 5, column - 4:column + 5].reshape(-1, 3).astype(float).mean(axis=0)


def invoke(overrides: str = "") -> None:
    with override():
        assert bpy.ops.prt.bake("INVOKE_DEFAULT", overrides=overrides) == {"RUNNING_MODAL"}, session().message


def jobs() -> list[Path]:
    """Job folders that this script's bakes have left, not those of scripts before it."""
    folder = core("operators.bake_session").jobs_folder()
    return sorted(set(folder.glob("bake-*")) - OTHERS) if folder.is_dir() else []


def left_over() -> list[str]:
    """What an unfinished bake may not leave behind: half-written files, responses."""
    return [str(path) for job in jobs() for path in (*job.glob(".*.part"), *job.glob("responses-*"))]


def open_room() -> Step:
    """The panel shows the settings of local lights."""
    print(f"drawn by {gpu.platform.backend_type_get()}", flush=True)
    with override():
        bpy.ops.wm.open_mainfile(filepath=str(SCENE), load_ui=False)
    yield 1.0
    space, settings = area().spaces.active, bpy.context.scene.prt
    space.show_region_ui, space.show_region_toolbar, space.shading.type = True, False, "SOLID"
    space.overlay.show_overlays, space.show_gizmo = False, False
    space.region_3d.view_perspective = "CAMERA"
    settings.preset, settings.lighting, settings.lamp_basis = "draft", "local", "cloud"
    OTHERS.update(jobs())
    yield 1.5
    region("UI").active_panel_category = "PRT"
    yield 1.5
    with override():
        assert bpy.ops.prt.analyze() == {"FINISHED"}
    yield 1.0
    shoot("l01_analysis")


def bake_lamps() -> Step:
    """A bake for lamps runs beside Blender and tells of its light cloud."""
    invoke("merge_response=0.02")
    yield from wait_for_bake("l02_baking")
    assert not session().failed, session().message
    yield from until(lambda: baked_names() == OBJECTS, f"the panel lists {baked_names()}")
    assert not children() and not jobs()
    yield DRAWN
    shoot("l03_baked")


def undo_and_redo() -> Step:
    """One undo takes the bake away, redo brings it back, cloud and kernels too."""
    with override():
        bpy.ops.ed.undo()
    yield from until(lambda: carrier("Floor") is None and not baked_names(), "undo leaves the bake")
    with override():
        bpy.ops.ed.redo()
    yield from until(lambda: carrier("Floor") and baked_names() == OBJECTS, "redo does not bring the bake back")
    assert {"prt_cloud", "prt_bases"} <= set(carrier("Floor").keys())


def preview() -> Step:
    """The viewport shows what the CPU says, in both shadings that a lamp is dragged in. Solid then stays: it is redrawn
    in a tenth of the time here."""
    with override():
        assert bpy.ops.prt.toggle_preview() == {"FINISHED"}
    for shading in ("MATERIAL", "SOLID"):
        area().spaces.active.shading.type = shading
        yield from check_picture(f"l04_{shading.lower()}")
    assert not session().preview_message, session().preview_message


def drag() -> Step:
    """A lamp dragged in small moves: the picture follows meanwhile, and settles on what the CPU says."""
    first = shoot("l05_before_drag")
    begin, end, moves = Vector(lamp().location), Vector((-0.6, 0.2, 0.9)), 12
    left, right = (-0.98, 0.2, 0.9), (0.98, -0.1, 1.3)
    walls = [(colour_at(first, left)[0], colour_at(first, right).mean())]
    for move in range(1, moves + 1):
        lamp().location = begin.lerp(end, move / moves)
        yield 0.15
        if move % 4 == 0:
            picture = shoot(f"l05_drag_{move}")
            walls.append((colour_at(picture, left)[0], colour_at(picture, right).mean()))
    yield from check_picture("l06_after_drag")
    lefts, rights = zip(*walls, strict=True)
    assert all(np.diff(lefts) > 0), f"the red wall does not brighten as the lamp comes near: {lefts}"
    assert all(np.diff(rights) < 0), f"the right wall does not darken as the lamp goes: {rights}"
    redness = [colour_at(first, place)[0] / colour_at(first, place)[2] for place in FACES]
    assert redness[0] > 1.1 * redness[1], f"the red wall does not bleed on the box: {redness}"


def drag_by_mouse() -> Step:
    """G and the mouse: the picture follows while the button is not yet pressed, and stays after the click."""
    for scene_object in bpy.context.scene.objects:
        scene_object.select_set(scene_object == lamp())
    bpy.context.view_layer.objects.active = lamp()
    with override():
        bpy.ops.ed.undo_push(message="before the drag")
    box, place = region(), Vector(lamp().location)
    column, row = box.x + box.width // 3, 600
    hand("mousemove", column, row)
    yield 0.5
    hand("key", "g")
    yield 0.5
    for _ in range(5):
        column += 30
        hand("mousemove", column, row)
        yield 0.3
    yield from until(lambda: lamp().location.x > place.x + 0.1, f"the lamp is not dragged: {lamp().location}")
    yield from check_picture("l06_held_by_mouse")
    hand("click", 1)
    yield 0.5
    assert lamp().location.x > place.x + 0.1
    yield from check_picture("l06_let_go")
    hand("mousemove", column, row, "key", "ctrl+z")
    yield from until(lambda: (lamp().location - place).length < 1e-4, "undo does not put the lamp back")
    yield from check_picture("l06_undone")
    lamp().select_set(False)


def hand(*arguments: object) -> None:
    """Mouse and keyboard."""
    subprocess.run(["xdotool", *map(str, arguments)], check=True, timeout=30)


def follow_lamp() -> Step:
    """Power, colour and hiding are followed, each to what the CPU says."""
    energy = lamp().data.energy
    lamp().data.energy = 0.3 * energy
    dim = yield from check_picture("l07_dim")
    lamp().data.energy, lamp().data.color = energy, (0.2, 0.4, 1.0)
    blue = yield from check_picture("l08_blue")
    assert colour_at(blue, (0.0, 0.98, 1.6))[2] > 1.5 * colour_at(blue, (0.0, 0.98, 1.6))[0]
    lamp().data.color = (1.0, 1.0, 1.0)
    lamp().hide_render = lamp().hide_viewport = True
    hidden = yield from check_picture("l09_hidden")
    assert colour_at(hidden, (-0.98, 0.2, 0.9))[0] < colour_at(dim, (-0.98, 0.2, 0.9))[0]
    lamp().hide_viewport = False  # a render decides
    yield from check_picture("l09_hidden_in_renders")
    lamp().hide_render = False
    yield from check_picture("l10_shown_again")


def play() -> Step:
    """A keyframed lamp plays back, and frame 1 gives the first picture again."""
    scene = bpy.context.scene
    lamp().keyframe_insert("location", frame=1)
    lamp().location = (0.5, -0.3, 1.5)
    lamp().keyframe_insert("location", frame=24)
    scene.frame_start, scene.frame_end = 1, 24
    scene.frame_set(1)
    first = yield from check_picture("l11_frame_1")
    scene.frame_set(24)
    last = yield from check_picture("l12_frame_24")
    assert np.abs(last - first.astype(float)).mean() > 1.0
    scene.frame_set(1)
    back = yield from check_picture("l13_frame_1_again")
    again = np.abs(at_vertices(back) - at_vertices(first)).max()
    assert again <= 1.0, f"frame 1 differs from itself by {again} levels"
    with override():
        bpy.ops.screen.animation_play()
    frames, pictures = set(), []
    for shot in range(3):
        yield 1.1
        frames.add(scene.frame_current)
        pictures.append(at_vertices(shoot(f"l14_playing_{shot}")))
    with override():
        bpy.ops.screen.animation_cancel(restore_frame=False)
    assert len(frames) > 1, "the animation does not play"
    assert max(np.abs(p - pictures[0]).mean() for p in pictures) > 1.0, "the picture stands while the lamp moves"
    scene.frame_set(1)
    back = yield from check_picture("l15_after_play")
    again = np.abs(at_vertices(back) - at_vertices(first)).max()
    assert again <= 1.0, f"frame 1 after playing differs by {again} levels"
    lamp().animation_data_clear()


def lamp_outside() -> Step:
    """A lamp outside of the cloud is named, in the panel and beside itself."""
    place = Vector(lamp().location)
    lamp().location = (1.6, 0.0, 1.4)
    area().spaces.active.overlay.show_overlays = True
    bpy.context.view_layer.objects.active = lamp()
    properties = next(a for a in window().screen.areas if a.type == "PROPERTIES").spaces.active
    yield 0.5
    properties.context = "DATA"
    yield DRAWN
    assert "Lamp" in session().preview_message and "outside" in session().preview_message, session().preview_message
    shoot("l16_outside")
    properties.context = "OBJECT"
    area().spaces.active.overlay.show_overlays = False
    lamp().location = place
    yield DRAWN
    assert not session().preview_message, session().preview_message
    yield from check_picture("l17_inside_again")


def metal_under_lamps() -> Step:
    """A ball of gold shows the lamps and what they shine on: as the CPU says for the camera's views."""
    settings, gold = bpy.context.scene.prt, bpy.data.materials["Box"]
    shader = gold.node_tree.nodes["Principled BSDF"].inputs
    shader["Base Color"].default_value, shader["Metallic"].default_value = (0.9, 0.7, 0.3, 1.0), 1.0
    shader["Roughness"].default_value = 0.5
    bpy.data.objects["Box"].hide_render = bpy.data.objects["Box"].hide_viewport = True
    with override():
        bpy.ops.mesh.primitive_uv_sphere_add(segments=48, ring_count=24, radius=0.45, location=(0.1, 0.0, 0.5))
        bpy.ops.object.shade_smooth()
    ball = bpy.context.view_layer.objects.active
    ball.name = "Ball"
    ball.data.materials.append(gold)
    ball.select_set(False)
    settings.lighting, settings.glossy_rows = "local", "9"
    lamp().location = (-0.5, -0.6, 1.5)
    invoke("merge_response=0.05, cloud_lights=27")
    yield from wait_for_bake()
    assert not session().failed, session().message
    assert "highlights of lamps" in session().message, session().message
    yield from check_picture("l25_gold", ("Ball",))
    lamp().location = (0.6, -0.6, 1.2)
    yield from check_picture("l26_gold_lamp_moved", ("Ball",))
    assert session().objects["Ball"].lamp_highlight_error >= 0.0
    bpy.data.objects.remove(ball)
    bpy.data.objects["Box"].hide_render = bpy.data.objects["Box"].hide_viewport = False
    shader["Metallic"].default_value = 0.0


def colour_attribute() -> Step:
    """The light of this moment as a colour attribute, one undo step, on all meshes that carry a bake."""
    with override():
        assert bpy.ops.prt.relight("INVOKE_DEFAULT") == {"FINISHED"}
    expected = oracle()
    for name, (_, radiance) in expected.items():
        attribute = carrier(name).color_attributes["PRT Light"]
        colours = np.empty(4 * len(radiance), np.float32)
        attribute.data.foreach_get("color", colours)
        assert (attribute.data_type, attribute.domain) == ("FLOAT_COLOR", "POINT")
        np.testing.assert_allclose(colours.reshape(-1, 4)[:, :3], radiance, rtol=1e-5, atol=1e-6)
        assert radiance.max() > 0.01
    assert carrier("Box") != bpy.data.objects["Box"].data  # one of them is a hidden receiver
    yield 1.0
    assert not any(line.stale for line in session().objects), "the attribute makes bakes stale"
    with override():
        bpy.ops.ed.undo()
    yield from until(lambda: carrier("Floor") and "PRT Light" not in carrier("Floor").color_attributes,
                     "undo leaves the attribute")
    yield from check_picture("l24_attribute_undone")


def cancel_in_lamps_stage() -> Step:
    """Cancel answers within a second, leaves nothing half-written, and the next bake goes on from there."""
    before, bpy.context.scene.prt.lighting = carrier("Floor")["prt_header"], "local"
    invoke(LONG)
    yield from until(lambda: session().stage == LAMPS_STAGE or not session().running, "no lamps' stage", 120.0)
    yield 1.0
    assert session().running and session().stage == LAMPS_STAGE, (session().stage, session().message)
    shoot("l18_lamps_stage")
    started = time.monotonic()
    assert bpy.ops.prt.cancel() == {"FINISHED"}
    while session().running:
        assert time.monotonic() - started < 1.0, "cancel does not answer"
        yield 0.02
    assert not children() and not session().failed and "cancel" in session().message.lower()
    assert carrier("Floor")["prt_header"] == before
    assert len(jobs()) == 1 and not left_over(), left_over()
    finished = {p.name: p.stat().st_mtime_ns for p in jobs()[0].glob("*.npz")}
    assert {"gather.npz", "direct.npz", "interreflection.npz"} <= set(finished), finished
    yield from check_picture("l19_cancelled")


def resume_after_kill() -> Step:
    """The process dies in the lamps' stage: nothing is left over, and the bake resumes after its finished stages."""
    finished = {p.name: p.stat().st_mtime_ns for p in jobs()[0].glob("*.npz")}
    invoke(LONG)
    yield from until(lambda: session().stage == LAMPS_STAGE or not session().running, "no lamps' stage", 60.0)
    yield 1.0
    assert session().running, session().message
    hand("mousemove", 600, 985)  # an error's bubble opens there, out of the way, and stands until a file is loaded
    os.kill(children()[0], signal.SIGKILL)
    yield from until(lambda: not session().running, "the bake still runs without its process")
    assert session().failed and "SIGKILL" in session().message, session().message
    assert len(jobs()) == 1 and not left_over(), left_over()
    assert {p.name: p.stat().st_mtime_ns for p in jobs()[0].glob("*.npz")} == finished, "stages were baked again"
    invoke(LONG)
    yield from until(lambda: session().stage == LAMPS_STAGE or not session().running, "no lamps' stage", 60.0)
    while session().running and session().stage == LAMPS_STAGE:
        yield 0.05
    assert {name: stamp for name, stamp in {p.name: p.stat().st_mtime_ns for p in jobs()[0].glob("*.npz")}.items()
            if name in finished} == finished, "stages were baked again"
    yield from wait_for_bake()
    assert not session().failed, session().message
    assert not jobs() and not children()
    yield from check_picture("l20_resumed")


def both_kinds() -> Step:
    """Sky and lamps in one bake: each is followed."""
    bpy.context.scene.prt.lighting = "both"
    background = bpy.context.scene.world.node_tree.nodes["Background"].inputs
    background["Color"].default_value, background["Strength"].default_value = (0.3, 0.5, 1.0, 1.0), 0.6
    invoke("merge_response=0.02")
    yield from wait_for_bake()
    assert not session().failed, session().message
    with_sky = yield from check_picture("l21_both")
    background["Strength"].default_value = 0.05
    dark_sky = yield from check_picture("l22_both_dark_sky")
    assert dark_sky.mean() < with_sky.mean()
    lamp().location = (0.6, 0.1, 0.7)
    yield from check_picture("l23_both_lamp_moved")


def lit_surfaces() -> Step:
    """A bake by the surfaces that lamps shine on: right in the open, at a wall and out of the room; a spot, too."""
    settings = bpy.context.scene.prt
    settings.lighting, settings.lamp_basis = "local", "surfaces"
    lamp().location = (0.0, 0.0, 1.2)
    yield 1.0
    shoot("l30_settings")
    invoke("surface_patches=512, surface_columns=96, cloud_lights=27")
    yield from wait_for_bake()
    assert not session().failed, session().message
    yield from check_picture("l31_surfaces")
    assert "lit surfaces" in session().cloud, session().cloud
    for name, place in (("l32_at_wall", (-0.85, 0.0, 0.5)), ("l33_outside", (1.6, 0.0, 1.4))):
        lamp().location = place
        yield from check_picture(name)
        assert not session().preview_message, session().preview_message
    lamp().data.type = "SPOT"
    lamp().location, lamp().rotation_euler = (0.0, 0.0, 1.2), (0.9, 0.0, 0.4)
    yield from check_picture("l34_spot")
    lamp().data.type = "POINT"
    settings.lamp_basis = "cloud"


STEPS = (open_room, bake_lamps, undo_and_redo, preview, drag, drag_by_mouse, follow_lamp, play, lamp_outside,
         both_kinds, colour_attribute, cancel_in_lamps_stage, resume_after_kill, metal_under_lamps,
         lit_surfaces)

start(STEPS, "lamps")
