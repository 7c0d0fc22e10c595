# SPDX-License-Identifier: GPL-3.0-or-later
"""Which charts a surface gets: xatlas's where it is there and wanted, else projected ones (`charts.py`)."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import PRTError
from .charts import NO_AREA, Charts, connected, extents, face_normals, projected_charts

METHODS = ("projection", "xatlas", "auto")
SECONDS = 60.0  # that xatlas may take
PROCESS = Path(__file__).with_name("unwrap_process.py")


def xatlas_file() -> str | None:
    """Where the library lies; None where it is missing (it has no wheel for Python 3.14)."""
    try:
        found = importlib.util.find_spec("xatlas")
    except (ImportError, ValueError):
        return None
    return None if found is None else found.origin


def make_charts(name: str, points: NDArray[np.float64], triangles: NDArray[np.integer], method: str = "projection",
                seconds: float = SECONDS) -> Charts:
    """Charts of an object's points (p, 3) and triangles (t, 3).

    method: "projection", "xatlas", or "auto": xatlas's if they come in time, else projected ones. seconds: that xatlas
    may take. Raises PRTError, naming the object, where "xatlas" is asked for and is missing, fails or takes longer.
    """
    if method not in METHODS:
        raise ValueError(f"{method} is none of {METHODS}")
    if method == "projection":
        return projected_charts(points, triangles)
    try:
        return _xatlas_charts(name, points, triangles, seconds)
    except PRTError:
        if method == "xatlas":
            raise
        return projected_charts(points, triangles)


def _xatlas_charts(name: str, points: NDArray[np.float64], triangles: NDArray[np.integer], seconds: float) -> Charts:
    """xatlas's charts, parted where they cross lines along which the surface's points are split."""
    remedy = "Use projected charts, or bake at vertices"
    library = xatlas_file()
    if library is None:
        raise PRTError(name, f"xatlas is not there for Python {sys.version_info[0]}.{sys.version_info[1]}", remedy)
    _, areas = face_normals(points, triangles)
    usable = areas > NO_AREA * float(np.ptp(points[triangles], axis=(0, 1)).max(initial=0.0)) ** 2
    # Unit size: xatlas has tolerances of its own.
    corners = points[np.unique(triangles)]
    size = float(np.ptp(corners, axis=0).max(initial=0.0)) or 1.0
    chart, places = np.full(len(triangles), -1, np.int64), np.zeros((len(triangles), 3, 2))
    chart[usable], places[usable] = _run(name, (points - corners.min(axis=0)) / size, triangles[usable], library,
                                         seconds, remedy)
    # What it gave no chart becomes one of its own, by projection.
    missing = usable & ((chart < 0) | (np.abs(_double_areas(places)) < 1e-12))
    if missing.any():
        own = projected_charts(points, triangles)
        places[missing] = own.flat[missing]
        chart[missing] = chart.max(initial=-1) + 1 + own.chart[missing]
    pieces = connected(triangles, chart, usable)
    return Charts(pieces, _to_metres(places, pieces, areas), "xatlas")


def _run(name: str, points: NDArray[np.float64], triangles: NDArray[np.integer], library: str, seconds: float,
         remedy: str) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Chart (t,) and places (t, 3, 2) from the library in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "surface.npz", Path(folder) / "charts.npz"
        np.savez(source, points=points.astype(np.float32), triangles=triangles.astype(np.uint32))
        command = [sys.executable, "-I", str(PROCESS), str(source), str(target), library]
        try:
            done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, timeout=seconds,
                                  check=False)
        except subprocess.TimeoutExpired as error:
            raise PRTError(name, f"it does not unwrap within {seconds:g} s (edges with more than two faces?)",
                           f"Mend the mesh. {remedy}") from error
        except OSError as error:
            raise PRTError(name, f"the unwrapping could not be started ({error.strerror})", remedy) from error
        if done.returncode != 0 or not target.exists():
            raise PRTError(name, "it does not unwrap (the library failed)", remedy)
        with np.load(target) as arrays:
            return arrays["chart"].astype(np.int64), arrays["places"].astype(np.float64)


def _double_areas(places: NDArray[np.float64]) -> NDArray[np.float64]:
    first, second = places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]
    return first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]


def _to_metres(places: NDArray[np.float64], chart: NDArray[np.int64], areas: NDArray[np.float64],
               ) -> NDArray[np.float64]:
    """Places (t, 3, 2) scaled so that each chart has the area of its surface, and turned to the front."""
    count, inside = int(chart.max(initial=-1)) + 1, chart >= 0
    of, double = np.maximum(chart, 0), _double_areas(places)
    laid = np.bincount(of[inside], np.abs(double[inside]) / 2.0, count)
    signed = np.bincount(of[inside], double[inside], count)
    surface = np.bincount(of[inside], areas[inside], count)
    scale = np.sqrt(surface / np.maximum(laid, np.finfo(np.float64).tiny))
    low, _ = extents(places, chart)
    flat = (places - low[of][:, None]) * scale[of][:, None, None]
    flat[..., 0] *= np.where(signed < 0.0, -1.0, 1.0)[of][:, None]
    return flat
