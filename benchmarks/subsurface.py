# SPDX-License-Identifier: GPL-3.0-or-later
"""Subsurface light of a shared mesh: links, seconds and error against the hierarchy's tolerance.

    python benchmarks/subsurface.py [--mesh buddha_nirj.obj] [--radius 0.2 0.1 0.05] [--threads 2] [--checked 100]

radius: the Principled BSDF's, per channel, as a share of the object's diagonal. Columns are the unshadowed transfer of
order 5 (25 columns, one channel); the error is against the full sum at random receivers. The second table:
all mean free paths equal, as shares of the diagonal.
"""

from __future__ import annotations

import argparse
import os
import time

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the bake's process; before numpy loads

import numpy as np
from common import drain, load_obj, mesh_path, print_table, smooth_object
from numpy.typing import NDArray

from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.transport.dipole import Medium
from prt_addon.transport.direct import unshadowed_transfer
from prt_addon.transport.subsurface import TOLERANCE, Subsurface, subsurface_transfer

BASE_COLOUR = (0.8, 0.5, 0.3)


def point_areas(points: NDArray[np.float64], triangles: NDArray[np.int32]) -> NDArray[np.float64]:
    """A third of the area of the triangles at each point."""
    corners = points[triangles]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.sqrt(np.sum(face**2, axis=1))
    return np.bincount(triangles.ravel(), np.repeat(area / 3.0, 3), len(points))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", default="buddha_nirj.obj")
    parser.add_argument("--radius", type=float, nargs=3, default=(0.2, 0.1, 0.05))
    parser.add_argument("--tolerances", type=float, nargs="*", default=(0.1, 0.03, 0.01, 0.003))
    parser.add_argument("--paths", type=float, nargs="*", default=(1e-4, 1e-3, 1e-2, 1e-1, 1.0, 1e2))
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--checked", type=int, default=100)
    arguments = parser.parse_args()
    scene = SceneMesh.assemble([smooth_object("mesh", *load_obj(mesh_path(arguments.mesh)), BASE_COLOUR)])
    points, areas = scene.points, point_areas(scene.points, scene.triangles)
    diagonal = float(np.sqrt(np.sum(np.ptp(points, axis=0) ** 2)))
    irradiance = unshadowed_transfer(scene.normals, 5)[:, :, None].astype(np.float32)

    def run(medium: Medium, tolerance: float) -> tuple[float, Subsurface]:
        started = time.perf_counter()
        drain(subsurface_transfer(points, scene.normals, areas, irradiance, medium, tolerance, arguments.threads,
                                  checked=0))
        seconds = time.perf_counter() - started
        return seconds, drain(subsurface_transfer(points, scene.normals, areas, irradiance, medium, tolerance,
                                                  arguments.threads, arguments.checked))

    print(f"{arguments.mesh}: {len(points)} receivers, 25 columns, base colour {BASE_COLOUR}")
    medium = Medium.of_principled(BASE_COLOUR, np.array(arguments.radius) * diagonal)
    rows = []
    for tolerance in arguments.tolerances:
        seconds, result = run(medium, tolerance)
        rows.append([tolerance, result.links, seconds, result.error, result.worst, result.bound])
    print_table(["tolerance", "links per place", "seconds", "RMS error", "largest error", "bound"], rows)
    rows = []
    for path in arguments.paths:
        medium = Medium.of_principled(BASE_COLOUR, 4.0 * np.pi * path * diagonal)
        seconds, result = run(medium, TOLERANCE)
        rows.append([path, result.links, seconds, result.error, *(float(e) for e in result.energy),
                     float(result.reduced.max())])
    print()
    print_table(["mean free path", "links per place", "seconds", "RMS error", "energy R", "G", "B", "reduced"], rows)


if __name__ == "__main__":
    main()
