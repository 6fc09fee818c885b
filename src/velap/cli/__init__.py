"""The command line. Heavy imports wait inside the commands, so that help and wrong options answer at once."""

from __future__ import annotations

import contextlib
import io
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import tyro

from velap._version import __version__
from velap.cli.config import config
from velap.cli.evaluate import demo, diagnose, evaluate
from velap.cli.info import info
from velap.cli.inspect import inspect, label
from velap.cli.options import ERR, OUT, Settings, note, say
from velap.cli.serve import export, serve
from velap.cli.studies import bench, figure, study, table
from velap.cli.train import collect, run, train
from velap.cli.view import view
from velap.errors import ConfigError, VelapError
from velap.signals import stop_signals

__all__ = ["COMMANDS", "OUT", "Settings", "main"]

COMMANDS: dict[str, Callable[..., Any]] = {
    "demo": demo, "collect": collect, "train": train, "evaluate": evaluate, "run": run, "table": table, "bench": bench,
    "diagnose": diagnose, "study": study, "figure": figure, "config": config, "info": info, "serve": serve, "export": export,
    "inspect": inspect, "label": label, "view": view,
}
GREEDY = ("--set", "--only", "--env-kwargs")
"""Options that take several values of the form NAME=VALUE."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code: 0, 2 after an error that says what to do, 130 after Ctrl-C."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # π and γ are not in every code page that a log file gets
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # `--env my_module:Env-v0` finds a module beside the user, as `python -m` does
    try:
        with warnings.catch_warnings(), _stop_as_interrupt():
            warnings.filterwarnings("default", category=UserWarning, module=r"velap\..*")
            warnings.showwarning = lambda message, *_, **__: note(str(message))
            return _run(given)
    except VelapError as error:
        ERR.print(f"velap: {error}", style="red", markup=False, soft_wrap=True)
        return 2
    except OSError as error:
        ERR.print(f"velap: {error}. Expected a file or folder that can be read and written; check its name, the permissions "
                  "and the free space, and repeat the command.", style="red", markup=False, soft_wrap=True)
        return 2
    except KeyboardInterrupt:
        ERR.print("stopped; the same command goes on from here (`velap train` with --resume)", markup=False, soft_wrap=True)
        return 130


@contextlib.contextmanager
def _stop_as_interrupt() -> Iterator[None]:
    """The signals of `velap.signals` end the block as Ctrl-C does."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = {number: signal.signal(number, signal.default_int_handler) for number in stop_signals()}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _run(given: Sequence[str]) -> int:
    """Answer `--version` and `--help`, or run the command that is named."""
    if list(given) == ["--version"]:
        say(f"velap {__version__}")
        return 0
    if not given or given[0] in ("-h", "--help"):
        say(_help())
        return 0 if given else 2
    name, *rest = given
    if name not in COMMANDS:
        raise ConfigError(f"unknown command {name!r}; expected one of {', '.join(COMMANDS)}. `velap --help` says what each "
                          "does.")
    tyro.cli(COMMANDS[name], prog=f"velap {name}", args=several_last(rest),
             config=(tyro.conf.PositionalMetavarFromFieldName, tyro.conf.FlagCreatePairsOff))
    return 0


def _help() -> str:
    """Every command with the first sentence of its docstring."""
    width = max(map(len, COMMANDS))
    lines = [f"  {name:{width}}  {(function.__doc__ or '').strip().splitlines()[0]}" for name, function in COMMANDS.items()]
    return ("usage: velap [-h] [--version] COMMAND ...\n\nValue-guided expansive latent planning (VELAP, CoRL 2023).\n\n"
            "commands:\n" + "\n".join(lines) + "\n\n`velap COMMAND --help` describes its options.")


def several_last(given: Sequence[str]) -> list[str]:
    """The arguments with the options that take several values behind all others, so that none takes the task for a value:
    `--set a.b=1 SpiralMaze` -> `SpiralMaze --set a.b=1`."""
    first: list[str] = []
    last: dict[str, list[str]] = {}
    taking = ""
    for word in given:
        if word in GREEDY:
            taking = word
            last.setdefault(word, [])
        elif taking and "=" in word and not word.startswith("-"):
            last[taking].append(word)
        elif taking == "--only" and not last[taking]:  # of `velap bench`, which takes plain names
            del last[taking]
            first += [taking, word]
            taking = ""
        elif taking and not last[taking]:
            raise ConfigError(f"{taking} got {word!r}; expected NAME=VALUE. Put the task first, or write {taking} before "
                              "each value.")
        else:
            taking = ""
            first.append(word)
    return first + [word for option, values in last.items() for word in (option, *values)]
