# SPDX-License-Identifier: GPL-3.0-or-later
"""Where the error of an encoding lies, against the definition; and which source triangle each part belongs to."""

from __future__ import annotations

import numpy as np
import pytest

from prt_addon.compression.encoding import encode
from prt_addon.compression.point_errors import point_errors
from prt_addon.compression.settings import EncoderSettings
from prt_addon.scene.refinement import Beside, EdgeLimit, refine


@pytest.mark.parametrize("rows", [0, 3])
def test_point_errors_are_distances_to_what_is_decoded(rows: int) -> None:
    generator = np.random.default_rng(3)
    signal = generator.normal(size=(500, 12)).astype(np.float32) * np.linspace(1.0, 0.01, 12, dtype=np.float32)
    root = generator.normal(size=(rows, rows))
    metric = root @ root.T + np.eye(rows) if rows else None
    encoding = encode(signal, EncoderSettings(clusters=5, vectors=3), metric)
    found = point_errors(signal, encoding, metric)
    full = np.eye(12) if metric is None else np.kron(metric, np.eye(12 // rows))
    difference = signal.astype(np.float64) - encoding.decode()
    squares, energy = (np.einsum("pi,ij,pj->p", x, full, x) for x in (difference, signal.astype(np.float64)))
    assert np.allclose(found, np.sqrt(squares / energy.mean()), rtol=1e-3, atol=1e-5)
    assert np.mean(found.astype(np.float64) ** 2) == pytest.approx(encoding.squared_error / energy.sum(), rel=1e-3)


def test_a_signal_of_nothing_has_no_error() -> None:
    signal = np.zeros((9, 4), np.float32)
    assert np.array_equal(point_errors(signal, encode(signal, EncoderSettings(clusters=1, vectors=1))), np.zeros(9))


def test_parts_of_refined_triangles_lie_in_their_source() -> None:
    generator = np.random.default_rng(7)
    points = generator.uniform(-1.0, 1.0, (30, 3))
    triangles = generator.permutation(30).reshape(-1, 3).astype(np.int32)
    beside = Beside(np.zeros(30, np.int32), None, np.arange(10, dtype=np.int32))
    limit = EdgeLimit(0.2, points.min(axis=0), points.max(axis=0))
    new_points, _, _, parts = refine(points, np.tile((0.0, 0.0, 1.0), (30, 1)), np.ones((30, 3)), triangles, limit,
                                     "Test", beside)
    assert len(parts) > 500 and len(beside.source) == len(parts)
    area = np.linalg.norm(np.cross(*(new_points[parts[:, k]] - new_points[parts[:, 0]] for k in (1, 2))), axis=1)
    whole = np.linalg.norm(np.cross(*(points[triangles[:, k]] - points[triangles[:, 0]] for k in (1, 2))), axis=1)
    assert np.allclose(np.bincount(beside.source, area, 10), whole)
    corners = points[triangles[beside.source]]
    for corner in range(3):  # within the plane and the bounds of the source
        place = new_points[parts[:, corner]]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert np.abs(np.sum((place - corners[:, 0]) * normal, axis=1)).max() < 1e-12
        assert (place >= corners.min(axis=1) - 1e-12).all() and (place <= corners.max(axis=1) + 1e-12).all()
