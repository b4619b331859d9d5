"""Where a user is told of results: text as it is, whatever it holds."""

from __future__ import annotations

import sys
from typing import Any

from rich.console import Console
from rich.text import Text

from geomocap.reading import harmless


class PlainConsole(Console):
    """A console for which names from outside are nothing but text: no mark-up, no commands to the terminal."""

    def render_str(self, text: str, **options: Any) -> Text:
        """Make a text of a string, with what a terminal would obey written out, and what it can't show too."""
        encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
        shown = harmless(text).encode(encoding, "backslashreplace").decode(encoding)
        return super().render_str(shown, **options)


console = PlainConsole(highlight=False, soft_wrap=True, markup=False, emoji=False)
