# SPDX-License-Identifier: GPL-3.0-or-later
"""Who works in a job folder: one living process at a time.

The claim is the operating system's lock on a file in the folder, so that a process that was killed holds nothing any
more, whatever its number was; the same process can't claim a folder twice either. Imports nothing large.
"""

from __future__ import annotations

import errno
import os
import shutil
import sys
from pathlib import Path

CLAIM_FILE = "in_use.lock"
# File systems that know no locks (some network folders): there a folder counts as free.
NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL}
RACES = 20  # lost against owners who remove the same folder, after which the error is another one


class Claim:
    """A job folder that is this process's own until `release`, `discard`, or the process's end."""

    def __init__(self, folder: Path, descriptor: int) -> None:
        self.folder = folder
        self._descriptor: int | None = descriptor

    @staticmethod
    def take(folder: Path) -> Claim | None:
        """Claim an existing folder; None where another living process, or another bake of this one, has it.

        Raises OSError where the folder is missing or can't be written.
        """
        path = folder / CLAIM_FILE
        while True:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
            try:
                if not _lock(descriptor):
                    os.close(descriptor)
                    return None
                if os.path.samestat(os.fstat(descriptor), os.stat(path)):
                    return Claim(folder, descriptor)
            except FileNotFoundError:  # its last owner removed the folder between our opening and our locking
                if not folder.is_dir():
                    os.close(descriptor)
                    raise
            except BaseException:
                os.close(descriptor)
                raise
            os.close(descriptor)

    @staticmethod
    def make(folder: Path) -> Claim | None:
        """Make a folder if it is missing, and `take` it. Raises OSError where it can't be made or written."""
        for _ in range(RACES):
            try:
                folder.mkdir(parents=True, exist_ok=True)
                return Claim.take(folder)
            except (FileNotFoundError, FileExistsError):  # its last owner is just removing it
                continue
        folder.mkdir(parents=True, exist_ok=True)
        return Claim.take(folder)

    def release(self) -> None:
        """Let others have the folder. May be called twice."""
        if self._descriptor is not None:
            os.close(self._descriptor)  # ends the lock
            self._descriptor = None

    def discard(self) -> None:
        """Remove the folder with all that is in it, and release it. What can't be removed stays."""
        for entry in self._entries():
            if entry.name != CLAIM_FILE:
                if entry.is_dir():
                    shutil.rmtree(entry, ignore_errors=True)
                else:
                    _unlink(entry)
        if sys.platform == "win32":  # an open file can't be removed there
            self.release()
        shutil.rmtree(self.folder, ignore_errors=True)
        self.release()

    def _entries(self) -> list[Path]:
        try:
            return list(self.folder.iterdir())
        except OSError:  # somebody removed it already
            return []


def _taken_if_free(folder: Path) -> Claim | None:
    """A claim of a folder in which nobody works; None, too, where it can't be written."""
    try:
        return Claim.take(folder)
    except OSError:
        return None


def is_free(folder: Path) -> bool:
    """Whether no living process works in a folder. False, too, where it can't be written."""
    claim = _taken_if_free(folder)
    if claim is not None:
        claim.release()
    return claim is not None


def discard_if_free(folder: Path) -> bool:
    """Remove a folder in which nobody works; False where somebody does."""
    claim = _taken_if_free(folder)
    if claim is not None:
        claim.discard()
    return claim is not None


def _unlink(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError:  # somebody reads it
        return


def _lock(descriptor: int) -> bool:
    """Lock an open file without waiting; False where it is locked already."""
    if sys.platform == "win32":
        import msvcrt

        try:
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        except OSError:
            return False
        return True
    import fcntl

    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno in NO_LOCKS
    return True
