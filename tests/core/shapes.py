# SPDX-License-Identifier: GPL-3.0-or-later
"""Small meshes with known answers, as ObjectMesh."""

from __future__ import annotations

import numpy as np

from prt_addon.scene.object_mesh import ObjectMesh


def drain(steps):
    """Exhaust a generator and return its result."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return end.value


def make(name, positions, triangles, smooth=False, albedo=(0.5, 0.5, 0.5), target=True):
    """An ObjectMesh with flat or angle-unweighted smooth normals and one albedo."""
    positions, triangles = np.asarray(positions, float), np.asarray(triangles, np.int32)
    corners = positions[triangles]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(face, axis=1, keepdims=True)
    if smooth:
        vertex = np.zeros_like(positions)
        np.add.at(vertex, triangles.ravel(), np.repeat(face, 3, axis=0))
        vertex /= np.maximum(np.linalg.norm(vertex, axis=1, keepdims=True), 1e-30)
        normals = vertex[triangles]
    else:
        normals = np.repeat((face / np.maximum(length, 1e-300))[:, None], 3, axis=1)
    colours = np.broadcast_to(np.asarray(albedo, np.float32), (len(triangles), 3, 3)).copy()
    return ObjectMesh(name, positions, triangles, normals.astype(np.float32), colours, target)


def box(name="box", low=(0, 0, 0), high=(1, 1, 1), inward=False, **options):
    """A box of 8 vertices and 12 triangles with flat normals."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    unit = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    return make(name, low + unit * (high - low), triangles[:, ::-1] if inward else triangles, **options)


def plane(name="plane", size=1.0, height=0.0, cells=1, centre=(0.0, 0.0), up=True, **options):
    """A square facing up (or down) of cells x cells quads, centred."""
    line = (np.arange(cells + 1) / cells - 0.5) * size
    x, y = np.meshgrid(line + centre[0], line + centre[1], indexing="ij")
    positions = np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)
    first = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    a, b, c, d = first, first + cells + 1, first + cells + 2, first + 1
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return make(name, positions, triangles if up else triangles[:, ::-1], **options)


def sphere(name="sphere", radius=1.0, centre=(0, 0, 0), subdivisions=3, inward=False, **options):
    """A smooth icosphere wound outwards (or inwards)."""
    golden = (1 + 5**0.5) / 2
    positions = [(-1, golden, 0), (1, golden, 0), (-1, -golden, 0), (1, -golden, 0), (0, -1, golden), (0, 1, golden),
                 (0, -1, -golden), (0, 1, -golden), (golden, 0, -1), (golden, 0, 1), (-golden, 0, -1), (-golden, 0, 1)]
    triangles = np.array([(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4), (11, 10, 2),
                          (10, 7, 6), (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9), (4, 9, 5),
                          (2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1)])
    points = np.array(positions, float)
    for _ in range(subdivisions):
        points, triangles = _subdivide(points, triangles)
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    options.setdefault("smooth", True)
    mesh = make(name, points * radius + np.asarray(centre), triangles[:, ::-1] if inward else triangles, **options)
    return mesh


def _subdivide(points, triangles):
    edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    unique, place = np.unique(edges, axis=0, return_inverse=True)
    middle = len(points) + place.reshape(3, -1)
    a, b, c = triangles.T
    ab, bc, ca = middle
    split = [np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    return np.concatenate([points, points[unique].mean(axis=1)]), np.concatenate(split)


def join(name, *meshes):
    """Several meshes as one object."""
    offsets = np.cumsum([0, *(len(m.positions) for m in meshes)])
    return ObjectMesh(name, np.concatenate([m.positions for m in meshes]),
                      np.concatenate([m.triangles + o for m, o in zip(meshes, offsets, strict=False)]).astype(np.int32),
                      np.concatenate([m.corner_normals for m in meshes]),
                      np.concatenate([m.corner_albedo for m in meshes]), meshes[0].is_target)
