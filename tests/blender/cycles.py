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
    scene.world = bpy.data.worlds.new("World")
    if scene.world.node_tree is None:
        scene.world.use_nodes = True
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
    mesh.materials.append(_white())
    facets = bpy.data.objects.new("Facets", mesh)
    bpy.context.scene.collection.objects.link(facets)
    return facets


def _white() -> bpy.types.Material:
    material = bpy.data.materials.new("White")
    if material.node_tree is None:
        material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    output, diffuse = tree.nodes.new("ShaderNodeOutputMaterial"), tree.nodes.new("ShaderNodeBsdfDiffuse")
    diffuse.inputs["Color"].default_value = (1, 1, 1, 1)
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
