# SPDX-License-Identifier: GPL-3.0-or-later
"""The links of live subsurface light in a container: of all translucent materials of an object, each a body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..relighting.live_scattering import SubsurfaceLinks
from ..relighting.subsurface_texels import link_texels
from ..scene.scene_mesh import SceneMesh, SceneObject
from ..storage.container import BakedTransfer
from ..storage.subsurface_links import ENTRY, links_entry
from ..transport.dipole import Medium
from ..transport.subsurface_links import adaptive_links
from ..transport.surface_pyramid import SurfacePyramid
from .settings import BakeSettings
from .translucency import point_areas


def links_bytes(scene: SceneMesh, settings: BakeSettings) -> int:
    """What the links of a bake take in the file, and what a preview's graphics card takes again."""
    if not settings.local_light or not settings.subsurface_links:
        return 0
    points = sum(len(translucent_points(scene, target)) for target in scene.objects if target.is_target)
    return 16 * points * (settings.subsurface_links + 1)


def translucent_points(scene: SceneMesh, target: SceneObject) -> NDArray[np.int64]:
    """The points of a target, counted from its first, whose material is translucent."""
    translucent = np.array([m.is_translucent for m in scene.materials])[scene.material[target.points]]
    return np.flatnonzero(translucent & ~scene.loose[target.points])


def with_subsurface_links(container: BakedTransfer, scene: SceneMesh, target: SceneObject, links: int,
                          threads: int) -> BakedTransfer:
    """The container of a target with so many links per receiver; itself where nothing of it is translucent."""
    chosen = translucent_points(scene, target)
    if not len(chosen) or not links:
        return container
    numbers, body = np.unique(scene.material[target.points][chosen], return_inverse=True)
    found = _links(scene, target, chosen, numbers, body.reshape(-1), links, threads)
    return replace(container, header={**container.header, ENTRY: links_entry(found)}, links=found)


def _links(scene: SceneMesh, target: SceneObject, chosen: NDArray[np.int64], numbers: NDArray[np.integer],
           body: NDArray[np.int64], links: int, threads: int) -> SubsurfaceLinks:
    """chosen: (k,) translucent points of the target; body: (k,) of each, numbers: its material."""
    points = target.points.start + chosen
    areas = point_areas(scene, target)[chosen]
    pyramid = SurfacePyramid.over_points(scene.points[points], scene.normals[points], areas, body)
    count = int(pyramid.start[1])
    used = pyramid.texel >= 0
    row = np.cumsum(used) - 1
    places, texels = np.zeros((count, 4), np.float32), np.zeros((int(used.sum()), links, 4), np.float32)
    places[:, 0] = np.where(used, chosen[pyramid.texel], -1)
    places[used, 3] = areas[pyramid.texel[used]]
    for index, number in enumerate(numbers):
        material = scene.materials[number]
        mine = np.flatnonzero(used & (body[pyramid.texel] == index))
        medium = Medium.of_principled(material.base_colour, material.subsurface_radius)
        texels[row[mine]] = link_texels(adaptive_links(pyramid, mine, medium, links, body=index, threads=threads))
        places[mine, 1] = material.subsurface_weight * (1.0 - material.metallic)
        places[mine, 2] = material.subsurface_weight
    return SubsurfaceLinks(places, texels, pyramid.levels)
