# SPDX-License-Identifier: GPL-3.0-or-later
"""Links of subsurface light (Carr et al. 2003): error against their number, seams, seconds, and the passes' frame time.

    python benchmarks/subsurface_links.py [--mesh stanford-bunny.obj] [--side 256] [--checked 400] [--threads 2]
    python benchmarks/subsurface_links.py --export DIR    (for device_subsurface.py on a machine with a graphics card)

Errors are root mean squares relative to that of the sum over all texels, at random texels, of a lamp behind the mesh.
The seam is that of neighbouring texels whose cut through the tree differs: the mean step of the light between texels
that are neighbours on the surface, less the same step in the full sum, relative to the light.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import time
import types
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the bake's process; before numpy loads

import numpy as np
from common import ROOT, load_obj, mesh_path, print_table, smooth_object
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.transport.dipole import Medium, disc_integral
from prt_addon.transport.subsurface_links import Links, adaptive_links, full_sum, level_links
from prt_addon.transport.surface_pyramid import SurfacePyramid
from prt_addon.transport.surface_texels import SurfaceTexels, texels_on_mesh

COLOUR = (0.85, 0.6, 0.4)
# Mean free paths as shares of the diagonal: marble-like, and one that light hardly leaves.
PATHS = {"deep": (0.05, 0.03, 0.02), "middle": (0.02, 0.012, 0.006), "shallow": (0.005, 0.003, 0.0015)}
EXPORTED = ("__init__.py", "errors.py", "transport/__init__.py", "transport/dipole.py", "transport/surface_pyramid.py",
            "transport/surface_texels.py", "transport/subsurface_links.py", "relighting/__init__.py",
            "relighting/subsurface_texels.py")


def normalised(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int32]]:
    """Positions, normals and triangles of a mesh, its bounding box centred with diagonal 1."""
    scene = SceneMesh.assemble([smooth_object("mesh", *load_obj(path), COLOUR)])
    points = scene.points - 0.5 * (scene.points.min(axis=0) + scene.points.max(axis=0))
    return points / np.sqrt(np.sum(np.ptp(points, axis=0) ** 2)), scene.normals, scene.triangles


def lamp_light(points: NDArray[np.float64], normals: NDArray[np.float64], lamp: NDArray[np.float64],
               ) -> NDArray[np.float32]:
    """Unshadowed irradiance (n, 3) of a point of intensity 1."""
    towards = lamp - points
    squared = np.sum(towards * towards, axis=1)
    value = np.maximum(np.sum(towards * normals, axis=1), 0.0) / (squared * np.sqrt(squared))
    return np.repeat(value[:, None], 3, axis=1).astype(np.float32)


def export(folder: Path, mesh: Path) -> None:
    """Everything that device_subsurface.py needs, beside a copy of it."""
    package = types.ModuleType("prt")  # the shaders' folder imports relatively from the root
    package.__path__ = [str(ROOT)]
    sys.modules["prt"] = package
    from prt.gpu_shaders import subsurface_programs as programs

    folder.mkdir(parents=True, exist_ok=True)
    for name in ("lamp", "reduce", "gather", "shade"):
        (folder / f"{name}.glsl").write_text(programs.program(name).glsl())
        if name != "shade":
            (folder / f"{name}_plain.glsl").write_text(programs.program(name, moments=False).glsl())
    for name in EXPORTED:
        target = folder / "prt_addon" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / "prt_addon" / name, target)
    shutil.copyfile(ROOT / "benchmarks" / "device_subsurface.py", folder / "device_subsurface.py")
    points, normals, triangles = normalised(mesh)
    np.savez_compressed(folder / "mesh.npz", positions=points.astype(np.float32), normals=normals.astype(np.float32),
                        triangles=triangles)
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    print(f"{folder}: {size / 2**20:.1f} MiB")


class Case:
    """A mesh's texels, and a medium."""

    def __init__(self, texels: SurfaceTexels, path: tuple[float, ...], checked: int) -> None:
        self.medium = Medium.of_principled(COLOUR, 4.0 * np.pi * np.array(path))
        self.pyramid = SurfacePyramid.over_points(texels.points, texels.normals, texels.areas)
        lamp = np.array([0.2, 0.3, -0.9])
        self.means = self.pyramid.means(lamp_light(texels.points, texels.normals, lamp))
        generator = np.random.default_rng(1)
        chosen = generator.choice(len(texels.points), checked, replace=False)
        _, beside = cKDTree(texels.points).query(texels.points[chosen], k=2)
        place = self.pyramid.place(len(texels.points))
        self.places = place[np.concatenate([chosen, beside[:, 1]])]
        self.full = full_sum(self.pyramid, self.places, self.medium, self.means)
        ones = np.ones_like(self.means)
        self.energy = full_sum(self.pyramid, self.places[:64], self.medium, ones).mean(axis=0)

    def figures(self, links: Links) -> tuple[float, float, float]:
        """Error, seam and energy relative to the full sum's."""
        found = links.gathered(self.means)
        brightness = float(np.sqrt(np.mean(self.full.astype(np.float64) ** 2)))
        half = len(found) // 2
        steps = [np.abs(values[:half] - values[half:]).mean() for values in (found, self.full)]
        error = float(np.sqrt(np.mean((found - self.full) ** 2))) / brightness
        return error, float(steps[0] - steps[1]) / brightness, float(
            links.sums[:64].mean() / self.energy.mean())


def errors(texels: SurfaceTexels, checked: int, threads: int) -> None:
    """Error and seam against the number of links, best-first by both rules and of a fixed level."""
    for name, path in PATHS.items():
        case = Case(texels, path, checked)
        rows = []
        for links in (4, 8, 16, 32, 64, 128, 256):
            row = [links]
            for rule in ("factor", "spread"):
                row += case.figures(adaptive_links(case.pyramid, case.places, case.medium, links, rule,
                                                   threads=threads))[:2]
            row += [case.figures(adaptive_links(case.pyramid, case.places, case.medium, links, threads=threads))[2]]
            below = int(np.log2(links)) // 2
            row += case.figures(level_links(case.pyramid, case.places, case.medium, below, threads=threads))[:2] \
                if 4 ** below == links else ["", ""]
            rows.append(row)
        print(f"\n{name}: mean free paths {path} of the diagonal, {len(texels.points)} texels, {checked} checked\n")
        print_table(["links", "error, by factor", "seam", "error, by spread", "seam", "energy", "error, fixed level",
                     "seam"], rows)


def seconds(mesh: tuple, sides: tuple[int, ...], threads: int) -> None:
    """Seconds of the atlas and its links."""
    points, normals, triangles = mesh
    rows = []
    for side in sides:
        started = time.perf_counter()
        texels = texels_on_mesh(points, normals, triangles, side * side)
        pyramid = SurfacePyramid.over_points(texels.points, texels.normals, texels.areas)
        atlas, started = time.perf_counter() - started, time.perf_counter()
        found = adaptive_links(pyramid, np.arange(pyramid.start[1]),
                               Medium.of_principled(COLOUR, 4.0 * np.pi * np.array(PATHS["middle"])), 16,
                               threads=threads)
        rows.append([f"{side}^2", atlas, time.perf_counter() - started, found.node.size * 16 / 2**20])
    print(f"\n16 links, best-first, {threads} threads\n")
    print_table(["atlas", "atlas seconds", "link seconds", "MiB of links"], rows)


def sphere_energy(count: int = 16384) -> None:
    """A sphere, whose sum has a closed form: of chords, a sphere has the same area at each distance as a plane."""
    index = np.arange(count) + 0.5
    z, turn = 1.0 - 2.0 * index / count, index * np.pi * (1.0 + np.sqrt(5.0))
    points = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)
    pyramid = SurfacePyramid.over_points(points, points, np.full(count, 4.0 * np.pi / count))
    some = np.random.default_rng(0).choice(count, 64, replace=False)
    rows = []
    for path in (0.3, 0.1, 0.03, 0.01):
        medium = Medium.of_principled((0.8, 0.8, 0.8), 4.0 * np.pi * path)
        exact = float(disc_integral(medium.poles(0, 1.0), 4.0))
        full = full_sum(pyramid, some, medium, np.ones((len(pyramid.area), 3), np.float32)).mean()
        rows.append([path, exact, float(full)] + [float(adaptive_links(pyramid, some, medium, k).sums.mean())
                                                  for k in (4, 16, 64, 256)])
    print("\nA sphere of radius 1 under even light\n")
    print_table(["mean free path", "closed form", "all texels", "4 links", "16", "64", "256"], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", default="stanford-bunny.obj")
    parser.add_argument("--side", type=int, default=256)
    parser.add_argument("--checked", type=int, default=400)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--sides", type=int, nargs="*", default=(256, 512, 1024), help="of the table of seconds")
    parser.add_argument("--export", type=Path)
    arguments = parser.parse_args()
    if arguments.export:
        export(arguments.export, mesh_path(arguments.mesh))
        return
    sphere_energy()
    points, normals, triangles = mesh = normalised(mesh_path(arguments.mesh))
    print(f"\n{arguments.mesh}: {len(triangles)} triangles")
    errors(texels_on_mesh(points, normals, triangles, arguments.side ** 2), arguments.checked, arguments.threads)
    seconds(mesh, arguments.sides, arguments.threads)


if __name__ == "__main__":
    main()
