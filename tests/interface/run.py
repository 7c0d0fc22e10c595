# SPDX-License-Identifier: GPL-3.0-or-later
"""Tests of the zip that users install, in a real Blender with its user interface.

    python tests/interface/run.py --zip prt-linux-x64.zip --output FOLDER --ui "COMMAND" --headless "COMMAND"

COMMAND starts Blender with an interface (under Xvfb where there is no display) and in background mode; the arguments
of this script are appended to it. BLENDER_USER_RESOURCES names a fresh folder, so that no user's set-up is touched.
Screenshots, for a person to look at, and Blender's own output land in FOLDER. The last line is "N passed, M failed".
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

HERE = Path(__file__).resolve().parent
UI_SECONDS = 600
# What drives an interface, and what makes its scene.
SCRIPTS = {
    "interface": ("in_blender.py", "make_scene.py"),
    "lamps": ("lamps_in_blender.py", "make_room.py"),
    "faults": ("faults_in_blender.py", "make_scene.py"),
    "losses": ("losses_in_blender.py", "make_scene.py"),
    "killed": ("killed_in_blender.py", "make_scene.py"),
    "untouched": ("untouched_in_blender.py", "make_scene.py"),
    "presets": ("presets_in_blender.py", "make_scene.py"),
    "compare": ("compare_in_blender.py", "make_scene.py"),
    "views": ("views_in_blender.py", "make_views.py"),
    "changes": ("changes_in_blender.py", "make_views.py"),
    "display": ("display_in_blender.py", "make_display.py"),
    "sky": ("sky_in_blender.py", "make_display.py"),
    "tracing": ("tracing_in_blender.py", "make_display.py"),
    "editing": ("editing_in_blender.py", "make_editing.py"),
    "texels": ("texels_in_blender.py", "make_display.py"),
    "bodies": ("bodies_in_blender.py", "make_body.py"),
}
RESTARTED = "killed_in_blender.py"  # it ends its Blender, and looks what the next start finds
COMMAND_SECONDS = 240
# What may not stand in a log: tracebacks, and warnings of Blender's own log (of the GPU module above all).
COMPLAINT = re.compile(r"^Traceback|^Exception ignored|\| (WARNING|ERROR|FATAL) |^(Warning|Error)\b|Validation")
# Reports of operators to the user, which the tests ask for, and what this Blender says on any machine like this one.
EXPECTED = re.compile(r"\| operator +\||^\S+ +operator +\||Could not get a list of mounted file-systems|"
                      r"matches no enum in|XDG_RUNTIME_DIR|CUEW")


class Blender:
    """A Blender of its own preferences folder."""

    def __init__(self, ui: str, headless: str, output: Path, resources: Path) -> None:
        self.ui, self.headless, self.output = shlex.split(ui), shlex.split(headless), output
        self.environment = {**os.environ, "BLENDER_USER_RESOURCES": str(resources)}

    @contextmanager
    def apart(self) -> Iterator[Blender]:
        """This Blender with a copy of its preferences and extensions, as scripts may leave them otherwise: one that
        disables the extension takes its wheels from the next one's Blender."""
        with tempfile.TemporaryDirectory() as folder:
            resources = Path(folder) / "resources"
            shutil.copytree(self.environment["BLENDER_USER_RESOURCES"], resources, symlinks=True)
            yield Blender(shlex.join(self.ui), shlex.join(self.headless), self.output, resources)

    def command(self, *arguments: str, seconds: float = COMMAND_SECONDS) -> subprocess.CompletedProcess[str]:
        """Run in background mode."""
        return subprocess.run([*self.headless, *arguments], env=self.environment, capture_output=True, text=True,
                              timeout=seconds)

    def start_command(self, *arguments: str) -> subprocess.Popen[str]:
        """Start in background mode and do not wait, in a process group of its own as a terminal does."""
        return subprocess.Popen([*self.headless, *arguments], env=self.environment, stdout=subprocess.PIPE,
                                stderr=subprocess.PIPE, text=True, start_new_session=True)

    def script(self, name: str, *arguments: str, options: tuple[str, ...] = (), log_name: str = "") -> None:
        """Run a script with the interface, options being Blender's; its output lands in the output folder."""
        with open(self.output / f"{log_name or Path(name).name}.log", "w", encoding="utf-8") as log:
            subprocess.run([*self.ui, *options, "--python-exit-code", "1", "--python", str(HERE / name), "--",
                             *arguments], env=self.environment, stdout=log, stderr=subprocess.STDOUT,
                            timeout=UI_SECONDS, check=False)


def results(done: subprocess.CompletedProcess[str]) -> list[str]:
    """The lines of stdout without those of Blender's own log, which it writes before any command runs."""
    return [line for line in done.stdout.splitlines() if not re.match(r"\d\d:\d\d\.\d+ +\S+ +\|", line)]


def check_install(blender: Blender, zip_file: Path) -> None:
    """Installs, enables, and its command is known."""
    done = blender.command("--command", "extension", "install-file", "-r", "user_default", "--enable", str(zip_file))
    assert done.returncode == 0, done.stdout + done.stderr
    listed = blender.command("--command", "prt", "--help")
    assert listed.returncode == 0 and "bake" in listed.stdout + listed.stderr, listed.stdout + listed.stderr


def check_command_bake(blender: Blender, scene: Path) -> None:
    """`blender --command prt bake`: exit 0, stdout is the paths alone, the files are there, the input is unchanged."""
    before = scene.read_bytes()
    baked, report = blender.output / "baked.blend", blender.output / "report.json"
    done = blender.command("--command", "prt", "bake", "--input", str(scene), "--output", str(baked),
                           "--preset", "draft", "--report", str(report))
    assert done.returncode == 0, done.stderr
    assert results(done) == [str(baked), str(report)], done.stdout
    assert json.loads(report.read_text())["seconds"] > 0.0
    assert scene.read_bytes() == before
    drawn = blender.output / "command_preview.png"
    done = blender.command("--command", "prt", "preview", "--input", str(baked), "--output", str(drawn),
                           "--size", "640x400")
    assert done.returncode == 0 and drawn.stat().st_size > 1000, done.stderr
    arrays = blender.output / "relit.npz"
    done = blender.command("--command", "prt", "relight", "--input", str(baked), "--use-scene-lights", "--output",
                           str(arrays))
    assert done.returncode == 0 and arrays.is_file(), done.stderr


def check_bad_arguments(blender: Blender, scene: Path) -> None:
    """Exit 2 and one line of ours."""
    for arguments in (["bake"], ["bake", "--input", str(scene), "--output", "x.blend", "--preset", "best"],
                      ["dance"], ["analyze", "--input", "absent.blend"]):
        done = blender.command("--command", "prt", *arguments)
        ours = [line for line in done.stderr.splitlines() if line.startswith("prt:")]
        assert done.returncode == 2 and len(ours) == 1, (arguments, done.returncode, done.stderr)
        assert "Traceback" not in done.stderr and not results(done), (arguments, done.stdout)


def check_interrupt(blender: Blender, scene: Path) -> None:
    """Ctrl-C during a bake: exit 3, nothing written, no child left."""
    output = blender.output / "interrupted.blend"
    running = blender.start_command("--command", "prt", "bake", "--input", str(scene), "--output", str(output),
                                    "--preset", "high", "--set", "directions=65536")
    for line in running.stderr:
        if line.startswith("prt:"):
            break
    time.sleep(1.0)
    os.killpg(running.pid, signal.SIGINT)
    _, errors = running.communicate(timeout=30)
    assert running.returncode == 3, (running.returncode, errors)
    assert "resume" in errors and "Traceback" not in errors, errors
    assert not output.exists()


def check_kill_among_lamps(blender: Blender, scene: Path) -> None:
    """Blender is killed while its child bakes local lights: the child ends and cleans up, and the next bake resumes."""
    output, report = blender.output / "killed.blend", blender.output / "killed.json"
    command = ("--command", "prt", "bake", "--input", str(scene), "--output", str(output), "--report", str(report),
               "--preset", "draft", "--lighting", "local", "--set", "cloud_region=Region", "--set", "cloud_lights=300",
               "--set", "lamp_basis=cloud",
               "--set", "merge_response=0", "--set", "error_receivers=0", "--set", "spacing=0.02")
    running = blender.start_command(*command)
    for line in running.stderr:
        if "Local lights" in line:
            break
    jobs = Path(blender.environment["BLENDER_USER_RESOURCES"])
    deadline = time.monotonic() + 30.0
    while not list(jobs.rglob("responses-*")):
        assert time.monotonic() < deadline and running.poll() is None, "no responses on disk"
        time.sleep(0.02)
    os.kill(blender_process(output), signal.SIGKILL)
    running.communicate(timeout=30)
    assert running.returncode != 0 and not output.exists()
    while left := [*jobs.rglob("responses-*"), *jobs.rglob("bake-*/.*.part")]:
        assert time.monotonic() < deadline, left
        time.sleep(0.1)
    done = blender.command(*command)
    assert done.returncode == 0, done.stderr
    resumed = json.loads(report.read_text())["resumed"]
    assert resumed == ["gather", "direct", "interreflection"], resumed


def blender_process(output: Path) -> int:
    """The number of the Blender that writes this file: what was started may be a wrapper around it."""
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            name, command = (folder / "comm").read_text(), (folder / "cmdline").read_bytes()
            if name == "blender\n" and str(output).encode() in command:
                return int(folder.name)
        except OSError:  # it ended meanwhile
            continue
    raise AssertionError("Blender is not running")


def interface_results(blender: Blender, script: str, results: str, scene: Path, vulkan: bool = False,
                      ) -> list[tuple[str, str]]:
    """Name and failure (empty: passed) of each step that a script took, and whether its log is clean."""
    if script == RESTARTED:
        return restarted_results(blender, script, scene)
    results = blender.output / results
    results.unlink(missing_ok=True)
    log_name = f"{script}.vulkan" if vulkan else script
    blender.script(script, str(blender.output), str(scene), options=("--gpu-backend", "vulkan") if vulkan else (),
                   log_name=log_name)
    log = blender.output / f"{log_name}.log"
    if not results.is_file():
        return [(script, f"left no results; see {log}")]
    complaints = complaints_in(log.read_text(encoding="utf-8", errors="replace"))
    found = [*json.loads(results.read_text(encoding="utf-8")), (f"log of {log_name}", "\n    ".join(complaints))]
    if vulkan and "drawn by VULKAN" not in log.read_text(encoding="utf-8", errors="replace"):
        found.append((log_name, "Blender did not draw by Vulkan"))
    return [(f"{name} (Vulkan)" if vulkan else name, failure) for name, failure in found]


def complaints_in(log: str) -> list[str]:
    """Lines of a log that should not be there, each once."""
    return list(dict.fromkeys(line for line in log.splitlines()
                              if COMPLAINT.search(line) and not EXPECTED.search(line)))


def restarted_results(blender: Blender, script: str, scene: Path) -> list[tuple[str, str]]:
    """`interface_results` of the script that is started again as long as killed.again holds the next start's number."""
    again, number, outcomes = blender.output / "killed.again", 1, []
    while number:
        blender.script(script, str(blender.output), str(scene))
        (blender.output / f"{script}.log").replace(blender.output / f"{script}.{number}.log")
        results = blender.output / f"killed_{number}.json"
        if results.is_file():
            outcomes += [(name, failure) for name, failure in json.loads(results.read_text(encoding="utf-8"))]
        following = int(again.read_text()) if again.is_file() else 0
        if not results.is_file() and following <= number:
            outcomes.append((script, f"start {number} left no results; see {script}.{number}.log"))
        number = following if following > number else 0
    return outcomes


def make_scene(blender: Blender, script: str, outcomes: list[tuple[str, str]]) -> Path:
    """The scene that a script makes, as scenes are told apart by it; how that went is noted."""
    scene = blender.output / f"{Path(script).stem}.blend"
    made = blender.command("--python-exit-code", "1", "--python", str(HERE / script), "--", str(scene))
    outcomes.append((script, "" if made.returncode == 0 and scene.is_file() else made.stdout + made.stderr))
    return scene


def run_check(check: Callable[..., None], *arguments: object) -> tuple[str, str]:
    """The check's name and its failure."""
    try:
        check(*arguments)
    except (AssertionError, subprocess.TimeoutExpired, OSError) as error:
        return check.__name__, f"{type(error).__name__}: {error}"
    return check.__name__, ""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--zip", type=Path, required=True)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--ui", default="blender")
    parser.add_argument("--headless", default="blender --background")
    parser.add_argument("--only", choices=("commands", "vulkan", *SCRIPTS), default=None)
    arguments = parser.parse_args()
    output = arguments.output.resolve()
    shutil.rmtree(output, ignore_errors=True)
    output.mkdir(parents=True)
    with tempfile.TemporaryDirectory() as resources:
        blender = Blender(arguments.ui, arguments.headless, output, Path(resources))
        outcomes = [run_check(check_install, blender, arguments.zip.resolve())]
        if arguments.only in (None, "commands"):
            with blender.apart() as own:
                scene = make_scene(own, "make_scene.py", outcomes)
                outcomes += [run_check(check, own, scene)
                             for check in (check_bad_arguments, check_command_bake, check_interrupt)]
                outcomes.append(run_check(check_kill_among_lamps, own, make_scene(own, "make_room.py", outcomes)))
        for name, (script, maker) in SCRIPTS.items():
            if arguments.only in (None, name):
                with blender.apart() as own:
                    outcomes += interface_results(own, script, f"{name}.json", make_scene(own, maker, outcomes))
        if arguments.only in (None, "vulkan"):
            script, maker = SCRIPTS["views"]
            with blender.apart() as own:
                outcomes += interface_results(own, script, "views.json", make_scene(own, maker, outcomes), True)
    for name, failure in outcomes:
        print(f"{'failed' if failure else 'passed'}: {name}" + (f"\n    {failure}" if failure else ""))
    failed = sum(bool(failure) for _, failure in outcomes)
    print(f"{len(outcomes) - failed} passed, {failed} failed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
