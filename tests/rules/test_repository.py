# SPDX-License-Identifier: GPL-3.0-or-later
"""What may be in the repository: licensed text of ours, small files, no machine's paths, no registry's address."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from tests.rules.checkout import ROOT

LARGEST = 2_000_000
SOURCE = {".py", ".sh", ".glsl", ".css", ".toml"}
SOURCE_NAMES = {"Makefile", "run", "find_python"}
# Folders of one machine. Written apart, so that this file passes its own test.
MACHINE = re.compile("|".join("/" + name for name in ("root/", "home/", "work/", "tmp/", "opt/", "Users/")))
REGISTRIES = re.compile("|".join(f"{name}[.]{end}" for name, end in (
    ("pypi", "org"), ("pythonhosted", "org"), ("npmjs", "org"), ("crates", "io"), ("debian", "org"), ("golang", "org"),
    ("apache", "org/maven"), ("extensions[.]blender", "org"))))


def texts(files: list[Path]) -> list[tuple[str, str]]:
    """Name and content of every text file but the licence."""
    found = []
    for path in files:
        name = str(path.relative_to(ROOT))
        if name != "LICENSE" and path.suffix not in (".png", ".gif", ".npz", ".exr", ".blend"):
            found.append((name, path.read_text("utf-8")))
    return found


def test_files_are_small(files: list[Path]) -> None:
    assert len(files) > 20
    assert [str(path) for path in files if path.stat().st_size > LARGEST] == []


def test_every_source_file_names_its_licence(files: list[Path]) -> None:
    sources = [path for path in files if path.suffix in SOURCE or path.name in SOURCE_NAMES]
    missing = [str(path.relative_to(ROOT)) for path in sources
               if "SPDX-License-Identifier: GPL-3.0-or-later" not in "".join(path.read_text("utf-8").splitlines()[:3])]
    assert missing == []


def test_licence_is_the_whole_text() -> None:
    text = (ROOT / "LICENSE").read_text("utf-8")
    assert "GNU GENERAL PUBLIC LICENSE" in text and "Version 3, 29 June 2007" in text
    assert "END OF TERMS AND CONDITIONS" in text and len(text) > 34_000


def test_no_machine_path_and_no_registry(files: list[Path]) -> None:
    found = [f"{name}:{number}: {line.strip()}" for name, text in texts(files)
             for number, line in enumerate(text.splitlines(), 1) if MACHINE.search(line) or REGISTRIES.search(line)]
    assert found == []


def test_requirements_are_pinned_by_version_and_hash_alone() -> None:
    for name in ("runtime", "test", "interpreter"):
        text = (ROOT / "requirements" / f"{name}.txt").read_text("utf-8")
        assert "://" not in text and "--index" not in text and "--find-links" not in text, name
        entries = re.sub(r"\\\n\s*", "", text).splitlines()
        for entry in (line for line in entries if not line.startswith("#")):
            assert re.match(r"[\w.-]+==\S+ .*--hash=sha256:[0-9a-f]{64}", entry), entry
    pins = re.findall(r"^\w+==\S+$", (ROOT / "requirements" / "runtime.in").read_text("utf-8"), re.MULTILINE)
    for name in ("runtime", "test"):
        locked = (ROOT / "requirements" / f"{name}.txt").read_text("utf-8").lower()
        assert all(f"{pin.lower()} " in locked for pin in pins), name


def test_bundled_wheels_are_those_the_tests_run_with() -> None:
    wheels = tomllib.loads((ROOT / "requirements" / "wheels.toml").read_text("utf-8"))["wheel"]
    locked = (ROOT / "requirements" / "runtime.txt").read_text("utf-8")
    have = {(w["platform"], w["python"], w["name"]) for w in wheels}
    names = {(python, name) for python in ("3.13", "3.14") for name in ("embreex", "OpenEXR", "scipy", "xatlas")}
    platforms = ("linux-x64", "windows-x64", "macos-arm64")
    assert have == {(p, *rest) for p in platforms for rest in names - {("3.14", "xatlas")}}
    for wheel in wheels:
        assert f"{wheel['name']}=={wheel['version']} ".lower() in locked.lower(), wheel["file"]
        assert wheel["sha256"] in locked, wheel["file"]
