# SPDX-License-Identifier: GPL-3.0-or-later
"""Fixtures of the rules."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.rules.checkout import PRODUCT, ROOT, Module, module, repository_files


@pytest.fixture(scope="session")
def files() -> list[Path]:
    """All files of the repository."""
    return repository_files()


@pytest.fixture(scope="session")
def modules(files: list[Path]) -> list[Module]:
    """The product's Python files."""
    return [module(path) for path in files
            if path.suffix == ".py" and path.relative_to(ROOT).parts[0] in PRODUCT]
