# SPDX-License-Identifier: GPL-3.0-or-later
"""Takes the documentation's pictures in a real Blender, from the zip that users install.

    python tools/pictures.py --zip build/extension/prt-VERSION-linux-x64.zip --ui "COMMAND" --headless "COMMAND"

COMMAND as for tests/interface/run.py. Pictures land in docs/pictures, whole screens in build/pictures. Needs
ImageMagick (`import`, `convert`) where Blender runs.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "interface"))
from run import Blender, check_install  # its path is known only now

ROOT = Path(__file__).resolve().parent.parent
OUTPUT, DOCS = ROOT / "build" / "pictures", ROOT / "docs" / "pictures"
LARGEST = 2_000_000  # bytes: the limit of files in the repository


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--zip", type=Path, required=True)
    parser.add_argument("--ui", default="blender")
    parser.add_argument("--headless", default="blender --background")
    arguments = parser.parse_args()
    shutil.rmtree(OUTPUT, ignore_errors=True)
    OUTPUT.mkdir(parents=True)
    scene = OUTPUT / "scene.blend"
    subprocess.run([sys.executable, str(ROOT / "tools" / "demo_scene.py"), str(scene)], check=True,
                   stdout=subprocess.DEVNULL)
    with tempfile.TemporaryDirectory() as resources:
        blender = Blender(arguments.ui, arguments.headless, OUTPUT, Path(resources))
        check_install(blender, arguments.zip.resolve())
        blender.script(str(ROOT / "tools" / "pictures_in_blender.py"), str(OUTPUT), str(scene))
    steps = json.loads((OUTPUT / "pictures.json").read_text(encoding="utf-8"))
    failures = [f"{name}: {failure}" for name, failure in steps if failure]
    DOCS.mkdir(exist_ok=True)
    for picture in sorted((OUTPUT / "docs").glob("*")):
        if picture.stat().st_size > LARGEST:
            failures.append(f"{picture.name} has {picture.stat().st_size} bytes")
        shutil.copy(picture, DOCS / picture.name)
        print(f"docs/pictures/{picture.name}: {picture.stat().st_size / 1e3:.0f} kB")
    for failure in failures:
        print(failure, file=sys.stderr)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
