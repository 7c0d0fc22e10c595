# SPDX-License-Identifier: GPL-3.0-or-later
"""Receivers at texels in a Blender with its interface: the floor and the wall of a scene, whose few faces get an atlas,
are baked, shown and turned into images. Run by run.py; its pictures are to be looked at."""

from __future__ import annotations

import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))  # Blender runs this file by its path

from driving import (
    DRAWN,
    SCENE,
    Step,
    area,
    baked_names,
    carrier,
    invoke_bake,
    override,
    pixel,
    region,
    session,
    shoot,
    start,
    until,
    wait_for_bake,
)

ALL = {"Ball", "Floor", "Statue", "Wall"}
AT_TEXELS = {"Floor", "Wall"}
TILE = 0.5  # metres, of the checker on the floor


def bake_at_texels() -> Step:
    """Automatic receivers: texels on coarse objects alone."""
    with override():
        bpy.ops.wm.open_mainfile(filepath=str(SCENE), load_ui=False)
    bpy.data.objects.remove(bpy.data.objects["Lamp"])  # a bake for the World warns of it, and warnings are not wanted
    yield 1.0
    space = area().spaces.active
    space.show_region_ui, space.shading.type = True, "SOLID"
    space.region_3d.view_perspective = "PERSP"
    space.region_3d.view_rotation = (0.82, 0.49, 0.15, 0.26)
    space.region_3d.view_distance, space.region_3d.view_location = 7.5, (0.2, 0.0, 0.6)
    bpy.context.scene.view_settings.view_transform = "Standard"
    yield 1.5
    region("UI").active_panel_category = "PRT"
    bpy.context.scene.cursor.location = (0.0, 0.0, -5.0)  # out of the pictures
    settings = bpy.context.scene.prt
    settings.preset, settings.order, settings.receivers = "draft", 3, "auto"
    assert not bpy.ops.prt.light_images.poll()
    with override():
        assert bpy.ops.prt.analyze() == {"FINISHED"}
    assert "texels in 1 chart of an atlas" in session().analysis, session().analysis
    yield DRAWN
    shoot("01_analyzed")
    assert invoke_bake() == {"RUNNING_MODAL"}
    yield from wait_for_bake()
    assert not session().failed, session().message
    yield from until(lambda: baked_names() == ALL, f"the panel lists {baked_names()}")
    found = {name for name in ALL if "prt_texel" in carrier(name).attributes}
    assert found == AT_TEXELS, found
    yield 1.0


def show() -> Step:
    """The floor's tiles are as sharp as its image, and redder at the red wall's foot than in front."""
    with override():
        assert bpy.ops.prt.toggle_preview() == {"FINISHED"}
    yield 2.0 * DRAWN
    picture = shoot("02_texels")
    assert not session().viewport_message, session().viewport_message
    places = [((-2.0 + TILE * (column + 0.5), -2.0 + TILE * (row + 0.5), 0.0), (row + column) % 2 == 0)
              for row in range(2) for column in range(1, 7)]
    light = [pixel(picture, place).mean() for place, is_light in places if is_light]
    dark = [pixel(picture, place).mean() for place, is_light in places if not is_light]
    assert min(light) > 1.5 * max(dark), (light, dark)
    # Both tiles are of one kind; the red wall colours the one at its foot.
    front, foot = pixel(picture, (-0.75, -1.75, 0.0)), pixel(picture, (1.75, 1.75, 0.0))
    assert foot[0] / foot[2] > 1.03 * front[0] / front[2], (foot, front)
    bpy.context.scene.prt.display = "clusters"
    yield DRAWN
    shoot("03_clusters")
    bpy.context.scene.prt.display = "relit"
    yield DRAWN


def images() -> Step:
    """Apply to Images leaves one for each atlas, and a UV map; nothing becomes stale by it."""
    with override():
        assert bpy.ops.prt.light_images() == {"FINISHED"}
    yield DRAWN
    assert {image.name for image in bpy.data.images if image.name.startswith("PRT ")} == {"PRT Floor", "PRT Wall"}
    floor = bpy.data.objects["Floor"].data
    assert "PRT Atlas" in floor.uv_layers and floor.uv_layers.active.name != "PRT Atlas"
    yield 2.0 * DRAWN
    assert not any(line.stale for line in session().objects), [line.stale for line in session().objects]
    shoot("04_images_made")
    with override():
        bpy.ops.prt.toggle_preview()
    yield DRAWN


start((bake_at_texels, show, images), "texels")
