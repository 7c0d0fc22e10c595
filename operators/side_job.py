# SPDX-License-Identifier: GPL-3.0-or-later
"""What jobs have in common that stand in the queue of bakes and write none: a child process, and no object in use."""

from __future__ import annotations

from typing import ClassVar

from ..prt_addon.baking.process import BakeProcess


class SideJob:
    """A job whose child process is `process`; `job_mixin.py` says when each method is called."""

    process: BakeProcess
    writes_bakes: ClassVar[bool] = False

    def object_in_use(self) -> None:
        """Nothing that could be in edit mode is written."""

    def end(self, _state: str) -> None:
        """It was cancelled or failed."""
        self.close()

    def close(self) -> None:
        """End the child if it lives. May be called twice."""
        self.process.cancel()

    def file_saved(self) -> None:
        """It knows no file of the user's."""
