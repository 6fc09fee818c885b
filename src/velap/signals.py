"""Signals that ask a process to stop: Ctrl-C, and what terminals and clusters send before they end it."""

from __future__ import annotations

import signal

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1", "SIGUSR2", "SIGXCPU", "SIGBREAK")
"""Ctrl-C; `kill`, preemption and time limits; a closed terminal; Slurm's `--signal`; Grid Engine's limit; Ctrl-Break."""


def stop_signals() -> tuple[signal.Signals, ...]:
    """Those that this system has and this process does not ignore: `nohup` ignores SIGHUP, `&` in scripts SIGINT."""
    here = (signal.Signals[name] for name in _NAMES if hasattr(signal, name))
    return tuple(number for number in here if signal.getsignal(number) is not signal.SIG_IGN)
