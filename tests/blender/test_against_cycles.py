# SPDX-License-Identifier: GPL-3.0-or-later
"""The whole chain against Cycles in the same Blender: read, trace, bounce, compress, relight; per-vertex radiance."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from prt_addon.baking.recipe import bake, exhaust
from prt_addon.baking.settings import make_settings
from prt_addon.blender.read_scene import read_objects
from prt_addon.lighting.environment import project, world_rotation
from prt_addon.relighting.exit_radiance import cluster_constants, exit_radiance, view_radiance
from prt_addon.scene.scene_mesh import SceneMesh
from tests.blender.cycles import (
    ALL_LIGHT,
    diffuse_material,
    environment_world,
    shown_radiance,
    smooth_environment,
    use_cycles,
)

# Cycles' own noise at these samples: two bakes with other seeds differ by sqrt(2) times it (asserted below).
SAMPLES = 256


@pytest.fixture
def still_life(scene):
    """A smooth-shaded body with a groove and coarse faces over a floor whose vertices are close, colours that bleed."""
    bpy.ops.mesh.primitive_torus_add(location=(0, 0, 0.7), rotation=(0.5, 0.3, 0.0), major_segments=24,
                                     minor_segments=10, major_radius=0.6, minor_radius=0.3)
    bpy.ops.object.shade_smooth()
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=20, y_subdivisions=20, size=4.0)
    bpy.ops.object.shade_smooth()
    for thing, colour in zip(bpy.data.objects, ((0.8, 0.25, 0.1, 1), (0.6, 0.7, 0.8, 1)), strict=True):
        thing.data.materials.append(diffuse_material(thing.name, colour))
    use_cycles(SAMPLES)
    return scene


def baked(bounces):
    objects = read_objects(bpy.context.evaluated_depsgraph_get(), [o.name for o in bpy.data.objects])
    mesh = SceneMesh.assemble(objects, 0.0)
    assert all(o.matches_source for o in mesh.objects)
    settings = make_settings("high", {"bounces": str(bounces), "error_receivers": "0", "threads": "2"})
    return exhaust(bake(mesh, settings)).objects


def relit(container, image, degrees):
    light = project(image, container.header["columns"]["order"], world_rotation(degrees))
    constants = cluster_constants(container.bases, light)
    return exit_radiance(container.cluster, container.weights, constants)[:, 0]


def relative_rms(ours, theirs):
    return float(np.sqrt(np.sum((ours - theirs) ** 2) / np.sum(theirs**2)))


@pytest.mark.parametrize(("passes", "bounces", "limit"), [
    ({"DIRECT"}, 0, 0.01), ({"DIRECT", "INDIRECT"}, -1, 0.015)])
def test_radiance_of_a_smooth_environment(still_life, tmp_path, passes, bounces, limit):
    image = smooth_environment()
    containers = baked(bounces)
    bodies = list(bpy.data.objects)
    for degrees in (0.0, 130.0):
        world = environment_world(image, degrees, tmp_path)
        world.cycles.sampling_method = "NONE"  # see shown_radiance
        ours = np.concatenate([relit(containers[o.name], image, degrees) for o in bodies])
        theirs = [np.concatenate([shown_radiance(o, passes, np.arange(len(o.data.vertices)), seed) for o in bodies])
                  for seed in (0, 1)]
        noise = relative_rms(*theirs) / np.sqrt(2.0)
        assert noise < 0.01
        truth = 0.5 * (theirs[0] + theirs[1])
        error = relative_rms(ours, truth)
        print(f"{sorted(passes)} at {degrees:g}: error {error:.4f}, noise of the mean {noise / 2**0.5:.4f}")
        assert error < limit
        # Orientation: any other turn fits far worse.
        turned = np.concatenate([relit(containers[o.name], image, degrees + 90.0) for o in bodies])
        assert relative_rms(turned, truth) > 5 * limit


@pytest.mark.parametrize(("metallic", "anisotropic", "limit"), [(1.0, 0.0, 0.05), (1.0, 0.7, 0.06), (0.0, 0.0, 0.03)])
def test_highlights_towards_a_camera(scene, tmp_path, metallic, anisotropic, limit):
    """A torus of a rough metal (anisotropic too) or plastic over a floor, as a camera sees it, bounces included."""
    bpy.ops.mesh.primitive_torus_add(location=(0, 0, 0.5), rotation=(0.5, 0.3, 0.0), major_segments=40,
                                     minor_segments=20, major_radius=0.6, minor_radius=0.3)
    body = bpy.context.object
    bpy.ops.object.shade_smooth()
    material = bpy.data.materials.new("Rough")
    shader = material.node_tree.nodes["Principled BSDF"]
    for name, value in (("Base Color", (0.9, 0.6, 0.3, 1.0)), ("Metallic", metallic), ("Roughness", 0.5),
                        ("Anisotropic", anisotropic)):
        shader.inputs[name].default_value = value
    body.data.materials.append(material)
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=20, y_subdivisions=20, size=4.0)
    bpy.context.object.data.materials.append(diffuse_material("Floor", (0.6, 0.7, 0.8, 1)))
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(camera)
    scene.camera, camera.location = camera, (1.5, -3.0, 2.5)
    use_cycles(256)
    objects = read_objects(bpy.context.evaluated_depsgraph_get(), [body.name])
    settings = make_settings("high", {"bounces": "-1", "error_receivers": "0", "threads": "2", "encoder": "iterative"})
    container = exhaust(bake(SceneMesh.assemble(objects, 0.0), settings)).objects[body.name]
    assert len(container.functions) >= 16
    towards = np.array(camera.location) - container.positions
    facing = np.flatnonzero(np.sum(container.normals * towards, axis=1) > 0.0)
    image = smooth_environment()
    environment_world(image, 0.0, tmp_path).cycles.sampling_method = "NONE"
    theirs = [shown_radiance(body, ALL_LIGHT, facing, seed) for seed in (0, 1)]
    light = project(image, container.header["columns"]["order"], world_rotation(0.0))
    ours = view_radiance(container, light, towards)[facing]
    error = np.sqrt(np.sum((ours - theirs[0]) * (ours - theirs[1])) / np.sum(theirs[0] * theirs[1]))
    print(f"metallic {metallic:g}, anisotropic {anisotropic:g}: error {error:.4f}")
    assert error < limit
    # From elsewhere the same surface looks different: the view is what was tested.
    elsewhere = view_radiance(container, light, towards * (-1.0, 1.0, 1.0))[facing]
    assert relative_rms(elsewhere, theirs[0]) > 1.5 * limit
