# SPDX-License-Identifier: GPL-3.0-or-later
"""The repository as the rules see it: its files and the product's modules."""

from __future__ import annotations

import ast
import subprocess
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PRODUCT = ("__init__.py", "prt_addon", "operators", "panels", "gpu_shaders")


@dataclass(frozen=True)
class Module:
    """A Python file of the product. place: its path in the repository, e.g. ("prt_addon", "scene", "needs.py")."""

    path: Path
    place: tuple[str, ...]
    tree: ast.Module
    lines: list[str]

    @property
    def name(self) -> str:
        return "/".join(self.place)

    @property
    def package(self) -> tuple[str, ...]:
        """What `.` means in a relative import."""
        return self.place[:-1]


def repository_files() -> list[Path]:
    """Files that are tracked or about to be; without git (an unpacked archive), all but what the tools make."""
    listed = subprocess.run(["git", "-C", str(ROOT), "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
                            capture_output=True, text=True, check=False)
    if listed.returncode == 0:
        return sorted(path for name in set(listed.stdout.split("\0")) - {""} if (path := ROOT / name).is_file())
    made = {".git", ".venv", "build", "wheels", "__pycache__", ".ruff_cache", ".pytest_cache"}
    return sorted(path for path in ROOT.rglob("*")
                  if path.is_file() and not made.intersection(path.relative_to(ROOT).parts))


def module(path: Path) -> Module:
    text = path.read_text("utf-8")
    return Module(path, path.relative_to(ROOT).parts, ast.parse(text, str(path)), text.splitlines())
