# SPDX-License-Identifier: GPL-3.0-or-later
"""Lamps that shine through a translucent body, from the bake to the viewport's light."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import pytest

from tests.blender.test_local_light_bakes import run

FAST = ("--preset", "draft", "--set", "directions=256", "--set", "gather_directions=64", "--set", "spacing=0",
        "--set", "error_receivers=0", "--set", "surface_columns=16", "--set", "surface_patches=64", "--set",
        "cloud_lights=8", "--set", "threads=1", "--lighting", "local")
RADIUS = 0.5


@pytest.fixture(scope="module")
def baked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ball of wax with a lamp behind it, baked with links."""
    folder = tmp_path_factory.mktemp("wax")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=4, radius=RADIUS)
    ball = bpy.context.object
    ball.name = "Ball"
    ball.data.shade_smooth()
    wax = bpy.data.materials.new("Wax")
    if wax.node_tree is None:
        wax.use_nodes = True
    shader = wax.node_tree.nodes["Principled BSDF"]
    for name, value in {"Base Color": (0.9, 0.7, 0.5, 1.0), "Subsurface Weight": 0.75, "Subsurface Scale": 1.0,
                        "Subsurface Radius": (0.5, 0.3, 0.2), "Specular IOR Level": 0.0}.items():
        shader.inputs[name].default_value = value
    ball.data.materials.append(wax)
    lamp = bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "POINT"))
    lamp.data.energy, lamp.data.shadow_soft_size, lamp.location = 40.0, 0.0, (0.0, 1.5, 0.0)
    bpy.context.scene.collection.objects.link(lamp)
    source, output = folder / "wax.blend", folder / "baked.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(source))
    assert run("bake", "--input", source, "--output", output, *FAST, "--set", "subsurface_links=48") == 0
    return output


def relit(path: Path, **changes: object) -> dict[str, np.ndarray]:
    """The arrays of `relight`."""
    from prt.operators.relit import radiance_arrays
    from prt.operators.relit import relit as light_of
    from prt.prt_addon.blender.stored import read_baked

    bpy.ops.wm.open_mainfile(filepath=str(path))
    for name, value in changes.items():
        setattr(bpy.data.objects["Lamp"], name, value)
    bpy.context.view_layer.update()
    bake = {"Ball": read_baked(bpy.data.objects["Ball"])}
    return radiance_arrays(bake, light_of(bpy.context.scene, bake))


def test_the_dark_side_shows_what_the_dipole_says(baked: Path) -> None:
    """Against the plain double sum over the vertices, of the closed form of the lamp's light."""
    from prt.prt_addon.transport.dipole import Medium
    from prt.prt_addon.transport.subsurface_links import full_sum
    from prt.prt_addon.transport.surface_pyramid import SurfacePyramid

    arrays = relit(baked)
    points, normals = (arrays[name].astype(np.float64) for name in ("position", "normal"))
    dark = points[:, 1] < -0.2
    assert arrays["radiance"][dark, 0].min() > 0.0 and arrays["radiance"].min() > -1e-6  # it is linear, without clips
    towards = np.array([0.0, 1.5, 0.0]) - points
    squared = np.sum(towards**2, axis=1)
    cosine = np.maximum(np.sum(towards * normals, axis=1), 0.0) / np.sqrt(squared)
    light = 40.0 / (4.0 * np.pi) * cosine / squared / np.pi  # E / pi
    area = 4.0 * np.pi * RADIUS**2 / len(points)
    pyramid = SurfacePyramid.over_points(points, normals, np.full(len(points), area))
    medium = Medium.of_principled((0.9, 0.7, 0.5), (0.5, 0.3, 0.2))
    means = pyramid.means(np.repeat(light[:, None], 3, axis=1).astype(np.float32))
    wanted = 0.75 * full_sum(pyramid, pyramid.place(len(points)), medium, means)
    off = arrays["radiance"][dark] - wanted[dark]
    assert np.sqrt(np.mean(off**2) / np.mean(wanted[dark] ** 2)) < 0.15  # of a thousandth of the bright side
    bright = points[:, 1] > 0.3
    both = wanted + 0.25 * light[:, None] * np.array([0.9, 0.7, 0.5])
    assert np.sqrt(np.mean((arrays["radiance"][bright] - both[bright]) ** 2) / np.mean(both[bright] ** 2)) < 0.06


def test_the_light_follows_the_lamp(baked: Path) -> None:
    behind, before = relit(baked), relit(baked, location=(0.0, -1.5, 0.0))
    mirrored = behind["position"] * np.array([1.0, -1.0, 1.0])
    order = np.lexsort(mirrored.round(3).T), np.lexsort(before["position"].round(3).T)
    assert before["radiance"][order[1]].mean() == pytest.approx(behind["radiance"][order[0]].mean(), rel=0.01)
    front = before["position"][:, 1] < -0.3
    assert before["radiance"][front].mean() > 3.0 * behind["radiance"][front].mean()


def test_links_are_stored_and_cleared(baked: Path) -> None:
    from prt.prt_addon.blender import stored

    bpy.ops.wm.open_mainfile(filepath=str(baked))
    ball = bpy.data.objects["Ball"]
    bake = stored.read_baked(ball)
    assert bake.links.texels.shape == (len(bake.positions), 48, 4)
    before = bake.links.texels.copy()
    stored.write_baked(ball, bake)
    assert np.array_equal(stored.read_baked(ball).links.texels.view(np.uint32), before.view(np.uint32))
    mesh = stored.baked_mesh(ball)
    assert stored.clear_baked(ball) and "prt_links" not in mesh


def test_the_panel_tells_of_bodies(baked: Path) -> None:
    import types

    from prt.operators.live_bodies import body_lines, lamp_light
    from prt.operators.scene_lamps import SceneLamps
    from prt.prt_addon.blender.stored import read_baked

    bpy.ops.wm.open_mainfile(filepath=str(baked))
    shown = types.SimpleNamespace(baked=read_baked(bpy.data.objects["Ball"]), moved=None)
    lamps_of = SceneLamps()
    assert body_lines(lamps_of, {"Ball": shown})[0] == "Ball is translucent to lamps"
    lamps = lamps_of.step({"Ball": shown.baked}, bpy.context.evaluated_depsgraph_get(), [])
    direct, scattering = lamp_light(lamps_of, "Ball", shown, lamps, ())
    assert not scattering.on_card and "processor" in body_lines(lamps_of, {"Ball": shown})[-1]
    scattering.live.card_seconds = 0.0  # as if it had been measured
    plain, scattering = lamp_light(lamps_of, "Ball", shown, lamps, ())
    assert scattering.on_card and "graphics card" in body_lines(lamps_of, {"Ball": shown})[-1]
    assert scattering.live.added(plain, scattering.bounced) == pytest.approx(direct, abs=1e-6)
