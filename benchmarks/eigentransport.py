# SPDX-License-Identifier: GPL-3.0-or-later
"""Eigentransport against spherical harmonics and Haar wavelets: error of transport functions, bounces, turns of light.

    python benchmarks/eigentransport.py                      every scene, with and without a ground plane: minutes
    python benchmarks/eigentransport.py --mesh vtk_horse.ply --ground only    one scene
    python benchmarks/eigentransport.py --bounces            the same scenes' bounces, all columns against a basis
    python benchmarks/eigentransport.py --turns              milliseconds and lost light of turns of a 6 x 32 x 32 light

Errors are relative L2 over all receivers' cosine-weighted visibility, integrals over the sphere (Nowrouzezahrai et al.
2007, Figures 3 and 10). Eigentransport and harmonics have the same functions for all receivers; Haar's largest
coefficients differ from receiver to receiver, as in the paper, so that more than so many are stored. Transfer is filled
and analysed in blocks of columns, in a file beyond --budget GB; --receivers bounds how many random vertices of a mesh
(and five eighths as many of the ground) stand for all.
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import dataclass

os.environ.setdefault("OPENBLAS_NUM_THREADS", "2")  # before numpy loads

import numpy as np
from common import drain, load_obj, mesh_path, print_table, smooth_object
from numpy.typing import NDArray
from paper_signals import load_ply
from scipy import linalg

from prt_addon.basis.cubemap import cubemap_directions, cubemap_solid_angles
from prt_addon.basis.directions import quadrature, random_rotation
from prt_addon.basis.haar import haar_transform
from prt_addon.basis.spherical_harmonics import evaluate
from prt_addon.compression.eigentransport import eigentransport
from prt_addon.lighting.cubemap_light import Turn, bilinear_look_up, total_flux
from prt_addon.linear_algebra import multiply
from prt_addon.scene.object_mesh import ObjectMesh
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport.cubemap_transfer import bounced_columns, cubemap_transfer
from prt_addon.transport.gather import gather_operator
from prt_addon.transport.interreflection import interreflect
from prt_addon.transport.receiver_set import ReceiverSet

MESHES = ("buddha_nirj.obj", "stanford-bunny.obj", "vtk_horse.ply")
COUNTS = (12, 36, 48, 64, 72, 96, 144, 192)
ORDERS = (6, 8, 10)
GROUND_CELLS = 172  # 29,929 vertices, as many as the 30k of Huang & Ramamoorthi 2010
HAAR_RECEIVERS = 4096
Single = NDArray[np.float32]


@dataclass(frozen=True)
class Case:
    """scene; keys: the receivers."""

    scene: SceneMesh
    tracer: Tracer
    keys: NDArray[np.int64]


def upright(name: str) -> ObjectMesh:
    """A shared mesh, turned so that its up is +Z, on the plane z = 0."""
    positions, triangles = (load_ply if name.endswith(".ply") else load_obj)(mesh_path(name))
    if name.endswith(".obj"):
        positions = positions[:, [0, 2, 1]] * (1.0, -1.0, 1.0)
    positions -= (*positions[:, :2].mean(axis=0), positions[:, 2].min())
    return smooth_object("model", positions, triangles, (0.7, 0.7, 0.7))


def ground_under(model: ObjectMesh) -> ObjectMesh:
    """A square three times as wide as the model, just under it."""
    size = float(np.ptp(model.positions, axis=0).max())
    line = (np.arange(GROUND_CELLS + 1) / GROUND_CELLS - 0.5) * 3.0 * size
    x, y = np.meshgrid(line, line, indexing="ij")
    positions = np.stack([x.ravel(), y.ravel(), np.full(x.size, -1e-4 * size)], axis=1)
    first = (np.arange(GROUND_CELLS)[:, None] * (GROUND_CELLS + 1) + np.arange(GROUND_CELLS)).ravel()
    a, b, c, d = first, first + GROUND_CELLS + 1, first + GROUND_CELLS + 2, first + 1
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]).astype(np.int32)
    return smooth_object("ground", positions, triangles, (0.7, 0.7, 0.7))


def case_of(name: str, ground: bool, receivers: int) -> Case:
    """A scene and some of its vertices, at random."""
    model = upright(name)
    scene = SceneMesh.assemble([model, ground_under(model)] if ground else [model])
    random = np.random.default_rng(1)
    keys = []
    for number, found in enumerate(scene.objects):
        own = np.arange(found.points.start, found.points.stop)
        own = own[~scene.loose[own]]
        most = receivers if number == 0 else receivers * 5 // 8
        keys.append(own if not receivers or len(own) <= most else random.choice(own, most, replace=False))
    return Case(scene, Tracer(scene.points, scene.triangles), np.sort(np.concatenate(keys)))


def harmonics_errors(transfer: Single, scale: NDArray, r: int, energy: float) -> list[float]:
    """Relative L2 left by least squares on spherical harmonics of each of ORDERS. transfer: (columns, receivers)."""
    root = np.sqrt(cubemap_solid_angles(r))
    functions = evaluate(max(ORDERS), cubemap_directions(r)) * root[:, None]
    axes = np.ascontiguousarray(linalg.qr(functions, mode="economic")[0].T * scale, np.float32)
    projected = np.zeros((len(axes), transfer.shape[1]))
    for start in range(0, len(transfer), 256):
        part = slice(start, start + 256)
        projected += multiply(np.ascontiguousarray(axes[:, part]), transfer[part])
    squares = np.square(projected).sum(axis=1)
    return [float(np.sqrt(max(energy - squares[:order * order].sum(), 0.0) / energy)) for order in ORDERS]


def haar_errors(transfer: Single, scale: NDArray, r: int) -> list[float]:
    """Relative L2 left by each receiver's COUNTS largest Haar coefficients, over some receivers."""
    random = np.random.default_rng(2)
    count = min(HAAR_RECEIVERS, transfer.shape[1])
    chosen = np.sort(random.choice(transfer.shape[1], count, replace=False))
    left, energy = np.zeros(len(COUNTS)), 0.0
    for start in range(0, count, 512):
        rows = transfer[:, chosen[start:start + 512]].T * scale.astype(np.float32)
        squares = np.square(haar_transform(rows, r), dtype=np.float64)
        largest = -np.sort(-np.partition(squares, squares.shape[1] - max(COUNTS), axis=1)[:, -max(COUNTS):], axis=1)
        held = np.cumsum(largest.sum(axis=0))
        energy += squares.sum()
        left += squares.sum() - held[np.array(COUNTS) - 1]
    return [float(np.sqrt(max(value, 0.0) / energy)) for value in left]


def measure(name: str, ground: bool, options: argparse.Namespace) -> list[list]:
    """Rows of the table of one scene."""
    case = case_of(name, ground, options.receivers)
    receivers = ReceiverSet.of_keys(case.scene, case.tracer, case.keys)
    started = time.perf_counter()
    transfer = drain(cubemap_transfer(case.tracer, receivers, options.size, 1, budget=int(options.budget * 1e9)))
    traced = time.perf_counter()
    scale = 1.0 / np.sqrt(cubemap_solid_angles(options.size))
    found = eigentransport(transfer.T, max(COUNTS), scale)
    analysed = time.perf_counter()
    encoding = found.encoding
    energy = encoding.squared_error / encoding.relative_error
    scatter = encoding.squared_error / (1.0 - found.captured[-1])
    harmonics = dict(zip((order * order for order in ORDERS), harmonics_errors(transfer, scale, options.size, energy),
                         strict=True))
    haar = haar_errors(transfer, scale, options.size)
    scene = f"{name.split('.')[0]}{' on a ground' if ground else ''}"
    kind = "file" if isinstance(transfer, np.memmap) else "memory"
    print(f"{scene}: {transfer.shape[1]:,} receivers x {len(transfer):,} columns ({transfer.nbytes / 1e9:.2f} GB in "
          f"{kind}); traced in {traced - started:.1f} s, analysed in {analysed - traced:.1f} s "
          f"({'exactly' if found.exact else 'from a random sample'}); 4 d (v + 1) at d = 192: "
          f"{found.bytes() / 1e6:.1f} MB", flush=True)
    rows = []
    for place, count in enumerate(COUNTS):
        captured = float(found.captured[count - 1])
        ours = float(np.sqrt((1.0 - captured) * scatter / energy))
        nearest = next((value for size, value in harmonics.items() if size == count), None)
        rows.append([scene, count, f"{captured:.1%}", ours, haar[place], "" if nearest is None else nearest])
    rows.append([scene, 100, "", "", "", harmonics[100]])
    return rows


def measure_bounces(name: str, ground: bool, options: argparse.Namespace) -> list[list]:
    """All columns carried by the operator against the direct transfer's leading vectors carried by it."""
    case = case_of(name, ground, 0)
    gathered = drain(gather_operator(case.tracer, case.scene, case.keys, *quadrature(128, 4)))
    budget = int(options.budget * 1e9)
    direct = drain(cubemap_transfer(case.tracer, gathered.receivers, options.size, 1, budget=budget))
    albedo = np.full((len(gathered.receivers), 1), 0.7, np.float32)
    started = time.perf_counter()
    exact, _ = drain(bounced_columns(gathered.matrix, albedo, direct, 1e-3, budget=budget))
    seconds = time.perf_counter() - started
    scene = f"{name.split('.')[0]}{' on a ground' if ground else ''}"
    rows = [[scene, f"all {len(direct):,} columns", seconds, 0.0, 0.0]]
    root = np.sqrt(cubemap_solid_angles(options.size))
    for vectors in (24, 96, 192):
        started = time.perf_counter()
        basis = eigentransport(direct.T, vectors, 1.0 / root).encoding
        found_basis = time.perf_counter()
        start = np.concatenate([np.ones((len(albedo), 1), np.float32), basis.weights], axis=1)
        added = drain(interreflect(gathered.matrix, albedo, start, 1e-3)).transfer[:, :, 0] - start
        carried = time.perf_counter()
        wrong = indirect = total = 0.0
        for first in range(0, len(direct), 256):
            part = slice(first, first + 256)
            there = multiply(np.ascontiguousarray(basis.bases[0, :, part].T), np.ascontiguousarray(added.T))
            weight = 1.0 / root[part, None] ** 2
            wrong += float(np.sum(weight * np.square(direct[part] + there - exact[part], dtype=np.float64)))
            indirect += float(np.sum(weight * np.square(exact[part] - direct[part], dtype=np.float64)))
            total += float(np.sum(weight * np.square(exact[part], dtype=np.float64)))
        rows.append([scene, f"{vectors} vectors ({found_basis - started:.1f} s) and the mean", carried - found_basis,
                     float(np.sqrt(wrong / indirect)), float(np.sqrt(wrong / total))])
    return rows


def measure_turns() -> None:
    """Milliseconds of a turn and its projection, and the flux that a plain look-up keeps of lights of one texel."""
    r, random = 32, np.random.default_rng(1)
    texels = random.random((6 * r * r, 3))
    rows = []
    for vectors in (48, 192):
        bases = random.random((vectors + 1, 6 * r * r)).astype(np.float32)
        seconds = []
        for index in range(40):
            started = time.perf_counter()
            multiply(bases, Turn(r, random_rotation(3, index))(texels).astype(np.float32))
            seconds.append(time.perf_counter() - started)
        rows.append([vectors, float(np.median(seconds) * 1e3), float(np.max(seconds[1:]) * 1e3)])
    print_table(["vectors", "median ms", "largest ms"], rows)
    kept, ours = [], []
    for index in range(200):
        light = np.zeros((6 * r * r, 3))
        light[random.integers(len(light))] = 1e6
        rotation, flux = random_rotation(4, index), total_flux(light, r)[0]
        kept.append(total_flux(bilinear_look_up(light, r, rotation), r)[0] / flux)
        ours.append(total_flux(Turn(r, rotation)(light), r)[0] / flux)
    print(f"flux of a light of one texel after a turn: bilinear look-up alone {min(kept):.3f} to {max(kept):.3f}, "
          f"evened out {min(ours):.9f} to {max(ours):.9f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", action="append", choices=MESHES)
    parser.add_argument("--ground", choices=("both", "only", "none"), default="both")
    parser.add_argument("--size", type=int, default=32, help="texels along an edge of the cubemap")
    parser.add_argument("--receivers", type=int, default=16000, help="0: all")
    parser.add_argument("--budget", type=float, default=1.0, help="GB of an array beyond which it is a file")
    parser.add_argument("--bounces", action="store_true")
    parser.add_argument("--turns", action="store_true")
    options = parser.parse_args()
    if options.turns:
        measure_turns()
        return
    rows = []
    for name in options.mesh or MESHES:
        for ground in {"both": (False, True), "only": (True,), "none": (False,)}[options.ground]:
            rows += (measure_bounces if options.bounces else measure)(name, ground, options)
    if options.bounces:
        print_table(["scene", "carried by the operator", "seconds", "error of bounced light", "error of all"], rows)
    else:
        print_table(["scene", "coefficients", "captured", "eigentransport", "Haar, largest", "harmonics"], rows)


if __name__ == "__main__":
    main()
