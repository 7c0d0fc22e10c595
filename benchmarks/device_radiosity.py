# SPDX-License-Identifier: GPL-3.0-or-later
"""Matrix radiosity's Jacobi iterations on a real GPU against scipy on its CPU. Stands alone: no Blender, no checkout.

    python device_radiosity.py [FOLDER] [--output R.json]

FOLDER (this file's by default): what `benchmarks/radiosity.py --export` wrote, radiosity_jacobi.glsl and
traced_room.npz. Needs moderngl, numpy and scipy. Two checks (the traced room against its solution in double precision,
each size against the same iterations of scipy), then seconds per iteration at 2,000, 10,000 and 20,000 receivers: of
the GPU by its own clock and by the wall, of scipy on one thread.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import moderngl
import numpy as np
from scipy import sparse

WIDTH, GROUP = 2048, 64
SIZES = (2_000, 10_000, 20_000)
RAYS = 128
TARGET_SECONDS = 1.5  # of GPU iterations for each size


def box_room(receivers: int, seed: int = 1) -> sparse.csr_matrix:
    """Form factors (r, r) of patches of a unit box seen from inside, by RAYS cosine-distributed rays from each."""
    side = round((receivers / 6) ** 0.5)
    generator = np.random.default_rng(seed)
    ticks = (np.arange(side) + 0.5) / side
    first, second = (grid.ravel() for grid in np.meshgrid(ticks, ticks, indexing="ij"))
    rows, columns = [], []
    for axis in range(3):
        for end in (0.0, 1.0):
            count = side * side
            radius = np.sqrt((np.arange(RAYS) + generator.uniform(size=(count, RAYS))) / RAYS)
            turn = 2 * np.pi * (np.arange(RAYS) * 0.6180339887 + generator.uniform(size=(count, 1)))
            direction = np.empty((count, RAYS, 3))
            direction[..., (axis + 1) % 3] = radius * np.cos(turn)
            direction[..., (axis + 2) % 3] = radius * np.sin(turn)
            direction[..., axis] = np.sqrt(np.maximum(1.0 - radius ** 2, 1e-12)) * (1.0 if end == 0.0 else -1.0)
            origin = np.empty((count, 1, 3))
            origin[:, 0, axis], origin[:, 0, (axis + 1) % 3], origin[:, 0, (axis + 2) % 3] = end, first, second
            with np.errstate(divide="ignore", invalid="ignore"):
                distance = np.where(direction > 0.0, (1.0 - origin) / direction, -origin / direction)
            distance[..., axis] = 1.0 / np.abs(direction[..., axis])
            wall = distance.argmin(axis=2)
            hit = origin + direction * distance.min(axis=2)[..., None]
            across = [along(hit, (wall + offset) % 3) for offset in (1, 2)]
            cell = np.clip((np.stack(across) * side).astype(np.int64), 0, side - 1)
            far = along(direction, wall) > 0.0
            columns.append((((2 * wall + far) * side + cell[0]) * side + cell[1]).ravel())
            start = (2 * axis + int(end)) * count
            rows.append(np.repeat(start + np.arange(count), RAYS))
    values = np.full(6 * side * side * RAYS, 1.0 / RAYS, np.float32)
    size = 6 * side * side
    return sparse.coo_matrix((values, (np.concatenate(rows), np.concatenate(columns))), (size, size)).tocsr()


def along(vectors: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Of vectors (..., 3) the component along an axis (...) each."""
    return np.take_along_axis(vectors, axis[..., None], -1)[..., 0]


def texels(values: np.ndarray) -> np.ndarray:
    """(n, 1..4) values as RGBA texels in rows of WIDTH."""
    height = max(1, -(-len(values) // WIDTH))
    result = np.zeros((height * WIDTH, 4), np.float32)
    result[:len(values), :values.shape[1]] = values
    return result.reshape(height, WIDTH, 4)


class Gpu:
    """The exported program with one matrix."""

    def __init__(self, context: moderngl.Context, source: str, matrix: sparse.csr_matrix) -> None:
        self.context, self.program, self.size = context, context.compute_shader(source), matrix.shape[0]
        counts = np.diff(matrix.indptr)
        pairs = -(-counts // 2)
        place = np.arange(matrix.nnz) - np.repeat(matrix.indptr[:-1], counts)
        entries = np.zeros((int(pairs.max()) * self.size, 2, 2), np.float32)
        where = place // 2 * self.size + np.repeat(np.arange(self.size), counts)
        entries[where, place % 2, 0], entries[where, place % 2, 1] = matrix.indices, matrix.data
        rows = np.stack([pairs, matrix.diagonal()], axis=1)
        self.fixed = [self.texture(entries.reshape(-1, 4)), self.texture(rows)]

    def texture(self, values: np.ndarray) -> moderngl.Texture:
        found = texels(values)
        texture = self.context.texture((WIDTH, len(found)), 4, found.tobytes(), dtype="f4")
        texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        return texture

    def start(self, albedo: np.ndarray, emittance: np.ndarray) -> None:
        self.light = [self.texture(albedo), self.texture(emittance)]
        self.pair = [self.texture(emittance), self.texture(emittance)]
        self.program["receivers"].value = self.size

    def iterate(self, times: int) -> None:
        for slot, texture in enumerate((*self.fixed, *self.light)):
            texture.use(slot)
        for _ in range(times):
            now, after = self.pair
            now.use(4)
            after.bind_to_image(0, read=False, write=True)
            self.program.run(WIDTH // GROUP, after.height, 1)
            self.context.memory_barrier()
            self.pair = [after, now]

    def radiosity(self) -> np.ndarray:
        return np.frombuffer(self.pair[0].read(), np.float32).reshape(-1, 4)[:self.size, :3]


def jacobi(matrix: sparse.csr_matrix, albedo: np.ndarray, emittance: np.ndarray, times: int) -> np.ndarray:
    """The same iterations by scipy."""
    values, inverse = emittance.copy(), 1.0 / (1.0 - albedo * matrix.diagonal()[:, None])
    for _ in range(times):
        values = values + inverse * (emittance + albedo * (matrix @ values) - values)
    return values


def largest_difference(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.abs(found - expected).max() / np.abs(expected).max())


def check_traced(context: moderngl.Context, source: str, path: Path) -> dict[str, float]:
    """The traced room, until nothing changes any more, against its solution in double precision."""
    stored = np.load(path)
    size = len(stored["indptr"]) - 1
    matrix = sparse.csr_matrix((stored["data"], stored["indices"], stored["indptr"]), (size, size))
    solver = Gpu(context, source, matrix)
    solver.start(stored["albedo"], stored["emittance"])
    solver.iterate(200)
    return {"receivers": size, "entries": int(matrix.nnz),
            "difference": largest_difference(solver.radiosity(), stored["solution"])}


def measure(context: moderngl.Context, source: str, receivers: int) -> dict[str, float]:
    """Seconds per iteration of one size."""
    matrix = box_room(receivers)
    size, generator = matrix.shape[0], np.random.default_rng(2)
    albedo = generator.uniform(0.2, 0.8, (size, 3)).astype(np.float32)
    emittance = (generator.uniform(size=(size, 3)) * (generator.uniform(size=(size, 1)) < 0.05)).astype(np.float32)
    solver = Gpu(context, source, matrix)
    solver.start(albedo, emittance)
    solver.iterate(10)
    difference = largest_difference(solver.radiosity(), jacobi(matrix, albedo, emittance, 10))
    began = time.perf_counter()
    solver.iterate(5)
    context.finish()
    times = int(np.clip(5 * TARGET_SECONDS / max(time.perf_counter() - began, 1e-6), 5, 2000))
    query = context.query(time=True)
    began = time.perf_counter()
    with query:
        solver.iterate(times)
    context.finish()
    wall = (time.perf_counter() - began) / times
    began = time.perf_counter()
    solver.radiosity()
    read = time.perf_counter() - began
    jacobi(matrix, albedo, emittance, 1)
    runs = max(3, min(100, int(1e7 / matrix.nnz)))
    began = time.perf_counter()
    jacobi(matrix, albedo, emittance, runs)
    cpu = (time.perf_counter() - began) / runs
    return {"receivers": size, "entries": int(matrix.nnz), "gpu_ms": query.elapsed * 1e-6 / times,
            "wall_ms": wall * 1e3, "read_ms": read * 1e3, "scipy_ms": cpu * 1e3, "factor": cpu / wall,
            "difference": difference}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=Path(__file__).parent)
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    context = moderngl.create_standalone_context(require=430, backend="egl")
    source = (arguments.folder / "radiosity_jacobi.glsl").read_text()
    found = {"gpu": context.info["GL_RENDERER"], "version": context.info["GL_VERSION"]}
    print(f"{found['gpu']}, {found['version']}")
    found["traced"] = check_traced(context, source, arguments.folder / "traced_room.npz")
    print(f"traced room, {found['traced']['receivers']} receivers: largest difference from double precision "
          f"{found['traced']['difference']:.1e} of the brightest")
    found["sizes"] = []
    print("| receivers | entries | GPU ms per iteration | with calls | reading ms | scipy ms | factor | difference |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for receivers in SIZES:
        row = measure(context, source, receivers)
        found["sizes"].append(row)
        print(f"| {row['receivers']:,} | {row['entries']:,} | {row['gpu_ms']:.4f} | {row['wall_ms']:.4f} | "
              f"{row['read_ms']:.2f} | {row['scipy_ms']:.2f} | {row['factor']:.1f} | {row['difference']:.1e} |",
              flush=True)
    if arguments.output:
        arguments.output.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
