# SPDX-License-Identifier: GPL-3.0-or-later
"""Three scenes for the ray engine, in tracing space (unit diagonal around the origin): a closed room, in which every
miss is a leak; the Buddha, 100,000 small triangles; and figures on a floor, small triangles among large ones."""

from __future__ import annotations

import numpy as np
from common import load_obj, mesh_path
from numpy.typing import NDArray
from ray_measurements import Scene

from prt_addon.tracing.ray_calibration import ball_field

LIFT = 2e-4  # of origins above the surface


def grid(cells: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """A unit square around the origin in z = 0, facing up."""
    ticks = np.linspace(-0.5, 0.5, cells + 1)
    x, y = np.meshgrid(ticks, ticks, indexing="ij")
    points = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    a = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    b, c, d = a + cells + 1, a + cells + 2, a + 1
    return points, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def joined(parts: list[tuple[NDArray, NDArray]]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Parts (points, triangles) as one."""
    offsets = np.cumsum([0, *(len(points) for points, _ in parts[:-1])])
    return (np.concatenate([points for points, _ in parts]),
            np.concatenate([triangles + offset for (_, triangles), offset in zip(parts, offsets, strict=True)]))


def room() -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """A closed box of 24 x 24 quads a wall, turned so that nothing lies along the axes, with 64 balls inside."""
    square, faces = grid(24)
    up, away = square + np.array((0.0, 0.0, 0.5)), np.eye(3)
    turns = [away, away[[0, 2, 1]], away[[2, 1, 0]]]  # odd ones mirror: their faces are turned back
    walls = []
    for turn, mirrored in zip(turns, (False, True, True), strict=True):
        for side in (1.0, -1.0):
            flip = mirrored != (side < 0.0)
            walls.append(((up * (1.0, 1.0, side)) @ turn, faces if flip else faces[:, ::-1]))  # facing inwards
    balls, ball_faces = ball_field()
    points, triangles = joined([*walls, (0.8 * balls, ball_faces)])
    points = points.copy()
    turn, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
    return welded(points @ turn, triangles)


def welded(points: NDArray[np.float64], triangles: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Points at one place as one: walls share their edges exactly."""
    _, first, number = np.unique(np.round(points * 1e9).astype(np.int64), axis=0, return_index=True,
                                 return_inverse=True)
    return points[first], number.ravel()[triangles]


def figures() -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """A bunny and four cows on a floor of two triangles."""
    floor, faces = grid(1)
    parts = [(4.0 * floor, faces)]
    for name, places in (("stanford-bunny.obj", [(0.0, 0.0)]),
                         ("spot.obj", [(-1.2, -1.2), (1.2, -1.2), (-1.2, 1.2), (1.2, 1.2)])):
        points, triangles = load_obj(mesh_path(name))
        points = points[:, [0, 2, 1]] * (1.0, -1.0, 1.0)
        points = (points - points.min(axis=0)) / np.ptp(points, axis=0).max()
        parts += [(points - (0.5, 0.5, 0.0) + (x, y, 0.01), triangles) for x, y in places]
    return joined(parts)


def scenes() -> dict[str, Scene]:
    """By name."""
    made = {"closed room": room(), "Buddha": load_obj(mesh_path("buddha_nirj.obj")), "figures": figures()}
    return {name: make_scene(name, *mesh) for name, mesh in made.items()}


def make_scene(name: str, points: NDArray[np.float64], triangles: NDArray[np.integer]) -> Scene:
    """In tracing space, with origins at 50,000 random places on the surfaces in the order of a curve through space."""
    low, high = points.min(axis=0), points.max(axis=0)
    points = ((points - 0.5 * (low + high)) / np.linalg.norm(high - low)).astype(np.float32)
    triangles = triangles.astype(np.int32)
    corners = points[triangles].astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    generator = np.random.default_rng(4)
    chosen = generator.choice(len(triangles), 50_000, p=area / area.sum())
    weights = generator.dirichlet((1.0, 1.0, 1.0), len(chosen))
    unit = normal[chosen] / area[chosen, None]
    origins = np.einsum("nc,ncx->nx", weights, corners[chosen]) + LIFT * unit
    steps = np.clip((origins + 0.5) * 1024, 0, 1023).astype(np.int64)
    key = np.zeros(len(chosen), np.int64)
    for bit in range(9, -1, -1):
        for axis in range(3):
            key = 2 * key + ((steps[:, axis] >> bit) & 1)
    order = np.argsort(key, kind="stable")
    return Scene(name, points, triangles, origins[order].astype(np.float32), unit[order].astype(np.float32))
