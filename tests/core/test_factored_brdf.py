# SPDX-License-Identifier: GPL-3.0-or-later
"""In-out factorisation against the lobe itself, and its sparsely sampled terms against fully sampled ones."""

from __future__ import annotations

import numpy as np
import pytest

from prt_addon.basis.cubemap import cubemap_directions, cubemap_solid_angles, texel_of
from prt_addon.basis.directions import cosine_hemisphere
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.scene.surface_material import SurfaceMaterial
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport.factored_brdf import TABLE, FactoredElements, factored
from prt_addon.transport.receiver_set import ReceiverSet
from prt_addon.transport.reflectance import PrincipledLobe
from prt_addon.transport.sparse_sampling import SparseSettings, sparse_transfer
from tests.core.shapes import drain, plane, sphere

ROUGH = SurfaceMaterial("metal", (0.9, 0.9, 0.9), roughness=0.8, metallic=1.0)


def test_kernel_integrates_to_what_the_quadrature_gives():
    """f cos at single pairs, summed over the sphere, against the lobe's own nodes."""
    lobe = PrincipledLobe(ROUGH)
    views = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.9, 0.1, 0.4]])
    views /= np.linalg.norm(views, axis=1, keepdims=True)
    lights, solid_angles = cubemap_directions(64), cubemap_solid_angles(64)
    up = lights[:, 2] > 0
    found = np.sum(lobe.kernel(views, lights[up])[..., 0] * solid_angles[up], axis=1)
    np.testing.assert_allclose(found, lobe.scatter(views).weights[..., 0].sum(axis=1), rtol=2e-3)


@pytest.mark.parametrize(("roughness", "most"), [(0.5, 0.75), (0.8, 0.35), (1.0, 0.2)])
def test_error_is_that_of_the_sum_of_products(roughness, most):
    material = SurfaceMaterial("metal", (0.9, 0.9, 0.9), roughness=roughness, metallic=1.0)
    lobe = factored(material)
    generator = np.random.default_rng(0)
    views = cosine_hemisphere(2000)[generator.permutation(2000)[:300]]
    lights = cubemap_directions(16)
    solid_angles = cubemap_solid_angles(16)[lights[:, 2] > 0]
    lights = lights[lights[:, 2] > 0]
    truth = PrincipledLobe(material).kernel(views, lights)[..., 0]
    products = lobe.outgoing[:, texel_of(views, TABLE)].T @ lobe.incoming[:, texel_of(lights, TABLE)]
    error = np.sqrt(np.sum((products - truth) ** 2 * solid_angles) / np.sum(truth ** 2 * solid_angles))
    assert error == pytest.approx(lobe.error, abs=0.05)
    assert lobe.error < most
    assert (np.diff(lobe.captured) <= 1e-12).all()
    assert roughness < 1.0 or factored(material, 12).error < lobe.error


def test_sparse_terms_against_fully_sampled_ones():
    scene = SceneMesh.assemble([sphere(radius=0.5, centre=(0, 0, 0.6)), plane(size=4.0, cells=39)])
    tracer = Tracer(scene.points, scene.triangles, 1)
    receivers = ReceiverSet.of_keys(scene, tracer, np.flatnonzero(~scene.loose))
    everyone = np.arange(len(receivers))
    elements = FactoredElements(tracer, receivers, 16)
    positions = scene.points[receivers.key % len(scene.points)]
    found = drain(sparse_transfer(elements, positions, receivers.normals, SparseSettings(radius=0.07)))
    assert found.sampled < 0.125
    column, row = np.nonzero(elements.unknown(everyone).T)
    truth = np.zeros((len(receivers), elements.columns), np.float32)
    truth[row, column] = elements.evaluate(row, column)
    lobe = factored(ROUGH)
    for number in range(4):
        factor = elements.term(lobe, number, everyone)
        error = np.linalg.norm((found.transfer.T - truth) * factor) / np.linalg.norm(truth * factor)
        assert error < 0.08
