# SPDX-License-Identifier: GPL-3.0-or-later
"""False colours, legends and marks: what they say against the bakes that they are made of."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import bpy
import numpy as np
import pytest

from tests.blender import gpu_support  # makes the checkout the package `prt`

# isort: split
from prt.gpu_shaders import offscreen, render_data
from prt.gpu_shaders.render_data import DrawItem, heat_colours
from prt.operators import display
from prt.prt_addon.baking.recipe import bake, exhaust
from prt.prt_addon.baking.settings import make_settings
from prt.prt_addon.blender import stored
from prt.prt_addon.blender.read_scene import read_objects
from prt.prt_addon.lighting.light_cloud import LightCloud
from prt.prt_addon.lighting.lit_surfaces import LitSurfaces
from prt.prt_addon.scene.scene_mesh import SceneMesh

from tests.blender.scenes import depsgraph


def made_up(side: int = 12, seed: int = 1, clusters: int = 30) -> Any:
    generator = np.random.default_rng(seed)
    return gpu_support.made_up_bake(*gpu_support.grid_mesh(side, generator), generator, clusters=clusters, vectors=2)


def test_clusters_have_a_colour_each_and_neighbours_differ() -> None:
    baked = made_up()
    shown = display.Display()
    colours = shown.colours_of("clusters", {"A": baked})["A"].values
    of_cluster = {c: {tuple(x) for x in colours[baked.cluster == c].tolist()} for c in np.unique(baked.cluster)}
    assert all(len(found) == 1 for found in of_cluster.values())
    assert len(set().union(*of_cluster.values())) == len(of_cluster)
    # On a map as an atlas shows it (each cluster has few neighbours) all neighbours have other tones.
    across, down = np.meshgrid(np.arange(16), np.arange(16), indexing="ij")
    number = across * 16 + down
    pairs = np.concatenate([np.stack([number[:-1].ravel(), number[1:].ravel()], 1),
                            np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()], 1)])
    palette = display.distinct_colours(pairs, 256)
    assert np.abs(palette[pairs[:, 0]] - palette[pairs[:, 1]]).max(axis=1).min() > 0.15
    assert np.array_equal(palette, display.distinct_colours(pairs[::-1, ::-1], 256))  # the same for the same neighbours
    assert len(np.unique(palette, axis=0)) == 256


def test_errors_are_heat_up_to_the_legend() -> None:
    generator = np.random.default_rng(4)
    first, second = (replace(made_up(seed=seed), error=generator.uniform(0.0, 0.013, 144).astype(np.float32))
                     for seed in (1, 2))
    shown = display.Display()
    colours = shown.colours_of("error", {"A": first, "B": second})
    assert shown.legend.labels == ("0 %", "1 %", "2 %")
    assert np.array_equal(colours["B"].values, heat_colours(second.error / 0.02))
    bar = display.to_linear(np.array(shown.legend.colours))
    assert np.allclose(bar, heat_colours(np.linspace(0.0, 1.0, 64)), atol=1e-5)
    assert shown.colours_of("error", {"A": first, "B": second}) is colours  # made once
    other = replace(second, error=None)
    mixed = shown.colours_of("error", {"A": first, "B": other})
    assert len(np.unique(mixed["B"].values, axis=0)) == 1 and len(np.unique(mixed["A"].values, axis=0)) > 50
    shown.colours_of("error", {"B": other})
    assert "bake again" in shown.legend.title and not shown.legend.colours
    assert shown.colours_of("relit", {"A": first}) == {} and shown.legend is None


@pytest.mark.parametrize(("value", "end"), [(0.013, 0.02), (0.02, 0.02), (0.31, 0.5), (0.7, 1), (0.0, 1e-6), (7, 10)])
def test_the_legend_ends_at_a_round_number(value: float, end: float) -> None:
    assert display.nice_end(value) == pytest.approx(end)


def test_vectors_count_those_that_are_not_zero() -> None:
    baked = made_up()
    baked.bases[:10, 2] = 0.0
    shown = display.Display()
    colours = shown.colours_of("vectors", {"A": baked})["A"].values
    assert shown.legend.labels == ("0", "2") and len(np.unique(colours, axis=0)) == 2
    fewer = baked.cluster < 10
    assert len(np.unique(colours[fewer], axis=0)) == len(np.unique(colours[~fewer], axis=0)) == 1


def test_false_colours_are_drawn_as_they_are(scene: bpy.types.Scene) -> None:
    """No light, no albedo, no texture on them."""
    gpu_support.require_gpu()
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.data.type, camera.data.ortho_scale, camera.location = "ORTHO", 2.2, (0.0, 0.0, 5.0)
    scene.collection.objects.link(camera)
    scene.camera = camera
    baked = made_up()
    values = np.tile(np.float32([0.2, 0.5, 0.7]), (len(baked.cluster), 1))
    item = DrawItem("A", baked, np.eye(4), np.zeros((25, 3)), colours=render_data.FalseColours(values))
    picture = offscreen.draw_items(scene, [item], 40, 40, samples=1)
    assert np.allclose(picture[20, 20], (0.2, 0.5, 0.7, 1.0), atol=1e-4)
    other = replace(item, colours=render_data.FalseColours(values * 0.5))
    assert render_data.light_signature(item) != render_data.light_signature(other)


def test_marks_of_a_cloud_stand_at_its_lights() -> None:
    generator = np.random.default_rng(2)
    zones = [generator.uniform(-1, 1, (n, 3)) for n in (5, 3)]
    cloud = LightCloud.of_zones(zones, np.concatenate([*zones, [[2.0, 0.0, 0.0]]]), 0.5)
    box, dense, merged = display.cloud_overlays(cloud)
    assert np.allclose(merged.places, cloud.positions) and np.allclose(dense.places, cloud.dense)
    assert [len(np.unique(merged.colours[part], axis=0)) for part in (slice(0, 5), slice(5, 8))] == [1, 1]
    assert len(np.unique(merged.colours, axis=0)) == 2 and len(np.unique(dense.colours, axis=0)) == 1
    assert box.kind == "LINES" and len(box.places) == 24
    assert np.allclose(box.places.max(axis=0), cloud.dense.max(axis=0) + 0.25)
    lengths = np.abs(box.places[::2] - box.places[1::2])
    assert (np.count_nonzero(lengths, axis=1) == 1).all()


def test_marks_of_patches_cover_their_triangles() -> None:
    corners = np.array([[(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(1, 0, 0), (1, 1, 0), (0, 1, 0)]], np.float32)
    lit = LitSurfaces(corners, np.array([[0, 1, 2], [1, 3, -1]], np.int32), np.ones((2, 4), np.float32))
    (marks,) = display.cloud_overlays(lit)
    triangles = marks.places.reshape(-1, 3, 3)
    area = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])[:, 2] / 2.0
    assert (area > 0.0).all()  # wound as their triangles are
    assert area.sum() == pytest.approx(5.0 / 6.0)  # without the corner that belongs to no patch
    colours = marks.colours.reshape(-1, 3, 4)[:, 0]
    shares = [area[(colours == colour).all(axis=1)].sum() for colour in np.unique(colours, axis=0)]
    assert sorted(shares) == pytest.approx([1 / 6, 1 / 6, 1 / 6, 1 / 3])


def test_marks_are_shared_and_move_with_the_first_object() -> None:
    cloud = LightCloud.of_zones([np.zeros((1, 3))], np.zeros((1, 3)), 1.0)
    first, second = replace(made_up(seed=1), cloud=cloud), replace(made_up(seed=2), cloud=cloud)
    moved = np.eye(4)
    moved[0, 3] = 3.0
    shown = display.Display()
    bakes, moves = {"A": first, "B": second}, {"A": moved, "B": None}
    assert not shown.marks(bakes, moves, False).overlays and not shown.overlays
    marks = shown.marks(bakes, moves, True)
    assert len(marks.overlays) == 3 and all(np.array_equal(place, moved) for _, place in marks.overlays)
    again = shown.marks(bakes, moves, True)
    assert all(a[0] is b[0] for a, b in zip(marks.overlays, again.overlays, strict=True))  # made once


def test_errors_survive_the_file(scene: bpy.types.Scene) -> None:
    """Of own vertices and of receiver meshes; with the source triangles of the latter; and old bakes have none."""
    bpy.ops.mesh.primitive_uv_sphere_add(segments=16, ring_count=8)
    ball = bpy.context.object
    bpy.ops.object.shade_smooth()
    bpy.ops.mesh.primitive_cube_add(location=(3.0, 0.0, 0.0))
    cube = bpy.context.object
    mesh = SceneMesh.assemble(read_objects(depsgraph(), [ball.name, cube.name]), 0.0)
    settings = make_settings("draft", {"order": "3", "error_receivers": "0", "threads": "1", "clusters": "2",
                                       "vectors": "1"})
    for name, container in exhaust(bake(mesh, settings)).objects.items():
        assert container.error.shape == (len(container.cluster),) and container.error.max() > 0.0
        stored.write_baked(bpy.data.objects[name], container)
        read = stored.read_baked(bpy.data.objects[name])
        assert np.array_equal(read.error, container.error) and np.array_equal(read.source, container.source)
        carrier = stored.baked_mesh(bpy.data.objects[name])
        on_source_mesh = json.loads(carrier["prt_header"])["source"]["on_source_mesh"]
        assert ("prt_source" in carrier.attributes) == (not on_source_mesh)
        carrier.attributes.remove(carrier.attributes["prt_error"])
        assert stored.read_baked(bpy.data.objects[name]).error is None
    assert "prt_receiver" in cube and "prt_receiver" not in ball
    stored.clear_baked(ball)
    assert not [a.name for a in ball.data.attributes if a.name.startswith("prt_")]
