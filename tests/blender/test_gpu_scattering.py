# SPDX-License-Identifier: GPL-3.0-or-later
"""The passes of live subsurface light on the graphics card against those on the processor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.blender.gpu_support import made_up_bake, require_gpu


@pytest.fixture(scope="module", autouse=True)
def gpu() -> None:
    require_gpu()


def linked_bake(functions: tuple[int, ...], seed: int = 3):
    """A made-up bake on a ball, all of it but its first points translucent."""
    from prt.prt_addon.relighting.live_scattering import SubsurfaceLinks
    from prt.prt_addon.relighting.subsurface_texels import link_texels
    from prt.prt_addon.transport.dipole import Medium
    from prt.prt_addon.transport.subsurface_links import adaptive_links
    from prt.prt_addon.transport.surface_pyramid import SurfacePyramid

    random = np.random.default_rng(seed)
    points = random.normal(size=(700, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    triangles = random.integers(0, 700, (50, 3)).astype(np.int32)
    baked = made_up_bake(points.astype(np.float32), triangles, random, functions=functions)
    body = np.zeros(660, np.int64)
    body[500:] = 1
    chosen = np.arange(40, 700)
    pyramid = SurfacePyramid.over_points(points[chosen], points[chosen], np.full(660, 4.0 * np.pi / 660), body)
    used = pyramid.texel >= 0
    places = np.zeros((int(pyramid.start[1]), 4), np.float32)
    places[:, 0] = np.where(used, chosen[pyramid.texel], -1)
    places[used, 1:] = 0.7, 0.9, 4.0 * np.pi / 660
    row, texels = np.cumsum(used) - 1, np.zeros((660, 32, 4), np.float32)
    medium = Medium.of_principled((0.9, 0.6, 0.3), (2.0, 1.0, 0.5))
    for number in (0, 1):
        mine = np.flatnonzero(used & (body[pyramid.texel] == number))
        texels[row[mine]] = link_texels(adaptive_links(pyramid, mine, medium, 32, body=number))
    return replace(baked, links=SubsurfaceLinks(places, texels, pyramid.levels))


@pytest.mark.parametrize("functions", [(), (0,), (0, 1, 2, 3)])
@pytest.mark.parametrize("with_bounces", [False, True])
def test_the_card_gives_what_the_processor_gives(functions: tuple[int, ...], with_bounces: bool) -> None:
    from prt.gpu_shaders.render_data import texture_values
    from prt.gpu_shaders.scattering import ScatteringPasses, bounced_texture, fits
    from prt.gpu_shaders.textures import make_texture, read_texture
    from prt.prt_addon.relighting.live_scattering import LiveScattering

    baked = linked_bake(functions)
    live, random, rows = LiveScattering(baked), np.random.default_rng(0), 1 + len(functions)
    direct = random.uniform(0.0, 2.0, (700, rows, 3)).astype(np.float32)
    bounced = random.uniform(0.0, 1.0, (700, 3)).astype(np.float32) if with_bounces else None
    wanted = live.added(direct, bounced)
    passes = ScatteringPasses(live)
    assert fits(live) and passes.seconds(700, rows) > 0.0
    found = read_texture(passes.run(make_texture(texture_values(direct.reshape(-1, 3))),
                                    None if bounced is None else bounced_texture(bounced), 700, rows))
    found = found.reshape(-1, 4)[:700 * rows, :3].reshape(700, rows, 3)
    assert found == pytest.approx(wanted, abs=2e-5 * float(np.abs(wanted).max()))
    assert np.abs(found - direct).max() > 0.1  # something was done
    assert np.array_equal(found[:40], direct[:40])  # not to what is not translucent


def test_a_drawing_scatters_where_it_is_asked_to() -> None:
    """And finds out once how long that takes where it is not."""
    from prt.gpu_shaders.draw import ObjectDrawing
    from prt.gpu_shaders.render_data import LampScattering, make_render_data
    from prt.gpu_shaders.textures import read_texture
    from prt.prt_addon.relighting.live_scattering import LiveScattering

    baked = linked_bake((0,))
    live, drawing = LiveScattering(baked), ObjectDrawing(make_render_data(baked))
    direct = np.random.default_rng(1).uniform(0.0, 1.0, (700, 2, 3)).astype(np.float32)
    wanted = live.added(direct, None)
    assert not live.prefers_card
    drawing.add_direct(wanted, LampScattering(live))
    assert live.card_seconds > 0.0
    drawing.add_direct(direct, LampScattering(live, on_card=True))
    found = read_texture(drawing._direct).reshape(-1, 4)[:1400, :3].reshape(700, 2, 3)
    assert found == pytest.approx(wanted, abs=2e-5 * float(np.abs(wanted).max()))
    drawing.add_direct(direct)
    found = read_texture(drawing._direct).reshape(-1, 4)[:1400, :3].reshape(700, 2, 3)
    assert np.array_equal(found, direct)


def test_links_that_fit_no_texture_stay_with_the_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    from prt.gpu_shaders import scattering
    from prt.gpu_shaders.draw import ObjectDrawing
    from prt.gpu_shaders.render_data import LampScattering, make_render_data
    from prt.prt_addon.relighting.live_scattering import LiveScattering

    monkeypatch.setattr(scattering, "LARGEST_TEXTURE", 1)  # rows of texels
    baked = linked_bake((0,))
    live, drawing = LiveScattering(baked), ObjectDrawing(make_render_data(baked))
    wanted = live.added(np.ones((700, 2, 3), np.float32), None)
    drawing.add_direct(wanted, LampScattering(live))
    assert live.card_seconds == np.inf and not live.prefers_card
