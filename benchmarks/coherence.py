# SPDX-License-Identifier: GPL-3.0-or-later
"""Overdraw before and after reclassification and superclusters, beside the numbers of Sloan et al. 2003, Table 1.

    python benchmarks/coherence.py [--mesh buddha_nirj.obj] [--signal buddha_24x25.npy --rows 24]

Encodes the diffuse transfer of a bake (order 5, with bounces), and a glossy signal, (vertices, rows * columns) as
`glossy.py --write` leaves it, where one is given or found. Seconds are those of the coherence step alone, all three
results included.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the bake's process; before numpy loads

import numpy as np
from common import best_of, drain, load_obj, mesh_path, print_table, smooth_object
from numpy.typing import NDArray

from prt_addon.basis.directions import quadrature
from prt_addon.basis.hemisphere import gram_matrix
from prt_addon.compression.coherence import REGISTERS, make_coherent
from prt_addon.compression.encoding import encode
from prt_addon.compression.settings import METHODS, EncoderSettings
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport.direct import direct_transfer
from prt_addon.transport.gather import gather_operator
from prt_addon.transport.interreflection import interreflect

ORDER, ALBEDO = 5, 0.5
# Table 1's lines below the encoders: anisotropic gloss 24 x 25, n' = 8, m_c = 256, 5 % of the squared error.
PUBLISHED = [["paper: Buddha, 24 x 25", 0.05, 1.93, 1.72, 1.61, 1.48], ["paper: bird, 24 x 25", 0.05, 1.25, 1.23, 1.14,
                                                                       1.138]]


def diffuse_signal(positions: NDArray[np.float64], triangles: NDArray[np.int32],
                   directions: int) -> NDArray[np.float32]:
    """Diffuse transfer (vertices, 25) with bounces, zero at vertices without a face."""
    scene = SceneMesh.assemble([smooth_object("mesh", positions, triangles, (ALBEDO,) * 3)])
    tracer = Tracer(scene.points, scene.triangles, 0)
    if len(scene.points) != len(positions):
        raise SystemExit("the mesh's vertices were split: give a smooth one")
    gathered = drain(gather_operator(tracer, scene, np.flatnonzero(~scene.loose), *quadrature(directions // 8, 4)))
    direct = drain(direct_transfer(tracer, gathered.receivers, *quadrature(directions, ORDER), ORDER))
    albedo = np.full((len(gathered.receivers), 1), ALBEDO, np.float32)
    transfer = drain(interreflect(gathered.matrix, albedo, direct, 1e-3)).transfer
    signal = np.zeros((len(positions), ORDER**2), np.float32)
    front = gathered.receivers.key < len(positions)
    signal[gathered.receivers.key[front]] = transfer[front, :, 0]
    return signal


def measure(name: str, triangles: NDArray[np.int32], signal: NDArray[np.float32], rows: int, metric: NDArray | None,
            options: argparse.Namespace) -> Iterator[list[object]]:
    """Rows of the table for one signal, one for each share of the squared error."""
    started = time.perf_counter()
    encoding = encode(signal, EncoderSettings(options.clusters, options.vectors, options.encoder, 1), metric)
    print(f"{name}: encoded in {time.perf_counter() - started:.1f} s, squared error {encoding.squared_error:.6g}",
          flush=True)
    for share in options.share:
        seconds, (_, found) = best_of(options.runs, lambda share=share: make_coherent(
            encoding, triangles, signal, share, metric, rows, options.registers))
        yield [name, share, found.before, found.reclassified, found.superclustered, found.both,
               found.squared_error_after / found.squared_error_before, found.moved, found.superclusters, seconds]


def main() -> None:
    """Parse the command line and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", default="buddha_nirj.obj")
    parser.add_argument("--signal", type=Path, help="glossy signal (.npy), as benchmarks/glossy.py --write makes it")
    parser.add_argument("--rows", type=int, default=24, help="rows of the glossy signal's matrices")
    parser.add_argument("--metric", action="store_true", help="also with the glossy signal in the hemisphere's metric")
    parser.add_argument("--encoder", default="iterative", choices=METHODS)
    parser.add_argument("--clusters", type=int, default=256)
    parser.add_argument("--vectors", type=int, default=8)
    parser.add_argument("--share", type=float, nargs="+", default=[0.05, 0.1])
    parser.add_argument("--registers", type=int, default=REGISTERS)
    parser.add_argument("--directions", type=int, default=2048)
    parser.add_argument("--runs", type=int, default=1, help="take the least seconds of so many runs")
    options = parser.parse_args()
    positions, triangles = load_obj(mesh_path(options.mesh))
    table = list(measure(f"diffuse 1 x {ORDER**2}", triangles, diffuse_signal(positions, triangles, options.directions),
                         1, None, options))
    path = options.signal
    if path is not None and path.exists():
        signal = np.load(path)
        if len(signal) != len(positions):
            raise SystemExit(f"{path} has {len(signal)} rows, the mesh {len(positions)} vertices")
        name = f"glossy {options.rows} x {signal.shape[1] // options.rows}"
        table += measure(name, triangles, signal, options.rows, None, options)
        if options.metric:
            functions = tuple(i for i in range(25) if options.rows != 24 or i != 2)[:options.rows]
            table += measure(f"{name}, metric", triangles, signal, options.rows, gram_matrix(functions), options)
    else:
        print("skipped: no glossy signal was given")
    print(f"{len(positions)} vertices, {len(triangles)} triangles, {options.encoder}, {options.clusters} clusters, "
          f"{options.vectors} vectors, {options.registers} registers; mean overdraw")
    print_table(["signal", "share", "before", "rec", "sc", "both", "error ratio", "moved", "superclusters", "seconds"],
                [*table, *(row + [""] * 4 for row in PUBLISHED)])


if __name__ == "__main__":
    main()
