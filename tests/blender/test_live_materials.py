# SPDX-License-Identifier: GPL-3.0-or-later
"""Materials edited after a bake that kept its form factors: what the preview draws, against fresh bakes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
import pytest

from tests.blender import gpu_support  # makes the checkout the package `prt`
from tests.blender.scenes import add_cube, add_mesh, depsgraph
from tests.blender.test_gpu_scattering import linked_bake
from tests.blender.test_live_preview import GROUPS, follow, listed

# isort: split
from prt.gpu_shaders.render_data import LampScattering
from prt.operators import live_preview, properties
from prt.operators.live_materials import Edited
from prt.prt_addon.baking.recipe import bake, exhaust
from prt.prt_addon.baking.settings import make_settings
from prt.prt_addon.blender import fingerprint, live_materials, stored
from prt.prt_addon.blender.read_scene import read_objects
from prt.prt_addon.relighting.exit_radiance import baked_constants, exit_radiance
from prt.prt_addon.relighting.live_scattering import LiveScattering
from prt.prt_addon.scene.scene_mesh import SceneMesh

assert gpu_support
SETTINGS = {"order": "3", "directions": "512", "gather_directions": "256", "spacing": "0.05", "clusters": "32",
            "error_receivers": "0", "live_editing": "true", "glossy_rows": "0"}


def plain(name: str, colour: tuple[float, float, float]) -> bpy.types.Material:
    material = bpy.data.materials.new(name)
    material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (*colour, 1.0)
    return material


def inputs_of(material: bpy.types.Material) -> bpy.types.NodeInputs:
    return material.node_tree.nodes["Principled BSDF"].inputs


def bake_all() -> None:
    """Bake everything in this process, as a session does."""
    graph, settings = depsgraph(), make_settings("standard", SETTINGS)
    scene = SceneMesh.assemble(read_objects(graph), settings.spacing, texels=settings.texels,
                               split_slots=settings.live_editing)
    found = {o.name: bpy.data.objects[o.name] for o in scene.objects}
    digests = {name: fingerprint.fingerprint(o, graph, settings.live_editing) for name, o in found.items()}
    around = fingerprint.surroundings(graph)
    result = exhaust(bake(scene, settings))
    for name, o in found.items():
        stored.write_baked(o, result.objects[name], digests[name], around)


@pytest.fixture
def room(scene: bpy.types.Scene) -> Iterator[dict[str, bpy.types.Object]]:
    """A floor of two materials that look the same and a wall, under a bluish sky, baked, with the preview on."""
    for group in GROUPS:
        bpy.utils.register_class(group)
    properties.register()
    scene.world = bpy.data.worlds.new("Sky")
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.6, 0.8, 1.0, 1.0)
    floor = add_mesh("Floor", [(x, y, 0) for x in (-2, 0, 2) for y in (-2, 2)], [(0, 2, 3, 1), (2, 4, 5, 3)])
    for name in ("Left", "Right"):
        floor.data.materials.append(plain(name, (0.3, 0.3, 0.3)))
    floor.data.polygons[1].material_index = 1
    wall = add_mesh("Wall", [(x, 2.05, z) for x in (-2, 2) for z in (0.1, 2.5)], [(0, 2, 3, 1)])
    wall.data.materials.append(plain("White", (0.7, 0.7, 0.7)))
    bake_all()
    live_preview._lives.clear()
    properties.session().preview = True
    yield {"Floor": floor, "Wall": wall}
    live_preview._lives.clear()
    properties.unregister()
    for group in reversed(GROUPS):
        bpy.utils.unregister_class(group)


def follow_materials() -> live_preview.Live:
    live = live_preview._lives.setdefault(live_preview._context_key(), live_preview.Live())
    live.materials_dirty = True
    return follow()


def drawn(live: live_preview.Live) -> dict[str, np.ndarray]:
    """Radiance (points, 3) by name, as it would be drawn: its positions first, for an order that fresh bakes share."""
    found = {}
    for name, shown in live.shown.items():
        light = live_preview._light_on(shown, np.eye(4))
        row = exit_radiance(shown.baked.cluster, shown.baked.weights, baked_constants(shown.baked, light))[:, 0]
        edited = live.materials.edited.get(name)
        albedo = shown.baked.albedo
        if edited is not None:
            row, albedo = row + edited.added[:, 0], edited.baked.albedo
        found[name] = row * albedo
    return found


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def test_an_edited_colour_is_followed_within_a_percent_of_a_fresh_bake_and_is_not_stale(room) -> None:
    live = follow_materials()
    before = drawn(live)
    assert live.materials.present and not live.materials.edited and live.materials.message == ""
    inputs_of(bpy.data.materials["Right"])["Base Color"].default_value = (0.9, 0.1, 0.05, 1.0)
    live = follow_materials()
    assert listed() == {"Floor": False, "Wall": False}
    assert "follows materials" in properties.session().live_materials
    found = drawn(live)
    # Elsewhere, where no preview takes edits into account, the bake is stale.
    around = fingerprint.surroundings(depsgraph())
    assert all(stored.stale(o, depsgraph(), around) for o in room.values())
    bake_all()
    live_preview._lives.clear()
    live = follow_materials()
    assert not live.materials.edited
    fresh = drawn(live)
    for name in room:
        assert rms(found[name] - fresh[name]) < 0.01 * rms(fresh[name]), name
        assert rms(before[name] - fresh[name]) > 0.02 * rms(fresh[name]), name


def test_texels_follow_as_vertices_do(room, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SETTINGS, "receivers", "texels")
    bake_all()
    live_preview._lives.clear()
    live = follow_materials()
    before = drawn(live)
    assert live.shown["Floor"].baked.texels is not None and live.materials.present
    inputs_of(bpy.data.materials["Right"])["Base Color"].default_value = (0.9, 0.1, 0.05, 1.0)
    found = drawn(follow_materials())
    assert not any(listed().values())
    bake_all()
    live_preview._lives.clear()
    fresh = drawn(follow_materials())
    for name in room:
        assert rms(found[name] - fresh[name]) < 0.01 * rms(fresh[name]), name
        assert rms(before[name] - fresh[name]) > 0.02 * rms(fresh[name]), name


def test_undoing_an_edit_leaves_nothing_of_it(room) -> None:
    before = drawn(follow_materials())
    inputs_of(bpy.data.materials["Left"])["Base Color"].default_value = (0.9, 0.1, 0.05, 1.0)
    assert rms(drawn(follow_materials())["Wall"] - before["Wall"]) > 1e-3
    inputs_of(bpy.data.materials["Left"])["Base Color"].default_value = (0.3, 0.3, 0.3, 1.0)
    live = follow_materials()
    assert not live.materials.edited and properties.session().live_materials == ""
    assert np.array_equal(drawn(live)["Wall"], before["Wall"])


def test_a_glowing_surface_lights_the_others_and_shows_its_glow(room) -> None:
    before = drawn(follow_materials())
    white = inputs_of(bpy.data.materials["White"])
    white["Emission Color"].default_value = (1.0, 0.5, 0.0, 1.0)
    white["Emission Strength"].default_value = 4.0
    live = follow_materials()
    assert listed() == {"Floor": False, "Wall": False}
    glow = drawn(live)
    assert np.allclose((glow["Wall"] - before["Wall"]).mean(axis=0), (4.0, 2.0, 0.0), atol=0.3)
    gained = glow["Floor"] - before["Floor"]
    near = live.shown["Floor"].baked.positions[:, 1] > 1.0
    assert gained[near, 0].mean() > 5.0 * gained[~near & (live.shown["Floor"].baked.positions[:, 1] < -1.5), 0].mean()
    assert np.allclose(gained[near, 1], 0.5 * gained[near, 0], rtol=0.02) and np.abs(gained[:, 2]).max() < 1e-4
    white["Base Color"].default_value = (0.0, 0.0, 0.0, 1.0)  # black, it still glows
    assert np.allclose(drawn(follow_materials())["Wall"].mean(axis=0), (4.0, 2.0, 0.0), atol=0.02)


def test_another_material_in_a_slot_is_followed_unless_its_highlight_would_be_another(room) -> None:
    follow_materials()
    floor = room["Floor"]
    floor.material_slots[0].material = plain("Green", (0.1, 0.8, 0.1))
    live = follow_materials()
    assert listed() == {"Floor": False, "Wall": False}
    albedo = live.materials.edited["Floor"].baked.albedo
    left = live.shown["Floor"].baked.positions[:, 0] < -0.01
    assert np.allclose(albedo[left], (0.1, 0.8, 0.1), atol=1e-6)
    assert np.allclose(albedo[live.shown["Floor"].baked.positions[:, 0] > 0.01], 0.3, atol=1e-6)
    for slot in ("Metallic", "Roughness", "Subsurface Weight"):
        inputs_of(floor.material_slots[0].material)[slot].default_value = 0.9
        assert {"Floor", "Wall"} == {name for name in listed() if follow_materials() and listed()[name]}, slot
        inputs_of(floor.material_slots[0].material)[slot].default_value = 0.5 if slot == "Roughness" else 0.0
        follow_materials()
        assert not any(listed().values()), slot


def test_edits_follow_the_light(room) -> None:
    inputs_of(bpy.data.materials["Right"])["Base Color"].default_value = (0.9, 0.1, 0.05, 1.0)
    before = drawn(follow_materials())
    bpy.context.scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value = 2.0
    after = drawn(follow_materials())
    for name in room:
        assert rms(after[name] - 2.0 * before[name]) < 2e-3 * rms(after[name])


def test_form_factors_survive_a_file_and_go_with_the_bake(room, tmp_path: Path) -> None:
    floor = room["Floor"]
    kept = live_materials.read_live(stored.baked_mesh(floor), "Floor")
    assert live_materials.read_live(stored.baked_mesh(room["Wall"]), "Wall") is None
    path = tmp_path / "kept.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    bpy.ops.wm.open_mainfile(filepath=str(path))
    floor = bpy.data.objects["Floor"]
    again = live_materials.read_live(stored.baked_mesh(floor), "Floor")
    for name, values in kept.arrays().items():
        assert np.array_equal(again.arrays()[name], values), name
    stored.clear_baked(floor)
    assert not any(key in mesh for mesh in bpy.data.meshes for key in live_materials.PROPERTIES.values())


def test_broken_form_factors_are_told_and_the_bake_is_still_shown(room) -> None:
    mesh = stored.baked_mesh(room["Floor"])
    mesh["prt_live_counts"] = np.array([1, 2, 3], np.int32)
    live = follow_materials()
    assert set(live.shown) == {"Floor", "Wall"} and not live.materials.present
    assert "can't be read" in properties.session().live_materials
    inputs_of(bpy.data.materials["Right"])["Base Color"].default_value = (0.9, 0.1, 0.05, 1.0)
    follow_materials()
    assert all(listed().values())


def test_what_a_bake_without_live_editing_does_stays(room) -> None:
    SETTINGS["live_editing"] = "false"
    try:
        bake_all()
    finally:
        SETTINGS["live_editing"] = "true"
    live_preview._lives.clear()
    inputs_of(bpy.data.materials["Right"])["Base Color"].default_value = (0.9, 0.1, 0.05, 1.0)
    live = follow_materials()
    assert not live.materials.present and all(listed().values())
    assert "prt_live_counts" not in stored.baked_mesh(room["Floor"])


def test_emission_is_read_of_plain_values(scene: bpy.types.Scene) -> None:
    cube = add_cube()
    cube.data.materials.append(plain("Lamp", (0.5, 0.5, 0.5)))
    material = cube.data.materials[0]
    assert live_materials.emission_of(material) == live_materials.emission_of(None) == (0.0, 0.0, 0.0)
    inputs_of(material)["Emission Strength"].default_value = 3.0
    assert live_materials.emission_of(material) == pytest.approx((3.0, 3.0, 3.0))
    tree = material.node_tree
    node = tree.nodes.new("ShaderNodeEmission")
    node.inputs["Color"].default_value, node.inputs["Strength"].default_value = (0.2, 0.4, 1.0, 1.0), 5.0
    tree.links.new(node.outputs[0], tree.nodes["Material Output"].inputs["Surface"])
    assert live_materials.emission_of(material) == pytest.approx((1.0, 2.0, 5.0))
    assert live_materials.albedo_of(material) == (0.0, 0.0, 0.0)


def test_a_glow_is_traced_once_whatever_colours_are_edited(room, monkeypatch: pytest.MonkeyPatch) -> None:
    from prt.operators import live_materials as followers
    traced = []
    monkeypatch.setattr(followers, "glow_of", lambda *a, trace=followers.glow_of: traced.append(1) or trace(*a))
    inputs_of(bpy.data.materials["White"])["Emission Strength"].default_value = 2.0
    follow_materials()
    first = len(traced)
    assert first == len(room)
    inputs_of(bpy.data.materials["White"])["Emission Strength"].default_value = 3.0
    inputs_of(bpy.data.materials["Left"])["Base Color"].default_value = (0.9, 0.1, 0.05, 1.0)
    follow_materials()
    assert len(traced) == first
    room["Floor"].location.z = -0.5  # shapes and places are another matter
    follow_materials()
    room["Floor"].location.z = 0.0
    follow_materials()
    assert len(traced) > first


def test_edits_follow_lamps_by_directions(room) -> None:
    lamp = bpy.data.objects.new("Far", bpy.data.lights.new("Far", "POINT"))
    lamp.location, lamp.data.energy = (3.0, -6.0, 6.0), 2000.0
    bpy.context.scene.collection.objects.link(lamp)
    bpy.context.scene.prt.lamps_by_directions = True
    inputs_of(bpy.data.materials["Right"])["Base Color"].default_value = (0.9, 0.1, 0.05, 1.0)
    before = follow_materials().materials.edited["Wall"].added.copy()
    lamp.data.energy = 6000.0
    live = follow()
    assert live.shown["Wall"].direct is not None
    found = live.materials.edited["Wall"].added.copy()
    assert rms(found - before) > 0.1 * rms(before)
    assert np.array_equal(found, follow_materials().materials.edited["Wall"].added)


@pytest.mark.parametrize("with_bounces", [False, True])
def test_an_edit_does_not_enter_a_body_on_the_graphics_card(with_bounces: bool) -> None:
    """As on the processor, whose sums the card is tested to give (test_gpu_scattering.py): a glow stays whole."""
    baked, random = linked_bake((0,)), np.random.default_rng(2)
    live = LiveScattering(baked)
    direct, added = random.uniform(0.0, 1.0, (2, 700, 2, 3)).astype(np.float32)
    added[:, 1] = 0.0
    bounced = random.uniform(0.0, 1.0, (700, 3)).astype(np.float32) if with_bounces else None
    edited, on_card = Edited(baked, "key", added), LampScattering(live, bounced, on_card=True)
    asked = edited.with_scattering(on_card)
    assert edited.with_scattering(on_card) is asked and asked.on_card  # or each redraw would scatter anew
    found = live.added(edited.with_direct(direct), asked.bounced)
    assert found == pytest.approx(live.added(direct, bounced) + added, abs=1e-5)
    assert edited.with_scattering(None) is None
    timed = LampScattering(live)
    assert edited.with_scattering(timed) is timed
