"""Pictures of a terminal with a command and its output, as SVG by Rich."""

from __future__ import annotations

import re
from html import escape
from io import StringIO
from typing import TYPE_CHECKING

from rich._export_format import CONSOLE_SVG_FORMAT
from rich.console import Console
from rich.text import Text

if TYPE_CHECKING:
    from collections.abc import Sequence

COLUMNS = 96
_FONT = re.compile(r"@font-face \{\{.*?\}\}", re.DOTALL)
_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)


def picture(session: Sequence[tuple[str, str]], title: str, description: str) -> str:
    """Return the picture of commands with their outputs.

    Parameters
    ----------
    session
        Commands and the text that each printed.
    title
        Title of the window.
    description
        Text for screen readers.
    """
    console = Console(record=True, width=COLUMNS, file=StringIO())
    for command, printed in session:
        console.print(Text("$ ", "bold green") + Text(command, "bold"), soft_wrap=False)
        for line in printed.rstrip().splitlines():
            console.print(Text(line.rstrip(), overflow="fold"))

    # no font from another site, no comment with a link
    form = _COMMENT.sub("", _FONT.sub("", CONSOLE_SVG_FORMAT))
    drawn = console.export_svg(title=title, code_format=form, unique_id="terminal")
    label = f'role="img" aria-label="{escape(description)}"'
    return "\n".join(
        line.rstrip() for line in drawn.replace("<svg ", f"<svg {label} ", 1).splitlines()
    )
