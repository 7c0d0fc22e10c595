# SPDX-License-Identifier: GPL-3.0-or-later
"""Surfaces drawn from texels, pixel by pixel against the CPU's filtering of the same texels where a ray meets them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import bpy
import numpy as np
import pytest

from tests.blender.gpu_support import made_up_bake, require_gpu  # makes the checkout the package `prt`
from tests.core import shapes

# isort: split
from prt.gpu_shaders import offscreen, programs
from prt.gpu_shaders.render_data import DrawItem, FalseColours
from prt.prt_addon.relighting.texel_light import texel_radiance
from prt.prt_addon.scene.object_mesh import ObjectMesh
from prt.prt_addon.scene.scene_mesh import SceneMesh
from prt.prt_addon.scene.surface_textures import SurfaceTextures, TextureUse
from prt.prt_addon.scene.texel_receivers import TexelChoice
from prt.prt_addon.tracing.tracer import Tracer

SIZE = 96
FUNCTIONS = (0, 1, 2, 3)


@pytest.fixture(scope="module", autouse=True)
def graphics() -> Iterator[None]:
    require_gpu()
    yield
    programs.release()


def texel_bake(mesh: Any, functions: tuple[int, ...] = (), side: int = 40, seed: int = 3) -> Any:
    """A bake at an object's texels with random numbers in every place."""
    own = ObjectMesh(**{name: getattr(mesh, name) for name in mesh.__dataclass_fields__ if name != "materials"})
    scene = SceneMesh.assemble([own], 0.0, None, TexelChoice("texels", side))
    generator = np.random.default_rng(seed)
    baked = made_up_bake(scene.points.astype(np.float32), scene.triangles, generator, clusters=3, vectors=5,
                         functions=functions)
    return replace(baked, normals=scene.normals.astype(np.float32), albedo=scene.albedo,
                   tangents=scene.tangents.astype(np.float32) if functions else None, texels=scene.surfaces[0])


def view() -> tuple[np.ndarray, np.ndarray]:
    """A perspective transform to clip space and the eye."""
    eye = np.array([2.6, 1.9, 2.2])
    back = eye / np.linalg.norm(eye)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    turn = np.stack([right, np.cross(back, right), back])
    placed = np.eye(4)
    placed[:3, :3], placed[:3, 3] = turn, -turn @ eye
    near, far, focal = 0.1, 20.0, 2.2
    project = np.array([[focal, 0, 0, 0], [0, focal, 0, 0], [0, 0, (far + near) / (near - far),
                                                            2 * far * near / (near - far)], [0, 0, -1, 0]])
    return project @ placed, eye


def seen(baked: Any) -> tuple[np.ndarray, Any, np.ndarray]:
    """Pixels (k,) that see a triangle well inside, the triangle, u, v there, and the views to the eye."""
    transform, eye = view()
    x, y = np.meshgrid((np.arange(SIZE) + 0.5) / SIZE * 2 - 1, 1 - (np.arange(SIZE) + 0.5) / SIZE * 2)
    back = np.linalg.inv(transform)
    far = np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.9), np.ones(x.size)], axis=1) @ back.T
    far = far[:, :3] / far[:, 3:]
    tracer = Tracer(baked.texels.points, baked.texels.triangles, 1)
    directions = (far - eye) / np.linalg.norm(far - eye, axis=1, keepdims=True)
    hits = tracer.nearest(np.repeat(tracer.to_tracing_space(eye[None]), x.size, axis=0), directions.astype(np.float32))
    inner = (hits.triangle >= 0) & (np.minimum(np.minimum(hits.u, hits.v), 1 - hits.u - hits.v) > 0.02)
    kept = np.flatnonzero(inner)
    return kept, hits, -directions[kept]


def light(columns: int) -> np.ndarray:
    values = np.random.default_rng(1).normal(0.0, 0.1, (columns, 3))
    values[0] += 3.0
    return values.astype(np.float32)


@pytest.mark.parametrize("functions", [(), FUNCTIONS, (0,)])
@pytest.mark.parametrize("shape", ["cube", "sphere"])
def test_pixels_are_the_texels_around_them(shape: str, functions: tuple[int, ...]) -> None:
    mesh = shapes.box(low=(-1, -1, -1), albedo=(0.6, 0.4, 0.2)) if shape == "cube" else shapes.sphere(subdivisions=2)
    baked = texel_bake(mesh, functions)
    lit, transform = light(baked.columns), view()[0]
    direct = np.random.default_rng(2).uniform(0.0, 1.0, (len(baked.positions), baked.bases.shape[2], 3))
    direct = direct.astype(np.float32)
    drawn = offscreen.draw_view([DrawItem(0, baked, np.eye(4), lit, direct=direct)], transform, SIZE, SIZE, samples=1)
    kept, hits, views = seen(baked)
    expected = texel_radiance(baked, lit, hits.triangle[kept], hits.u[kept], hits.v[kept], views, direct)
    found = drawn.reshape(-1, 4)[kept, :3]
    assert len(kept) > 1500
    difference = np.abs(found - np.maximum(expected, 0.0))
    # Rays and rasterisation find places a little apart; the numbers are random from texel to texel.
    assert np.quantile(difference, 0.99) < 0.02 and difference.mean() < 2e-3
    assert expected.std() > 0.1


def test_false_colours_and_images_are_shown_on_texels() -> None:
    baked = texel_bake(shapes.box(low=(-1, -1, -1)), FUNCTIONS)
    kept, hits, _ = seen(baked)
    colours = np.random.default_rng(4).uniform(0.0, 1.0, (len(baked.positions), 3)).astype(np.float32)
    lit, transform = light(baked.columns), view()[0]
    item = DrawItem(0, baked, np.eye(4), lit, colours=FalseColours(colours))
    drawn = offscreen.draw_view([item], transform, SIZE, SIZE, samples=1).reshape(-1, 4)[kept, :3]
    expected = baked.texels.layout.sample(colours, hits.triangle[kept], hits.u[kept], hits.v[kept])
    assert np.quantile(np.abs(drawn - expected), 0.99) < 0.02
    image = bpy.data.images.new("grey", 2, 2, float_buffer=True)
    image.pixels.foreach_set(np.tile(np.array([0.25, 0.5, 0.75, 1.0], np.float32), 4))
    count = len(baked.texels.triangles)
    use = TextureUse(("grey", None), (1.0, 1.0, 1.0), True, "REPEAT")
    textures = SurfaceTextures((use,), np.zeros(count, np.int32), np.full((count, 3, 2), 0.5, np.float32), 1)
    plain = replace(baked, albedo=np.tile(np.array([0.25, 0.5, 0.75], np.float32), (len(baked.positions), 1)))
    try:
        with_image, without = (offscreen.draw_view([DrawItem(0, b, np.eye(4), lit, textures=t)], transform, SIZE, SIZE,
                                                   samples=1) for b, t in ((baked, textures), (plain, None)))
    finally:
        bpy.data.images.remove(image)
    assert np.allclose(with_image, without, atol=2e-3)
