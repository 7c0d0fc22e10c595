# SPDX-License-Identifier: GPL-3.0-or-later
"""What a bake that was ended in the middle leaves in its job folder beside its finished stages, and its removal.

Imports nothing large: the child process loads it before anything else.
"""

from __future__ import annotations

import shutil
from pathlib import Path

# Exit status of a child that can't even write its messages: it has no other way to say so.
CANT_WRITE = 28
# Names of folders of local lights' responses on disk, which can be gigabytes, begin so.
RESPONSES = "responses-"
# Half-written files (storage.files.write_atomically).
HALF_WRITTEN = ".*.part"


def drop_responses(folder: Path) -> None:
    """Remove responses on disk. Never raises."""
    for left in folder.glob(f"{RESPONSES}*"):
        shutil.rmtree(left, ignore_errors=True)


def drop_unfinished(folder: Path) -> None:
    """Remove all that is of no use to a bake that resumes. Never raises: what can't be removed stays."""
    drop_responses(folder)
    for left in folder.glob(HALF_WRITTEN):
        try:
            left.unlink(missing_ok=True)
        except OSError:  # somebody reads it
            continue
