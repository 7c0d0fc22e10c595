# SPDX-License-Identifier: GPL-3.0-or-later
"""A lamp that shines through a ball of wax, in a Blender with its interface: the light follows it. Run by run.py; its
pictures are to be looked at, its times are in bodies_times.json."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))  # Blender runs this file by its path

from driving import (
    DRAWN,
    MODULE,
    OUTPUT,
    SCENE,
    Step,
    area,
    baked_names,
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

# On the ball, towards the camera: its middle, and its upper left.
MIDDLE, ASIDE = (0.0, -0.6, 0.7), (-0.3, -0.45, 0.96)
TIMES: dict[str, object] = {}


def settings() -> bpy.types.PropertyGroup:
    return bpy.context.scene.prt


def live() -> object:
    """What takes the lamp's light through the ball."""
    found = sys.modules[f"{MODULE}.operators.live_preview"]._lives
    return next(iter(found.values())).lamps.known_scattering("Ball")


def bake_for_lamps() -> Step:
    """The number of links is in the panel, and the bake stores them."""
    with override():
        bpy.ops.wm.open_mainfile(filepath=str(SCENE), load_ui=False)
    yield 1.0
    space = area().spaces.active
    space.show_region_ui, space.shading.type, space.overlay.show_overlays = True, "SOLID", False
    space.region_3d.view_perspective = "CAMERA"
    yield 1.5
    region("UI").active_panel_category = "PRT"
    settings().preset, settings().lighting, settings().subsurface_links = "draft", "local", 64
    settings().surface_columns, settings().surface_patches, settings().cloud_lights = 32, 256, 27
    yield 0.5
    assert invoke_bake() == {"RUNNING_MODAL"}
    yield from wait_for_bake()
    assert not session().failed, session().message
    yield from until(lambda: baked_names() == {"Ball", "Floor"}, f"the panel lists {baked_names()}")
    with override():
        assert bpy.ops.prt.toggle_preview() == {"FINISHED"}
    yield 2.0 * DRAWN
    TIMES["receivers"], TIMES["links"] = live().links.texels.shape[:2]


def it_shines_through() -> Step:
    """With the lamp behind it the side in sight is lit, redder than the lamp, and smoothly so."""
    yield 0.1
    picture = shoot("01_behind")
    middle = pixel(picture, MIDDLE)
    assert middle[0] > 0.05 and middle[0] > 1.5 * middle[2], middle
    across = np.array([pixel(picture, (x, -np.sqrt(0.36 - x * x), 0.7)) for x in np.linspace(-0.3, 0.3, 61)])
    TIMES["largest_step"] = round(float(np.abs(np.diff(across, axis=0)).max()), 4)
    assert TIMES["largest_step"] < 0.06, across


def it_follows_the_lamp() -> Step:
    """Dragged to the left, the light comes from there; in front, the ball is lit as a whole."""
    lamp = bpy.data.objects["Lamp"]
    before = shoot("02_before")
    for step in range(4):
        lamp.location = (-0.35 * (step + 1), 1.2, 1.0 + 0.1 * step)
        yield DRAWN
    aside = shoot("03_aside")
    assert pixel(aside, ASIDE)[0] > pixel(before, ASIDE)[0] + 0.02, (pixel(aside, ASIDE), pixel(before, ASIDE))
    lamp.location = (-0.8, -1.6, 1.6)
    yield 2.0 * DRAWN
    front = shoot("04_in_front")
    assert pixel(front, MIDDLE).min() > pixel(aside, MIDDLE).min() + 0.1


def the_faster_one_is_chosen() -> Step:
    """The card was timed once, and the panel says which is used."""
    found = live()
    yield from until(lambda: found.card_seconds is not None, "the card was not timed")
    TIMES["processor_ms"], TIMES["card_ms"] = (round(1e3 * v, 2) for v in (found.seconds, found.card_seconds))
    lamp = bpy.data.objects["Lamp"]
    lamp.location = (0.0, 1.3, 1.0)
    yield 2.0 * DRAWN
    chosen = shoot("05_chosen")
    for slow in (np.inf, 0.0):  # both ways, whatever was measured
        found.card_seconds = slow
        lamp.location.x += 1e-4
        yield 2.0 * DRAWN
        picture = shoot(f"06_{'processor' if slow else 'card'}")
        for place in (MIDDLE, ASIDE):
            assert np.abs(pixel(picture, place) - pixel(chosen, place)).max() < 0.012, (slow, place)
        said = session().cloud
        assert ("processor" if slow else "graphics card") in said, said
    (OUTPUT / "bodies_times.json").write_text(json.dumps(TIMES, indent=1), encoding="utf-8")
    print(json.dumps(TIMES), flush=True)
    with override():
        bpy.ops.prt.toggle_preview()
    yield DRAWN


start((bake_for_lamps, it_shines_through, it_follows_the_lamp, the_faster_one_is_chosen), "bodies")
