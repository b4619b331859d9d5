"""Where a user is told of results."""

from rich.console import Console

console = Console(highlight=False, soft_wrap=True)
