# SPDX-License-Identifier: GPL-3.0-or-later
"""Clustered PCA beside Table 1 and Figures 2, 3, 10 and 11 of Sloan et al. 2003.

    python benchmarks/paper_tables.py table                        some three minutes; timings want a quiet machine
    python benchmarks/paper_tables.py figure2 figure3              five minutes on two shared cores
    python benchmarks/paper_tables.py figure10 figure11            four minutes

Each part prints Markdown; --docs also writes it to its place in docs/paper_tables.md, and the plots beside it. Signals
(paper_signals.py) are kept in the cache folder. Squared errors are of other transfer than the paper's (its BRDFs and
scale are not published), so only ratios between encoders compare. Seconds are wall time with a thread for each core.
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy loads; the encoder brings its own threads

import numpy as np
from common import ROOT, markdown_table, save_plot, write_block
from numpy.typing import NDArray
from paper_signals import SIGNALS, signal_of

from prt_addon.compression.encoding import Encoding, encode, pca, vector_quantization
from prt_addon.compression.pca import principal_components
from prt_addon.compression.settings import METHODS, EncoderSettings
from prt_addon.linear_algebra import multiply
from prt_addon.reporting.svg_plots import Curve, curves

DOCS = ROOT / "docs"
CLUSTERS = 256
Single = NDArray[np.float32]
# The paper's seconds and squared errors of static and iterative encoding; the bird's beside the horse.
PAPER_TABLE = {
    "glossy 16 x 25": (("3 m 30 s", 563.0), ("1 h 51 m", 451.0)),
    "anisotropic 24 x 25": (("6 m 7 s", 10996.0), ("4 h 34 m", 8524.0)),
    "subsurface + gloss 25 x 25": (("6 m 21 s", 1992.0), ("4 h 32 m", 1439.0)),
    "horse diffuse 1 x 100": (("43 s", 3.14), ("3 m 26 s", 0.668)),
    "horse anisotropic 24 x 25": (("6 m 34 s", 898.0), ("3 h 43 m", 294.0)),
}
TABLE = ("diffuse 1 x 100", "glossy 16 x 25", "anisotropic 24 x 25", "subsurface + gloss 25 x 25",
         "horse diffuse 1 x 100", "horse anisotropic 24 x 25")
# Figures 10 and 11: our signal, the paper's model, its squared errors for PCA 1 x 20, VQ 1,792 and CPCA 256 x 8, and
# for 256 clusters of 2, 4, 8 and 12 vectors.
COUNTS_11 = (2, 4, 8, 12)
PAPER_FIGURES = {
    "anisotropic 24 x 25": ("Buddha", None, (40353.5, 21077.5, 8524.1, 4413.01)),
    "horse anisotropic 24 x 25": ("bird", (101304.0, 14799.0, 294.4), (9510.75, 2353.09, 294.421, 66.7495)),
}
MOST_ERROR, MOST_SECONDS = 0.9, 2.0  # of adaptive against iterative: performance.md's floors


@dataclass(frozen=True)
class Run:
    """One encode: wall seconds, and what came of it."""

    seconds: float
    made: Encoding

    @property
    def error(self) -> float:
        return self.made.squared_error


def run(signal: Single, vectors: int, method: str, clusters: int = CLUSTERS,
        metric: NDArray[np.float64] | None = None) -> Run:
    """One encode with a thread for each core and the default settings."""
    started = time.perf_counter()
    made = encode(signal, EncoderSettings(clusters, vectors, method, 1), metric)
    return Run(time.perf_counter() - started, made)


def error_over_hemisphere(signal: Single, made: Encoding, metric: NDArray[np.float64]) -> float:
    """Squared error of exit radiance over the hemisphere of views, e^T A e summed over points and columns."""
    error = 0.0
    for start in range(0, len(signal), 4096):
        rows = slice(start, start + 4096)
        wrong = signal[rows].astype(np.float64) - made.decode(rows)
        wrong = np.moveaxis(wrong.reshape(len(wrong), len(metric), -1), 1, 0).reshape(len(metric), -1)
        error += float((wrong * multiply(metric, wrong)).sum())
    return error


def table_1(cache: Path, chosen: str) -> str:
    """All signals and encoders beside the paper's, the ratios, and the errors over the hemisphere."""
    rows, ratios, hemisphere = [], [], []
    for name in TABLE:
        if not name.startswith(chosen):
            continue
        signal, vectors, metric = signal_of(name, cache), SIGNALS[name].vectors, SIGNALS[name].metric
        runs = {method: run(signal, vectors, method) for method in METHODS}
        paper = dict(zip(METHODS, PAPER_TABLE.get(name, ()), strict=False))
        for method, found in runs.items():
            cost = found.made.storage_cost
            rows.append([name, vectors, method, found.seconds, found.error, f"{cost:,}", signal.size / cost,
                         *paper.get(method, ("", ""))])
        ratios.append(_ratios(name, runs, paper))
        if metric is not None:
            coefficients = error_over_hemisphere(signal, runs["iterative"].made, metric)
            better = run(signal, vectors, "iterative", metric=metric)
            seen = error_over_hemisphere(signal, better.made, metric)
            hemisphere.append([name, coefficients, seen, seen / coefficients, runs["iterative"].seconds,
                               better.seconds])
    return "\n\n".join([
        markdown_table(["signal", "n'", "encoder", "seconds", "squared error", "numbers stored", "times fewer",
                        "paper: time", "paper: squared error"], rows),
        markdown_table(["signal", "iterative / static: squared error", "the paper's", "adaptive / iterative:"
                        f" squared error (floor {MOST_ERROR})", f"seconds (floor {MOST_SECONDS:g})"], ratios),
        markdown_table(["iterative encoding: squared error over the hemisphere", "fitted in coefficients",
                        "fitted in the hemisphere's metric", "ratio", "seconds", "seconds in the metric"],
                       hemisphere)])


def _ratios(name: str, runs: dict[str, Run], paper: dict[str, tuple[str, float]]) -> list[object]:
    static, iterative, adaptive = (runs[method] for method in METHODS)
    error, seconds = adaptive.error / iterative.error, adaptive.seconds / iterative.seconds
    return [name, iterative.error / static.error, paper["iterative"][1] / paper["static"][1] if paper else "",
            f"{error:.3f} {'met' if error <= MOST_ERROR else 'MISSED'}",
            f"{seconds:.2f} {'met' if seconds <= MOST_SECONDS else 'MISSED'}"]


def static_errors(signal: Single, clusters: int, counts: list[int]) -> list[float]:
    """Squared error of static encoding for several numbers of vectors: they share their clusters (section 4.1)."""
    labels = encode(signal, EncoderSettings(clusters, 0, "static", 1)).cluster
    errors = np.zeros(max(counts) + 1)
    order = np.argsort(labels, kind="stable")
    for members in np.split(order, np.cumsum(np.bincount(labels))[:-1]):
        points = signal[members].astype(np.float64)
        mean, _, squares = principal_components(points, max(counts))
        left = np.square(points - mean).sum() - np.concatenate([[0.0], np.cumsum(squares)])
        errors += np.pad(left, (0, len(errors) - len(left)), mode="edge")
    return [float(errors[count]) for count in counts]


def figure_2(cache: Path, _: str) -> str:
    """Error against storage for static encoding of diffuse transfer, and against clusters for all three methods."""
    name, counts, numbers = "horse diffuse 1 x 25", [0, 1, 2, 4, 8], [4**power for power in range(8)]
    signal = signal_of(name, cache)
    points, values = signal.shape
    by_clusters = np.array([static_errors(signal, clusters, counts) for clusters in numbers])
    cost = np.array([[points * n + clusters * (n + 1) * values for n in counts] for clusters in numbers])
    drawn = [Curve(f"n' = {n}", list(zip(cost[:, i], by_clusters[:, i], strict=True))) for i, n in enumerate(counts)]
    save_plot(DOCS / "paper_figure_2_storage.svg", curves(
        drawn, "numbers stored", "squared error", "Static encoding, 1 to 16,384 clusters: horse, diffuse 1 x 25",
        as_percent=False, log_x=True))
    crossing = []
    for i in range(1, len(counts)):
        fewer = np.exp(np.interp(np.log(cost[:, i]), np.log(cost[:, i - 1]), np.log(by_clusters[:, i - 1])))
        below = np.flatnonzero((by_clusters[:, i] < fewer) & (cost[:, i] <= cost[-1, i - 1]))
        crossing.append([f"{counts[i]} below {counts[i - 1]}", f"{numbers[below[0]]:,}" if len(below) else "nowhere"])
    texts = [markdown_table(["clusters", *(f"n' = {n}" for n in counts)],
                            [[f"{k:,}", *errors] for k, errors in zip(numbers, by_clusters.tolist(), strict=True)]),
             markdown_table(["n' vectors, at equal storage", "from so many clusters on"], crossing)]
    name, numbers = "glossy 16 x 25", [32, 64, 128, 256, 512]
    signal, vectors = signal_of(name, cache), SIGNALS[name].vectors
    errors = {method: [run(signal, vectors, method, clusters).error for clusters in numbers] for method in METHODS}
    drawn = [Curve(method, list(zip(numbers, errors[method], strict=True))) for method in METHODS]
    save_plot(DOCS / "paper_figure_2_clusters.svg", curves(
        drawn, "clusters", "squared error", f"Buddha, {name}, n' = {vectors}", as_percent=False, log_x=True))
    texts.append(markdown_table([f"{name}, clusters", *METHODS],
                                [[k, *(errors[method][i] for method in METHODS)] for i, k in enumerate(numbers)]))
    return "\n\n".join(texts)


def vectors_more(error: float, plain: list[float], counts: list[int]) -> float:
    """The number of vectors at which a falling curve of errors reaches an error; NaN beyond its ends."""
    return float(np.interp(-np.log(error), -np.log(plain), counts, left=np.nan, right=np.nan))


def figure_3(cache: Path, _: str) -> str:
    """Error against n' for each encoder, and how many vectors more the simpler one needs for the same error."""
    texts = []
    for name, counts, short in (("glossy 16 x 25", [1, 2, 3, 4, 5, 6, 8, 10], "buddha"),
                                ("horse diffuse 1 x 25", [1, 2, 3, 4, 5, 6, 8, 10], "horse")):
        signal = signal_of(name, cache)
        errors = {m: [run(signal, n, m).error for n in counts] for m in METHODS}
        rows = []
        for place, vectors in enumerate(counts):
            more = [vectors_more(errors[better][place], errors[plain], counts) - vectors
                    for better, plain in (("iterative", "static"), ("adaptive", "iterative"))]
            rows.append([vectors, *(errors[m][place] for m in METHODS),
                         *(f"{x:.1f}" if np.isfinite(x) else "beyond" for x in more)])
        texts.append(markdown_table([f"{name}, n'", *METHODS, "static needs more than iterative (paper: 1 to 4)",
                                     "iterative needs more than adaptive (paper: 1)"], rows))
        drawn = [Curve(m, list(zip(counts, errors[m], strict=True))) for m in METHODS]
        save_plot(DOCS / f"paper_figure_3_{short}.svg", curves(drawn, "vectors n'", "squared error",
                                                               f"{name}, 256 clusters", as_percent=False))
    return "\n\n".join(texts)


def figure_10(cache: Path, _: str) -> str:
    """PCA, VQ and CPCA at about the cost of drawing: 20 vectors, 1,792 clusters, 256 clusters of 8 vectors."""
    rows = []
    for name, (model, paper, _) in PAPER_FIGURES.items():
        signal = signal_of(name, cache)
        errors = [pca(signal, 20).squared_error, vector_quantization(signal, 1792, seed=1).squared_error,
                  run(signal, 8, "iterative").error]
        for i, encoder in enumerate(("PCA 1 x 20", "VQ 1,792", "CPCA 256 x 8")):
            rows.append([name, encoder, errors[i], errors[i] / errors[2],
                         f"{paper[i] / paper[2]:.0f} ({model})" if paper else "not given"])
    return markdown_table(["signal", "encoder", "squared error", "times CPCA's", "the paper's"], rows)


def figure_11(cache: Path, _: str) -> str:
    """Error against n' for 256 clusters, iterative, beside the paper's."""
    rows, drawn = [], []
    for name, (model, _, paper) in PAPER_FIGURES.items():
        signal = signal_of(name, cache)
        errors = [run(signal, n, "iterative").error for n in COUNTS_11]
        for i, vectors in enumerate(COUNTS_11):
            rows.append([name, vectors, errors[i], f"{errors[i] / errors[0]:.4f}",
                         f"{paper[i] / paper[0]:.4f} ({model})"])
        drawn += [Curve(label, [(n, e / found[0]) for n, e in zip(COUNTS_11, found, strict=True)])
                  for label, found in ((f"{'horse' if 'horse' in name else 'Buddha'}, here", errors),
                                       (f"{model}, paper", paper))]
    save_plot(DOCS / "paper_figure_11.svg", curves(drawn, "vectors n'", "squared error, share of that at n' = 2",
                                                   "Anisotropic 24 x 25, 256 clusters, iterative"))
    return markdown_table(["signal", "n'", "squared error", "of that at n' = 2", "the paper's"], rows)


PARTS = {"table": table_1, "figure2": figure_2, "figure3": figure_3, "figure10": figure_10, "figure11": figure_11}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=list(PARTS), metavar="PART", help=f"of {', '.join(PARTS)}")
    parser.add_argument("--signals", default="", help="in the table, only those whose name starts so")
    parser.add_argument("--docs", action="store_true", help="also write to docs/paper_tables.md")
    parser.add_argument("--cache", type=Path, default=ROOT / "build" / "paper_tables")
    arguments = parser.parse_args()
    for part in arguments.parts or PARTS:
        started = time.perf_counter()
        text = PARTS[part](arguments.cache, arguments.signals)
        print(f"{part}, {time.perf_counter() - started:.0f} s\n\n{text}\n", flush=True)
        if arguments.docs and not arguments.signals:
            write_block(DOCS / "paper_tables.md", part, text)


if __name__ == "__main__":
    main()
