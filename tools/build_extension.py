# SPDX-License-Identifier: GPL-3.0-or-later
"""Builds build/extension/prt-VERSION-PLATFORM.zip for each platform, with Blender's own tool, and validates it.

    python tools/build_extension.py [--platform linux-x64 ...]

Each zip carries only its platform's wheels, and its manifest lists exactly those; a source manifest without wheels
keeps a checkout loadable. Run tools/fetch_wheels.py first (`make extension` does both).
"""

from __future__ import annotations

import argparse
import importlib.util
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

from fetch_wheels import PYTHONS, ROOT, TAGS, Wheel, pinned_wheels, present

OUTPUT = ROOT / "build" / "extension"
# The product. Everything else in the repository (tests, tools, benchmarks, requirements) stays out.
FILES = ("__init__.py", "LICENSE", "README.md")
# Licence of each wheel, and of the libraries inside that bring no text of their own; all may go with the GPL 3.
LICENCES = {
    "embreex": ("BSD-2-Clause", "Contains Intel Embree and oneTBB, under the Apache License 2.0 (below)."),
    "OpenEXR": ("BSD-3-Clause", "Contains Imath (BSD-3-Clause) and libdeflate (MIT)."),
    "scipy": ("BSD-3-Clause", "Contains OpenBLAS and the GCC runtime libraries; their texts are part of its own."),
    "xatlas": ("MIT", "Contains the xatlas library (MIT)."),
}
FOLDERS = ("prt_addon", "operators", "panels", "gpu_shaders")


def blender_tool() -> Path:
    """Blender's extension tool inside the wheel `bpy`, found without importing it."""
    specification = importlib.util.find_spec("bpy")
    if specification is None or specification.origin is None:
        sys.exit("build_extension: the wheel bpy is not installed. Run `make extension`, which installs it")
    tools = list(Path(specification.origin).parent.glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py"))
    if len(tools) != 1:
        sys.exit(f"build_extension: expected one blender_ext.py inside bpy, found {len(tools)}. Reinstall bpy")
    return tools[0]


def notices(wheels: list[Wheel]) -> str:
    """Names, versions and full licence texts of the bundled wheels, and of what lies inside them without its text."""
    parts = ["# Third-party software in this extension", "", "The files in `wheels/` are unmodified. Their licences:"]
    for wheel in wheels:
        if wheel.python != PYTHONS[0]:
            continue
        licence, inside = LICENCES[wheel.name]
        parts += ["", f"## {wheel.name} {wheel.version}", "", f"Licence: {licence}. {inside}"]
        with zipfile.ZipFile(wheel.path) as archive:
            texts = [name for name in archive.namelist() if not name.endswith("/") and any(
                word in Path(name).name.upper() for word in ("LICEN", "COPYING", "NOTICE"))]
            for text in texts:
                parts += ["", f"`{text}`:", "", "```text", archive.read(text).decode("utf-8").strip(), "```"]
    apache = (ROOT / "tools" / "licences" / "Apache-2.0.txt").read_text("utf-8").rstrip()
    return "\n".join([*parts, "", "## Apache License 2.0", "", "```text", apache, "```", ""])


def manifest(platform: str, wheels: list[Wheel]) -> str:
    """The repository's manifest with this zip's platform and wheels; top-level keys must precede the first table."""
    text = (ROOT / "blender_manifest.toml").read_text("utf-8")
    listed = "".join(f'  "./wheels/{wheel.file}",\n' for wheel in wheels)
    return text.replace("\n[permissions]", f'\nplatforms = ["{platform}"]\nwheels = [\n{listed}]\n\n[permissions]', 1)


def stage(platform: str, wheels: list[Wheel]) -> Path:
    """Lay out a zip's content in build/stage/PLATFORM."""
    folder = ROOT / "build" / "stage" / platform
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "wheels").mkdir(parents=True)
    for name in FILES:
        shutil.copy2(ROOT / name, folder / name)
    for name in FOLDERS:
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", "*.pyc"))
    for wheel in wheels:
        shutil.copy2(wheel.path, folder / "wheels" / wheel.file)
    (folder / "THIRD_PARTY.md").write_text(notices(wheels), "utf-8")
    (folder / "blender_manifest.toml").write_text(manifest(platform, wheels), "utf-8")
    return folder


def build(platform: str) -> Path:
    """One platform's zip, built and validated by Blender's tool."""
    wheels = pinned_wheels([platform])
    if not all(present(wheel) for wheel in wheels):
        sys.exit(f"build_extension: wheels for {platform} are missing. Run tools/fetch_wheels.py first")
    described = tomllib.loads((ROOT / "blender_manifest.toml").read_text("utf-8"))
    archive = OUTPUT / f"{described['id']}-{described['version']}-{platform}.zip"
    tool = blender_tool()
    # --valid-tags: the list beside Blender's own scripts, so that a tag it does not know fails here.
    tags = tool.parents[3] / "modules" / "_bpy_internal" / "extensions" / "tags.py"
    for command in (
        ["build", f"--source-dir={stage(platform, wheels)}", f"--output-filepath={archive}", f"--valid-tags={tags}"],
        ["validate", str(archive), f"--valid-tags={tags}"],
    ):
        done = subprocess.run([sys.executable, str(tool), *command], capture_output=True, text=True, check=False)
        if done.returncode != 0:
            said = done.stdout + done.stderr
            sys.exit(f"build_extension: Blender's tool refused `{command[0]}` for {platform}:\n{said}")
    return archive


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--platform", action="append", choices=tuple(TAGS), help="default: all")
    platforms = parser.parse_args().platform or list(TAGS)
    OUTPUT.mkdir(parents=True, exist_ok=True)
    for platform in platforms:
        archive = build(platform)
        print(f"{archive.relative_to(ROOT)}  {archive.stat().st_size / 1e6:.0f} MB  valid")


if __name__ == "__main__":
    main()
