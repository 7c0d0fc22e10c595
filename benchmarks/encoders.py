# SPDX-License-Identifier: GPL-3.0-or-later
"""Encoders side by side: seconds and squared error, beside a plain implementation and scikit-learn.

    python benchmarks/encoders.py                              a synthetic signal
    python benchmarks/encoders.py --signal transfer.npy --clusters 256 --vectors 8 --plain

Bakes nothing: reads points x values float32, or makes a smooth-surface signal with shadow edges. Seconds are this
process's own on the processor, all threads together, so that other load on the machine disturbs them less; run with one
BLAS thread (OPENBLAS_NUM_THREADS=1) to compare. Ratios count, not seconds.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from prt_addon.compression.encoding import encode
from prt_addon.compression.settings import EncoderSettings


def synthetic_signal(points: int, values: int, seed: int) -> NDArray[np.float32]:
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


def plain_iterative(signal: NDArray[np.float32], clusters: int, vectors: int, sweeps: int, seed: int) -> float:
    """Section 4.2 with whole-array products: every point against every cluster, exact eigenproblems; squared error."""
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
            if error > last * 0.99:
                break
            last = error
    return error


def _nearest(block: NDArray[np.float32], means: NDArray[np.float32], axes: NDArray[np.float32]) -> NDArray[np.intp]:
    """The subspace with the least squared approximation error for every point of a block."""
    squared = -2 * block @ means.T + (means**2).sum(axis=1)
    for i in range(axes.shape[1]):
        squared -= (block @ axes[:, i].T - (axes[:, i] * means).sum(axis=1)) ** 2
    return squared.argmin(axis=1)


def sklearn_error(signal: NDArray[np.float32], clusters: int, vectors: int, seed: int) -> float:
    """scikit-learn's k-means++ and one PCA per cluster: squared error."""
    from sklearn.cluster import KMeans
    labels = KMeans(min(clusters, len(signal)), n_init=1, random_state=seed).fit_predict(signal)
    return sum(top_vectors(signal[labels == k], vectors)[2] for k in np.unique(labels))


def runs(signal: NDArray[np.float32], options: argparse.Namespace) -> Iterator[tuple[str, Callable[[], float]]]:
    """Name and function, returning the squared error, of everything that is asked for."""
    def ours(method: str, clusters: int, vectors: int) -> Callable[[], float]:
        settings = EncoderSettings(clusters, vectors, method, options.seed)
        return lambda: encode(signal, settings).squared_error
    for method in ("static", "iterative", "adaptive"):
        yield method, ours(method, options.clusters, options.vectors)
    # One PCA and one VQ at about the storage of the clustered one, as the paper compares (m_p n' + m_c (n' + 1) n).
    cost = len(signal) * options.vectors + options.clusters * (options.vectors + 1) * signal.shape[1]
    components = min(signal.shape[1], cost // (len(signal) + signal.shape[1]))
    yield f"PCA, {components} vectors", ours("static", 1, components)
    yield "VQ, same clusters", ours("static", options.clusters, 0)
    if importlib.util.find_spec("sklearn") is None:
        print("scikit-learn is not installed: skipped")
    else:
        yield "sklearn k-means++ and PCA", lambda: sklearn_error(signal, options.clusters, options.vectors,
                                                                 options.seed)
    if options.plain:
        yield "plain iterative", lambda: plain_iterative(signal, options.clusters, options.vectors, options.sweeps,
                                                         options.seed)
    else:
        print("plain iterative: skipped, ask for it with --plain (slow)")


def main() -> None:
    """Parse the command line and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--signal", type=Path, help=".npy of points x values; without it a synthetic one")
    parser.add_argument("--points", type=int, default=20_000)
    parser.add_argument("--values", type=int, default=25)
    parser.add_argument("--every", type=int, default=1, help="use every n-th point of the signal")
    parser.add_argument("--clusters", type=int, default=128)
    parser.add_argument("--vectors", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sweeps", type=int, default=10, help="most LBG sweeps per vector of the plain implementation")
    parser.add_argument("--plain", action="store_true", help="also run the plain whole-array implementation")
    options = parser.parse_args()
    signal = (np.load(options.signal) if options.signal
              else synthetic_signal(options.points, options.values, options.seed))
    signal = np.ascontiguousarray(signal.reshape(len(signal), -1)[::options.every], np.float32)
    points, values = signal.shape
    print(f"{points} points x {values} values, {options.clusters} clusters, {options.vectors} vectors")
    print(f"{'encoder':28}{'seconds':>10}{'squared error':>16}{'of the energy':>16}")
    energy = float(np.square(signal, dtype=np.float64).sum())
    for name, run in runs(signal, options):
        started = time.process_time()
        error = run()
        print(f"{name:28}{time.process_time() - started:10.2f}{error:16.6g}{error / energy:16.3e}", flush=True)


if __name__ == "__main__":
    main()
