# SPDX-License-Identifier: GPL-3.0-or-later
"""Ground truth from Cycles: irradiance over pi on white diffuse faces, baked to vertices."""

from __future__ import annotations

import math

import bpy
import numpy as np


def use_cycles(samples: int) -> bpy.types.World:
    """Set the scene up for small exact bakes on one thread; returns its new, black world."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    scene.cycles.device = "CPU"
    scene.cycles.samples = samples
    scene.cycles.use_adaptive_sampling = False
    scene.cycles.use_denoising = False
    # Blender's defaults end diffuse light after four bounces and cut bright paths.
    scene.cycles.max_bounces = scene.cycles.diffuse_bounces = scene.cycles.glossy_bounces = 64
    scene.cycles.sample_clamp_indirect = 0.0
    scene.world = bpy.data.worlds.new("World")
    if scene.world.node_tree is None:
        scene.world.use_nodes = True
    # The automatic importance map takes seconds to build and serves large pictures.
    scene.world.cycles.sampling_method, scene.world.cycles.sample_map_resolution = "MANUAL", 512
    background = scene.world.node_tree.nodes["Background"]
    background.inputs["Color"].default_value = (0, 0, 0, 1)
    return scene.world


def add_white_facets(normals: np.ndarray) -> bpy.types.Object:
    """A white diffuse mesh of one small triangle per normal (n, 3), on a large sphere: none shadows another."""
    helper = np.where(np.abs(normals[:, 2:]) < 0.9, [[0.0, 0, 1]], [[1.0, 0, 0]])
    tangent = np.cross(helper, normals)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    bitangent = np.cross(normals, tangent)
    turns = 2 * math.pi * np.arange(3) / 3
    offsets = 0.1 * (np.cos(turns)[:, None, None] * tangent + np.sin(turns)[:, None, None] * bitangent)
    corners = (100 * normals + offsets).transpose(1, 0, 2).reshape(-1, 3)
    mesh = bpy.data.meshes.new("Facets")
    mesh.from_pydata(corners.tolist(), [], np.arange(len(corners)).reshape(-1, 3).tolist())
    mesh.materials.append(diffuse_material("White", (1, 1, 1, 1)))
    facets = bpy.data.objects.new("Facets", mesh)
    bpy.context.scene.collection.objects.link(facets)
    return facets


def diffuse_material(name: str, colour: tuple[float, float, float, float]) -> bpy.types.Material:
    """A material of one Diffuse BSDF: the only one whose bake is its colour times irradiance over pi."""
    material = bpy.data.materials.new(name)
    if material.node_tree is None:
        material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    output, diffuse = tree.nodes.new("ShaderNodeOutputMaterial"), tree.nodes.new("ShaderNodeBsdfDiffuse")
    diffuse.inputs["Color"].default_value = colour
    tree.links.new(diffuse.outputs[0], output.inputs[0])
    return material


def baked_irradiance(facets: bpy.types.Object) -> np.ndarray:
    """Irradiance over pi (n, 3) of every facet, direct light only: the mean of its three baked vertices."""
    mesh = facets.data
    attribute = mesh.color_attributes.get("bake") or mesh.color_attributes.new("bake", "FLOAT_COLOR", "POINT")
    mesh.color_attributes.active_color = attribute
    bpy.context.view_layer.objects.active = facets
    facets.select_set(True)
    bpy.context.scene.render.bake.use_pass_color = False
    bpy.ops.object.bake(type="DIFFUSE", pass_filter={"DIRECT"}, target="VERTEX_COLORS", use_clear=True)
    colours = np.empty(4 * len(mesh.vertices), np.float32)
    mesh.color_attributes["bake"].data.foreach_get("color", colours)
    return colours.reshape(-1, 3, 4)[:, :, :3].mean(axis=1).astype(np.float64)


def smooth_environment(width: int = 256) -> np.ndarray:
    """A smooth coloured equirectangular environment (width / 2, width, 3) without symmetry, radiance 0.2 to 4."""
    from prt_addon.lighting.environment import direction_of_pixel

    rows, columns = np.arange(width // 2)[:, None], np.arange(width)[None, :]
    directions = direction_of_pixel(rows, columns, width // 2, width)
    image = np.full((width // 2, width, 3), 0.2)
    for axis, sharpness, colour in (((0.7, 0.2, 0.6), 4.0, (3.0, 2.4, 1.6)), ((-0.5, 0.8, 0.3), 3.0, (0.3, 0.8, 1.4)),
                                    ((0.1, -0.9, -0.3), 2.0, (0.5, 0.2, 0.4))):
        towards = np.asarray(axis) / np.linalg.norm(axis)
        image += np.exp(sharpness * ((directions * towards).sum(axis=-1, keepdims=True) - 1.0)) * np.asarray(colour)
    return image.astype(np.float32)


def environment_world(image: np.ndarray, degrees: float, folder) -> bpy.types.World:
    """Give the scene a world of this equirectangular image, turned by a Mapping node (type Point)."""
    from pathlib import Path

    import OpenEXR

    # Not by Blender's own save: that writes such a picture through the sRGB curve, in which Cycles then interpolates:
    # a sun of a few pixels lost a sixth of its light.
    path = Path(folder) / "environment.exr"
    with OpenEXR.File({}, {"RGB": np.ascontiguousarray(image, np.float32)}) as file:
        file.write(str(path))
    world = bpy.data.worlds.new("Environment")
    if world.node_tree is None:
        world.use_nodes = True
    tree = world.node_tree
    texture, mapping = tree.nodes.new("ShaderNodeTexEnvironment"), tree.nodes.new("ShaderNodeMapping")
    coordinate = tree.nodes.new("ShaderNodeTexCoord")
    texture.image = bpy.data.images.load(str(path))
    texture.image.colorspace_settings.name = "Linear Rec.709"
    mapping.inputs["Rotation"].default_value = (0.0, 0.0, math.radians(degrees))
    tree.links.new(coordinate.outputs["Generated"], mapping.inputs["Vector"])
    tree.links.new(mapping.outputs["Vector"], texture.inputs["Vector"])
    tree.links.new(texture.outputs["Color"], tree.nodes["Background"].inputs["Color"])
    bpy.context.scene.world = world
    return world


# Everything that a camera sees of a surface, colours included.
ALL_LIGHT = {"DIRECT", "INDIRECT", "DIFFUSE", "GLOSSY", "TRANSMISSION", "EMIT"}


def vertex_radiance(thing: bpy.types.Object, passes: set[str], seed: int = 0) -> np.ndarray:
    """Exit radiance (v, 3) of an object's vertices under the scene's light, baked by Cycles: for unit albedo and of
    diffuse light, or, with the pass GLOSSY as in ALL_LIGHT, what goes towards the scene's camera, colours included."""
    mesh = thing.data
    attribute = mesh.color_attributes.get("bake") or mesh.color_attributes.new("bake", "FLOAT_COLOR", "POINT")
    mesh.color_attributes.active_color = attribute
    bpy.ops.object.select_all(action="DESELECT")
    bpy.context.view_layer.objects.active = thing
    thing.select_set(True)
    bpy.context.scene.cycles.seed = seed
    bake = bpy.context.scene.render.bake
    bake.use_pass_color, bake.view_from = False, "ACTIVE_CAMERA" if "GLOSSY" in passes else "ABOVE_SURFACE"
    bpy.ops.object.bake(type="COMBINED" if "GLOSSY" in passes else "DIFFUSE", pass_filter=passes,
                        target="VERTEX_COLORS", use_clear=True)
    colours = np.empty(4 * len(mesh.vertices), np.float32)
    mesh.color_attributes["bake"].data.foreach_get("color", colours)
    mesh.color_attributes.remove(mesh.color_attributes["bake"])
    return colours.reshape(-1, 4)[:, :3].astype(np.float64)


def shown_radiance(thing: bpy.types.Object, passes: set[str], vertices: np.ndarray, seed: int = 0) -> np.ndarray:
    """Exit radiance (v, 3) that Cycles shows around some vertices of an object; passes: as for `vertex_radiance`.

    A vertex bake stands on the corner itself, where Cycles leaves out only the one face that a ray starts on and lets
    part of the light from under it through; on coarse smooth-shaded meshes no render shows that value. What a render
    shows is the faces' insides: here a small probe lies on each face next to the vertex, with the vertex's shading
    normal, lit by everything and hiding nothing; the vertex gets the mean over its faces by their angles. Let the world
    be found by the surface's own samples alone (`sampling_method` NONE): Cycles starts samples of the light from under
    a face 1e-5 away from it, which on folds of small meshes is the other side of the body.
    """
    probes, owner, weight = _add_probes(thing, vertices)
    colours = vertex_radiance(probes, passes, seed).reshape(-1, 3, 3).mean(axis=1)
    mesh = probes.data
    bpy.data.objects.remove(probes)
    bpy.data.meshes.remove(mesh)
    total = np.stack([np.bincount(owner, weight * colours[:, k], len(vertices)) for k in range(3)], axis=1)
    return total / np.bincount(owner, weight, len(vertices))[:, None]


# Places of a probe's corners on the way from the vertex to the middle of its face and its edges' ends.
PROBE_NEAR, PROBE_SIZE = 0.02, 0.01
# Its height above the face, as a share of its distance to the face's edges (a higher one would look over the next face
# of a fold) and, at least, of the object's diagonal (single precision).
PROBE_HEIGHT, PROBE_LEAST = 0.1, 5e-7


def _add_probes(thing: bpy.types.Object, vertices: np.ndarray) -> tuple[bpy.types.Object, np.ndarray, np.ndarray]:
    """Probes at every triangle corner of the vertices; the place (n,) of each one's vertex and its corner's angle."""
    mesh = thing.data
    mesh.calc_loop_triangles()
    triangles = np.empty((len(mesh.loop_triangles), 3), np.int32)
    mesh.loop_triangles.foreach_get("vertices", triangles.ravel())
    points, normals = np.empty((2, len(mesh.vertices), 3), np.float32)
    mesh.vertices.foreach_get("co", points.ravel())
    mesh.vertex_normals.foreach_get("vector", normals.ravel())
    points = points.astype(np.float64)
    place = np.full(len(points), -1)
    place[vertices] = np.arange(len(vertices))
    face, corner = np.nonzero(place[triangles] >= 0)
    a, b, c = (points[triangles[face, (corner + k) % 3]] for k in range(3))
    across = np.cross(b - a, c - a)
    area = np.linalg.norm(across, axis=1)
    kept = area > 1e-12 * area.max()
    face, corner, a, b, c, across, area = (x[kept] for x in (face, corner, a, b, c, across, area))
    cosine = np.sum((b - a) * (c - a), axis=1) / (np.linalg.norm(b - a, axis=1) * np.linalg.norm(c - a, axis=1))
    start = a + PROBE_NEAR * ((a + b + c) / 3 - a)
    around = sum(np.linalg.norm(side, axis=1) for side in (b - a, c - b, a - c))
    height = np.maximum(PROBE_HEIGHT * PROBE_NEAR * area / around, PROBE_LEAST * np.linalg.norm(np.ptp(points, axis=0)))
    start += height[:, None] * across / area[:, None]
    corners = np.stack([start, start + PROBE_SIZE * (b - a), start + PROBE_SIZE * (c - a)], axis=1)
    probes = bpy.data.meshes.new("Probes")
    probes.from_pydata(corners.reshape(-1, 3).tolist(), [], np.arange(3 * len(a)).reshape(-1, 3).tolist())
    probes.polygons.foreach_set("use_smooth", np.ones(len(a), bool))
    owner = triangles[face, corner]
    probes.normals_split_custom_set(np.repeat(normals[owner], 3, axis=0).tolist())
    probes.materials.append(mesh.materials[0])
    added = bpy.data.objects.new("Probes", probes)
    bpy.context.scene.collection.objects.link(added)
    added.matrix_world = thing.matrix_world
    added.visible_shadow = False
    return added, place[owner], np.arccos(np.clip(cosine, -1.0, 1.0))
