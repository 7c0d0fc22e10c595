# SPDX-License-Identifier: GPL-3.0-or-later
"""Brings the binary wheels that the extension carries into build/wheels, each checked against its pinned sha256.

    python tools/fetch_wheels.py [--platform linux-x64 ...]     fetch what requirements/wheels.toml lists
    python tools/fetch_wheels.py --lock                         write that list anew from requirements/runtime.in

pip does the downloading, so no address is written anywhere. numpy is never bundled: it would replace Blender's own for
every extension.
"""

from __future__ import annotations

import argparse
import hashlib
import re
import subprocess
import sys
import tempfile
import tomllib
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
WHEELS = ROOT / "build" / "wheels"
LOCK = ROOT / "requirements" / "wheels.toml"

# Official Blender 5.2 runs Python 3.13, Debian's build 3.14.
PYTHONS = ("3.13", "3.14")
PACKAGES = ("embreex", "OpenEXR", "scipy", "xatlas")
# No wheel of xatlas exists for 3.14; the product guards its import.
MISSING = {("xatlas", "3.14")}
# Wheel tags that Blender's own minimum systems accept (glibc 2.28; embreex asks for macOS 13). Blender 5 has no build
# for Intel Macs, and embreex no wheel.
TAGS = {
    "linux-x64": ("manylinux_2_28_x86_64", "manylinux_2_27_x86_64", "manylinux_2_17_x86_64"),
    "windows-x64": ("win_amd64",),
    "macos-arm64": ("macosx_13_0_arm64", "macosx_12_0_arm64", "macosx_11_0_arm64"),
}


class Wheel(NamedTuple):
    """One file of requirements/wheels.toml."""

    platform: str
    python: str
    name: str
    version: str
    file: str
    sha256: str

    @property
    def path(self) -> Path:
        return WHEELS / self.file


def pinned_wheels(platforms: list[str] | None = None) -> list[Wheel]:
    """The wheels of requirements/wheels.toml, of the given platforms or of all."""
    wheels = [Wheel(**entry) for entry in tomllib.loads(LOCK.read_text("utf-8"))["wheel"]]
    return [wheel for wheel in wheels if platforms is None or wheel.platform in platforms]


def digest(path: Path) -> str:
    """sha256 of a file, in hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def present(wheel: Wheel) -> bool:
    """Whether the file is there and is the pinned one."""
    return wheel.path.is_file() and digest(wheel.path) == wheel.sha256


def download(requirements: list[str], platform: str, python: str, folder: Path, *options: str) -> None:
    """pip's download of requirement lines for another platform and Python; raises CalledProcessError when it fails."""
    with tempfile.TemporaryDirectory() as scratch:
        listed = Path(scratch) / "requirements.txt"
        listed.write_text("\n".join(requirements) + "\n", "utf-8")
        tags = [part for tag in TAGS[platform] for part in ("--platform", tag)]
        subprocess.run(
            [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps",
             "--only-binary=:all:", "--implementation", "cp", "--python-version", python, *tags, *options,
             "--dest", str(folder), "-r", str(listed)],
            check=True,
        )


def fetch(platforms: list[str] | None) -> None:
    """Download what is not there yet and check every file, whoever downloaded it."""
    WHEELS.mkdir(parents=True, exist_ok=True)
    wheels = pinned_wheels(platforms)
    absent = [wheel for wheel in wheels if not present(wheel)]
    for (platform, python), group in groupby(absent, key=lambda wheel: (wheel.platform, wheel.python)):
        lines = [f"{wheel.name}=={wheel.version} --hash=sha256:{wheel.sha256}" for wheel in group]
        print(f"fetching {len(lines)} wheels for {platform}, Python {python}", flush=True)
        download(lines, platform, python, WHEELS, "--require-hashes")
    wrong = [wheel.file for wheel in wheels if not present(wheel)]
    if wrong:
        sys.exit(f"fetch_wheels: {', '.join(wrong)}: missing or not the pinned file. Delete build/wheels and try again")
    size = sum(wheel.path.stat().st_size for wheel in wheels)
    print(f"{len(wheels)} wheels in {WHEELS.relative_to(ROOT)}, {size / 1e6:.0f} MB")


def write_lock() -> None:
    """Resolve the versions of requirements/runtime.in for every platform and Python, and pin the files found."""
    pins = dict(re.findall(r"^(\w+)==(\S+)$", (ROOT / "requirements" / "runtime.in").read_text("utf-8"), re.MULTILINE))
    lines = ["# SPDX-License-Identifier: GPL-3.0-or-later",
             "# Written by `tools/fetch_wheels.py --lock`: the wheels inside the extension, by file."]
    for platform in TAGS:
        for python in PYTHONS:
            for name in PACKAGES:
                if (name, python) in MISSING:
                    continue
                with tempfile.TemporaryDirectory() as folder:
                    download([f"{name}=={pins[name]}"], platform, python, Path(folder))
                    (file,) = Path(folder).iterdir()
                    wheel = Wheel(platform, python, name, pins[name], file.name, digest(file))
                lines += ["", "[[wheel]]", *(f'{key} = "{value}"' for key, value in wheel._asdict().items())]
    LOCK.write_text("\n".join(lines) + "\n", "utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--platform", action="append", choices=tuple(TAGS), help="default: all")
    parser.add_argument("--lock", action="store_true", help="resolve and pin the files anew")
    arguments = parser.parse_args()
    if arguments.lock:
        write_lock()
    fetch(arguments.platform)


if __name__ == "__main__":
    main()
