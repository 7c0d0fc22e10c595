# SPDX-License-Identifier: GPL-3.0-or-later
"""Seconds of each stage of the glossy transfer of one mesh, and its signal for the encoder's benchmarks.

    python benchmarks/glossy.py [--rows 24] [--light-order 5] [--indirect] [--write signal.npy]

The material is a Phong lobe (isotropic, --rows 16 or 25) or a lobe stretched along the tangent (24 rows without l=1,
m=0), fitted by quadrature. The signal is (points, rows * columns * channels), in the order of the mesh's vertices.
"""

from __future__ import annotations

import argparse
import os
import resource
import time
from collections.abc import Generator
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the bake's process; before numpy loads

import numpy as np
from common import drain, load_obj, mesh_path, print_table, smooth_object

from prt_addon.basis.directions import quadrature
from prt_addon.basis.spherical_harmonics import evaluate
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport.direct import direct_transfer
from prt_addon.transport.gather import gather_operator
from prt_addon.transport.glossy import GlossySurfaces, glossy_transfer, surface_frames
from prt_addon.transport.hemisphere_visibility import HemisphereVisibility
from prt_addon.transport.incident_light import DiffuseRadiance, GlossyRadiance, IndirectLight
from prt_addon.transport.interreflection import interreflect
from prt_addon.transport.receiver_set import ReceiverSet

ALBEDO, EXPONENT = 0.5, 12.0


def lobe_kernel(functions: np.ndarray, incident_order: int, stretch: float) -> np.ndarray:
    """K (rows, incident functions, 1) = A^-1 B A^-1 of a Phong lobe, narrower by `stretch` across the tangent."""
    directions, weights = quadrature(4096, 8)
    upper = directions[:, 2] > 0.0
    directions, weights = directions[upper], weights[upper]
    mirrored = directions * (-1.0, -1.0, 1.0)
    scale = np.array([1.0, stretch, 1.0])
    difference = ((directions[:, None, :] - mirrored[None, :, :]) * scale)
    lobe = np.exp(-0.5 * EXPONENT * np.sum(difference ** 2, axis=2)) * (EXPONENT + 1) / (2 * np.pi)
    exit_values, incident_values = evaluate(5, directions)[:, functions], evaluate(incident_order, directions)
    brdf = (exit_values * weights[:, None]).T @ lobe @ (incident_values * (weights * directions[:, 2])[:, None])
    exit_gram = (exit_values * weights[:, None]).T @ exit_values
    incident_gram = (incident_values * weights[:, None]).T @ incident_values
    kernel = np.linalg.solve(exit_gram, np.linalg.solve(incident_gram, brdf.T).T)
    return kernel[:, :, None]


def row_functions(rows: int) -> np.ndarray:
    """Numbers of the exit functions: all of an order, or the 24 of order 5 without l=1, m=0."""
    return np.delete(np.arange(25), 2) if rows == 24 else np.arange(rows)


class Clock:
    """Seconds of named stages."""

    def __init__(self) -> None:
        self.rows: list[list[Any]] = []

    def run(self, name: str, steps: Generator[Any, None, Any]) -> Any:
        """Exhaust a fill and note how long it took."""
        started = time.perf_counter()
        result = drain(steps)
        self.rows.append([name, time.perf_counter() - started])
        return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", default="buddha_nirj.obj")
    parser.add_argument("--rows", type=int, default=24, choices=(9, 16, 24, 25))
    parser.add_argument("--light-order", type=int, default=5)
    parser.add_argument("--incident-order", type=int, default=5)
    parser.add_argument("--directions", type=int, default=1024)
    parser.add_argument("--gather-directions", type=int, default=128)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--channels", type=int, default=1, choices=(1, 3))
    parser.add_argument("--indirect", action="store_true", help="diffuse bounces into the glossy rows, a glossy bounce")
    parser.add_argument("--compare", action="store_true", help="also the diffuse transfer alone, before and after")
    parser.add_argument("--write", help="write the glossy signal (points, rows * columns * channels) as .npy")
    arguments = parser.parse_args()
    positions, triangles = load_obj(mesh_path(arguments.mesh))
    scene = SceneMesh.assemble([smooth_object("mesh", positions, triangles, (ALBEDO,) * 3)])
    clock = Clock()
    matrices, receivers = fill(scene, arguments, clock)
    print_table(["stage", "seconds"], clock.rows)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    print(f"{len(receivers)} receivers, {' x '.join(map(str, matrices.shape[1:]))}, {matrices.nbytes / 1e6:.0f} MB; "
          f"peak memory of the process {peak:.0f} MB")
    if arguments.write:
        front = receivers.key < len(scene.points)
        signal = np.zeros((len(scene.points), matrices[0].size), np.float32)
        signal[receivers.key[front]] = matrices.reshape(len(matrices), -1)[front]
        np.save(arguments.write, signal)
        print(f"wrote {arguments.write} {signal.shape}")


def fill(scene: SceneMesh, arguments: argparse.Namespace, clock: Clock) -> tuple[np.ndarray, ReceiverSet]:
    """All stages; the glossy matrices (g, rows, columns, channels) and their receivers."""
    order, incident = arguments.light_order, arguments.incident_order
    tracer = Tracer(scene.points, scene.triangles, arguments.threads)
    keys = np.flatnonzero(~scene.loose)
    functions = row_functions(arguments.rows)
    gathered = None
    if arguments.indirect:
        wanted = np.ones(2 * len(scene.points), bool)
        gathered = clock.run("gather, hits kept", gather_operator(
            tracer, scene, keys, *quadrature(arguments.gather_directions, 4), wanted=wanted))
    receivers = gathered.receivers if gathered else ReceiverSet.of_keys(scene, tracer, keys)
    directions = quadrature(arguments.directions, order)
    if arguments.compare:
        clock.run("diffuse transfer alone", direct_transfer(tracer, receivers, *directions, order))
    plain = HemisphereVisibility(np.ones(len(receivers), bool), incident + order - 1, incident if gathered else 0)
    direct = clock.run("diffuse transfer with visibility",
                       direct_transfer(tracer, receivers, *directions, order, plain=plain))
    if arguments.compare:
        clock.run("diffuse transfer alone", direct_transfer(tracer, receivers, *directions, order))
    started = time.perf_counter()
    visibility = plain.result(receivers.normals)
    tangents = np.cross((0.0, 0.0, 1.0), receivers.normals)
    colours = np.array([1.0, 0.8, 0.5])[:arguments.channels]
    kernel = lobe_kernel(functions, incident, 2.0 if arguments.rows == 24 else 1.0) * colours
    frames = surface_frames(receivers.normals, tangents)
    surfaces = GlossySurfaces(frames, np.zeros(len(receivers), np.int64), (kernel,))
    clock.rows.append(["coefficients, frames, kernel", time.perf_counter() - started])
    if gathered is None:
        return clock.run("glossy matrices", glossy_transfer(tracer, surfaces, order, visibility.visible)), receivers
    albedo = np.full((len(receivers), arguments.channels), ALBEDO, np.float32)
    bounced = clock.run("diffuse bounces", interreflect(gathered.matrix, albedo, direct, 1e-3)).transfer
    record = gathered.hits
    print(f"{len(record.triangle)} hits, {sum(a.nbytes for a in vars(record).values()) / 1e6:.0f} MB")
    source = DiffuseRadiance(record, scene, receivers, bounced * albedo[:, None, :])
    indirect = IndirectLight(record, source, visibility.rows, visibility.blocked)
    matrices = clock.run("glossy matrices, diffuse bounces in",
                         glossy_transfer(tracer, surfaces, order, visibility.visible, indirect))
    glossy = GlossyRadiance(record, scene, receivers.key, surfaces.frames, matrices, functions)
    second = IndirectLight(record, glossy, visibility.rows, visibility.blocked)
    diffuse = np.empty((len(matrices), order ** 2 * arguments.channels), np.float32)
    added = clock.run("glossy bounce", glossy_transfer(tracer, surfaces, order, None, second, diffuse=diffuse))
    size = [float(np.sqrt(np.mean(np.square(a[::16], dtype=np.float64)))) for a in (matrices, added)]
    print(f"RMS of the matrices {size[0]:.4g}, of the glossy bounce {size[1]:.4g}")
    matrices += added
    return matrices, receivers


if __name__ == "__main__":
    main()
