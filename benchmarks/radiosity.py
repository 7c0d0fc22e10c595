# SPDX-License-Identifier: GPL-3.0-or-later
"""Matrix radiosity (Carr et al. 2003): error per iteration (Figure 3), seconds against receivers (4), stiff rooms.

    python benchmarks/radiosity.py [--quick] [--export DIR]

The scene is a closed room with a block in it, traced by the gather operator. GPU: Blender's own GPU module in the `bpy`
wheel, left out where that finds no driver. --export writes what `device_radiosity.py` needs to time the same shader on
another machine.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import time
import types
from pathlib import Path

import numpy as np
from common import ROOT, drain
from numpy.typing import NDArray
from scipy import sparse

from prt_addon.basis.directions import quadrature
from prt_addon.scene.object_mesh import ObjectMesh
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport.form_factors import spectral_radius
from prt_addon.transport.gather import gather_operator
from prt_addon.transport.live_operator import sampled_rows
from prt_addon.transport.radiosity import BICGSTAB, GAUSS_SEIDEL, JACOBI, choose_solver, solve_radiosity

METHODS = (JACOBI, GAUSS_SEIDEL, BICGSTAB)
DIRECTIONS = 256  # half of them from each receiver
ENTRIES = 128  # kept per row where the operator is stored in a file


def as_package() -> None:
    """The checkout as package `prt`, as the extension is one: gpu_shaders imports by it."""
    package = types.ModuleType("prt")
    package.__path__ = [str(ROOT)]
    sys.modules["prt"] = package


def block_mesh(name: str, low: tuple[float, ...], high: tuple[float, ...], inward: bool = False) -> ObjectMesh:
    """A box with flat normals."""
    unit = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    positions = np.asarray(low) + unit * (np.asarray(high) - np.asarray(low))
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    triangles = (triangles[:, ::-1] if inward else triangles).astype(np.int32)
    corners = positions[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return ObjectMesh(name, positions, triangles, np.repeat(normal[:, None], 3, axis=1).astype(np.float32),
                      np.full((len(triangles), 3, 3), 0.5, np.float32), True)


def room(receivers: int) -> sparse.csr_matrix:
    """Form factors of a room of about so many receivers."""
    spacing = 2.58 / receivers ** 0.5
    meshes = [block_mesh("room", (0, 0, 0), (1, 1, 1), True), block_mesh("block", (0.3, 0.3, 0.05), (0.5, 0.6, 0.45))]
    scene = SceneMesh.assemble(meshes, spacing)
    tracer = Tracer(scene.points, scene.triangles, 0)
    return drain(gather_operator(tracer, scene, np.flatnonzero(~scene.loose), *quadrature(DIRECTIONS, 4))).matrix


def light(size: int, albedo: float | None = None) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Albedo, of coloured surfaces where none is given, and an emittance of a few bright receivers."""
    generator = np.random.default_rng(2)
    coloured = generator.uniform(0.2, 0.8, (size, 3)).astype(np.float32)
    emittance = generator.uniform(size=(size, 3)) * (generator.uniform(size=(size, 1)) < 0.05)
    return coloured if albedo is None else np.full((size, 3), albedo, np.float32), emittance.astype(np.float32)


def error_per_iteration(matrix: sparse.csr_matrix) -> None:
    """Figure 3: the residual after each iteration; and what it took to 1e-5."""
    print(f"\nResidual |E - MB| / |E| after an iteration, {matrix.shape[0]:,} receivers, albedo 0.2 to 0.8")
    print("| iteration | " + " | ".join(METHODS) + " |\n| --- |" + " --- |" * len(METHODS))
    albedo, emittance = light(matrix.shape[0])
    found = {method: solve_radiosity(matrix, albedo, emittance, method, 1e-7) for method in METHODS}
    for step in (1, 2, 3, 4, 6, 8, 12, 16, 20):
        cells = [f"{f.history[step - 1]:.1e}" if step <= f.iterations else "" for f in found.values()]
        print(f"| {step} | " + " | ".join(cells) + " |")
    for method, solution in found.items():
        last = next(k for k, r in enumerate(solution.history) if r <= 1e-5)
        print(f"{method}: 1e-5 after {last + 1} iterations, {solution.seconds[last] * 1e3:.0f} ms")


def stiff(matrix: sparse.csr_matrix, tolerance: float = 1e-4) -> None:
    """Iterations and milliseconds in a closed room of one albedo."""
    print(f"\nA closed room of one albedo, to {tolerance:g}: iterations / ms; the choice is made by predictions alone")
    print("| albedo | estimated radius | " + " | ".join(METHODS) + " | chosen |\n| --- | --- |"
          + " --- |" * (len(METHODS) + 1))
    for albedo in (0.5, 0.7, 0.9, 0.97, 0.99, 0.999):
        rho, emittance = light(matrix.shape[0], albedo)
        radius = spectral_radius(matrix, rho)
        cells = []
        for method in METHODS:
            if albedo > 0.99 and method != BICGSTAB:
                cells.append("")
                continue
            found = solve_radiosity(matrix, rho, emittance, method, tolerance)
            cells.append(f"{found.iterations} / {found.seconds[-1] * 1e3:.0f}")
        cells.append(choose_solver(radius, tolerance))
        print(f"| {albedo} | {radius:.4f} | " + " | ".join(cells) + " |", flush=True)


def seconds_against_receivers(sizes: tuple[int, ...], gpu: bool) -> None:
    """Figure 4: milliseconds per iteration."""
    names = [*METHODS, "sampled Jacobi", *(["GPU Jacobi"] if gpu else [])]
    print(f"\nMilliseconds per iteration ({DIRECTIONS // 2} rays from each receiver; sampled: {ENTRIES} entries kept)")
    print("| receivers | entries | " + " | ".join(names) + " |\n| --- | --- |" + " --- |" * len(names))
    for size in sizes:
        matrix = room(size)
        albedo, emittance = light(matrix.shape[0])
        times = []
        for method in METHODS:
            found = solve_radiosity(matrix, albedo, emittance, method, 1e-30, most=6)
            times.append((found.seconds[-1] - found.seconds[0]) / (found.iterations - 1))
        found = solve_radiosity(sampled_rows(matrix, ENTRIES), albedo, emittance, JACOBI, 1e-30, most=9)
        times.append((found.seconds[-1] - found.seconds[0]) / (found.iterations - 1))
        if gpu:
            times.append(on_gpu(matrix, albedo, emittance))
        print(f"| {matrix.shape[0]:,} | {matrix.nnz:,} | " + " | ".join(f"{t * 1e3:.2f}" for t in times) + " |",
              flush=True)


def on_gpu(matrix: sparse.csr_matrix, albedo: NDArray[np.float32], emittance: NDArray[np.float32]) -> float:
    """Seconds per iteration in the compute shader."""
    from prt.gpu_shaders.radiosity import BATCH, RadiosityOnGpu
    solver = RadiosityOnGpu(matrix)
    solver.solve(albedo, emittance, tolerance=1e-30, most=BATCH)
    found = solver.solve(albedo, emittance, tolerance=1e-30, most=3 * BATCH)
    return (found.seconds[-1] - found.seconds[0]) / (2 * BATCH)


def gpu_at_hand() -> bool:
    """Whether the wheel draws; says why not."""
    try:
        from prt.gpu_shaders import offscreen
        offscreen.prepare_gpu()
    except Exception as error:  # whatever is missing: the other tables are worth printing
        print(f"no GPU module: {error}")
        return False
    return True


def export(folder: Path) -> None:
    """The shader as plain GLSL, a traced room with its solution, and the script that times them."""
    from prt.gpu_shaders.radiosity_texels import JACOBI as PROGRAM
    folder.mkdir(parents=True, exist_ok=True)
    matrix = sampled_rows(room(2000), ENTRIES)
    albedo, emittance = light(matrix.shape[0])
    exact = solve_radiosity(matrix, albedo.astype(np.float64), emittance.astype(np.float64), BICGSTAB, 1e-12)
    (folder / "radiosity_jacobi.glsl").write_text(PROGRAM.glsl())
    np.savez_compressed(folder / "traced_room.npz", data=matrix.data, indices=matrix.indices, indptr=matrix.indptr,
                        albedo=albedo, emittance=emittance, solution=exact.radiosity.astype(np.float32))
    shutil.copy(ROOT / "benchmarks" / "device_radiosity.py", folder)
    size = sum(path.stat().st_size for path in folder.iterdir())
    print(f"wrote {folder}: {size / 1e6:.1f} MB")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="small sizes only")
    parser.add_argument("--export", type=Path)
    arguments = parser.parse_args()
    as_package()
    if arguments.export:
        export(arguments.export)
        return
    began = time.perf_counter()
    matrix = room(2000)
    error_per_iteration(matrix)
    stiff(matrix)
    seconds_against_receivers((500, 1000, 2000) if arguments.quick else (500, 2000, 5000, 14_000, 24_000),
                              gpu_at_hand())
    print(f"\n{time.perf_counter() - began:.0f} s in all")


if __name__ == "__main__":
    main()
