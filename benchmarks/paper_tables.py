# SPDX-License-Identifier: GPL-3.0-or-later
"""Clustered PCA beside the tables and figures of Sloan et al. 2003, on a Buddha of the paper's own vertex count.

    python benchmarks/paper_tables.py [--clusters 256] [--figures] [--cache build/paper_tables]

Signals come from the bake's own fill (order-5 light, 1,024 directions, one bounce; order 10 for 1 x 100), grey, without
the diffuse row; they are kept in the cache folder. Squared errors are of other transfer than the paper's (its BRDFs and
scale are not published), so only ratios between encoders compare. --figures adds error against n' and clusters as SVG.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Generator
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy loads

import numpy as np
from common import ROOT, load_obj, mesh_path, print_table, save_plot, smooth_object
from numpy.typing import NDArray

from prt_addon.baking.recipe import _Bake
from prt_addon.baking.settings import BakeSettings
from prt_addon.compression.encoding import encode, pca, vector_quantization
from prt_addon.compression.settings import EncoderSettings
from prt_addon.reporting.svg_plots import Curve, curves
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.scene.surface_material import SurfaceMaterial

GLOSS = SurfaceMaterial("gloss", (0.8, 0.8, 0.8), roughness=0.4, metallic=1.0, specular_level=0.5)
ANISOTROPIC = replace(GLOSS, anisotropic=0.6)
# Mean free path of 1 % of the Buddha's size (radius / 4 pi, see transport/dipole.py).
WAX = replace(GLOSS, metallic=0.0, subsurface_weight=1.0)
METHODS = ("static", "iterative", "adaptive")
# name: (material, rows, order of the light, n'); the paper's seconds and squared errors, static and iterative.
SIGNALS = {
    "diffuse 1 x 100": (None, 0, 10, 8, "43s / 3m26s (bird)", "3.14 / 0.668 (bird)"),
    "glossy 16 x 25": (GLOSS, 16, 5, 6, "3m30s / 1h51m", "563 / 451"),
    "anisotropic 24 x 25": (ANISOTROPIC, 24, 5, 8, "6m7s / 4h34m", "10996 / 8524"),
    "subsurface + gloss 25 x 25": (WAX, 25, 5, 8, "6m21s / 4h32m", "1992 / 1439"),
}


class _Caught(Exception):
    """Ends a bake where its signals are known."""


class _Signals(_Bake):
    """A bake up to its encoding."""

    def _encode(self, signals: dict[str, NDArray[np.float32]]) -> Generator:
        self.signals = signals
        raise _Caught
        yield


def signal_of(name: str, cache: Path) -> NDArray[np.float32]:
    """(points, rows * columns) of one of SIGNALS."""
    path = cache / f"{name.replace(' ', '')}.npy"
    if path.exists():
        return np.load(path)
    material, rows, order, *_ = SIGNALS[name]
    positions, triangles = load_obj(mesh_path("buddha_nirj.obj"))
    mesh = smooth_object("buddha", positions, triangles, (0.7, 0.7, 0.7))
    if material is not None:
        size = float(np.linalg.norm(np.ptp(positions, axis=0)))
        material = replace(material, subsurface_radius=(0.01 * 4 * np.pi * size,) * 3)
        mesh = replace(mesh, materials=(material,))
    settings = BakeSettings(order=order, directions=1024, gather_directions=128, bounces=1, error_receivers=0,
                            spacing=0.0, glossy_rows=rows, glossy_albedo=0.0)
    bake = _Signals(SceneMesh.assemble([mesh]), settings, None, None, {})
    try:
        for _ in bake.run():
            pass
    except _Caught:
        pass
    found = bake.signals["buddha"][..., 0]
    found = found[:, 1:] if rows else found
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, found.reshape(len(found), -1))
    return np.load(path)


def timed(signal: NDArray[np.float32], clusters: int, vectors: int, method: str) -> tuple[float, float, int]:
    """Seconds, squared error and numbers stored."""
    started = time.perf_counter()
    made = encode(signal, EncoderSettings(clusters, vectors, method, 1))
    return time.perf_counter() - started, made.squared_error, made.storage_cost


def table_1(clusters: int, cache: Path) -> None:
    """All signals and encoders."""
    rows = []
    for name, (*_, vectors, paper_seconds, paper_errors) in SIGNALS.items():
        signal = signal_of(name, cache)
        for method in METHODS:
            seconds, error, cost = timed(signal, clusters, vectors, method)
            rows.append([name, vectors, method, seconds, error, cost, signal.size / cost, paper_seconds, paper_errors])
            print(rows[-1], flush=True)
    print_table(["signal", "n'", "encoder", "seconds", "squared error", "numbers stored", "times fewer",
                 "paper: static / iterative", "paper: squared errors"], rows)


def figure_10(cache: Path) -> None:
    """PCA, VQ and CPCA at about the cost of drawing: 20 vectors, 1,792 clusters, 256 clusters of 8 vectors."""
    signal = signal_of("anisotropic 24 x 25", cache)
    errors = {"CPCA 256 x 8": timed(signal, 256, 8, "iterative")[1], "PCA 1 x 20": pca(signal, 20).squared_error,
              "VQ 1,792": vector_quantization(signal, 1792).squared_error}
    best = errors["CPCA 256 x 8"]
    print_table(["encoder", "squared error", "times CPCA's", "paper (its bird)"],
                [[name, error, error / best, paper]
                 for (name, error), paper in zip(errors.items(), ("1", "344", "50"), strict=True)])


def shape(clusters: int, cache: Path, folder: Path) -> None:
    """Error against n' for each encoder, and how many vectors more the simpler one needs for the same error."""
    signal = signal_of("glossy 16 x 25", cache)
    counts = [2, 3, 4, 6, 8, 10]
    errors = {m: [timed(signal, clusters, n, m)[1] for n in counts] for m in METHODS}
    rows = []
    for place, vectors in enumerate(counts[:4]):
        row = [vectors]
        for better, plain in (("iterative", "static"), ("adaptive", "iterative")):
            logs = np.log(errors[plain])
            needed = np.interp(-np.log(errors[better][place]), -logs, counts)
            row.append(float(needed - vectors))
        rows.append(row)
    print_table(["n'", "static needs so many vectors more than iterative (paper: 1 to 4)",
                 "iterative more than adaptive (paper: 1)"], rows)
    drawn = [Curve(m, list(zip(counts, errors[m], strict=True))) for m in METHODS]
    save_plot(folder / "error_against_vectors.svg", curves(drawn, "vectors n'", "squared error", "Buddha, 16 x 25"))
    numbers = [32, 64, 128, 256, 512]
    drawn = [Curve(m, [(k, timed(signal, k, 6, m)[1]) for k in numbers]) for m in ("static", "iterative")]
    save_plot(folder / "error_against_clusters.svg", curves(drawn, "clusters", "squared error", "Buddha, n' = 6"))
    print(f"plots in {folder.relative_to(ROOT)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clusters", type=int, default=256)
    parser.add_argument("--figures", action="store_true")
    parser.add_argument("--cache", type=Path, default=ROOT / "build" / "paper_tables")
    arguments = parser.parse_args()
    table_1(arguments.clusters, arguments.cache)
    figure_10(arguments.cache)
    if arguments.figures:
        shape(arguments.clusters, arguments.cache, arguments.cache)


if __name__ == "__main__":
    main()
