# SPDX-License-Identifier: GPL-3.0-or-later
"""What the benchmarks share: meshes, tables, and the checkout as a package. Run them from the repository's root."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # a script's own process, not Blender's

from prt_addon.scene.object_mesh import ObjectMesh

MESHES = ROOT.parent / "shared" / "data" / "meshes"


def mesh_path(name: str) -> Path:
    """The shared mesh, or the end of the program with a line that says it is absent."""
    path = MESHES / name
    if not path.exists():
        print(f"skipped: {name} is not in the folder of shared meshes")
        sys.exit(0)
    return path


def load_obj(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Positions (v, 3) and triangles (t, 3) of an OBJ file of triangles."""
    positions, triangles = [], []
    for line in path.read_text().splitlines():
        if line.startswith("v "):
            positions.append([float(x) for x in line.split()[1:4]])
        elif line.startswith("f "):
            triangles.append([int(x.split("/")[0]) - 1 for x in line.split()[1:4]])
    return np.array(positions), np.array(triangles, np.int32)


def smooth_object(name: str, positions: NDArray[np.float64], triangles: NDArray[np.int32],
                  albedo: tuple[float, float, float]) -> ObjectMesh:
    """An ObjectMesh with area-weighted vertex normals."""
    corners = positions[triangles]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(positions)
    np.add.at(normals, triangles.ravel(), np.repeat(face, 3, axis=0))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    colours = np.broadcast_to(np.asarray(albedo, np.float32), (len(triangles), 3, 3)).copy()
    return ObjectMesh(name, positions, triangles, normals[triangles].astype(np.float32), colours, True)


def drain(steps: Generator[Any, None, Any]) -> Any:
    """Exhaust a generator and return its result."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return end.value


def best_of(runs: int, work: Callable[[], Any]) -> tuple[float, Any]:
    """Least seconds of some runs, and the last result: the machines are shared, so the least is nearest the truth."""
    least, result = float("inf"), None
    for _ in range(runs):
        started = time.perf_counter()
        result = work()
        least = min(least, time.perf_counter() - started)
    return least, result


def markdown_table(header: list[str], rows: list[list[Any]]) -> str:
    """A Markdown table; floats to four digits."""
    def cell(value: Any) -> str:
        if not isinstance(value, float):
            return str(value)
        return f"{value:,.0f}" if abs(value) >= 1000.0 else f"{value:.4g}"
    lines = ["| " + " | ".join(header) + " |", "|" + " --- |" * len(header)]
    return "\n".join(lines + ["| " + " | ".join(cell(value) for value in row) + " |" for row in rows])


def print_table(header: list[str], rows: list[list[Any]]) -> None:
    """Print a Markdown table."""
    print(markdown_table(header, rows))


def write_block(path: Path, name: str, text: str) -> None:
    """Replace what stands between <!-- name --> and <!-- /name --> in a document. Raises ValueError without them."""
    content = path.read_text()
    start, end = (content.index(f"<!-- {mark}{name} -->") for mark in ("", "/"))
    start += len(f"<!-- {name} -->")
    path.write_text(f"{content[:start]}\n\n{text}\n\n{content[end:]}")


COLOURS = ("#2a6f97", "#c8553d", "#588157", "#9c6644", "#7b5ea7")
STYLE = ("<style>svg{background:#fff}text{font:13px sans-serif;fill:#23272e}.quiet{fill:#69707c}.small{font-size:11px}"
         ".grid{stroke:#dedcd6}.curve{fill:none;stroke-width:2}"
         + "".join(f".curve.series-{name}{{stroke:{colour}}}.mark.series-{name}{{fill:{colour}}}"
                   for name, colour in zip("abcde", COLOURS, strict=True)) + "</style>")


def save_plot(path: Path, picture: str) -> None:
    """An inline SVG of reporting.svg_plots as a file of its own."""
    picture = picture.replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(picture.replace("<title>", STYLE + "<title>", 1))
