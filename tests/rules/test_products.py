# SPDX-License-Identifier: GPL-3.0-or-later
"""Heavy products go through prt_addon/linear_algebra.py: official Blender builds carry a numpy without a fast BLAS.

A product that is tiny whatever the scene (a rotation, a 4x4 matrix) says so: its line ends in `# small`.
"""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tests.rules.checkout import Module

PRODUCTS = {"dot", "vdot", "einsum", "einsum_path", "matmul", "tensordot", "inner", "linalg", "vecdot", "matvec"}


def is_product(node: ast.AST) -> bool:
    """`@`, `@=`, np.dot and its kin, np.linalg, the method .dot, and importing any of them."""
    if isinstance(node, ast.BinOp | ast.AugAssign):
        return isinstance(node.op, ast.MatMult)
    if isinstance(node, ast.Attribute):
        named = isinstance(node.value, ast.Name) and node.value.id in ("np", "numpy")
        return (named and node.attr in PRODUCTS) or node.attr == "dot"
    if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "numpy":
        return node.module == "numpy.linalg" or any(alias.name in PRODUCTS for alias in node.names)
    return False


def violations(module: Module) -> list[str]:
    return [f"{module.name}:{node.lineno}: {module.lines[node.lineno - 1].strip()}" for node in ast.walk(module.tree)
            if is_product(node) and not module.lines[node.end_lineno - 1].endswith("# small")]


def test_heavy_products_go_through_linear_algebra(modules: list[Module]) -> None:
    checked = [m for m in modules if m.place[0] == "prt_addon" and m.name != "prt_addon/linear_algebra.py"]
    assert checked
    assert [line for module in checked for line in violations(module)] == []


@pytest.mark.parametrize(("text", "allowed"), [
    ("c = a @ b", False), ("c = a @ b  # small", True), ("a @= b", False), ("c = np.einsum('ij,jk', a, b)", False),
    ("c = np.linalg.eigh(a)", False), ("c = a.dot(b)", False), ("from numpy.linalg import svd", False),
    ("from numpy import dot", False), ("c = np.sum(a * b)", True), ("c = linalg.eigh(a)", True),
])
def test_the_rule_sees_products(text: str, allowed: bool) -> None:
    module = Module(Path("x.py"), ("prt_addon", "scene", "x.py"), ast.parse(text), text.splitlines())
    assert (violations(module) == []) == allowed
