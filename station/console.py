"""Where the command line speaks: results on stdout, everything else on stderr."""

from __future__ import annotations

from rich.console import Console

# No markup: brackets and colons of a name are the name's own. What stands out does so by `style` or a Text.
out = Console(highlight=False, markup=False, emoji=False, soft_wrap=True)
err = Console(stderr=True, highlight=False, markup=False, emoji=False, soft_wrap=True)
