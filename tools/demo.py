# SPDX-License-Identifier: GPL-3.0-or-later
"""The demo: from a scene to relit pictures and a report, by the commands that every user has.

Run by `make demo`; leaves everything in build/demo and ends by saying what to look at.
"""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "build" / "demo"
TURN = 140  # degrees between the two pictures


def run(what: str, script: str, *arguments: str | Path) -> str:
    """One step, as a user would type it; returns its stdout. The demo ends where a step fails."""
    command = [sys.executable, str(ROOT / "tools" / script), *map(str, arguments)]
    print(f"\n{what}\n  python tools/{script} {' '.join(map(shown, arguments))}", flush=True)
    started = time.perf_counter()
    log = FOLDER / "log.txt"
    with log.open("a") as stream:
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=stream, text=True, check=False)
    if done.returncode != 0:
        print(log.read_text(), file=sys.stderr)
        sys.exit(f"demo: tools/{script} ended with exit code {done.returncode}; see {shown(log)}")
    print(f"  {time.perf_counter() - started:.1f} s", flush=True)
    return done.stdout


def shown(argument: str | Path) -> str:
    """A path as seen from the repository."""
    return str(argument.relative_to(ROOT)) if isinstance(argument, Path) else argument


def main() -> None:
    FOLDER.mkdir(parents=True, exist_ok=True)
    (FOLDER / "log.txt").unlink(missing_ok=True)
    scene, baked, report = FOLDER / "scene.blend", FOLDER / "baked.blend", FOLDER / "report.json"
    page, first, second = FOLDER / "report.html", FOLDER / "preview.png", FOLDER / "preview_turned.png"
    run("Build a scene: Suzanne and primitives under one of Blender's HDRIs", "demo_scene.py", scene)
    (FOLDER / "analysis.json").write_text(run("Ask what it needs", "prt.py", "analyze", "--input", scene))
    run("Bake: the slow step, once", "prt.py", "bake", "--input", scene, "--output", baked, "--report", report)
    run("Draw it under the scene's light", "prt.py", "preview", "--input", baked, "--output", first)
    run(f"Turn the sky by {TURN} degrees and draw again: nothing is baked anew", "prt.py", "preview", "--input", baked,
        "--rotate", str(TURN), "--output", second)
    run("The same light as numbers, for scripts", "prt.py", "relight", "--input", baked, "--rotate", str(TURN),
        "--output", FOLDER / "relit.npz")
    run("Write the report as a page", "prt.py", "report", "--input", report, "--output", page)
    print(f"\nLook at\n  {shown(first)}\n  {shown(second)}\n  {shown(page)}")


if __name__ == "__main__":
    main()
