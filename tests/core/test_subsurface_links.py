# SPDX-License-Identifier: GPL-3.0-or-later
"""Links of live subsurface light against the closed form of a sphere and the plain double sum."""

from __future__ import annotations

import numpy as np
import pytest

from prt_addon.errors import StorageError
from prt_addon.relighting.live_scattering import CONSTANT, LiveScattering, SubsurfaceLinks
from prt_addon.relighting.subsurface_texels import link_texels, unpacked_links
from prt_addon.storage.subsurface_links import ENTRY, flatten_links, links_entry, read_links
from prt_addon.transport.dipole import Medium, disc_integral
from prt_addon.transport.subsurface_links import adaptive_links, full_sum, level_links
from prt_addon.transport.surface_pyramid import SurfacePyramid, morton_texels, quadtree_order
from prt_addon.transport.surface_texels import texels_on_mesh
from tests.core.shapes import sphere

NUMBER = 4096


def ball(number: int = NUMBER, radius: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of equal area on a sphere, normals, areas."""
    index = np.arange(number) + 0.5
    z, turn = 1.0 - 2.0 * index / number, index * np.pi * (1.0 + np.sqrt(5.0))
    normals = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)
    return radius * normals, normals, np.full(number, 4.0 * np.pi * radius**2 / number)


def medium_of(path: float, colour: float = 0.8) -> Medium:
    return Medium.of_principled((colour, 0.5 * colour, 0.25 * colour), 4.0 * np.pi * np.array([path, path, 0.5 * path]))


def half_lit(normals: np.ndarray) -> np.ndarray:
    return np.repeat(np.maximum(normals[:, :1], 0.0), 3, axis=1).astype(np.float32)


def relative(found: np.ndarray, wanted: np.ndarray) -> float:
    return float(np.sqrt(np.mean((found.astype(float) - wanted) ** 2) / np.mean(wanted.astype(float) ** 2)))


# The pyramid.

@pytest.mark.parametrize("number", [1, 3, 4, 5, 64, 100])
def test_every_level_holds_the_whole_surface(number: int) -> None:
    random = np.random.default_rng(number)
    points, areas = random.normal(size=(number, 3)), random.uniform(0.5, 2.0, number)
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    pyramid = SurfacePyramid.over_points(points, normals, areas)
    light = random.uniform(0.0, 1.0, (number, 3)).astype(np.float32)
    means = pyramid.means(light)
    for level in range(pyramid.levels):
        part = slice(pyramid.start[level], pyramid.start[level + 1])
        assert pyramid.area[part].sum() * pyramid.size**2 == pytest.approx(areas.sum(), rel=1e-5)
        flux = (pyramid.area[part, None] * means[part]).sum(axis=0) * pyramid.size**2
        assert flux == pytest.approx((areas[:, None] * light).sum(axis=0), rel=1e-4)
    root = pyramid.roots[0]
    assert root == len(pyramid.area) - 1 and sorted(pyramid.texel[pyramid.texel >= 0]) == list(range(number))
    middle = (areas[:, None] * points).sum(axis=0) / areas.sum()
    apart = points - middle
    wanted = (areas[:, None, None] * apart[:, :, None] * (light - means[root])[:, None]).sum(axis=0) / areas.sum()
    assert pyramid.moments(means)[root] * pyramid.size == pytest.approx(wanted, abs=1e-5)
    # the second moment, the texels' own discs (of unit variance A / 2 pi in all) included
    spread = (areas * (np.sum(apart**2, axis=1) + areas / (2.0 * np.pi))).sum() / areas.sum()
    assert pyramid.covariance[root, :3].sum() * pyramid.size**2 == pytest.approx(spread, rel=1e-4)


def test_runs_of_texels_lie_close_together() -> None:
    points = ball()[0]
    order = quadtree_order(points)
    assert sorted(order) == list(range(NUMBER))
    width = np.ptp(points[order].reshape(-1, 64, 3), axis=1).max(axis=1)
    # 64 of 4096: a cap of 1/64 of the sphere has the diameter 0.5
    assert width.mean() < 0.6 and width.max() < 0.9


def test_an_image_is_a_pyramid_of_its_mip_levels() -> None:
    side, random = 8, np.random.default_rng(0)
    values = random.uniform(size=(side, side, 3)).astype(np.float32)
    y, x = np.mgrid[:side, :side]
    points = np.stack([x, y, np.zeros_like(x)], axis=2).astype(float)
    areas = np.ones((side, side))
    areas[0, :3] = 0.0
    pyramid = SurfacePyramid.over_image(points, np.tile([0.0, 0.0, 1.0], (side, side, 1)), areas)
    means = pyramid.means(values.reshape(-1, 3))
    weighted = (values * areas[..., None]).reshape(4, 2, 4, 2, 3).sum(axis=(1, 3))
    mip = weighted / areas.reshape(4, 2, 4, 2).sum(axis=(1, 3))[..., None].clip(1e-9)
    assert means[pyramid.start[1]:pyramid.start[1] + 16] == pytest.approx(mip.reshape(-1, 3)[morton_texels(4)],
                                                                           abs=1e-6)
    with pytest.raises(ValueError, match="power of two"):
        SurfacePyramid.over_image(points[:6, :6], points[:6, :6], areas[:6, :6])


def test_texels_of_a_mesh_share_its_area_evenly() -> None:
    mesh = sphere(subdivisions=2)
    texels = texels_on_mesh(mesh.positions, mesh.positions, mesh.triangles, 1000)
    corners = mesh.positions[mesh.triangles]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    assert texels.areas.sum() == pytest.approx(area.sum())
    count = np.bincount(texels.triangle, minlength=len(area))
    assert np.abs(count - 1000 * area / area.sum()).max() <= 1.0
    assert texels.weights.min() >= 0.0 and texels.weights.sum(axis=1) == pytest.approx(1.0)
    assert np.sum(texels.weights[:, :, None] * corners[texels.triangle], axis=1) == pytest.approx(texels.points)


# Links.

@pytest.mark.parametrize("path", [0.3, 0.1, 0.03])
def test_a_sphere_gives_its_closed_form(path: float) -> None:
    """Chords of a sphere have the same area at each length as a plane: all of it is a disc of radius 2."""
    pyramid, medium = SurfacePyramid.over_points(*ball()), medium_of(path)
    exact = [float(disc_integral(medium.poles(channel, 1.0), 4.0)) for channel in range(3)]
    some = np.arange(0, NUMBER, 97)
    ones = np.ones((len(pyramid.area), 3), np.float32)
    assert full_sum(pyramid, some, medium, ones).mean(axis=0) == pytest.approx(exact, rel=1e-2)
    assert adaptive_links(pyramid, some, medium, 64).sums.mean(axis=0) == pytest.approx(exact, rel=1e-2)
    assert adaptive_links(pyramid, some, medium, 16).sums.mean(axis=0) == pytest.approx(exact, rel=3e-2)
    assert level_links(pyramid, some, medium, 2).sums.mean(axis=0) == pytest.approx(exact, rel=4e-2)


def test_more_links_are_nearer_to_the_double_sum() -> None:
    points, normals, areas = ball()
    pyramid, medium = SurfacePyramid.over_points(points, normals, areas), medium_of(0.1)
    means = pyramid.means(half_lit(normals))
    some = np.arange(0, NUMBER, 41)
    full, moments = full_sum(pyramid, some, medium, means), pyramid.moments(means)
    errors = {}
    for links, most in ((4, 0.5), (16, 0.13), (64, 0.035), (256, 0.008)):
        found = adaptive_links(pyramid, some, medium, links)
        plain, shifted = relative(found.gathered(means), full), relative(found.gathered(means, moments), full)
        fixed = relative(level_links(pyramid, some, medium, links.bit_length() // 2).gathered(means), full)
        assert plain < most and (plain < fixed or links == 4), (links, plain, fixed)
        assert shifted < (0.7 if links < 256 else 1.0) * plain, (links, plain, shifted)
        errors[links] = shifted
    assert errors[16] < 0.06 and errors[64] < 0.015


def test_every_texel_linked_is_the_double_sum() -> None:
    points, normals, areas = ball(64)
    pyramid, medium = SurfacePyramid.over_points(points, normals, areas), medium_of(0.3)
    means, places = pyramid.means(half_lit(normals)), np.arange(64)
    found = adaptive_links(pyramid, places, medium, 64)
    assert found.gathered(means) == pytest.approx(full_sum(pyramid, places, medium, means), abs=2e-6)
    assert np.all(np.sort(found.node, axis=1) == np.arange(64))


def test_light_stays_in_its_body_and_threads_change_nothing() -> None:
    points, normals, areas = ball(300)
    two = np.concatenate([points, 0.5 * points[:77] + np.array([3.0, 0.0, 0.0])])
    body = np.repeat([1, 0], [300, 77])
    pyramid = SurfacePyramid.over_points(two, np.concatenate([normals, normals[:77]]),
                                         np.concatenate([areas, areas[:77]]), body)
    medium = medium_of(0.2)
    light = np.zeros((377, 3), np.float32)
    light[300:] = 1.0
    means = pyramid.means(light)
    mine = pyramid.place(377)
    found = adaptive_links(pyramid, mine[:300], medium, 16, body=1)
    assert np.all(found.gathered(means, pyramid.moments(means)) == 0.0) and found.sums.min() > 0.05
    assert adaptive_links(pyramid, mine[300:], medium, 16, body=0).gathered(means).min() > 0.05
    long = np.tile(mine[:300], 8)
    one, four = (adaptive_links(pyramid, long, medium, 16, body=1, threads=threads) for threads in (1, 4))
    assert np.array_equal(one.node, four.node) and np.array_equal(one.factor, four.factor)


def test_a_sheet_gives_no_more_than_it_gets() -> None:
    """Two faces a hundredth of the mean free path apart: each gives R once, and never more than 1 in all."""
    line = (np.arange(40) + 0.5) / 40 - 0.5
    x, y = np.meshgrid(line, line)
    face = np.stack([x.ravel(), y.ravel(), np.zeros(1600)], axis=1)
    points = np.concatenate([face, face + np.array([0.0, 0.0, 1e-4])])
    normals = np.repeat([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]], 1600, axis=0)
    pyramid = SurfacePyramid.over_points(points, normals, np.full(3200, 1.0 / 1600))
    medium = medium_of(0.01, 0.95)
    inside = np.flatnonzero((np.abs(points[pyramid.texel, :2]) < 0.2).all(axis=1) & (pyramid.texel >= 0))
    found = adaptive_links(pyramid, inside, medium, 32)
    assert found.sums.max() <= 1.0 + 1e-5 and found.sums[:, 0].min() > 0.9
    assert found.sums[:, 2].max() <= 2.0 * 0.95 * 0.25 + 1e-3
    assert found.bounded[0] > 0.2  # twice 0.95 was brought down to 1


# As stored.

def test_links_survive_their_packing() -> None:
    points, normals, areas = ball(500)
    pyramid = SurfacePyramid.over_points(points, normals, areas)
    links = adaptive_links(pyramid, np.arange(500), medium_of(0.05), 16)
    texels = link_texels(links)
    bits = texels.view(np.uint32)
    exponent = (bits >> 23) & 0xFF
    assert np.isfinite(texels).all() and not np.any((exponent == 0) & (bits << 1 != 0))  # no denormal numbers
    back = unpacked_links(texels)
    assert np.array_equal(back.node, links.node)
    assert back.factor == pytest.approx(links.factor, rel=1e-3, abs=1e-7)
    assert back.shift == pytest.approx(links.shift, rel=1e-3, abs=2e-4)


class Bake:
    """What live scattering reads of a bake."""

    def __init__(self, number: int = 500, functions: tuple[int, ...] = (0,)) -> None:
        self.positions, self.normals, areas = ball(number)
        self.functions, self.albedo = functions, np.full((number, 3), 0.5, np.float32)
        pyramid = SurfacePyramid.over_points(self.positions, self.normals, areas)
        count = int(pyramid.start[1])
        places = np.zeros((count, 4), np.float32)
        places[:, 0] = np.where(pyramid.texel >= 0, pyramid.texel, -1)
        places[pyramid.texel >= 0, 1:] = 0.6, 0.8, areas[0]
        used = np.flatnonzero(pyramid.texel >= 0)
        self.medium, self.pyramid = medium_of(0.2), pyramid
        texels = link_texels(adaptive_links(pyramid, used, self.medium, 32))
        self.links = SubsurfaceLinks(places, texels, pyramid.levels)


@pytest.mark.parametrize("functions", [(0,), ()])
def test_lamps_shine_through_a_body(functions: tuple[int, ...]) -> None:
    bake = Bake(functions=functions)
    live, light = LiveScattering(bake), half_lit(bake.normals)
    places = bake.pyramid.place(500)
    full = full_sum(bake.pyramid, places, bake.medium, bake.pyramid.means(light))
    assert relative(live.scattered(light), full) < 0.04
    direct = np.zeros((500, 1 + len(functions), 3), np.float32)
    direct[:, 0] = 0.7 * light
    added = live.added(direct, 0.3 * light)
    # What leaves is 0.6 of what was scattered, and 0.8 less of the diffuse light than the bake and `direct` have.
    shown = 0.5 * (added[:, 0] + 0.3 * light) + (CONSTANT * added[:, 1] if functions else 0.0)
    assert shown == pytest.approx(0.5 * 0.2 * light + 0.6 * live.scattered(light), abs=1e-5)
    assert np.array_equal(direct[:, 0], 0.7 * light)  # not in place


def test_stored_links_are_checked() -> None:
    bake = Bake(100)
    flat, header = flatten_links(bake.links), {ENTRY: links_entry(bake.links)}
    back = read_links(header, flat, 100, "Wax", "Bake again")
    assert np.array_equal(back.texels, bake.links.texels) and np.array_equal(back.places, bake.links.places)
    assert back.levels == bake.links.levels and read_links({}, None, 100, "Wax", "Bake again") is None
    node, receiver = flat.copy(), flat.copy()
    node[4 * len(bake.links.places)] = 1e6
    receiver[0] = receiver[4]
    for broken in (None, flat[:-1], node, receiver, np.where(np.arange(len(flat)) == 9, np.nan, flat)):
        with pytest.raises(StorageError, match="links of subsurface light"):
            read_links(header, broken, 100, "Wax", "Bake again")
    with pytest.raises(StorageError):
        read_links(header, flat, 50, "Wax", "Bake again")
