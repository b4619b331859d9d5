"""The error stream, on which only geomocap speaks."""

from __future__ import annotations

import faulthandler
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def own_lines_only() -> Iterator[None]:
    """Keep off the error stream what libraries write to it by themselves.

    libjpeg, libpng and others know no other place for what they find odd. Their warnings in Python are seen if asked
    for (`python -W`). Nothing is changed where Python's error stream isn't the process's.
    """
    own = sys.__stderr__
    if own is None or sys.stderr is not own:
        yield
        return
    own.flush()
    with os.fdopen(os.dup(2), "w", 1, own.encoding, own.errors) as seen, open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 2)
        sys.stderr = seen
        faulthandler.enable(seen)  # should a library end the process, where is seen at least
        try:
            with warnings.catch_warnings():
                if not sys.warnoptions:
                    warnings.simplefilter("ignore")
                yield
        finally:
            faulthandler.disable()
            sys.stderr = own
            seen.flush()
            os.dup2(seen.fileno(), 2)
