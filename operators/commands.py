# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line: `main(arguments) -> exit code`, the same from Blender's `--command prt` and from tools/prt.py.

Exit codes (design/contract.md): 0 done, 1 failed, 2 bad arguments, 3 cancelled or interrupted (run again to resume).
One line on stderr says what went wrong. stdout carries the result only.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn, TextIO

import bpy

from ..prt_addon.baking.settings import PRESETS
from ..prt_addon.errors import BadArguments, Cancelled, PRTError
from . import verbs
from .arguments import lighting_of, names_of, size_of

COMMAND = "prt"


class _Parser(argparse.ArgumentParser):
    """argparse with one line per mistake, and no prefixes of options: scripts must not depend on abbreviations."""

    def __init__(self, **options: object) -> None:
        super().__init__(**{"allow_abbrev": False, **options})

    def error(self, message: str) -> NoReturn:
        raise BadArguments(self.prog, message, f"See `{self.prog} --help`")


def main(arguments: list[str], output: TextIO | None = None) -> int:
    """Run one command and return its exit code. output: where results go (stdout)."""
    try:
        with _interruptible():
            with contextlib.redirect_stdout(output or sys.stdout):  # argparse prints its help there
                parsed = _parser().parse_args(arguments)
            for line in parsed.run(parsed):
                print(line, file=output or sys.stdout, flush=True)
    except SystemExit as end:  # argparse has printed the help
        return int(end.code or 0)
    except PRTError as error:
        print(f"{COMMAND}: {_one_line(str(error))}", file=sys.stderr, flush=True)
        return error.exit_code
    except OSError as error:  # what no check foresaw: a name too long, a closed pipe, a folder that went away
        print(f"{COMMAND}: {_one_line(f'{error.filename or COMMAND}: {error.strerror or error}')}. "
              "Check that it can be read and written", file=sys.stderr, flush=True)
        return PRTError.exit_code
    except KeyboardInterrupt:
        print(f"{COMMAND}: interrupted. Run the same command again to resume", file=sys.stderr, flush=True)
        return Cancelled.exit_code
    return 0


def run_as_program(arguments: list[str]) -> int:
    """`main` for a process that ends with it: Blender's own chatter on stdout goes to stderr until the exit.

    Blender's C code writes to file descriptor 1 past Python's sys.stdout, at its exit too ("Blender quit").
    """
    sys.stdout.flush()
    # Unbuffered: what a closed pipe or a full disk refused must not come up again when the stream is closed.
    with io.TextIOWrapper(os.fdopen(os.dup(1), "wb", buffering=0), "utf-8", "surrogateescape",
                          write_through=True) as results:
        os.dup2(2, 1)
        return main(arguments, results)


def _one_line(text: str) -> str:
    return " ".join(text.split())


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    """Ctrl-C and a polite kill raise KeyboardInterrupt: Blender's own handler of both would end it at once."""

    def interrupt(_number: int, _frame: object) -> NoReturn:
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog=COMMAND, description="Precomputed radiance transfer: bake once, relight at once.")
    verb = parser.add_subparsers(title="verbs", metavar="VERB", required=True)
    _add_analyze(verb)
    _add_bake(verb)
    _add_relight(verb)
    _add_preview(verb)
    _add_report(verb)
    _add_export(verb)
    _add_compare(verb)
    return parser


def _verb(verbs_group: argparse._SubParsersAction, name: str, text: str) -> argparse.ArgumentParser:
    parser = verbs_group.add_parser(name, help=text, description=text)
    parser.set_defaults(run=getattr(verbs, name))
    return parser


def _add_scene_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--input", type=Path, required=True, metavar="FILE.blend")
    parser.add_argument("--objects", type=names_of, default=None, metavar="A,B", help="default: all visible meshes")
    parser.add_argument("--preset", choices=tuple(PRESETS), default="standard")
    parser.add_argument("--lighting", type=lighting_of, default=None, metavar="environment,local",
                        help="what will light the scene: World and Suns, lamps that move, or both")
    parser.add_argument("--set", type=_assignment, action="append", default=[], dest="overrides", metavar="NAME=VALUE",
                        help="a single setting, in place of the preset's; may be repeated")


def _add_light_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--environment", type=Path, default=None, metavar="FILE.exr",
                        help="an equirectangular picture in place of the World")
    parser.add_argument("--rotate", type=float, default=0.0, metavar="DEG",
                        help="turns the environment, as a Z rotation in the World's Mapping node does")
    parser.add_argument("--window", action="store_true",
                        help="take ringing out of the light, where it rings, at the price of some of its detail")


def _add_by_directions(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--lamps-by-directions", action="store_true",
                        help="the scene's lamps light bakes without local light, too, as light from their direction; "
                             "only lamps outside the hull of the scene")


def _add_analyze(group: argparse._SubParsersAction) -> None:
    _add_scene_options(_verb(group, "analyze", "Print what the scene needs, what is left out, and the expected cost."))


def _add_bake(group: argparse._SubParsersAction) -> None:
    parser = _verb(group, "bake", "Bake light transfer and save the scene with it.")
    _add_scene_options(parser)
    parser.add_argument("--output", type=Path, required=True, metavar="FILE.blend")
    parser.add_argument("--report", type=Path, default=None, metavar="FILE.json")


def _add_relight(group: argparse._SubParsersAction) -> None:
    parser = _verb(group, "relight", "Write the exit radiance of every receiver of a baked scene.")
    parser.add_argument("--input", type=Path, required=True, metavar="FILE.blend")
    parser.add_argument("--output", type=Path, required=True, metavar="FILE.npz")
    _add_light_options(parser)
    parser.add_argument("--use-scene-lights", action="store_true",
                        help="add the scene's Suns to the environment, and its lamps where a light cloud was baked")
    _add_by_directions(parser)


def _add_preview(group: argparse._SubParsersAction) -> None:
    parser = _verb(group, "preview", "Draw the active camera's view of a baked scene.")
    parser.add_argument("--input", type=Path, required=True, metavar="FILE.blend")
    parser.add_argument("--output", type=Path, required=True, metavar="FILE.png")
    parser.add_argument("--size", type=size_of, default=None, metavar="WxH", help="default: the scene's resolution")
    _add_light_options(parser)
    _add_by_directions(parser)


def _add_report(group: argparse._SubParsersAction) -> None:
    parser = _verb(group, "report", "Turn a bake's report into a self-contained page with plots.")
    parser.add_argument("--input", type=Path, required=True, metavar="FILE.json")
    parser.add_argument("--output", type=Path, required=True, metavar="FILE.html")


def _add_export(group: argparse._SubParsersAction) -> None:
    parser = _verb(group, "export", "Write baked data for other programs: arrays and a description per object.")
    parser.add_argument("--input", type=Path, required=True, metavar="FILE.blend")
    parser.add_argument("--output", type=Path, required=True, metavar="FOLDER")


def _add_compare(group: argparse._SubParsersAction) -> None:
    parser = _verb(group, "compare", "Render the camera's view with Cycles, and compare the preview with it.")
    parser.add_argument("--input", type=Path, required=True, metavar="FILE.blend")
    parser.add_argument("--output", type=Path, required=True, metavar="FILE.png")
    parser.add_argument("--samples", type=int, default=64, help="of Cycles in each pixel; default: 64")
    parser.add_argument("--size", type=size_of, default=None, metavar="WxH", help="default: the scene's resolution")
    parser.add_argument("--report", type=Path, default=None, metavar="FILE.json", help="where the numbers go")


def _assignment(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not (name and equals):
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE")
    return name.strip(), value.strip()


_registered: list[object] = []


def register() -> None:
    """Make `blender --command prt` known."""
    _registered.append(bpy.utils.register_cli_command(COMMAND, run_as_program))


def unregister() -> None:
    """Withdraw the command."""
    while _registered:
        bpy.utils.unregister_cli_command(_registered.pop())
