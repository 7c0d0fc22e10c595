# SPDX-License-Identifier: GPL-3.0-or-later
"""Highlights of local lights: of surfaces that the lights of a cloud shine on, and of lamps themselves; against path
tracing, brute-force GGX and rooms whose answer is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prt_addon.baking.highlight_sampling import TrueHighlight
from prt_addon.baking.local_lights import LitHighlights
from prt_addon.baking.recipe import _Bake, transport_settings
from prt_addon.baking.settings import make_settings
from prt_addon.baking.surfaces import INCIDENT_ORDER
from prt_addon.basis import hemisphere
from prt_addon.basis.spherical_harmonics import evaluate
from prt_addon.relighting.exit_radiance import hemisphere_values
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.scene.surface_material import SurfaceMaterial
from prt_addon.transport.brdf import reflection_of_material
from prt_addon.transport.glossy import reflected_light
from prt_addon.transport.incident_light import DiffuseRadiance, IndirectLight
from prt_addon.transport.lamp_kernel import LAMP_ORDER, cosine_product, lamp_kernel
from tests.core.shapes import box, sphere

METAL = SurfaceMaterial("metal", (1.0, 1.0, 1.0), roughness=0.6, metallic=1.0, specular_level=0.5)
WALLS = 0.6


class KeepingBake(_Bake):
    """A bake that keeps what its highlights are made of."""

    def _local(self, gathered, visibility):
        self.gathered, self.visibility = gathered, visibility
        self.kept = yield from super()._local(gathered, visibility)
        return self.kept


def until_encoding(scene, **options):
    """A bake of local lights, run up to its encoding."""
    wanted = {"lighting": "local", "spacing": "0", "threads": "1", "merge_response": "0", "gather_directions": "1024",
              "directions": "1024"}
    settings = make_settings("standard", wanted | {name: str(value) for name, value in options.items()})
    bake = KeepingBake(scene, transport_settings(settings), None, None, {}, np.empty((0, 4, 4)))
    steps = bake.run()
    while next(steps).stage != "encode":
        pass
    steps.close()
    return bake


def room_with_ball(cells=16):
    """A grey room 4 m wide, whose walls are finely divided, and a white metal ball near a corner of the floor."""
    room = box("room", (-2, -2, -2), (2, 2, 2), inward=True, albedo=(WALLS,) * 3)
    ball = replace(sphere("ball", 0.5, (0.7, 0.4, -1.0), 3, albedo=(0, 0, 0)), materials=(METAL,))
    return SceneMesh.assemble([room, ball], 4.0 / cells / np.sqrt(48.0))


@pytest.fixture(scope="module")
def lit_room():
    return until_encoding(room_with_ball(), cloud_lights=8)


def views_of(bake, angle):
    """A view (g, 3) in the world for each highlight, and its coordinates in the receiver's frame."""
    frames = bake._glossy_surfaces(bake.kept.points).frames
    turn = 2.4 * np.arange(len(frames))
    local = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.full(len(frames), np.cos(angle))],
                     axis=1)
    return local, frames


def traced_radiance(bake, origins, directions, light, generator, bounces=24):
    """Radiance (n, ) that arrives along rays (n, 3) from diffuse surfaces lit by a point of 1 W/sr, by path tracing
    with rays to the light at each hit. The ball counts as white and diffuse, as the first bounce of a bake has it."""
    scene, tracer = bake.scene, bake.tracer
    total, throughput, alive = np.zeros(len(origins)), np.ones(len(origins)), np.arange(len(origins))
    for _ in range(bounces):
        hits = tracer.nearest(origins, directions.astype(np.float32))
        assert (hits.triangle >= 0).mean() > 0.999
        met = np.flatnonzero(hits.triangle >= 0)
        corners = scene.points[scene.triangles[hits.triangle[met]]]
        weights = np.stack([1 - hits.u[met] - hits.v[met], hits.u[met], hits.v[met]], axis=1)[:, :, None]
        place = np.sum(weights * corners, axis=1)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        alive, throughput = alive[met], throughput[met] * np.where(hits.triangle[met] < 10 ** 9, 1.0, 1.0)
        albedo = bake.albedo[scene.triangles[hits.triangle[met], 0], 0]
        origins = tracer.to_tracing_space(place + 1e-5 * normal)
        towards = tracer.to_tracing_space(light[None]) - origins
        metres = np.linalg.norm(light - place, axis=1)
        cosine = np.sum((light - place) * normal, axis=1) / metres
        hidden = tracer.occluded(origins, towards, np.full(len(towards), 0.9999, np.float32))
        throughput = throughput * albedo
        total[alive] += np.where(hidden, 0.0, throughput * np.maximum(cosine, 0.0) / (np.pi * metres ** 2))
        directions = normal + (lambda d: d / np.linalg.norm(d, axis=1, keepdims=True))(
            generator.normal(size=normal.shape))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return total


@pytest.mark.parametrize("degrees", [10.0, 50.0])
def test_a_metal_ball_in_a_lit_room_reflects_what_path_tracing_finds(lit_room, degrees):
    bake, generator = lit_room, np.random.default_rng(4)
    local, frames = views_of(bake, np.radians(degrees))
    some = np.arange(0, len(local), len(local) // 24)
    values = hemisphere_values(tuple(bake.surfaces.functions), local)
    truth = TrueHighlight(METAL)
    count, errors, whole = 1024, [], []
    number = np.argmin(np.linalg.norm(bake.kept.cloud.positions - (-1, -1, 1), axis=1))
    light = bake.kept.cloud.positions[number]
    found = np.sum(values[some] * bake.kept.rows[some, :, number, 0], axis=1)
    receivers = bake.gathered.receivers.origins[bake.visibility.rows[some]]
    for index, (place, origin) in enumerate(zip(some, receivers, strict=True)):
        directions, weight = truth.sample(np.repeat(local[place][None], count, 0), generator.random((count, 2)))
        up = directions[:, 2] > 0
        world = directions[up] @ frames[place]
        arriving = traced_radiance(bake, np.repeat(origin[None], len(world), 0), world, light, generator)
        expected = np.sum(weight[up, 0] * arriving) / count
        errors.append(found[index] - expected)
        whole.append(expected)
    errors, whole = np.array(errors), np.array(whole)
    print(degrees, np.sqrt(np.mean(errors ** 2)) / np.sqrt(np.mean(whole ** 2)), errors.mean() / whole.mean(), whole,
          found)
    assert np.sqrt(np.mean(errors ** 2)) < 0.05 * np.sqrt(np.mean(whole ** 2))
    assert abs(errors.mean()) < 0.02 * whole.mean()
