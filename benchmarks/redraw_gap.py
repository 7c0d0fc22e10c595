# SPDX-License-Identifier: GPL-3.0-or-later
"""Milliseconds between two redraws of a viewport that orbits, while a bake runs and without one, in one Blender.

    python benchmarks/redraw_gap.py --zip ZIP --ui "COMMAND" --headless "COMMAND" [--threads 0,1] [--seconds 15]

COMMAND as for tests/interface/run.py. threads: of the bake (0 is one per core). Ends with status 1 where the median gap
while baking is more than LIMIT times the idle one: what a bake in threads of Blender's own process had on two cores.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path

import numpy as np
from common import ROOT, print_table

from tests.interface.run import Blender, check_install, make_scene

LIMIT = 435.0 / 272.0
SCRIPT = ROOT / "benchmarks" / "redraw_gap_in_blender.py"


def row(name: str, gaps: list[float]) -> list[object]:
    """Median, mean, 95th percentile and longest of gaps in seconds, as milliseconds."""
    found = 1000.0 * np.array(gaps)
    return [name, len(found), float(np.median(found)), float(found.mean()), float(np.percentile(found, 95)),
            float(found.max())]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--zip", type=Path, required=True)
    parser.add_argument("--ui", default="blender")
    parser.add_argument("--headless", default="blender --background")
    parser.add_argument("--threads", default="0")
    parser.add_argument("--seconds", type=float, default=15.0)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=ROOT / "build") as folder:  # a folder that a Blender in a root of its own sees
        output = Path(folder)
        (output / "resources").mkdir()
        blender = Blender(arguments.ui, arguments.headless, output, output / "resources")
        check_install(blender, arguments.zip.resolve())
        outcomes: list[tuple[str, str]] = []
        scene = make_scene(blender, "make_scene.py", outcomes)
        assert not any(failure for _, failure in outcomes), outcomes
        blender.script(str(SCRIPT), str(output), str(scene), arguments.threads, str(arguments.seconds))
        results, log = output / "gaps.json", (output / f"{SCRIPT.name}.log").read_text()
        if not results.is_file():
            print(log[-3000:])
            return 1
        print("\n".join(line for line in log.splitlines() if line.startswith("threads=")))
        measured = json.loads(results.read_text())
    print_table(["state", "redraws", "median ms", "mean ms", "95 % ms", "longest ms"],
                [row(name, gaps) for name, gaps in measured.items()])
    idle = float(np.median([gap for name, gaps in measured.items() if name.startswith("idle") for gap in gaps]))
    ratios = {name: float(np.median(gaps)) / idle for name, gaps in measured.items() if not name.startswith("idle")}
    for name, ratio in ratios.items():
        print(f"{name}: {ratio:.2f} times the idle gap (limit {LIMIT:.2f})")
    return int(max(ratios.values()) > LIMIT)


if __name__ == "__main__":
    sys.exit(main())
