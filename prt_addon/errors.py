# SPDX-License-Identifier: GPL-3.0-or-later
"""Errors that a user reads: one line naming the object, the cause and the remedy.

Every other exception is a defect of ours; the commands and operators turn only these into messages and exit codes.
"""

from __future__ import annotations


class PRTError(Exception):
    """A failure that the user can act on.

    subject: what it is about (an object, file or setting by its name); cause and remedy: one clause each.
    """

    exit_code = 1

    def __init__(self, subject: str, cause: str, remedy: str) -> None:
        super().__init__(subject, cause, remedy)
        self.subject = subject
        self.cause = cause
        self.remedy = remedy

    def __str__(self) -> str:
        return f"{self.subject}: {self.cause}. {self.remedy}"


class BadArguments(PRTError):
    """A command or setting that makes no sense: exit code 2."""

    exit_code = 2


class Cancelled(PRTError):
    """Stopped by the user; what was finished is kept and the next run resumes: exit code 3."""

    exit_code = 3


class BadScene(PRTError):
    """Geometry, materials or lights that can't be baked or shown."""


class StorageError(PRTError):
    """Stored data that can't be read or written."""
