# SPDX-License-Identifier: GPL-3.0-or-later
"""The import rule of the architecture, as a walk over every import statement of the product.

    numpy, scipy, wheels <- prt_addon (without blender/) <- prt_addon/blender <- gpu_shaders <- operators

Inside prt_addon a folder imports only folders above it; panels import nothing but bpy; each wheel is imported in its
place and inside a function, so that an extension whose wheel is missing still loads and says so.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator

import pytest

from tests.rules.checkout import ROOT, Module

FOLDERS = ("scene", "tracing", "basis", "transport", "compression", "lighting", "relighting", "storage", "reporting",
           "baking", "blender")
GROUND_FLOOR = ("errors", "linear_algebra", "unlocked_blas")
EVERYWHERE = {"numpy", "scipy"}
BLENDER = {"bpy", "blf", "imbuf", "mathutils", "bmesh", "bpy_extras", "addon_utils", "idprop"}
GPU = {"gpu", "gpu_extras"}
# Wheel -> the folders that may import it, lazily.
WHEELS = {"embreex": ("prt_addon/tracing/",), "xatlas": ("prt_addon/scene/unwrap_process",),
          "OpenEXR": ("prt_addon/storage/", "prt_addon/lighting/")}
THREADS = {"threading", "_thread", "concurrent", "multiprocessing", "asyncio"}
# These run in Blender's own process, where extensions may not start threads; the rest of the core runs in the child.
BLENDER_PROCESS = ("__init__.py", "operators/", "panels/", "gpu_shaders/", "prt_addon/blender/",
                   "prt_addon/baking/process.py", "prt_addon/baking/job.py")
# A process of its own, started isolated: it alone may tell its Python where the extension's wheels lie (site).
OWN_PROCESS = ("prt_addon/baking/worker.py",)


def absolute_imports(module: Module) -> Iterator[tuple[str, ast.stmt]]:
    """The first name of every absolute import."""
    for node in ast.walk(module.tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name.split(".")[0], node) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield (node.module or "").split(".")[0], node


def relative_imports(module: Module) -> Iterator[tuple[tuple[str, ...], ast.ImportFrom]]:
    """Where every relative import leads, as a path in the repository, one per imported name."""
    for node in ast.walk(module.tree):
        if isinstance(node, ast.ImportFrom) and node.level > 0:
            assert node.level <= len(module.package) + 1, f"{module.name}:{node.lineno} leaves the extension"
            base = module.package[:len(module.package) - node.level + 1] + tuple((node.module or "").split("."))
            base = tuple(part for part in base if part)
            for alias in node.names:
                yield (*base, alias.name), node


def rank(place: tuple[str, ...]) -> int:
    """Height in the house: a module imports only from its own height or below. Folders of prt_addon are storeys."""
    if place[0] == "prt_addon":
        name = place[1].removesuffix(".py") if len(place) > 1 else "__init__"
        if name in FOLDERS:
            return 1 + FOLDERS.index(name)
        assert name in (*GROUND_FLOOR, "__init__"), f"prt_addon/{name} is no folder of the architecture"
        return 0
    return {"gpu_shaders": 20, "operators": 30, "panels": 40}.get(place[0], 50)


def relative_violations(module: Module) -> list[str]:
    found = []
    for target, node in relative_imports(module):
        where = f"{module.name}:{node.lineno} imports {'.'.join(target)}"
        if module.place[0] == "panels" and target[0] not in ("panels",) and target[:2] != ("operators", "properties"):
            found.append(f"{where}: panels import properties and operator ids only")
        elif rank(target) > rank(module.place):
            found.append(f"{where}: it stands above it")
    return found


def is_in_function(module: Module, statement: ast.stmt) -> bool:
    """Whether a statement stands inside some function."""
    functions = (node for node in ast.walk(module.tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef))
    return any(statement in ast.walk(function) for function in functions)


def absolute_violations(module: Module) -> list[str]:
    found = []
    for name, node in absolute_imports(module):
        where = f"{module.name}:{node.lineno} imports {name}"
        if name in WHEELS:
            if not module.name.startswith(WHEELS[name]):
                found.append(f"{where}: only {' and '.join(WHEELS[name])} may")
            elif not is_in_function(module, node):
                found.append(f"{where}: wheels are imported inside functions")
        elif name in GPU:
            if module.place[0] != "gpu_shaders":
                found.append(f"{where}: only gpu_shaders may")
        elif name in BLENDER:
            if module.place[0] == "prt_addon" and module.place[1] != "blender":
                found.append(f"{where}: the core knows no Blender")
        elif name in THREADS and module.name.startswith(BLENDER_PROCESS):
            found.append(f"{where}: no threads in Blender's process")
        elif name not in EVERYWHERE and name not in sys.stdlib_module_names:
            found.append(f"{where}: not a module of the product, Python, numpy or scipy")
    return found


def search_path_violations(module: Module) -> list[str]:
    """Every mention of sys.path, however it is reached."""
    found = []
    for node in ast.walk(module.tree):
        touched = isinstance(node, ast.Attribute) and node.attr == "path" and (
            isinstance(node.value, ast.Name) and node.value.id == "sys")
        taken = isinstance(node, ast.ImportFrom) and node.module == "sys" and any(a.name == "path" for a in node.names)
        site = isinstance(node, ast.Import) and any(alias.name == "site" for alias in node.names)
        if touched or taken or (site and module.name not in OWN_PROCESS):
            found.append(f"{module.name}:{node.lineno} touches the search path")
    return found


def test_there_is_something_to_check(modules: list[Module]) -> None:
    assert {module.place[0] for module in modules} == {"__init__.py", "prt_addon", "operators", "panels", "gpu_shaders"}


def test_folders_import_only_folders_above_them_in_the_list(modules: list[Module]) -> None:
    assert [line for module in modules for line in relative_violations(module)] == []


def test_blender_gpu_and_wheels_are_imported_in_their_places(modules: list[Module]) -> None:
    assert [line for module in modules for line in absolute_violations(module)] == []


def test_nothing_touches_the_search_path(modules: list[Module]) -> None:
    assert [line for module in modules for line in search_path_violations(module)] == []


@pytest.mark.parametrize(("place", "statement"), [
    ("prt_addon/scene/x.py", "import bpy"),
    ("prt_addon/scene/x.py", "from mathutils import Vector"),
    ("prt_addon/scene/x.py", "from ..tracing import tracer"),
    ("prt_addon/scene/x.py", "from .. import baking"),
    ("prt_addon/baking/x.py", "from ..blender import stored"),
    ("prt_addon/blender/x.py", "from ...gpu_shaders import draw"),
    ("prt_addon/blender/x.py", "import gpu"),
    ("prt_addon/blender/x.py", "import threading"),
    ("prt_addon/baking/process.py", "from concurrent.futures import ThreadPoolExecutor"),
    ("gpu_shaders/x.py", "from ..operators import bake"),
    ("panels/x.py", "from ..prt_addon.scene import needs"),
    ("panels/x.py", "from ..operators import bake"),
    ("prt_addon/tracing/x.py", "import embreex"),
    ("prt_addon/transport/x.py", "def f():\n    from embreex import rtcore_scene"),
    ("prt_addon/scene/needs.py", "def f():\n    import xatlas"),
    ("prt_addon/scene/x.py", "import prt_addon.errors"),
    ("prt_addon/scene/x.py", "import sklearn"),
    ("operators/x.py", "import sys\nsys.path.append('x')"),
    ("operators/x.py", "from sys import path"),
    ("operators/x.py", "import site"),
    ("prt_addon/baking/worker.py", "import sys\nsys.path.insert(0, 'x')"),
    ("__init__.py", "import asyncio"),
])
def test_the_rule_sees_violations(place: str, statement: str) -> None:
    module = Module(ROOT / place, tuple(place.split("/")), ast.parse(statement), statement.splitlines())
    assert relative_violations(module) + absolute_violations(module) + search_path_violations(module)


@pytest.mark.parametrize(("place", "statement"), [
    ("prt_addon/scene/x.py", "from ..errors import PRTError"),
    ("prt_addon/baking/x.py", "from ..scene.needs import decide"),
    ("prt_addon/baking/worker.py", "import site\nimport threading"),
    ("prt_addon/blender/x.py", "import bpy\nfrom ..scene import needs"),
    ("gpu_shaders/x.py", "import gpu\nfrom ..prt_addon.storage import container"),
    ("prt_addon/tracing/x.py", "def f():\n    from embreex import rtcore_scene"),
    ("operators/x.py", "import sys\nfrom ..gpu_shaders import draw\nprint(sys.argv)"),
])
def test_the_rule_lets_the_rest_through(place: str, statement: str) -> None:
    module = Module(ROOT / place, tuple(place.split("/")), ast.parse(statement), statement.splitlines())
    assert relative_violations(module) + absolute_violations(module) + search_path_violations(module) == []
