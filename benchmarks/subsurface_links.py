# SPDX-License-Identifier: GPL-3.0-or-later
"""Links of subsurface light (Carr et al. 2003): error against their number, seams, seconds, and the passes' frame time.

    python benchmarks/subsurface_links.py [--mesh stanford-bunny.obj] [--side 256] [--checked 400] [--threads 2]
    python benchmarks/subsurface_links.py --export DIR    (for device_subsurface.py on a machine with a graphics card)

Errors are root mean squares at random texels against the sum over all texels, of a lamp behind the mesh, relative to
that sum's root mean square. A jump is how far the difference between a texel and its nearest neighbour is off from the
full sum's: what shows as a seam. Of 600 pairs the 99 % quantile and the largest, relative to the same.
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
    """A pyramid, a medium, and what the sum over all texels gives at random texels and the nearest to each."""

    def __init__(self, pyramid: SurfacePyramid, points: NDArray[np.float64], normals: NDArray[np.float64],
                 path: tuple[float, ...], checked: int) -> None:
        self.medium, self.pyramid = Medium.of_principled(COLOUR, 4.0 * np.pi * np.array(path)), pyramid
        self.means = pyramid.means(lamp_light(points, normals, np.array([0.2, 0.3, -0.9])))
        self.moments = pyramid.moments(self.means)
        place = pyramid.place(len(points))
        there = np.flatnonzero(place >= 0)
        chosen = np.random.default_rng(1).choice(there, checked, replace=False)
        _, beside = cKDTree(points[there]).query(points[chosen], k=2)
        self.places = place[np.concatenate([chosen, there[beside[:, 1]]])]
        self.full = full_sum(pyramid, self.places, self.medium, self.means)
        self.brightness = float(np.sqrt(np.mean(self.full.astype(np.float64) ** 2)))
        self.even = full_sum(pyramid, self.places[:64], self.medium, np.ones_like(self.means)).mean()

    def figures(self, links: Links, moments: bool) -> list[float]:
        """Error; median and largest jump between neighbours that the full sum does not have, all relative."""
        off = links.gathered(self.means, self.moments if moments else None) - self.full
        half = len(off) // 2
        jump = np.abs(off[:half] - off[half:]).max(axis=1)
        return [float(np.sqrt(np.mean(off.astype(np.float64) ** 2))) / self.brightness,
                float(np.quantile(jump, 0.99)) / self.brightness, float(jump.max()) / self.brightness]


COUNTS = (4, 8, 16, 32, 64, 128, 256)


def errors(texels: SurfaceTexels, checked: int, threads: int) -> None:
    """Error and jumps against the number of links: of a fixed level, best-first by both rules, and with moments."""
    pyramid = SurfacePyramid.over_points(texels.points, texels.normals, texels.areas)
    for name, path in PATHS.items():
        case, rows = Case(pyramid, texels.points, texels.normals, path, checked), []
        for links in COUNTS:
            below = int(np.log2(links)) // 2
            fixed = case.figures(level_links(pyramid, case.places, case.medium, below, threads=threads), False) \
                if 4 ** below == links else ["", "", ""]
            found = {rule: adaptive_links(pyramid, case.places, case.medium, links, rule, threads=threads)
                     for rule in ("factor", "spread")}
            plain = case.figures(found["factor"], False)
            shifted = case.figures(found["spread"], True)
            energy = float(found["spread"].sums[:64].mean() / case.even)
            rows.append([links, fixed[0], fixed[2], plain[0], plain[1], plain[2],
                         case.figures(found["spread"], False)[0], *shifted, energy])
        print(f"\n{name}: mean free paths {path} of the diagonal, {len(texels.points)} texels, {checked} pairs\n")
        print_table(["links", "fixed level: error", "largest jump", "by factor (paper): error", "jump 99 %",
                     "largest jump", "by spread: error", "by spread, moments: error", "jump 99 %", "largest jump",
                     "energy"], rows)


def atlases(mesh: tuple, side: int, checked: int, threads: int) -> None:
    """The same over an atlas of charts."""
    from prt_addon.scene.atlas import make_atlas

    points, normals, triangles = mesh
    rows = []
    started = time.perf_counter()
    atlas = make_atlas("mesh", points, normals, triangles, side=side)
    chart_seconds, found = time.perf_counter() - started, atlas.texels
    power = 1 << (max(atlas.width, atlas.height) - 1).bit_length()
    picture = np.zeros((power, power, 7))
    picture[found.row, found.column] = np.concatenate([found.positions, found.normals, found.areas[:, None]], axis=1)
    charts = SurfacePyramid.over_image(picture[..., :3], picture[..., 3:6], picture[..., 6])
    started = time.perf_counter()
    own = texels_on_mesh(points, normals, triangles, len(found.areas))
    meshed = SurfacePyramid.over_points(own.points, own.normals, own.areas)
    meshed_seconds = time.perf_counter() - started
    flat = picture.reshape(-1, 7)
    for name, pyramid, where, taken in (
            (f"charts ({atlas.method}), {power}^2", charts, flat, chart_seconds),
            ("meshed", meshed, np.concatenate([own.points, own.normals], axis=1), meshed_seconds)):
        case = Case(pyramid, where[:, :3], where[:, 3:6], PATHS["middle"], checked)
        for links in (16, 64):
            linked = adaptive_links(pyramid, case.places, case.medium, links, threads=threads)
            rows.append([name, len(found.areas), taken, links, *case.figures(linked, False),
                         *case.figures(linked, True)])
    print("\nCharts against the meshed atlas, of as many texels\n")
    print_table(["atlas", "texels", "seconds", "links", "error", "jump 99 %", "largest jump", "with moments: error",
                 "jump 99 %", "largest jump"], rows)


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
    parser.add_argument("--side", type=int, default=128, help="of the atlas whose errors are measured")
    parser.add_argument("--checked", type=int, default=600)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--sides", type=int, nargs="*", default=(256, 512, 1024), help="of the table of seconds")
    parser.add_argument("--parts", nargs="*", default=("energy", "errors", "atlases", "seconds"))
    parser.add_argument("--export", type=Path)
    arguments = parser.parse_args()
    if arguments.export:
        export(arguments.export, mesh_path(arguments.mesh))
        return
    points, normals, triangles = mesh = normalised(mesh_path(arguments.mesh))
    print(f"{arguments.mesh}: {len(triangles)} triangles")
    if "energy" in arguments.parts:
        sphere_energy()
    if "errors" in arguments.parts:
        errors(texels_on_mesh(points, normals, triangles, arguments.side ** 2), arguments.checked, arguments.threads)
    if "atlases" in arguments.parts:
        atlases(mesh, arguments.side, arguments.checked, arguments.threads)
    if "seconds" in arguments.parts:
        seconds(mesh, arguments.sides, arguments.threads)


if __name__ == "__main__":
    main()
