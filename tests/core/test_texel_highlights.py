# SPDX-License-Identifier: GPL-3.0-or-later
"""Highlights and light through bodies in a cubemap's columns: against integrals over texels, against spherical
harmonics under lights that both hold, turned light, bounces, and a small memory budget."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prt_addon.baking.distant_basis import DistantBasis
from prt_addon.baking.recipe import bake, exhaust
from prt_addon.baking.settings import BakeSettings
from prt_addon.baking.surfaces import plan_surfaces
from prt_addon.baking.translucency import light_through_bodies
from prt_addon.basis.cubemap import cubemap_directions, cubemap_solid_angles, sample_directions
from prt_addon.basis.hemisphere import evaluate as hemisphere_values
from prt_addon.basis.hemisphere import functions_of, gram_matrix
from prt_addon.basis.spherical_harmonics import evaluate
from prt_addon.errors import PRTError
from prt_addon.lighting.cubemap_light import Turn
from prt_addon.relighting.exit_radiance import view_radiance
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.scene.surface_material import SurfaceMaterial
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport.brdf import reflection_matrix, reflection_of_material
from prt_addon.transport.column_arrays import column_array
from prt_addon.transport.cubemap_transfer import cubemap_transfer
from prt_addon.transport.glossy import GlossySurfaces, filled_rows, surface_frames
from prt_addon.transport.kernel_window import softened
from prt_addon.transport.lamp_kernel import profile_directions
from prt_addon.transport.receiver_set import ReceiverSet
from prt_addon.transport.reflectance import PrincipledLobe
from prt_addon.transport.texel_visibility import SEEN, TexelLight, TexelVisibility
from tests.core.shapes import drain, plane, sphere

METAL = SurfaceMaterial("metal", (1.0, 0.7, 0.3), roughness=0.6, metallic=1.0, specular_level=0.5)
BRUSHED = replace(METAL, roughness=0.7, anisotropic=0.8, anisotropic_rotation=0.15)
WAX = SurfaceMaterial("wax", (0.8, 0.5, 0.3), roughness=1.0, specular_level=0.0, subsurface_weight=1.0,
                      subsurface_radius=(0.2, 0.1, 0.05))
SMALL = BakeSettings(distant_basis="cubemap", cubemap_size=8, directions=1024, gather_directions=128, vectors=24,
                     encoder="static", clusters=8, spacing=0.0, compression_error=0.0, error_receivers=0, threads=1)
FUNCTIONS = functions_of(16)
INCIDENT = 7


def filled(mesh, material, r=8, samples=2, blocked=0):
    """Tracer, receivers, frames, visibility and rows (g, 16, 6 r r, channels) of a mesh alone."""
    scene = SceneMesh.assemble(mesh if isinstance(mesh, list) else [mesh])
    tracer = Tracer(scene.points, scene.triangles, 1)
    receivers = ReceiverSet.of_keys(scene, tracer, np.flatnonzero(~scene.loose))
    plain = TexelVisibility(np.ones(len(receivers), bool), 6 * r * r * samples ** 2, blocked)
    diffuse = drain(cubemap_transfer(tracer, receivers, r, samples, plain=plain))
    visibility = plain.result(receivers.normals)
    kernel = reflection_matrix(reflection_of_material(material, INCIDENT), FUNCTIONS)
    points = receivers.key
    surfaces = GlossySurfaces(surface_frames(scene.normals[points], scene.tangents[points]),
                              np.zeros(len(points), np.int64), (kernel,), FUNCTIONS)
    light = TexelLight(r, samples, visibility.visible, receivers.normals, INCIDENT)
    return receivers, surfaces, diffuse, visibility, light, drain(filled_rows(tracer, surfaces, light))


@pytest.mark.parametrize("material", [METAL, BRUSHED])
def test_one_texel_over_an_open_plane_is_the_integral_of_the_lobe_over_it(material):
    _, surfaces, _, _, _, rows = filled(plane(size=2.0, cells=1), material, samples=4)
    frame, lobe = surfaces.frames[0], PrincipledLobe(material)
    local = sample_directions(8, 16) @ frame.T  # (texels, 256, 3), much finer than the bake's
    high = np.flatnonzero(local[:, :, 2].min(axis=1) > 0.15)
    kernel = np.asarray(surfaces.kernels[0])
    angle = np.radians([0.0, 25.0, 50.0])
    views = np.stack([np.sin(angle), 0.3 * np.sin(angle), np.cos(angle)], axis=1)
    views /= np.linalg.norm(views, axis=1)[:, None]
    shown = hemisphere_values(FUNCTIONS, views)
    for texel in high[::9]:
        share = cubemap_solid_angles(8)[texel]
        expected = np.sum(kernel * evaluate(INCIDENT, local[texel]).mean(axis=0)[None, :, None], axis=1) * share
        scale = np.abs(rows[0]).max()
        assert np.abs(rows[0, :, texel] - expected).max() < 0.01 * scale
    # All texels of a smooth light together: the true lobe, which knows neither rows nor incident functions.
    light = 1.0 + sample_directions(8, 1)[:, 0, 0] * 0.7 + sample_directions(8, 1)[:, 0, 2] * 0.5
    ours = shown @ np.sum(rows[0] * light[None, :, None], axis=1)
    own = lobe.scatter(np.ascontiguousarray(_turned(views, -lobe.turn)), 64, 64)
    towards = _turned(own.directions.reshape(-1, 3), lobe.turn) @ frame
    smooth = (1.0 + towards[:, 0] * 0.7 + towards[:, 2] * 0.5).reshape(own.directions.shape[:2])
    truth = np.sum(own.weights * smooth[:, :, None], axis=1)
    np.testing.assert_allclose(ours, np.broadcast_to(truth, ours.shape), rtol=0.03)


def _turned(vectors, angle):
    cosine, sine = np.cos(angle), np.sin(angle)
    return vectors @ np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]).T


def test_visibility_is_that_of_the_diffuse_rows():
    """With the kernel of a diffuse surface the constant row is the diffuse transfer that was found from the same rays,
    over what is no part of the finite directions' own error."""
    meshes = [plane(size=4.0, cells=8), sphere(centre=(0, 0, 0.9), radius=0.8)]
    receivers, _, diffuse, visibility, light, _ = filled(meshes, METAL, blocked=INCIDENT)
    assert visibility.visible.dtype == np.uint8 and visibility.visible.max() == SEEN
    part = slice(0, len(receivers))
    incident = light.incident(part)
    cosine = np.sqrt(4 * np.pi / 3) * np.sum(incident[:, [3, 1, 2]] * receivers.normals[:, :, None], axis=1) / np.pi
    error = np.sqrt(np.sum((cosine - diffuse.T) ** 2) / np.sum(diffuse ** 2))
    assert error < 0.02
    # What is seen and what is blocked fill the open hemisphere, but for what lies under faces.
    y0 = 1.0 / np.sqrt(4 * np.pi)
    whole = (incident[:, 0].sum(axis=1) + visibility.blocked[:, 0]) / y0
    assert whole.max() < 2 * np.pi * 1.001
    assert np.allclose(whole[receivers.key < 81], 2 * np.pi, rtol=1e-4)  # the floor, flat


def still_life(material=METAL):
    ball = replace(sphere(centre=(0, 0, 0.9), radius=0.8, albedo=(0, 0, 0), subdivisions=2), materials=(material,))
    return SceneMesh.assemble([plane(size=4.0, cells=16, albedo=(0.8, 0.4, 0.2)), ball], 0.0)


def smooth_light(directions):
    """A light that order 4 holds, (n, 3)."""
    x, y, z = directions.T
    return np.stack([1.5 + x + 0.5 * z, 1.5 - y + 0.4 * x * z, 1.4 + 0.5 * y * z + 0.3 * x], axis=1)


@pytest.fixture(scope="module")
def texels():
    return exhaust(bake(still_life(), SMALL))


@pytest.fixture(scope="module")
def harmonics():
    return exhaust(bake(still_life(), replace(SMALL, distant_basis="sh", order=5, glossy_window=False)))


def shown(container, light):
    """Radiance of all receivers towards three views each."""
    if not container.functions:
        return view_radiance(container, light, container.normals)
    bitangents = np.cross(container.normals, container.tangents)
    views = [container.normals + a * container.tangents + b * bitangents for a, b in ((0, 0), (0.7, 0), (-0.5, 1.0))]
    return np.concatenate([view_radiance(container, light, view) for view in views])


def test_texels_and_harmonics_agree_under_a_light_that_both_hold(texels, harmonics):
    """Highlights, bounces into them and their share of the floor's light."""
    directions = sample_directions(8, 4)
    light = np.stack([smooth_light(part).mean(axis=0) for part in directions])
    basis = evaluate(5, directions.reshape(-1, 3))
    weights = np.repeat(cubemap_solid_angles(8) / 16, 16)
    coefficients = (basis * weights[:, None]).T @ smooth_light(directions.reshape(-1, 3))
    for name in ("plane", "sphere"):
        ours, theirs = texels.objects[name], harmonics.objects[name]
        assert ours.functions == theirs.functions and ours.lighting_basis.cubemap == 8
        found, expected = shown(ours, light), shown(theirs, coefficients)
        assert np.sqrt(np.mean((found - expected) ** 2) / np.mean(expected ** 2)) < 0.02, name


def test_a_white_world_is_as_white_as_with_harmonics(texels, harmonics):
    ball, other = texels.objects["sphere"], harmonics.objects["sphere"]
    white = DistantBasis(0, 8).white_light()
    difference = shown(ball, white) - shown(other, DistantBasis(5).white_light())
    assert np.sqrt(np.mean(difference ** 2)) < 0.01 and np.abs(difference).max() < 0.04
    assert np.abs(difference.mean()) < 0.002
    assert all(check["verdict"] == "ok" for check in texels.report["stability"])


def test_turned_light_is_the_light_of_a_turned_ball(texels):
    """A quarter turn about the vertical axis permutes texels, and an icosphere's poles see it turned alike."""
    r = 8
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    scene = SceneMesh.assemble([replace(sphere(subdivisions=2, albedo=(0, 0, 0)), materials=(METAL,))], 0.0)
    ball = exhaust(bake(scene, replace(SMALL, bounces=0))).objects["sphere"]
    light = smooth_light(cubemap_directions(r))
    turned = Turn(r, quarter)(light)
    assert np.allclose(turned, smooth_light(cubemap_directions(r) @ quarter), rtol=1e-6)  # f(R^-1 s)
    # Radiance towards a view far away depends on the mirrored direction; compare receivers with turned normals.
    view = np.array([0.2, 0.3, 0.9]) / np.linalg.norm([0.2, 0.3, 0.9])
    before = view_radiance(ball, light, np.broadcast_to(view, ball.normals.shape))
    after = view_radiance(ball, turned, np.broadcast_to(quarter @ view, ball.normals.shape))
    place = ball.normals @ quarter.T  # where the normals go
    distance = np.linalg.norm(place[:, None] - ball.normals[None], axis=2)
    pairs = np.flatnonzero(distance.min(axis=1) < 1e-4)
    partner = distance.argmin(axis=1)[pairs]
    assert len(pairs) > 4
    facing = ball.normals[pairs] @ view > 0.2
    np.testing.assert_allclose(after[partner][facing], before[pairs][facing], rtol=0.05)


def test_a_small_memory_budget_changes_nothing_and_leaves_no_file(texels, tmp_path):
    scene = still_life()
    small = exhaust(bake(scene, replace(SMALL, bounces=3, memory_budget=1e-6), tmp_path))
    large = exhaust(bake(scene, replace(SMALL, bounces=3)))
    light = smooth_light(cubemap_directions(8))
    for name, container in small.objects.items():
        np.testing.assert_allclose(shown(container, light), shown(large.objects[name], light), atol=2e-3)
    assert {path.name for path in tmp_path.iterdir()} - {"stages.json"} == {"gather.npz"}


def test_a_stopped_bake_goes_on_with_its_highlights(texels, tmp_path):
    steps = bake(still_life(), SMALL, tmp_path)
    for progress in steps:
        if progress.stage == "encode":
            break
    steps.close()
    again = exhaust(bake(still_life(), SMALL, tmp_path))
    assert set(again.report["resumed"]) == {"gather", "direct", "interreflection", "glossy"}
    light = smooth_light(cubemap_directions(8))
    np.testing.assert_allclose(shown(again.objects["sphere"], light), shown(texels.objects["sphere"], light), atol=1e-4)


def test_a_sharp_highlight_is_softened_until_a_small_light_hardly_rings():
    """At roughness 0.3 the rows swing to a sixth below black; a rough one keeps every bit; white stays white."""
    white = gram_matrix(np.arange(49))[0]
    views, lights = profile_directions()
    for roughness, changes in ((0.3, True), (0.6, False)):
        material = replace(METAL, roughness=roughness)
        kernel = reflection_matrix(reflection_of_material(material, INCIDENT), FUNCTIONS)
        soft, kept = softened(kernel, FUNCTIONS)
        assert (kept < 0.5) == changes == (not np.array_equal(soft, kernel))
        expected = np.einsum("kjc,j->kc", kernel, white)
        np.testing.assert_allclose(np.einsum("kjc,j->kc", soft, white), expected, atol=1e-10)
        shown_lights = evaluate(INCIDENT, lights).T
        lowest = [np.min(profile.min(axis=1) / profile.max(axis=1)) for profile in (
            hemisphere_values(FUNCTIONS, views) @ matrix.mean(axis=2) @ shown_lights for matrix in (kernel, soft))]
        assert lowest[1] > 0.6 * min(lowest[0], -0.05) and (lowest[0] < -0.15) == changes


def test_what_reflects_nothing_needs_no_window():
    kernel = np.zeros((len(FUNCTIONS), INCIDENT ** 2, 1))
    soft, kept = softened(kernel, FUNCTIONS)
    assert kept == 1.0 and not soft.any()


def test_the_budget_measures_highlights():
    sky = np.full((16, 32, 3), 0.3) * np.linspace(1.5, 0.5, 16)[:, None, None]
    from prt_addon.lighting.reference_light import ReferenceLight

    light = ReferenceLight.of(sky, None, [(np.array([0.5, 0.3, 0.81]) / np.linalg.norm([0.5, 0.3, 0.81]),
                                           np.array([3.0, 2.5, 2.0]), 0.35)], "a sky with a soft sun")
    found = {}
    for basis in ("cubemap", "sh"):
        settings = replace(SMALL, distant_basis=basis, error_receivers=32, error_paths=2048, vectors=24)
        found[basis] = exhaust(bake(still_life(), settings, light=light)).report["highlight_errors"]
    assert set(found["cubemap"]) == {"sampling", "rows", "basis", "bounces", "compression", "total"}
    error = {name: {part: entry["relative_rms"] for part, entry in found[name].items()} for name in found}
    assert error["cubemap"]["compression"] < 0.04 and error["cubemap"]["sampling"] < 0.1
    assert error["cubemap"]["basis"] < 0.6 * error["sh"]["basis"]  # a texel is narrower than order 5
    assert error["cubemap"]["total"] < 1.02 * error["sh"]["total"]  # but the rows are as few


def test_light_through_bodies_does_not_depend_on_blocks_of_columns():
    ball = replace(sphere(subdivisions=2), materials=(WAX,))
    scene = SceneMesh.assemble([ball], 0.0)
    surfaces = plan_surfaces(scene, SMALL)
    translucent = surfaces.translucent_points(scene)
    assert translucent.any()
    columns = np.random.default_rng(3).random((len(scene.points), 40, 1), np.float32)
    whole, parts = (drain(light_through_bodies(scene, surfaces, translucent, columns, 1, 1, at_once))[0]
                    for at_once in (0, 16))
    np.testing.assert_allclose(whole.transfer, parts.transfer, rtol=1e-4, atol=1e-6)
    assert np.array_equal(whole.light.energy, parts.light.energy)


def test_wax_in_texels_is_wax_in_harmonics():
    ball = replace(sphere(subdivisions=2, albedo=(0.8, 0.5, 0.3)), materials=(WAX,))
    scene = SceneMesh.assemble([ball], 0.0)
    found = [exhaust(bake(scene, replace(SMALL, distant_basis=basis, order=5))).objects["sphere"]
             for basis in ("cubemap", "sh")]
    assert found[0].functions == found[1].functions == (0,)
    directions = sample_directions(8, 4)
    light = np.stack([smooth_light(part).mean(axis=0) for part in directions])
    basis = evaluate(5, directions.reshape(-1, 3))
    weights = np.repeat(cubemap_solid_angles(8) / 16, 16)
    coefficients = (basis * weights[:, None]).T @ smooth_light(directions.reshape(-1, 3))
    ours, theirs = shown(found[0], light), shown(found[1], coefficients)
    assert np.sqrt(np.mean((ours - theirs) ** 2) / np.mean(theirs ** 2)) < 0.01 and theirs.mean() > 0.3


def test_what_no_disk_can_hold_is_refused_with_a_remedy(tmp_path):
    with pytest.raises(PRTError, match="fewer glossy_rows"):
        column_array(1 << 24, 1 << 24, 0, tmp_path)
    assert not list(tmp_path.iterdir())
