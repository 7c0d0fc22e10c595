# SPDX-License-Identifier: GPL-3.0-or-later
"""What the viewport shows in every way of looking at it: run by run.py, one step per timer call (driving.py).

All shadings and both engines, before and after the light changes, in perspective and orthographic views, through the
camera, in quad and local view, in edit and paint modes; always against the CPU (comparing.py). With Vulkan, whose
software driver takes its time, the steps of VULKAN alone.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import bpy
import gpu
import numpy as np
from mathutils import Quaternion

sys.path.insert(0, str(Path(__file__).parent))  # Blender runs this file by its path

from comparing import check_view, core
from driving import (
    DRAWN,
    MODULE,
    OUTPUT,
    SCENE,
    Step,
    area,
    baked_names,
    children,
    override,
    region,
    select,
    session,
    shoot,
    start,
    until,
    view,
    wait_for_bake,
)

BAKED = {"Floor", "Wall", "Ball"}
DIFFUSE = {"Floor", "Wall"}
QUICK = ("spacing=0, directions=1024, gather_directions=256, error_receivers=0, surface_patches=256, "
         "surface_columns=48, cloud_lights=27")


def space() -> bpy.types.SpaceView3D:
    return area().spaces.active


def node(kind: str) -> bpy.types.Node:
    return next(n for n in bpy.context.scene.world.node_tree.nodes if n.type == kind)


def look(perspective: str = "PERSP") -> None:
    """From above and the front right, with all three objects in sight."""
    seen = space().region_3d
    seen.view_perspective = perspective
    seen.view_rotation = Quaternion((0.82, 0.42, 0.17, 0.33)).normalized()
    seen.view_distance, seen.view_location = 7.0, (0.0, 0.0, 0.5)


def open_and_bake() -> Step:
    """The scene is baked for sky, Sun and lamps; the preview is on."""
    print(f"drawn by {gpu.platform.backend_type_get()}", flush=True)
    with override():
        bpy.ops.wm.open_mainfile(filepath=str(SCENE), load_ui=False)
    yield 1.0
    space().show_region_ui, space().show_region_toolbar, space().shading.type = True, False, "SOLID"
    space().overlay.show_overlays, space().show_gizmo = False, False
    look()
    yield 1.0
    region("UI").active_panel_category = "PRT"
    settings = bpy.context.scene.prt
    settings.preset, settings.lighting, settings.lamp_basis, settings.glossy_rows = "draft", "both", "surfaces", "9"
    settings.glossy_albedo = 0.5
    select(*BAKED)
    with override():
        assert bpy.ops.prt.bake("INVOKE_DEFAULT", overrides=QUICK) == {"RUNNING_MODAL"}
    yield from wait_for_bake()
    assert not session().failed, session().message
    yield from until(lambda: baked_names() == BAKED, f"the panel lists {baked_names()}")
    assert not any(line.stale for line in session().objects), [line.stale for line in session().objects]
    select()
    yield 0.5
    with override():
        assert bpy.ops.prt.toggle_preview() == {"FINISHED"}
    yield from check_view("v01_solid", BAKED)


def steady() -> None:
    """What every step starts from, whatever became of the one before."""
    if bpy.context.mode != "OBJECT":
        with override():
            bpy.ops.object.mode_set(mode="OBJECT")
    for scene_object in bpy.context.scene.objects:
        scene_object.hide_set(False)
    select()
    space().shading.type, space().overlay.show_overlays = "SOLID", False
    if space().local_view:
        with override():
            bpy.ops.view3d.localview(frame_selected=False)
    look()
    if not session().preview:
        with override():
            bpy.ops.prt.toggle_preview()


def shadings() -> Step:
    """Material preview, EEVEE and Cycles: through the view transform that Blender uses there."""
    scene, shading = bpy.context.scene, space().shading
    shading.type = "MATERIAL"
    yield from check_view("v02_material", BAKED)
    shading.type, scene.render.engine = "RENDERED", "BLENDER_EEVEE"
    # Without overlays neither engine leaves a depth: what stands in front must not be covered for that.
    assert is_blue((yield from check_view("v03_eevee", BAKED))), "the post in front is covered"
    scene.view_settings.look, scene.view_settings.exposure, scene.view_settings.gamma = "AgX - Punchy", 0.6, 1.1
    yield from check_view("v04_eevee_look", BAKED)
    scene.view_settings.look, scene.view_settings.exposure, scene.view_settings.gamma = "None", 0.0, 1.0
    scene.view_settings.view_transform = "Standard"
    scene.render.engine = "CYCLES"
    scene.cycles.preview_samples = 4
    yield from check_view("v05_cycles", BAKED)
    yield from until(lambda: is_blue(shoot("v05_cycles_post")), "the post in front is covered", 10.0)
    show_outlines_alone()
    yield from check_view("v06_cycles_overlays", BAKED)
    shading.type, scene.render.engine = "SOLID", "BLENDER_EEVEE"
    scene.view_settings.view_transform = "AgX"
    yield from check_view("v07_solid_overlays", BAKED)


def show_outlines_alone() -> None:
    """Overlays without what stands in front of surfaces."""
    overlay = space().overlay
    overlay.show_overlays = True
    overlay.show_floor = overlay.show_axis_x = overlay.show_axis_y = overlay.show_cursor = False
    overlay.show_object_origins = overlay.show_extras = overlay.show_text = False


def see_through() -> Step:
    """Wires and x-ray stay Blender's own: the preview changes nothing there."""
    steady()
    shading = space().shading
    for name, kind, xray in (("v08_wireframe", "WIREFRAME", False), ("v09_xray", "SOLID", True)):
        shading.type, shading.show_xray = kind, xray
        yield from unchanged_by_preview(name)
        shading.show_xray = False
    shading.type = "SOLID"


def unchanged_by_preview(name: str) -> Step:
    """The picture is the same with the preview off; it is on afterwards."""
    yield 1.0
    on = view(shoot(name))
    with override():
        bpy.ops.prt.toggle_preview()
    yield 1.0
    off = view(shoot(f"{name}_off"))
    with override():
        bpy.ops.prt.toggle_preview()
    yield 0.5
    assert np.abs(on - off).mean() < 0.1, f"{name}: the preview changes it by {np.abs(on - off).mean()} levels"


def light_moves() -> Step:
    """Sun, sky, strength, lamp: before and after, against the CPU."""
    steady()
    sun, lamp, mapping = bpy.data.objects["Sun"], bpy.data.objects["Lamp"], node("MAPPING").inputs["Rotation"]
    strength = bpy.context.scene.world.node_tree.nodes["Background"].inputs["Strength"]
    before = yield from check_view("v10_before", BAKED)

    def changed(picture: np.ndarray, what: str) -> np.ndarray:
        assert np.abs(view(picture) - view(before)).mean() > 1.0, f"{what} changes nothing"
        return picture

    sun.rotation_euler = (1.1, 0.0, -1.0)
    changed((yield from check_view("v11_sun", BAKED)), "turning the Sun")
    mapping.default_value[2] = 2.5
    changed((yield from check_view("v12_sky", BAKED)), "turning the sky")
    strength.default_value = 0.3
    changed((yield from check_view("v13_strength", BAKED)), "a weaker World")
    lamp.data.energy, lamp.data.color = 40.0, (0.3, 0.6, 1.0)
    changed((yield from check_view("v14_lamp", BAKED)), "the lamp's power and colour")
    lamp.location = (1.2, 0.9, 1.0)
    changed((yield from check_view("v15_lamp_moved", BAKED)), "moving the lamp")
    sun.rotation_euler, lamp.location, lamp.data.energy, lamp.data.color = (0.61, 0.0, 0.52), (-0.4, -0.6, 1.3), 15.0, (
        1.0, 1.0, 1.0)
    mapping.default_value[2], strength.default_value = 0.0, 1.0
    yield from check_view("v16_back", BAKED)


def during_a_bake() -> Step:
    """The previous bake is shown while another one runs, and after a cancel."""
    steady()
    with override():
        assert bpy.ops.prt.bake("INVOKE_DEFAULT", overrides="directions=65536, spacing=0.02") == {"RUNNING_MODAL"}
    yield from until(lambda: session().fraction > 0.01 or not session().running, "no progress", 60.0)
    assert session().running, session().message
    yield from check_view("v17_baking", BAKED)
    assert session().running, session().message
    bpy.data.objects["Sun"].rotation_euler = (1.0, 0.0, 2.0)
    yield from check_view("v18_baking_sun", BAKED)
    started = time.monotonic()
    assert bpy.ops.prt.cancel() == {"FINISHED"}
    while session().running:
        assert time.monotonic() - started < 3.0, "cancel does not answer"
        yield 0.05
    assert not children()
    yield from check_view("v19_cancelled", BAKED)


def kinds_of_view() -> Step:
    """Orthographic, through the camera (perspective, shifted, orthographic, with its frame darkened), quad view."""
    steady()
    look("ORTHO")
    yield from check_view("v20_orthographic", BAKED)
    camera = bpy.context.scene.camera.data
    space().region_3d.view_perspective = "CAMERA"
    space().region_3d.view_camera_zoom = 0.0
    camera.show_passepartout = True
    yield 1.0
    yield from check_view("v21_camera", BAKED, clear=inside_frame())
    camera.shift_x, camera.shift_y, camera.lens = 0.08, -0.05, 40.0
    yield 1.0
    yield from check_view("v22_camera_shifted", BAKED, clear=inside_frame())
    camera.shift_x, camera.shift_y = 0.0, 0.0
    camera.type, camera.ortho_scale = "ORTHO", 5.5
    yield 1.0
    yield from check_view("v23_camera_orthographic", BAKED, clear=inside_frame())
    camera.type, camera.lens = "PERSP", 50.0
    bpy.context.scene.render.use_border = True
    for name, value in (("min_x", 0.25), ("max_x", 0.75), ("min_y", 0.25), ("max_y", 0.75)):
        setattr(bpy.context.scene.render, f"border_{name}", value)
    space().shading.type = "RENDERED"
    yield 1.0
    left, right, top, bottom = inside_frame()
    box = region()
    across, up = (box.width - left - right) // 4, (box.height - top - bottom) // 4
    yield from check_view("v24_camera_border", BAKED, least=50,
                          clear=(left + across, right + across, top + up, bottom + up))
    bpy.context.scene.render.use_border = False
    space().shading.type = "SOLID"
    look()
    with override():
        bpy.ops.screen.region_quadview()
    yield DRAWN
    regions = sorted((r for r in area().regions if r.type == "WINDOW"), key=lambda r: (r.x, r.y))
    assert len(regions) == 4 and len(space().region_quadviews) == 4
    # In the order of Blender's own: bottom left, top left, bottom right, top right.
    yield from check_view("v25_quad_perspective", BAKED, least=40, at=(regions[3], space().region_quadviews[3]),
                          clear=(20, 330, 60, 20))
    yield from check_view("v26_quad_top", {"Floor"}, least=40, at=(regions[1], space().region_quadviews[1]),
                          clear=(20, 20, 60, 20))
    with override():
        bpy.ops.screen.region_quadview()
    yield 1.0
    look()
    yield from check_view("v27_single_again", BAKED)


def inside_frame() -> tuple[int, int, int, int]:
    """Pixels at the left, right, top and bottom of the viewport that lie outside the camera's frame."""
    camera, box = bpy.context.scene.camera, region()
    corners = np.array([camera.matrix_world @ corner for corner in camera.data.view_frame(scene=bpy.context.scene)])
    clip = np.c_[corners, np.ones(4)] @ np.array(space().region_3d.perspective_matrix).T
    place = (0.5 * clip[:, :2] / clip[:, 3:] + 0.5) * (box.width, box.height)
    (left, bottom), (right, top) = place.min(axis=0), place.max(axis=0)
    return tuple(int(v) + 4 for v in (left, max(box.width - right, 330), box.height - top, bottom))


def local_view() -> Step:
    """Local view shows what it holds, lit; leaving it brings all back. Hidden objects and collections stay hidden."""
    steady()
    select("Wall")
    with override():
        bpy.ops.view3d.localview(frame_selected=False)
    yield from check_view("v28_local", {"Wall"})
    look()
    picture = view(shoot("v28_local_shot"))
    with override():
        bpy.ops.view3d.localview(frame_selected=False)
    select()
    yield from check_view("v29_global", BAKED)
    assert np.abs(view(shoot("v29_global_shot")) - picture).mean() > 2.0
    ball = bpy.data.objects["Ball"]
    ball.hide_set(True)
    yield from check_view("v30_hidden", DIFFUSE)
    yield from not_there(ball, "v30_hidden_ball")
    ball.hide_set(False)
    held = bpy.data.collections.new("Held")
    bpy.context.scene.collection.children.link(held)
    held.objects.link(ball)
    bpy.context.scene.collection.objects.unlink(ball)
    bpy.context.view_layer.layer_collection.children["Held"].hide_viewport = True
    yield from check_view("v31_hidden_collection", DIFFUSE)
    yield from not_there(ball, "v31_hidden_collection_ball")
    bpy.context.view_layer.layer_collection.children["Held"].hide_viewport = False
    yield from check_view("v32_shown_again", BAKED)
    bpy.context.view_layer.layer_collection.children["Held"].exclude = True
    yield DRAWN
    assert session().objects["Floor"].stale, "an object that no longer renders still counts as a caster"
    bpy.context.view_layer.layer_collection.children["Held"].exclude = False
    yield from check_view("v33_included_again", BAKED)


def not_there(hidden: bpy.types.Object, name: str) -> Step:
    """Where a hidden object would be, its golden colour is not."""
    yield 0.2
    live = core("operators.live_preview")
    with bpy.context.temp_override(window=bpy.context.window_manager.windows[0], area=area(), region=region()):
        drawn = {item.key[1] for item in live.draw_list()}
    shoot(name)
    assert hidden.name not in drawn, drawn


def modes() -> Step:
    """Edited and painted objects are Blender's own to draw; the others stay lit, and cover and are covered rightly."""
    steady()
    for mode in ("EDIT", "SCULPT", "WEIGHT_PAINT", "VERTEX_PAINT", "TEXTURE_PAINT"):
        select("Ball")
        with override():
            bpy.ops.object.mode_set(mode=mode)
        yield from check_view(f"v34_{mode.lower()}", DIFFUSE)
        yield from not_there(bpy.data.objects["Ball"], f"v34_{mode.lower()}_ball")
        with override():
            bpy.ops.object.mode_set(mode="OBJECT")
    select()
    yield from check_view("v35_object_mode", BAKED)


def selection_is_seen() -> Step:
    """The outline of a selected object stands around it, and what is in front hides what is behind."""
    steady()
    show_outlines_alone()
    yield 1.0
    before = view(shoot("v36_not_selected"))
    select("Ball", "Wall")
    yield 1.5
    after = view(shoot("v37_selected"))
    orange = (after[..., 0] > 200) & (after[..., 1] < 190) & (after[..., 2] < 100) & (
        np.abs(after - before).max(axis=2) > 40)
    assert orange.sum() > 300, f"only {orange.sum()} pixels of outlines"
    select()
    yield from check_view("v38_deselected", BAKED)
    space().overlay.show_overlays = False


def is_blue(picture: np.ndarray) -> bool:
    """Whether the post, which is not baked and stands in front of the grey floor, is seen."""
    places = middle_of_post()
    colour = picture[places[:, 0], places[:, 1]].astype(float).mean(axis=0)  # single pixels of Cycles are noise
    return bool(colour[2] - colour[0] > 40.0)


def middle_of_post() -> np.ndarray:
    """Rows and columns (n, 2) of pixels on the post's upright edge that faces the viewer."""
    box, matrix = region(), np.array(space().region_3d.perspective_matrix)
    heights, across = np.meshgrid(np.linspace(0.1, 0.65, 40), np.linspace(0.05, 0.25, 12))
    corner = np.stack([0.35 + across, np.full_like(across, -1.05), heights], axis=-1).reshape(-1, 3)
    clip = np.c_[corner, np.ones(len(corner))] @ matrix.T
    place = (0.5 * clip[:, :2] / clip[:, 3:] + 0.5) * (box.width, box.height)
    return np.stack([1000 - (box.y + place[:, 1]), box.x + place[:, 0]], axis=1).astype(int)


def viewport_border() -> Step:
    """A render region of the viewport."""
    steady()
    space().shading.type = "RENDERED"
    space().use_render_border = True
    for name, value in (("min_x", 0.2), ("max_x", 0.8), ("min_y", 0.2), ("max_y", 0.8)):
        setattr(space(), f"render_border_{name}", value)
    yield from check_view("v39_render_region", BAKED, clear=(330, 480, 250, 250))
    space().use_render_border = False
    space().shading.type = "SOLID"


def reload() -> Step:
    """Saved and loaded with the preview on: the same picture."""
    steady()
    path = OUTPUT / "views_saved.blend"
    with override():
        bpy.ops.wm.save_as_mainfile(filepath=str(path))
        bpy.ops.wm.open_mainfile(filepath=str(path), load_ui=True)
    yield from until(lambda: baked_names() == BAKED, f"the panel lists {baked_names()}")
    assert session().preview
    yield from check_view("v40_reloaded", BAKED)


def disable() -> Step:
    """Disabled: Blender's own picture, as if the extension had never been there; enabled again: off, and off stays."""
    with override():
        bpy.ops.prt.toggle_preview()
    yield DRAWN
    shot = shoot("v41_off")
    plain = view(shot)
    with override():
        bpy.ops.prt.toggle_preview()
    lit, places = (yield from check_view("v42_on", BAKED)), middle_of_post()
    off = np.abs(lit[places[:, 0], places[:, 1]].astype(float) - shot[places[:, 0], places[:, 1]])
    assert off.mean() < 1.0, f"the post in front is {off.mean():.1f} levels off"
    live = core("operators.live_preview")
    timers = (live._catch_up, live._note_viewport, live._refine)
    bpy.ops.preferences.addon_disable(module=MODULE)
    yield DRAWN
    assert np.abs(view(shoot("v43_disabled")) - plain).mean() < 0.3, "something still draws"
    assert not any(bpy.app.timers.is_registered(timer) for timer in timers)
    handlers = bpy.app.handlers
    left = [f for name in dir(handlers) if isinstance(getattr(handlers, name), list)
            for f in getattr(handlers, name) if getattr(f, "__module__", "").startswith(MODULE)]
    assert not left, left
    for _ in range(3):  # orbiting calls draw handlers
        space().region_3d.view_rotation = space().region_3d.view_rotation @ Quaternion((0.0, 0.0, 1.0), 0.1)
        yield 0.3
    look()
    yield DRAWN
    assert np.abs(view(shoot("v44_disabled_orbited")) - plain).mean() < 0.3, "something still draws"


ALL = (open_and_bake, shadings, see_through, light_moves, during_a_bake, kinds_of_view, local_view, modes,
       selection_is_seen, viewport_border, reload, disable)
VULKAN = (open_and_bake, shadings, light_moves, reload, disable)


def chosen() -> tuple:
    """The steps of this driver, or those that PRT_STEPS names after the first one."""
    names = os.environ.get("PRT_STEPS", "").split()
    if names:
        return (open_and_bake, *(step for step in ALL if step.__name__ in names))
    return VULKAN if gpu.platform.backend_type_get() == "VULKAN" else ALL


if __name__ == "__main__":
    start(chosen(), "views")
