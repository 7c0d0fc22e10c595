# SPDX-License-Identifier: GPL-3.0-or-later
"""Encoders side by side in one run: ours, a plain implementation of the paper, scikit-learn and faiss.

    python benchmarks/encoders.py                                            a synthetic signal
    python benchmarks/encoders.py --transfer "anisotropic 24 x 25" --plain   a signal of paper_signals.py and its n'
    python benchmarks/encoders.py --signal transfer.npy --clusters 256 --vectors 8 --plain

Every encoder runs in a process of its own, ours with one thread and with all cores, the others with one. Printed are
wall seconds and processor seconds (all threads together, which other load on the machine disturbs less), the squared
error, ratios to the plain implementation, and the floors of ../shared/design/performance.md, met or missed. Floors
compare processor seconds of one thread. --plain is slow: minutes at 50,000 points of 600 values.

scikit-learn and faiss are no dependencies of the add-on, and left out with a line where absent. To have them:

    python3.13 -m venv build/peers && build/peers/bin/pip install numpy scipy scikit-learn faiss-cpu
    build/peers/bin/python benchmarks/encoders.py ...     (a signal not cached yet needs the add-on's wheels too)
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import importlib.util
import io
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
from prt_addon.compression.encoding import encode
from prt_addon.compression.pca import principal_components
from prt_addon.compression.settings import EncoderSettings
from prt_addon.compression.workers import processor_cores

OURS = ("static", "iterative", "adaptive")
PLAIN, PAPER = "plain, until 1 %", "plain, all sweeps"
SKLEARN, FAISS = "sklearn k-means++, PCA", "faiss k-means, PCA"
PEERS = ("sklearn.cluster", "faiss")
Single = NDArray[np.float32]


def installed(module: str) -> bool:
    """Whether a peer is there, without importing it."""
    return importlib.util.find_spec(module.split(".")[0]) is not None


def synthetic_signal(points: int, values: int, seed: int) -> Single:
    """Clamped cosines of a bumpy closed surface towards many directions, shadowed by half-spaces, in a random basis.

    Like transfer it is smooth but for moving shadow edges, with a spectrum that falls slowly. (points, values) float32.
    """
    generator = np.random.default_rng(seed)
    place = generator.normal(size=(points, 3))
    place /= np.linalg.norm(place, axis=1, keepdims=True)
    waves = generator.normal(size=(3, 12)) * 3
    normals = place + 0.6 * np.cos(place @ waves) @ generator.normal(size=(12, 3)) / 4
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    directions = generator.normal(size=(4 * values, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    offsets = generator.uniform(-0.6, 0.6, 4 * values)
    basis = (generator.normal(size=(4 * values, values)) / np.sqrt(4 * values)).astype(np.float32)
    signal = np.empty((points, values), np.float32)
    for start in range(0, points, 4096):
        rows = slice(start, start + 4096)
        cosine = np.maximum(normals[rows] @ directions.T, 0)
        edge = np.clip((place[rows] @ directions.T - offsets) * 8, 0, 1)
        signal[rows] = (cosine * edge).astype(np.float32) @ basis
    return signal


def top_vectors(points: NDArray, vectors: int) -> tuple[NDArray, NDArray, float]:
    """Mean, leading vectors and squared error of one cluster, by the Gram matrix of the smaller side."""
    mean = points.mean(axis=0, dtype=np.float64)
    centred = points - mean
    wide = len(points) < points.shape[1]
    values, columns = np.linalg.eigh(centred @ centred.T if wide else centred.T @ centred)
    columns = columns[:, ::-1][:, :vectors]
    values = np.maximum(values[::-1], 0)
    rows = (columns.T @ centred) / np.sqrt(np.maximum(values[:vectors], 1e-30))[:, None] if wide else columns.T
    padded = np.zeros((vectors, points.shape[1]))
    padded[:len(rows)] = rows
    return mean, padded, float(values[vectors:].sum())


def plain_iterative(signal: Single, clusters: int, vectors: int, sweeps: int, seed: int, decrease: float) -> float:
    """Section 4.2 with whole-array products: every point against every cluster, exact eigenproblems; squared error.

    sweeps: most per number of vectors (the paper: typically 10-20); decrease: of the error below which they end early,
    relative; -inf does all of them.
    """
    generator = np.random.default_rng(seed)
    means = signal[generator.permutation(len(signal))[:clusters]].astype(np.float32)
    axes = np.zeros((clusters, 0, signal.shape[1]), np.float32)
    error = np.inf
    for count in range(vectors + 1):
        last = np.inf
        for _ in range(sweeps):
            labels = np.concatenate([_nearest(signal[start:start + 2048], means, axes)
                                     for start in range(0, len(signal), 2048)])
            fits = [top_vectors(signal[labels == k], count) if (labels == k).any()
                    else (means[k], np.zeros((count, signal.shape[1])), 0.0) for k in range(len(means))]
            means = np.array([fit[0] for fit in fits], np.float32)
            axes = np.array([fit[1] for fit in fits], np.float32).reshape(len(means), count, signal.shape[1])
            error = sum(fit[2] for fit in fits)
            if error > last * (1 - decrease):
                break
            last = error
    return error


def _nearest(block: Single, means: Single, axes: Single) -> NDArray[np.intp]:
    """The subspace with the least squared approximation error for every point of a block."""
    squared = -2 * block @ means.T + (means**2).sum(axis=1)
    for i in range(axes.shape[1]):
        squared -= (block @ axes[:, i].T - (axes[:, i] * means).sum(axis=1)) ** 2
    return squared.argmin(axis=1)


def error_of_labels(signal: Single, labels: NDArray[np.integer], vectors: int) -> float:
    """Squared error of one PCA per cluster. By our own, which solves for the wanted vectors alone, so that peers that
    cluster by k-means pay the least for it."""
    error = 0.0
    for cluster in np.unique(labels):
        points = signal[labels == cluster]
        mean, _, squares = principal_components(points, vectors)
        error += float(np.square(points - mean).sum()) - float(squares.sum())
    return error


def sklearn_labels(signal: Single, clusters: int, seed: int) -> NDArray[np.int32]:
    """scikit-learn's k-means++ and Lloyd's iterations, its defaults but for one start."""
    from sklearn.cluster import KMeans
    return KMeans(min(clusters, len(signal)), n_init=1, random_state=seed).fit_predict(signal)


def faiss_labels(signal: Single, clusters: int, seed: int, threads: int) -> NDArray[np.int64]:
    """faiss' k-means from random points, its defaults but for using every point."""
    import faiss
    faiss.omp_set_num_threads(threads)
    means = faiss.Kmeans(signal.shape[1], min(clusters, len(signal)), seed=seed, max_points_per_centroid=len(signal))
    means.train(signal)
    return means.index.search(signal, 1)[1][:, 0]


def encoders(signal: Single, options: argparse.Namespace) -> dict[str, Callable[[], float]]:
    """Name and function, returning the squared error, of all that can run here."""
    clusters, vectors, seed, threads = options.clusters, options.vectors, options.seed, options.threads

    def ours(method: str, clusters: int, vectors: int) -> Callable[[], float]:
        return lambda: encode(signal, EncoderSettings(clusters, vectors, method, seed, threads=threads)).squared_error

    def plain(decrease: float) -> Callable[[], float]:
        return lambda: plain_iterative(signal, clusters, vectors, options.sweeps, seed, decrease)
    # One PCA at about the storage of the clustered one, as the paper compares (m_p n' + m_c (n' + 1) n).
    cost = len(signal) * vectors + clusters * (vectors + 1) * signal.shape[1]
    components = min(signal.shape[1], cost // (len(signal) + signal.shape[1]))
    found = {method: ours(method, clusters, vectors) for method in OURS}
    found |= {f"PCA, {components} vectors": ours("static", 1, components), "VQ, as many clusters": ours("static",
                                                                                                        clusters, 0)}
    for peer in PEERS:
        if installed(peer) and options.only:
            importlib.import_module(peer)  # before any clock runs
    if installed("sklearn.cluster"):
        found[SKLEARN] = lambda: error_of_labels(signal, sklearn_labels(signal, clusters, seed), vectors)
    if installed("faiss"):
        found[FAISS] = lambda: error_of_labels(signal, faiss_labels(signal, clusters, seed, threads), vectors)
    if options.plain:
        found |= {PLAIN: plain(0.01), PAPER: plain(-np.inf)}
    return found


@dataclass(frozen=True)
class Measured:
    """One encoder's run: wall and processor seconds, squared error."""

    name: str
    threads: int
    wall: float
    processor: float
    error: float


def measure(signal: Single, options: argparse.Namespace) -> Measured:
    """The encoder options.only, here and now."""
    run = encoders(signal, options)[options.only]
    wall, processor = time.perf_counter(), time.process_time()
    error = run()
    return Measured(options.only, options.threads, time.perf_counter() - wall, time.process_time() - processor, error)


def measure_apart(path: Path, name: str, threads: int, options: argparse.Namespace) -> Measured:
    """The same in a process of its own, whose BLAS and OpenMP know their threads from the start.

    Ours brings its own threads, each with one of BLAS.
    """
    command = [sys.executable, __file__, "--signal", str(path), "--only", name, "--threads", str(threads)]
    command += [f"--{key}={getattr(options, key)}" for key in ("clusters", "vectors", "seed", "sweeps")]
    blas = "1" if name in OURS else str(threads)
    done = subprocess.run([*command, *(["--plain"] if options.plain else [])], check=True, capture_output=True,
                          text=True, env=os.environ | {"OPENBLAS_NUM_THREADS": blas, "OMP_NUM_THREADS": str(threads)})
    return Measured(**json.loads(done.stdout.splitlines()[-1]))


def floors(found: dict[str, Measured], values: int, vectors: int) -> list[tuple[str, float, float, float, float]]:
    """What performance.md asks of these measurements: (name, error ratio, its floor, time ratio, its floor)."""
    asked = []

    def ask(ours: str, other: str, error: float, seconds: float) -> None:
        if other in found:
            a, b = found[ours], found[other]
            asked.append((f"{ours} / {other}", a.error / b.error, error, a.processor / b.processor, seconds))
    # performance.md's floors; elsewhere, never a higher error than the paper's procedure in its time.
    for plain in (PLAIN, PAPER):
        if (values, vectors) == (600, 8):
            ask("iterative", plain, 1.0, 1 / 25)
        elif (values, vectors) == (400, 6):
            ask("iterative", plain, 1.005, 1 / 6)
            ask("iterative", plain, 1.03, 1 / 12)
        else:
            ask("iterative", plain, 1.0, 1.0)
    ask("iterative", SKLEARN, *((0.5, 0.5) if values == 600 else (1.0, np.inf)))
    ask("iterative", FAISS, 1.0, np.inf)
    ask("adaptive", "iterative", 0.9, 2.0)
    return asked


def print_floors(found: dict[str, Measured], values: int, vectors: int) -> None:
    """A table, each ratio beside its floor."""
    def verdict(ratio: float, floor: float) -> str:
        if not np.isfinite(floor):
            return f"{ratio:.3f}"
        return f"{ratio:.3f}, floor {floor:.4g}: {'met' if ratio <= floor else 'MISSED'}"
    print("\n| one thread | squared error, ratio | processor seconds, ratio |\n| --- | --- | --- |")
    for name, error, most_error, seconds, most_seconds in floors(found, values, vectors):
        print(f"| {name} | {verdict(error, most_error)} | {verdict(seconds, most_seconds)} |")


def compare(signal: Single, options: argparse.Namespace) -> None:
    """Everything, and the tables."""
    for name in PEERS:
        if not installed(name):
            print(f"SKIPPED: {name} is not installed (see the top of this file)")
    if not options.plain:
        print("SKIPPED: the plain implementation, ask for it with --plain (slow)")
    energy = float(np.square(signal, dtype=np.float64).sum())
    cores = processor_cores()
    names = list(encoders(signal, options))
    runs = [(name, threads) for name in names for threads in ((1, cores) if name in OURS and cores > 1 else (1,))]
    print("| encoder | threads | wall s | processor s | squared error | of the energy "
          "| plain until 1 %: times its error | times faster | plain, all sweeps: times its error | times faster |")
    print("|" + " --- |" * 10)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "signal.npy"
        np.save(path, signal)
        # The plain ones first, as everything is compared with them.
        results = {run: measure_apart(path, *run, options)
                   for run in sorted(runs, key=lambda run: run[0] not in (PLAIN, PAPER))}
    for run in runs:
        row = results[run]
        cells = [row.name, str(row.threads), f"{row.wall:.2f}", f"{row.processor:.2f}", f"{row.error:.5g}",
                 f"{row.error / energy:.3e}"]
        for plain in (results.get((PLAIN, 1)), results.get((PAPER, 1))):
            cells += [f"{row.error / plain.error:.3f}", f"{plain.processor / row.processor:.1f}"] if plain else ["", ""]
        print("| " + " | ".join(cells) + " |", flush=True)
    print_floors({name: results[name, 1] for name in names}, signal.shape[1], options.vectors)


def main() -> None:
    """Parse the command line and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--signal", type=Path, help=".npy of points x values; without it a synthetic one")
    parser.add_argument("--transfer", help="a signal of paper_signals.py by its name, with the paper's n' for it")
    parser.add_argument("--cache", type=Path, default=ROOT / "build" / "paper_tables", help="where those are kept")
    parser.add_argument("--points", type=int, default=20_000)
    parser.add_argument("--values", type=int, default=25)
    parser.add_argument("--every", type=int, default=1, help="use every n-th point of the signal")
    parser.add_argument("--clusters", type=int, help="256, or 128 for a synthetic signal")
    parser.add_argument("--vectors", type=int, help="4, or the paper's n' for a signal of paper_signals.py")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sweeps", type=int, default=10, help="most LBG sweeps per vector of the plain implementation")
    parser.add_argument("--plain", action="store_true", help="also run the plain whole-array implementation")
    parser.add_argument("--docs", action="store_true", help="also write to docs/paper_tables.md, with --transfer")
    parser.add_argument("--only", help=argparse.SUPPRESS)
    parser.add_argument("--threads", type=int, default=1, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.transfer:
        from paper_signals import SIGNALS, signal_of
        options.vectors = options.vectors or SIGNALS[options.transfer].vectors
        signal = signal_of(options.transfer, options.cache)
    else:
        signal = (np.load(options.signal) if options.signal
                  else synthetic_signal(options.points, options.values, options.seed))
    options.clusters = options.clusters or (256 if options.transfer or options.signal else 128)
    options.vectors = 4 if options.vectors is None else options.vectors
    signal = np.ascontiguousarray(signal.reshape(len(signal), -1)[::options.every], np.float32)
    if options.only:
        print(json.dumps(vars(measure(signal, options))))
        return
    points, values = signal.shape
    text = io.StringIO()
    with contextlib.redirect_stdout(text):
        print(f"{options.transfer or options.signal or 'synthetic'}: {points} points x {values} values, "
              f"{options.clusters} clusters, {options.vectors} vectors\n")
        compare(signal, options)
    print(text.getvalue())
    if options.docs:
        from common import write_block
        write_block(ROOT / "docs" / "paper_tables.md", f"encoders {options.transfer}", text.getvalue().strip())


if __name__ == "__main__":
    main()
