# SPDX-License-Identifier: GPL-3.0-or-later
"""Seconds, rays and peak memory of each stage of a bake."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

_STATUS = Path("/proc/self/status")
_MEMORY = Path("/proc/meminfo")
_CLEAR = Path("/proc/self/clear_refs")


class StageTimer:
    """Records one entry per finished stage: {"name", "seconds", "rays", "peak_bytes"}, as the report has it.

    count_rays: rays traced so far, asked at both ends of a stage. A stage that raises (or is closed by a cancel) is
    recorded too: what it cost is true either way. A name that comes twice adds to its first entry.
    """

    def __init__(self, count_rays: Callable[[], int] = lambda: 0) -> None:
        self._count_rays = count_rays
        self.stages: list[dict[str, Any]] = []

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Measure what happens inside the `with`."""
        rays, started = self._count_rays(), time.perf_counter()
        reset_peak_bytes()
        try:
            yield
        finally:
            self._record(name, time.perf_counter() - started, self._count_rays() - rays, peak_bytes())

    def _record(self, name: str, seconds: float, rays: int, peak: int) -> None:
        for entry in self.stages:
            if entry["name"] == name:
                entry["seconds"] += seconds
                entry["rays"] += rays
                entry["peak_bytes"] = max(entry["peak_bytes"], peak)
                return
        self.stages.append({"name": name, "seconds": seconds, "rays": rays, "peak_bytes": peak})


def reset_peak_bytes() -> bool:
    """Start a new peak at the present memory; False where the system keeps one peak for the whole process."""
    try:
        _CLEAR.write_text("5")  # Linux, proc(5): resets the peak resident set size
    except OSError:
        return False
    return True


def peak_bytes() -> int:
    """Largest resident memory of this process since `reset_peak_bytes` (Linux), else since the process began."""
    if sys.platform == "win32":
        return _peak_bytes_windows()
    try:
        status = _STATUS.read_text("ascii", errors="replace")
    except OSError:
        return _peak_bytes_unix()
    for line in status.splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024
    return _peak_bytes_unix()


def available_bytes() -> int | None:
    """Memory that programs can still get without swapping; all there is where the system does not tell (macOS); None
    where nothing is known."""
    if sys.platform == "win32":
        return _available_bytes_windows()
    try:
        for line in _MEMORY.read_text("ascii", errors="replace").splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (ValueError, OSError):
        return None


def _available_bytes_windows() -> int | None:
    """ullAvailPhys of the Windows function GlobalMemoryStatusEx."""
    import ctypes
    from ctypes import wintypes

    sizes = ("TotalPhys", "AvailPhys", "TotalPageFile", "AvailPageFile", "TotalVirtual", "AvailVirtual",
             "AvailExtendedVirtual")

    class Status(ctypes.Structure):
        _fields_ = [("Length", wintypes.DWORD), ("MemoryLoad", wintypes.DWORD),
                    *((name, ctypes.c_uint64) for name in sizes)]

    status = Status(Length=ctypes.sizeof(Status))
    found = ctypes.WinDLL("kernel32").GlobalMemoryStatusEx(ctypes.byref(status))
    return int(status.AvailPhys) if found else None


def _peak_bytes_unix() -> int:
    import resource

    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return largest if sys.platform == "darwin" else largest * 1024  # bytes on macOS, KiB elsewhere


def _peak_bytes_windows() -> int:
    """PeakWorkingSetSize of the Windows function GetProcessMemoryInfo."""
    import ctypes
    from ctypes import wintypes

    sizes = ("PeakWorkingSetSize", "WorkingSetSize", "QuotaPeakPagedPoolUsage", "QuotaPagedPoolUsage",
             "QuotaPeakNonPagedPoolUsage", "QuotaNonPagedPoolUsage", "PagefileUsage", "PeakPagefileUsage")

    class Counters(ctypes.Structure):
        _fields_ = [("cb", wintypes.DWORD), ("PageFaultCount", wintypes.DWORD),
                    *((name, ctypes.c_size_t) for name in sizes)]

    counters = Counters(cb=ctypes.sizeof(Counters))
    kernel = ctypes.WinDLL("kernel32")
    kernel.GetCurrentProcess.restype = wintypes.HANDLE
    kernel.K32GetProcessMemoryInfo.argtypes = (wintypes.HANDLE, ctypes.POINTER(Counters), wintypes.DWORD)
    kernel.K32GetProcessMemoryInfo(kernel.GetCurrentProcess(), ctypes.byref(counters), counters.cb)
    return int(counters.PeakWorkingSetSize)
