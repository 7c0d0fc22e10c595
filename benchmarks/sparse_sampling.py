# SPDX-License-Identifier: GPL-3.0-or-later
"""Sparse sampling of transfer (Huang & Ramamoorthi 2010) against all of it in the same run, beside the paper's figures.

    python benchmarks/sparse_sampling.py PART [--scene horse,bunny,buddha] [--edge 32] [--threads 2]

PART: direct (Figures 9, 10), radius (Figure 6), encode (Figure 11), indirect, glossy (Figure 20), pays (where it does),
full (Figure 6's control), caustic (a metal ring), bake (texels as bakes sample them).
A scene is one of the shared meshes on a ground plane of 29,241 vertices from -2 to 2, as the paper's; model and ground
are sampled and told apart. Light for errors: Blender's forest, sunset and city. docs/sparse_precomputation.md.
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the bake's process; before numpy loads

import numpy as np
from common import drain, load_obj, mesh_path, print_table, smooth_object
from numpy.typing import NDArray
from paper_signals import load_ply

from prt_addon.baking.sampling import sparse_settings
from prt_addon.basis.directions import quadrature
from prt_addon.compression.dense_first import encode_dense_first
from prt_addon.compression.encoding import encode
from prt_addon.compression.settings import EncoderSettings
from prt_addon.lighting.cubemap_light import environment_texels
from prt_addon.lighting.environment import load_equirectangular
from prt_addon.linear_algebra import multiply
from prt_addon.scene.object_mesh import ObjectMesh
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.scene.surface_material import SurfaceMaterial
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport.caustic_elements import CausticElements, GlossySurfaces, gathered_caustics
from prt_addon.transport.cubemap_transfer import bounced_columns, cubemap_transfer
from prt_addon.transport.elements import Elements, MatrixElements, VisibilityElements
from prt_addon.transport.factored_brdf import FactoredElements, factored
from prt_addon.transport.gather import gather_operator
from prt_addon.transport.path_elements import PathElements
from prt_addon.transport.receiver_set import ReceiverSet
from prt_addon.transport.reflectance import PrincipledLobe
from prt_addon.transport.sparse_sampling import SparseSettings, SparseTransfer, sparse_transfer
from prt_addon.transport.texel_elements import TexelElements

FILES = {"horse": "vtk_horse.ply", "bunny": "stanford-bunny.obj", "buddha": "buddha_nirj.obj"}
GROUND_SIDE, GROUND_SIZE, HEIGHT = 171, 4.0, 1.4
WORLDS = ("forest", "sunset", "city")
ALBEDO = 0.6
BLOCK = 256
# The ring of the caustics, vertices along the ground's side, paths of an element, and the radius of neighbours.
RING_SEGMENTS, RING_RADIUS, RING_HEIGHT, RING_ROUGHNESS = 96, 0.6, 0.4, 0.4
CAUSTIC_SIDE, CAUSTIC_PATHS, CAUSTIC_RADIUS = 49, 64, 0.06
# Paths and bounces of the element-wise path tracer, and how many elements tell what one costs.
PATHS, BOUNCES, TIMED = 16, 2, 200_000


@dataclass
class Scene:
    """mesh: model, then ground; parts: the receivers of either."""

    mesh: SceneMesh
    tracer: Tracer
    parts: dict[str, ReceiverSet]

    def positions(self, part: str) -> NDArray[np.float64]:
        return self.mesh.points[self.parts[part].key % len(self.mesh.points)]


def ground_plane() -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """A square grid of GROUND_SIDE^2 vertices facing up."""
    n = GROUND_SIDE
    line = (np.arange(n) / (n - 1) - 0.5) * GROUND_SIZE
    x, y = np.meshgrid(line, line, indexing="ij")
    first = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    a, b, c, d = first, first + n, first + n + 1, first + 1
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1), triangles.astype(np.int32)


def model(name: str) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """A shared mesh standing on the ground, wound outwards, without unused vertices."""
    path = mesh_path(FILES[name])
    positions, triangles = (load_ply if path.suffix == ".ply" else load_obj)(path)
    used, triangles = np.unique(triangles, return_inverse=True)
    positions, triangles = positions[used], triangles.reshape(-1, 3).astype(np.int32)
    if name == "bunny":  # Y is up
        positions = np.stack([positions[:, 0], -positions[:, 2], positions[:, 1]], axis=1)
    corners = positions[triangles]
    if np.sum(np.cross(corners[:, 0], corners[:, 1]) * corners[:, 2]) < 0.0:
        triangles = np.ascontiguousarray(triangles[:, ::-1])
    positions = positions - positions.min(axis=0)
    positions *= HEIGHT / positions[:, 2].max()
    positions[:, :2] -= positions[:, :2].max(axis=0) / 2
    return positions, triangles


def build(name: str, threads: int) -> Scene:
    positions, triangles = model(name)
    mesh = SceneMesh.assemble([smooth_object(name, positions, triangles, (ALBEDO,) * 3),
                               smooth_object("ground", *ground_plane(), (ALBEDO,) * 3)])
    tracer = Tracer(mesh.points, mesh.triangles, threads)
    keys = np.flatnonzero(~mesh.loose)
    parts = {"model": keys[keys < len(positions)], "ground": keys[keys >= len(positions)]}
    return Scene(mesh, tracer, {part: ReceiverSet.of_keys(mesh, tracer, some) for part, some in parts.items()})


def world_lights(edge: int) -> NDArray[np.float32]:
    """(columns, 3 per world) of Blender's own world pictures."""
    import bpy
    folder = Path(bpy.utils.resource_path("LOCAL")) / "datafiles" / "studiolights" / "world"
    lights = [environment_texels(load_equirectangular(folder / f"{name}.exr"), edge) for name in WORLDS]
    return np.concatenate(lights, axis=1).astype(np.float32)


def errors(truth: NDArray[np.float32], found: NDArray[np.float32], light: NDArray[np.float32]) -> list[float]:
    """Relative L2 in percent of the elements of (columns, receivers), then of each world's relit radiance."""
    different = whole = 0.0
    exact, relit = (np.zeros((truth.shape[1], light.shape[1]), np.float32) for _ in range(2))
    for start in range(0, len(truth), BLOCK):
        part = slice(start, start + BLOCK)
        different += float(np.sum((truth[part] - found[part]) ** 2, dtype=np.float64))
        whole += float(np.sum(truth[part] ** 2, dtype=np.float64))
        exact += multiply(truth[part].T, light[part])
        relit += multiply(found[part].T, light[part])
    squares = np.sum((relit - exact) ** 2, axis=0).reshape(-1, 3).sum(axis=1)
    return [float(100.0 * (different / whole) ** 0.5),
            *(100.0 * np.sqrt(squares / np.sum(exact ** 2, axis=0).reshape(-1, 3).sum(axis=1))).tolist()]


class Timed:
    """Elements whose seconds are counted."""

    def __init__(self, elements: Elements) -> None:
        self.elements, self.seconds = elements, 0.0

    def __getattr__(self, name: str) -> object:
        return getattr(self.elements, name)

    def __len__(self) -> int:
        return len(self.elements)

    def evaluate(self, receivers: NDArray[np.int64], columns: NDArray[np.int64]) -> NDArray[np.float32]:
        started = time.perf_counter()
        values = self.elements.evaluate(receivers, columns)
        self.seconds += time.perf_counter() - started
        return values


def sampled(scene: Scene, part: str, elements: Elements, settings: SparseSettings,
            ) -> tuple[SparseTransfer, float, float]:
    """The sparse transfer of a part, all seconds, and those of them that elements took."""
    timed, started = Timed(elements), time.perf_counter()
    found = drain(sparse_transfer(timed, scene.positions(part), scene.parts[part].normals, settings))
    return found, time.perf_counter() - started, timed.seconds


def brute(scene: Scene, part: str, edge: int) -> tuple[NDArray[np.float32], float, int]:
    """All direct elements (columns, receivers), seconds, and rays."""
    before, started = scene.tracer.rays, time.perf_counter()
    truth = drain(cubemap_transfer(scene.tracer, scene.parts[part], edge, 1))
    return truth, time.perf_counter() - started, scene.tracer.rays - before


def direct(name: str, arguments: argparse.Namespace) -> None:
    """Sampling rates and errors, Figures 9 and 10, and the seconds that it takes with rays."""
    scene, light, rows = build(name, arguments.threads), world_lights(arguments.edge), []
    for part, receivers in scene.parts.items():
        truth, all_seconds, rays = brute(scene, part, arguments.edge)
        elements = VisibilityElements(scene.tracer, receivers, arguments.edge)
        found, seconds, tracing = sampled(scene, part, elements, SparseSettings())
        dense = found.dense.mean()
        rows.append([f"{name} {part}", len(receivers), 100 * dense, 100 * found.dense_elements / (dense * truth.size),
                     100 * found.sparse_elements / ((1 - dense) * truth.size), 100 * found.sampled,
                     100 * found.sampled * truth.size / rays, *errors(truth, found.transfer, light), all_seconds,
                     tracing, seconds - tracing])
    print_table([f"6 x {arguments.edge} x {arguments.edge}", "vertices",
                 "dense vertices %", "of their directions %", "of sparse ones' %", "all elements %",
                 "of brute force's rays %", "element error %", *(f"{world} %" for world in WORLDS), "all rays s",
                 "sparse: rays s", "sparse: rest s"], rows)


def full(name: str, arguments: argparse.Namespace) -> None:
    """Figure 6's control: all directions as samples, which then don't stand in the result; on sparse vertices alone."""
    scene, light = build(name, arguments.threads), world_lights(arguments.edge)
    truth, _, _ = brute(scene, "ground", arguments.edge)
    rows = []
    for share in (0.01, 0.018, 0.035, 0.06):
        row: list = [share * np.sqrt(2.0) * GROUND_SIZE]
        few = 350 / 6144
        for method, features in (("l1", few), ("least_squares", few), ("least_squares", 1.0), ("l1", 1.0)):
            settings = SparseSettings(radius=share, neighbours=96, method=method, features=features,
                                      samples_stand=False)
            elements = VisibilityElements(scene.tracer, scene.parts["ground"], arguments.edge)
            found, _, _ = sampled(scene, "ground", elements, settings)
            woven = np.flatnonzero(~found.dense)
            row += ["{:.2f} / {:.2f}".format(*errors(truth[:, woven], found.transfer[:, woven], light)[:2])]
        rows.append([*row, found.neighbours])
        print(rows[-1], flush=True)
    print_table([f"{name} ground, radius", f"L1: elements / {WORLDS[0]} %", "least squares",
                 "full: least squares of all directions", "L1 of all directions", "neighbours"], rows)


def radius(name: str, arguments: argparse.Namespace) -> None:
    """Figure 6: error against the radius, for L1, least squares, and weights by distance, on the ground."""
    scene, light = build(name, arguments.threads), world_lights(arguments.edge)
    truth, _, _ = brute(scene, "ground", arguments.edge)
    rows = []
    for share in (0.01, 0.018, 0.035, 0.06):
        row: list = [share * np.sqrt(2.0) * GROUND_SIZE]
        for method in ("l1", "least_squares", "radius"):
            settings = SparseSettings(radius=share, neighbours=96, method=method)
            elements = VisibilityElements(scene.tracer, scene.parts["ground"], arguments.edge)
            found, _, _ = sampled(scene, "ground", elements, settings)
            row += errors(truth, found.transfer, light)[:2] if method != "radius" else [
                *errors(truth, found.transfer, light)[:2], found.neighbours]
        rows.append(row)
    print_table([f"{name} ground, radius", "L1 elements %", f"L1 {WORLDS[0]} %", "least squares elements %",
                 f"{WORLDS[0]} %", "by distance elements %", f"{WORLDS[0]} %", "neighbours"], rows)


def encoders(name: str, arguments: argparse.Namespace) -> None:
    """Figure 11: clustered PCA of the dense vertices, the others joined, against all at once; seconds of processor
    time, as other work shares the cores."""
    from scipy.spatial import KDTree
    scene, rows = build(name, arguments.threads), []
    for part, clusters in (("model", 50), ("ground", 100)):
        elements = VisibilityElements(scene.tracer, scene.parts[part], arguments.edge)
        found, _, _ = sampled(scene, part, elements, SparseSettings())
        signal = np.ascontiguousarray(found.transfer.T)
        places = scene.positions(part)
        joins = np.flatnonzero(found.dense)[KDTree(places[found.dense]).query(places)[1]]
        settings = EncoderSettings(clusters, 24, threads=arguments.threads, restarts=0)
        print(f"{name} {part}: sampled", flush=True)
        started = time.process_time()
        first = encode_dense_first(signal, found.dense, joins, settings)
        between = time.process_time()
        print(f"dense first {between - started:.1f} s, {100 * first.relative_error ** 0.5:.2f} %", flush=True)
        whole = encode(signal, settings)
        ended = time.process_time()
        rows.append([f"{name} {part}", clusters, between - started, ended - between,
                     (ended - between) / (between - started), 100 * first.relative_error ** 0.5,
                     100 * whole.relative_error ** 0.5])
    print_table([f"6 x {arguments.edge} x {arguments.edge}, 24 vectors", "clusters", "dense first s", "full s", "ratio",
                 "dense first error %", "full error %"], rows)


def bounced(scene: Scene, edge: int) -> tuple[dict[str, NDArray[np.float32]], float]:
    """Indirect transfer (receivers, columns) of both parts by the gather operator, and the bounces' seconds."""
    started = time.perf_counter()
    keys = np.concatenate([receivers.key for receivers in scene.parts.values()])
    gather = drain(gather_operator(scene.tracer, scene.mesh, keys, *quadrature(128, 5)))
    seconds = time.perf_counter() - started
    plain = drain(cubemap_transfer(scene.tracer, gather.receivers, edge, 1))
    direct_light = time.perf_counter()
    albedo = np.full((len(gather.receivers), 1), ALBEDO, np.float32)
    both, _ = drain(bounced_columns(gather.matrix, albedo, plain, 1e-3, BOUNCES))
    seconds += time.perf_counter() - direct_light
    both -= plain
    place = np.argsort(gather.receivers.key)
    found = {}
    for part, receivers in scene.parts.items():
        rows = place[np.searchsorted(gather.receivers.key[place], receivers.key)]
        found[part] = np.ascontiguousarray(both[:, rows].T)
    return found, seconds


def path_cost(scene: Scene, part: str, edge: int) -> float:
    """Seconds per element of path tracing them one by one, from TIMED random ones in the order of columns."""
    albedo = np.full(len(scene.mesh.points), ALBEDO)
    elements = PathElements(scene.tracer, scene.mesh, scene.parts[part], albedo, edge, PATHS, BOUNCES)
    generator = np.random.default_rng(0)
    receivers = generator.integers(0, len(elements), TIMED)
    columns = np.sort(generator.integers(0, elements.columns, TIMED))
    started = time.perf_counter()
    elements.evaluate(receivers, columns)
    return (time.perf_counter() - started) / TIMED


def indirect(name: str, arguments: argparse.Namespace) -> None:
    """Two bounces: sparse sampling of what the gather operator gives, and what path tracing would have taken."""
    scene, light = build(name, arguments.threads), world_lights(arguments.edge)
    truths, seconds = bounced(scene, arguments.edge)
    rows = []
    for part, truth in truths.items():
        cost = path_cost(scene, part, arguments.edge)
        found, whole, _ = sampled(scene, part, MatrixElements(truth, angular=False), SparseSettings())
        rows.append([f"{name} {part}", 100 * found.sampled, *errors(truth.T, found.transfer, light), whole, cost * 1e6,
                     cost * truth.size, cost * truth.size * found.sampled + whole, seconds])
    print_table([f"indirect, 6 x {arguments.edge} x {arguments.edge}", "all elements %", "element error %",
                 *(f"{world} %" for world in WORLDS), "sparse without paths s", "us per element (paths)",
                 "all by paths s (from the cost)", "sparse by paths s (from the cost)",
                 "gather operator s (both parts)"], rows)


def glossy(name: str, arguments: argparse.Namespace) -> None:
    """Figure 20: the four terms of a factored BRDF, one visibility for all."""
    scene, light, rows = build(name, arguments.threads), world_lights(arguments.edge), []
    for roughness in (0.5, 0.8):
        lobe = factored(SurfaceMaterial("metal", (0.9,) * 3, roughness=roughness, metallic=1.0))
        for part, receivers in scene.parts.items():
            elements = FactoredElements(scene.tracer, receivers, arguments.edge)
            found, _, _ = sampled(scene, part, elements, SparseSettings())
            truth, _, _ = brute(scene, part, arguments.edge)
            truth = (truth > 0.0).astype(np.float32)  # a face's share near the horizon aside
            terms = []
            for number in range(4):
                factor = elements.term(lobe, number, np.arange(len(receivers))).T
                terms.append(errors(truth * factor, found.transfer * factor, light)[:2])
            rows.append([f"{name} {part}, roughness {roughness}", 100 * lobe.error, 100 * found.sampled,
                         *(f"{element:.1f} / {relit:.1f}" for element, relit in terms)])
    print_table([f"6 x {arguments.edge} x {arguments.edge}", "factorisation error %", "all elements %",
                 *(f"term {number + 1}: elements / {WORLDS[0]} %" for number in range(4))], rows)


def pays(name: str, arguments: argparse.Namespace) -> None:
    """From which cost of an element on sparse sampling is faster than all of them."""
    scene, rows = build(name, arguments.threads), []
    for part, receivers in scene.parts.items():
        truth, all_seconds, rays = brute(scene, part, arguments.edge)
        elements = VisibilityElements(scene.tracer, receivers, arguments.edge)
        found, seconds, tracing = sampled(scene, part, elements, SparseSettings())
        asked = found.dense_elements + found.sparse_elements
        rest = seconds - tracing
        paths = path_cost(scene, part, arguments.edge)
        rows.append([f"{name} {part}", all_seconds / rays * 1e6, tracing / asked * 1e6, rest / (rays - asked) * 1e6,
                     paths * 1e6, all_seconds, seconds, paths * rays, paths * asked + rest,
                     rays / asked])
        del truth
    print_table([f"6 x {arguments.edge} x {arguments.edge}", "ray, all in order us", "ray, sparse us",
                 "break-even us per element", "path-traced element us", "all rays s", "sparse with rays s",
                 "all by paths s (from the cost)", "sparse by paths s (from the cost)", "limit of the gain"], rows)


def bake_texels(name: str, arguments: argparse.Namespace) -> None:
    """Texels as bakes sample them, means over several rays: all of them against sparse sampling; processor seconds."""
    scene, rows = build(name, arguments.threads), []
    for edge, samples in ((8, 4), (16, 2), (32, 1)):
        light = world_lights(edge)
        for part, receivers in scene.parts.items():
            started = time.process_time()
            truth = drain(cubemap_transfer(scene.tracer, receivers, edge, samples))
            between = time.process_time()
            elements = TexelElements(scene.tracer, receivers, edge, samples)
            positions = scene.positions(part)
            found = drain(sparse_transfer(elements, positions, receivers.normals, sparse_settings(positions, 1)))
            ended = time.process_time()
            rows.append([f"{name} {part}, 6 x {edge} x {edge}", samples ** 2, 100 * found.sampled, between - started,
                         ended - between, (between - started) / (ended - between),
                         *errors(truth, found.transfer, light)])
            print(rows[-1], flush=True)
    print_table(["", "rays a texel", "all elements %", "all s", "sparse s", "gain", "element error %",
                 *(f"{world} %" for world in WORLDS)], rows)


def metal_ring() -> ObjectMesh:
    """An open ring of metal that stands on the ground, smooth, round the origin."""
    angle = np.arange(RING_SEGMENTS) * 2 * np.pi / RING_SEGMENTS
    circle = RING_RADIUS * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    low, after = np.arange(RING_SEGMENTS), (np.arange(RING_SEGMENTS) + 1) % RING_SEGMENTS
    points = np.concatenate([np.column_stack([circle, np.full(RING_SEGMENTS, z)]) for z in (0.01, RING_HEIGHT)])
    triangles = np.concatenate([np.stack([low, low + RING_SEGMENTS, after], axis=1),
                                np.stack([after, low + RING_SEGMENTS, after + RING_SEGMENTS], axis=1)])
    return smooth_object("ring", points, triangles.astype(np.int32), (0.9,) * 3)


def caustic(name: str, arguments: argparse.Namespace) -> None:
    """Caustics of a metal ring on the ground: elements by paths, sparsely and all of them, and paths that follow the
    lobe, which carry all columns at once. name is not used."""
    del name
    line = (np.arange(CAUSTIC_SIDE) / (CAUSTIC_SIDE - 1) - 0.5) * 2.4
    x, y = np.meshgrid(line, line, indexing="ij")
    first = (np.arange(CAUSTIC_SIDE - 1)[:, None] * CAUSTIC_SIDE + np.arange(CAUSTIC_SIDE - 1)).ravel()
    quads = np.stack([first, first + CAUSTIC_SIDE, first + CAUSTIC_SIDE + 1, first + 1], axis=1)
    triangles = np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]]).astype(np.int32)
    floor = smooth_object("floor", np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]), triangles, (ALBEDO,) * 3)
    mesh = SceneMesh.assemble([floor, metal_ring()])
    tracer, count = Tracer(mesh.points, mesh.triangles, arguments.threads), x.size
    receivers = ReceiverSet.of_keys(mesh, tracer, np.arange(count))
    lobe = PrincipledLobe(SurfaceMaterial("metal", (0.9,) * 3, roughness=RING_ROUGHNESS, metallic=1.0))
    glossy = GlossySurfaces(lobe, np.arange(len(mesh.points)) >= count)
    edge, light = arguments.edge, world_lights(arguments.edge)
    reference = drain(gathered_caustics(tracer, mesh, receivers, glossy, edge, 1 << 14, BOUNCES, 99))
    rows = []

    def show(way: str, share: float, found: NDArray[np.float32], seconds: float, truth: NDArray[np.float32]) -> None:
        rows.append([way, 100 * share, seconds, *errors(truth, found, light), errors(reference, found, light)[1]])
        print(rows[-1], flush=True)

    for paths in (64, 256, 1024):
        started = time.process_time()
        found = drain(gathered_caustics(tracer, mesh, receivers, glossy, edge, paths, BOUNCES))
        show(f"{paths} paths that follow the lobe", 1.0, found, time.process_time() - started, reference)
    elements = CausticElements(tracer, mesh, receivers, glossy, edge, CAUSTIC_PATHS, BOUNCES)
    started = time.process_time()
    every = np.empty((elements.columns, count), np.float32)
    for column in range(elements.columns):
        every[column] = elements.evaluate(np.arange(count), np.full(count, column))
    every *= elements.factor(np.zeros(1, np.int64)).T
    show(f"every element, {CAUSTIC_PATHS} paths", 1.0, every, time.process_time() - started, reference)
    for angular in (False, True):
        elements = CausticElements(tracer, mesh, receivers, glossy, edge, CAUSTIC_PATHS, BOUNCES, angular=angular)
        started = time.process_time()
        settings = SparseSettings(radius=CAUSTIC_RADIUS, adding_up=0.0, dense=0.25 if not angular else 0.15)
        found = drain(sparse_transfer(elements, mesh.points[receivers.key], receivers.normals, settings))
        way = "sparse, " + ("two passes" if angular else "a quarter of the texels")
        show(way, found.sampled, found.transfer, time.process_time() - started, every)
    print_table([f"6 x {edge} x {edge}, {count} vertices", "elements %", "processor s", "element error %",
                 *(f"{world} %" for world in WORLDS), f"{WORLDS[0]} % against 16,384 paths"], rows)


PARTS = {"direct": direct, "radius": radius, "full": full, "encode": encoders, "indirect": indirect, "glossy": glossy,
         "pays": pays, "caustic": caustic, "bake": bake_texels}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("--scene", default="horse")
    parser.add_argument("--edge", type=int, default=32)
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()
    for name in arguments.scene.split(","):
        PARTS[arguments.part](name, arguments)


if __name__ == "__main__":
    main()
