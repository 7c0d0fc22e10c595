# SPDX-License-Identifier: GPL-3.0-or-later
"""Corners of a mesh find the receivers of the same surface."""

from __future__ import annotations

import numpy as np

from prt_addon.relighting.corner_colours import receivers_of_corners


def test_corners_of_a_cube_take_the_receiver_of_their_own_face() -> None:
    """Three receivers lie at each corner of a cube, one for each face, and more in the faces' middles."""
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    receivers, normals, corner_point, corner_normals = [], [], [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            normal = sign * np.eye(3)[axis]
            receivers.append(normal)  # the middle of the face
            normals.append(normal)
            for index in np.flatnonzero(corners[:, axis] == sign):
                corner_point.append(index)
                corner_normals.append(normal)
                receivers.append(corners[index])
                normals.append(normal)
    order = np.random.default_rng(0).permutation(len(receivers))
    receivers, normals = np.array(receivers)[order], np.array(normals)[order]
    corner_point, corner_normals = np.array(corner_point), np.array(corner_normals)
    found = receivers_of_corners(corners, corner_point, corner_normals, receivers, normals)
    assert np.array_equal(receivers[found], corners[corner_point])
    assert np.array_equal(normals[found], corner_normals)


def test_fewer_receivers_than_are_looked_at() -> None:
    found = receivers_of_corners(np.array([[0.0, 0, 0], [1, 0, 0]]), np.array([0, 1, 1]), np.tile((0.0, 0, 1), (3, 1)),
                                 np.array([[0.1, 0, 0], [1.1, 0, 0]]), np.tile((0.0, 0, 1), (2, 1)))
    assert found.tolist() == [0, 1, 1]
