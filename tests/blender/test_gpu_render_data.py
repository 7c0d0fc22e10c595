# SPDX-License-Identifier: GPL-3.0-or-later
"""The arrays that go to the GPU, without a GPU."""

from __future__ import annotations

import dataclasses
import subprocess
import sys

import numpy as np
import pytest

from tests.blender import gpu_support  # makes the checkout the package `prt`

# isort: split
from prt.gpu_shaders import render_data
from prt.prt_addon.errors import BadScene


def bake(seed: int = 1, **options: int) -> object:
    generator = np.random.default_rng(seed)
    return gpu_support.made_up_bake(*gpu_support.grid_mesh(7, generator), generator, **options)


@pytest.mark.parametrize("vectors", [0, 1, 3, 4, 8, 24])
def test_encoding_holds_the_cluster_and_every_weight_where_the_shader_looks(vectors: int) -> None:
    baked = bake(clusters=9, vectors=vectors)
    data = render_data.make_render_data(baked)
    texels = data.encoding.reshape(-1, 4)
    per_point = vectors // 4 + 1
    numbers = texels[: data.points * per_point].reshape(data.points, -1)
    assert np.array_equal(numbers[:, 0], baked.cluster)
    assert np.array_equal(numbers[:, 1 : vectors + 1], baked.weights)
    assert not texels[data.points * per_point :].any()


def test_a_million_points_fit_two_dimensional_textures() -> None:
    cluster = np.arange(1_000_000) % 300
    encoding = render_data.encode(cluster, np.zeros((1_000_000, 24), np.float32))
    height, width, _ = encoding.shape
    assert max(height, width) <= render_data.LARGEST_TEXTURE
    assert encoding.reshape(-1)[999_999 * 28] == cluster[-1]  # 7 texels of 4 numbers per point


def test_what_does_not_fit_is_refused_by_name() -> None:
    with pytest.raises(BadScene, match="do not fit a texture"):
        render_data.texture_height(render_data.LARGEST_TEXTURE * render_data.TEXTURE_WIDTH + 1)


@pytest.mark.parametrize("name", ["cluster", "weights", "bases", "albedo", "positions", "triangles"])
def test_signature_changes_with_every_array_that_is_drawn_and_only_then(name: str) -> None:
    baked = bake(clusters=3, vectors=2)
    same = dataclasses.replace(baked, **{name: getattr(baked, name).copy()})
    assert render_data.transfer_signature(same) == render_data.transfer_signature(baked)
    changed = getattr(baked, name).copy()
    changed.flat[-1] += 1
    assert render_data.transfer_signature(dataclasses.replace(baked, **{name: changed})) != (
        render_data.transfer_signature(baked)
    )


def test_light_signature_ignores_exposure_and_sees_light_and_heat() -> None:
    baked = bake()
    item = render_data.DrawItem("key", baked, np.eye(4), np.ones((25, 3)))
    signature = render_data.light_signature(item)
    assert render_data.light_signature(dataclasses.replace(item, exposure=2.0, stale=True)) == signature
    brighter = dataclasses.replace(item, light=np.full((25, 3), 1.001))
    assert render_data.light_signature(brighter) != signature
    heated = dataclasses.replace(item, heat=np.zeros(49))
    assert render_data.light_signature(heated) != signature


def test_light_of_a_higher_order_is_cut_and_of_a_lower_one_refused() -> None:
    light = np.arange(108.0).reshape(36, 3)
    assert np.array_equal(render_data.matching_light(light, 25), light[:25])
    for wrong in (light[:24], light[:, :2], light[0]):
        with pytest.raises(BadScene, match="the light"):
            render_data.matching_light(wrong, 25)


def test_clip_transform_moves_towards_the_viewer_by_the_bias() -> None:
    generator = np.random.default_rng(2)
    view_projection, matrix = generator.normal(size=(2, 4, 4))
    point = np.array([0.3, -0.2, 0.5, 1.0])
    exact = view_projection @ matrix @ point
    biased = render_data.clip_transform(view_projection, matrix) @ point
    assert np.allclose(biased[[0, 1, 3]], exact[[0, 1, 3]], rtol=1e-12)
    assert biased[2] / biased[3] - exact[2] / exact[3] == pytest.approx(-1e-6, rel=1e-6)


def test_heat_colours_grow_in_luminance() -> None:
    colours = render_data.heat_colours(np.linspace(0.0, 1.0, 101))
    luminance = colours @ (0.2126, 0.7152, 0.0722)
    assert (np.diff(luminance) > 0).all()
    assert np.array_equal(colours[[0, -1]], [[0, 0, 0], [1, 1, 1]])


def test_render_data_imports_neither_gpu_nor_bpy() -> None:
    code = (
        "import sys; from tests.blender import gpu_support; import prt.gpu_shaders.render_data;"
        "assert not {'gpu', 'bpy', 'mathutils'} & set(sys.modules), 'imported'"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=gpu_support.ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
