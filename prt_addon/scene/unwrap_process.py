# SPDX-License-Identifier: GPL-3.0-or-later
"""xatlas in a process of its own: run by path as `python -I unwrap_process.py INPUT OUTPUT XATLAS`.

On meshes with many non-manifold edges xatlas may not end for a quarter of an hour and can't be interrupted, so whoever
starts this (`unwrapping.py`) ends it after a time. INPUT: .npz of points (p, 3), triangles (t, 3); OUTPUT: .npz of
chart (t,) and places (t, 3, 2); XATLAS: the library's file, as an isolated Python does not know the extension's wheels.
"""

from __future__ import annotations

import importlib.util
import sys
from types import ModuleType

import numpy as np


def load_xatlas(path: str) -> ModuleType:
    """The library, from its file."""
    spec = importlib.util.spec_from_file_location("xatlas", path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} is no library")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def main(source: str, target: str, library: str) -> int:
    """Unwrap and write; the exit status."""
    xatlas = load_xatlas(library)
    with np.load(source) as arrays:
        points, triangles = arrays["points"].astype(np.float32), arrays["triangles"].astype(np.uint32)
    atlas = xatlas.Atlas()
    atlas.add_mesh(points, triangles)
    options = xatlas.PackOptions()
    options.create_image = False
    atlas.generate(xatlas.ChartOptions(), options)
    _, indices, places = atlas[0]
    places = places * np.array([atlas.width, atlas.height], np.float32)
    chart = np.full(len(triangles), -1, np.int64)
    for number in range(atlas.get_mesh_chart_count(0)):
        chart[np.asarray(atlas.get_mesh_chart(0, number).faces, np.int64)] = number
    np.savez(target, chart=chart, places=places[indices.reshape(-1, 3)])
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:4]))
