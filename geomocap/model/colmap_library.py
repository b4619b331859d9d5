"""COLMAP's library without what it does to the process: importing it takes over SIGTERM.

Its handler prints a stack trace of thirty lines where a process that is asked to stop (by a queue of jobs, a container)
should just end.
"""

import signal
import threading

_own = signal.getsignal(signal.SIGTERM)

import pycolmap  # noqa: E402 - between the two

if threading.current_thread() is threading.main_thread() and _own is not None:
    signal.signal(signal.SIGTERM, _own)

__all__ = ["pycolmap"]
