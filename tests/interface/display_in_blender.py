# SPDX-License-Identifier: GPL-3.0-or-later
"""What the preview shows beside light, in a Blender with its interface: textures, clusters, errors, vectors, the lights
of a cloud and the patches of lit surfaces. Run by run.py; its pictures are to be looked at."""

from __future__ import annotations

import sys
from pathlib import Path

import bpy
import numpy as np

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
TILE = 0.5  # metres, of the checker on the floor


def settings() -> bpy.types.PropertyGroup:
    return bpy.context.scene.prt


def floor_places() -> list[tuple[tuple[float, float, float], bool]]:
    """Middles of tiles in front of everything, and whether each is a light one."""
    return [((-2.0 + TILE * (column + 0.5), -2.0 + TILE * (row + 0.5), 0.0), (row + column) % 2 == 0)
            for row in range(2) for column in range(1, 7)]


def open_and_bake() -> Step:
    """The scene is baked for World and lamps by lit surfaces."""
    with override():
        bpy.ops.wm.open_mainfile(filepath=str(SCENE), load_ui=False)
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
    settings().preset, settings().lighting, settings().lamp_basis = "draft", "both", "surfaces"
    settings().surface_columns, settings().order = 24, 3
    yield from bake()


def bake() -> Step:
    assert invoke_bake() == {"RUNNING_MODAL"}
    yield from wait_for_bake()
    assert not session().failed, session().message
    yield from until(lambda: baked_names() == ALL, f"the panel lists {baked_names()}")
    yield 1.0


def sharp_textures() -> Step:
    """The floor's tiles are as sharp as its image, though it came with four vertices."""
    with override():
        assert bpy.ops.prt.toggle_preview() == {"FINISHED"}
    yield 2.0 * DRAWN
    picture = shoot("01_textures")
    assert not session().viewport_message, session().viewport_message
    places = floor_places()
    light = [pixel(picture, place).mean() for place, is_light in places if is_light]
    dark = [pixel(picture, place).mean() for place, is_light in places if not is_light]
    assert min(light) > 1.5 * max(dark), (light, dark)
    # From one tile to the next within a few pixels: along the line between two middles, few are in between.
    (a, _), (b, _) = places[0], places[1]
    line = np.array([pixel(picture, tuple(np.array(a) + (np.array(b) - a) * share)).mean()
                     for share in np.linspace(0.0, 1.0, 200)])
    middle = np.abs(line - line.mean()) < 0.3 * np.ptp(line)
    assert middle.mean() < 0.2, f"{middle.mean():.0%} of the way from tile to tile is blurred"


def follow_the_image() -> Step:
    """A changed image is shown without a new bake, and does not make the bake stale."""
    image = bpy.data.images["tiles"]
    before = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(before)
    changed = before.reshape(-1, 4).copy()
    changed[:, 0], changed[:, 2] = before.reshape(-1, 4)[:, 2], before.reshape(-1, 4)[:, 0]
    image.pixels.foreach_set(changed.ravel())
    image.update()
    yield DRAWN
    place = next(place for place, is_light in floor_places() if not is_light)
    picture = shoot("02_image_changed")
    colour = pixel(picture, place)
    assert colour[0] > colour[2], f"{colour}: a reddened tile is still blue"
    assert not any(line.stale for line in session().objects), [line.stale for line in session().objects]
    image.pixels.foreach_set(before)
    image.update()
    yield DRAWN


def clusters() -> Step:
    """Clusters have colours that the view transform does not touch."""
    settings().display = "clusters"
    yield DRAWN
    standard = shoot("03_clusters")
    bpy.context.scene.view_settings.view_transform = "AgX"
    yield DRAWN
    agx = shoot("03_clusters_agx")
    bpy.context.scene.view_settings.view_transform = "Standard"
    places = [place for place, _ in floor_places()]
    off = max(np.abs(pixel(standard, place) - pixel(agx, place)).max() for place in places)
    assert off < 0.02, f"the view transform changes false colours by {off:.3f}"
    colours = {tuple(np.round(pixel(standard, place), 1)) for place in places}
    assert len(colours) >= 3, colours
    # The colours do not depend on overlays being shown, nor on what draws below.
    area().spaces.active.overlay.show_overlays = False
    for shading in ("SOLID", "MATERIAL"):
        area().spaces.active.shading.type = shading
        yield DRAWN
        bare = shoot(f"03_clusters_without_overlays_{shading.lower()}")
        off = max(np.abs(pixel(standard, place) - pixel(bare, place)).max() for place in places)
        assert off < 0.02, f"{shading} without overlays: false colours differ by {off:.3f}"
    area().spaces.active.shading.type = "SOLID"
    area().spaces.active.overlay.show_overlays = True


def errors() -> Step:
    """Errors are shown with a legend, in the colours of the legend."""
    settings().display = "error"
    yield DRAWN
    shoot("04_error")
    for name in ALL:
        assert "prt_error" in carrier(name).attributes, name
    attribute = carrier("Statue").attributes.get("prt_error")
    for name in ALL:
        carrier(name).attributes.remove(carrier(name).attributes["prt_error"])
    assert attribute is not None
    sys.modules["bl_ext.user_default.prt.operators.live_preview"].bakes_changed()
    yield 2.0 * DRAWN
    shoot("05_error_of_old_bakes")
    assert not any(line.receiver_errors for line in session().objects)


def vectors() -> Step:
    settings().display = "vectors"
    yield DRAWN
    shoot("06_vectors")
    settings().display = "relit"


def patches() -> Step:
    """Patches of lit surfaces are marked, move along with the bakes, and go with the switch and with overlays."""
    yield DRAWN
    off = shoot("07_patches_off")
    settings().show_cloud = True
    yield DRAWN
    on = shoot("07_patches")
    place = floor_places()[3][0]
    assert np.abs(pixel(on, place) - pixel(off, place)).max() > 0.05, "no patches are drawn"
    area().spaces.active.overlay.show_overlays = False
    yield DRAWN
    without = shoot("07_patches_without_overlays")
    assert np.abs(pixel(without, place) - pixel(off, place)).max() < 0.02, "patches are drawn though overlays are off"
    area().spaces.active.overlay.show_overlays = True
    settings().show_cloud = False


def cloud() -> Step:
    """The same with a light cloud."""
    settings().lamp_basis, settings().cloud_lights, settings().merge_response = "cloud", 30, 0.3
    yield from bake()
    off = shoot("09_cloud_off")
    settings().show_cloud = True
    yield DRAWN
    on = shoot("09_cloud")
    assert np.abs(on.astype(float) - off).max(axis=2).astype(bool).sum() > 300, "no lights are drawn"
    settings().show_cloud = False


def report_back() -> Step:
    """Nothing stays after the preview."""
    with override():
        bpy.ops.prt.toggle_preview()
    yield DRAWN
    shoot("10_off")
    assert not session().preview


start((open_and_bake, sharp_textures, follow_the_image, clusters, errors, vectors, patches, cloud, report_back),
      "display")
