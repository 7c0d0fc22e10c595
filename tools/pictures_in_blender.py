# SPDX-License-Identifier: GPL-3.0-or-later
"""The pictures of the documentation, taken in a real Blender with its interface; started by tools/pictures.py.

An artist's session: open the demo's scene, look at the panels, bake, switch the preview on, turn the sky, store light
presets, look at the errors, compare with Cycles, drag a lamp. Whole screens land in the output folder, what the
documentation shows in its folder docs.
"""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "interface"))
from driving import (  # its path is known only now
    DRAWN,
    MODULE,
    OUTPUT,
    SCENE,
    Step,
    area,
    invoke_bake,
    override,
    region,
    select,
    session,
    shoot,
    start,
    until,
    wait_for_bake,
)

FRAMES, FRAME_TIME = 24, 12  # of the animation; hundredths of a second
SHOWN = OUTPUT / "docs"
HEIGHT = 1000  # of the screen


def picture(name: str, *options: str, source: str = "") -> None:
    """A screenshot, cropped and shrunk by ImageMagick's options, as docs/NAME.png."""
    if not source:
        shoot(name)
    SHOWN.mkdir(exist_ok=True)
    subprocess.run(["convert", str(OUTPUT / f"{source or name}.png"), *options, "-strip", str(SHOWN / f"{name}.png")],
                   check=True, timeout=60)


def crop(kind: str = "UI", top: int = 0, height: int = 0) -> tuple[str, ...]:
    """ImageMagick's options for a region of the viewport, or for a part of its height."""
    box = region(kind)
    return "-crop", f"{box.width}x{height or box.height}+{box.x}+{HEIGHT - box.y - box.height + top}", "+repage"


def only(*wanted: str) -> None:
    """Only these panels in the sidebar, in order; none named: all. Scripts can't fold panels."""
    panels = [cls for cls in sys.modules[MODULE].CLASSES if issubclass(cls, bpy.types.Panel)]
    for cls in reversed(panels):
        if cls.is_registered:
            bpy.utils.unregister_class(cls)
    for cls in panels:
        if not wanted or cls.__name__ in wanted:
            bpy.utils.register_class(cls)


def set_up() -> Step:
    """The scene in one large viewport, with the sidebar's tab open, seen from its camera."""
    with override():
        bpy.ops.wm.open_mainfile(filepath=str(SCENE), load_ui=False)
    yield DRAWN
    space = area().spaces.active
    space.show_region_ui, space.show_gizmo, space.overlay.show_floor = True, False, False
    space.overlay.show_axis_x = space.overlay.show_axis_y = space.overlay.show_cursor = False
    space.overlay.show_text = False
    space.region_3d.view_perspective = "CAMERA"
    bpy.context.scene.camera.data.passepartout_alpha = 1.0
    with override():
        bpy.ops.view3d.view_center_camera()
    yield 1.0
    sys.modules[MODULE].PRT_PT_last_bake.bl_options = set()  # open from the first time that it is drawn
    only()
    yield 1.0
    region("UI").active_panel_category = "PRT"
    select()
    yield 1.0


def before_the_bake() -> Step:
    """What an artist sees first, and what Analyze says."""
    shoot("before")
    with override():
        bpy.ops.prt.analyze()
    yield DRAWN
    picture("analysis", *crop(height=620))


def bake() -> Step:
    """Progress in the panel and in the status bar, then the results."""
    bpy.context.scene.prt.preset = "standard"
    assert invoke_bake() == {"RUNNING_MODAL"}
    yield from wait_for_bake("baking")
    picture("progress", *crop(height=400), source="baking")
    assert not session().failed, session().message
    yield from until(lambda: session().objects, "nothing is listed")
    with override():
        bpy.ops.prt.toggle_preview()
    yield 2.0 * DRAWN
    picture("panel", "-resize", "1200x")


def errors() -> Step:
    """What the preview can show in place of light."""
    names = []
    for mode in ("relit", "clusters", "error"):
        bpy.context.scene.prt.display = mode
        yield DRAWN
        shoot(mode)
        names.append(str(OUTPUT / f"{mode}.png"))
    bpy.context.scene.prt.display = "relit"
    box = region("WINDOW")
    view = f"{box.width - 560}x{box.height - 160}+{box.x + 60}+{HEIGHT - box.y - box.height + 90}"
    SHOWN.mkdir(exist_ok=True)
    subprocess.run(["convert", *names, "-crop", view, "+repage", "-resize", "420x", "+append", "-strip",
                    str(SHOWN / "display.png")], check=True, timeout=60)


def presets() -> Step:
    """Three light set-ups, each a click."""
    mapping = next(n for n in bpy.context.scene.world.node_tree.nodes if n.type == "MAPPING")
    for name, turn in (("Morning", 0.0), ("Noon", 2.0), ("Evening", 4.2)):
        mapping.inputs["Rotation"].default_value[2] = turn
        yield DRAWN
        with override():
            assert bpy.ops.prt.light_preset_add(name=name) == {"FINISHED"}
        yield 1.0
    only("PRT_PT_light_presets", "PRT_PT_lights", "PRT_PT_light_animation")
    yield DRAWN
    picture("presets", *crop(height=600))
    mapping.inputs["Rotation"].default_value[2] = 0.0
    only("PRT_PT_results", "PRT_PT_last_bake")
    yield DRAWN
    picture("results", *crop(height=700))
    only()
    yield DRAWN


def drag_a_lamp() -> Step:
    """A lamp around the scene, with the light that it bounces."""
    scene = bpy.context.scene
    scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0.12
    lamp = bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "POINT"))
    lamp.data.energy, lamp.data.color, lamp.data.shadow_soft_size = 90.0, (1.0, 0.82, 0.6), 0.15
    scene.collection.objects.link(lamp)
    lamp.location = (0.9, -1.9, 1.5)
    scene.prt.preset, scene.prt.lighting = "draft", "both"
    assert invoke_bake() == {"RUNNING_MODAL"}
    yield from wait_for_bake()
    assert not session().failed, session().message
    box = region("WINDOW")
    view = f"{box.width - 560}x{box.height - 160}+{box.x + 60}+{HEIGHT - box.y - box.height + 90}"
    area().spaces.active.overlay.show_extras = False
    frames = []
    for number in range(FRAMES):
        angle = 2.0 * math.pi * number / FRAMES
        lamp.location = (1.2 * math.cos(angle) + 0.5, 0.9 * math.sin(angle) - 1.1, 1.6 + 0.25 * math.sin(2.0 * angle))
        yield 1.2
        shoot(f"lamp_{number:02}")
        frames.append(str(OUTPUT / f"lamp_{number:02}.png"))
    subprocess.run(["convert", "-delay", str(FRAME_TIME), *frames, "-crop", view, "+repage", "-resize", "480x",
                    "-colors", "160", "-layers", "Optimize", "-loop", "0", str(SHOWN / "lamp.gif")], check=True,
                   timeout=120)


start((set_up, before_the_bake, bake, errors, presets, drag_a_lamp), "pictures")
