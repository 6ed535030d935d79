"""HTML pages without scripts: the document, sections, tables, lists of facts.

Invariant: all text is escaped. The content security policy of a page forbids everything except the
page's own style sheet.
"""

from __future__ import annotations

import base64
import hashlib
from html import escape
from importlib.resources import files
from typing import TYPE_CHECKING

from jointfit_daemon import __version__

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence


class Drawing(str):
    """SVG text of `_svg_plot`, which is inserted into a table without escaping."""

    __slots__ = ()


class PageLink(str):
    """Text that links to another page; `address` is relative to the page with the link."""

    __slots__ = ("address",)

    def __new__(cls, text: str, address: str) -> PageLink:
        """Return a link."""
        made = super().__new__(cls, text)
        made.address = address
        return made

    address: str


def document(title: str, body: str) -> str:
    """Return a page; `body` is HTML, the title is escaped."""
    tools = files("jointfit_daemon.tools")
    theme = (tools / "dashboard" / "page" / "css" / "theme.css").read_text("utf-8")
    own = (tools / "report" / "report.css").read_text("utf-8")

    # The colours are the colours of the dashboard, but printed pages are always white.
    dark = "(prefers-color-scheme: dark)"
    style = f"{theme.replace(dark, f'screen and {dark}')}\n{own}"
    digest = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\';'
        f" style-src 'sha256-{digest}'; base-uri 'none'; form-action 'none'\">"
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="referrer" content="no-referrer">'
        '<meta name="color-scheme" content="light dark">'
        f"<title>{escape(title)}</title><style>{style}</style></head><body>{body}</body></html>\n"
    )


def footer(text: str) -> str:
    """Return the footer of a page, which contains the version of the software."""
    return f"<footer><p>{escape(text)}</p><p>Made by jointfitd {__version__}.</p></footer>"


def section(anchor: str, title: str, parts: Iterable[str]) -> str:
    """Return a section of the page with its heading."""
    body = "".join(parts)
    return (
        f'<section id="{escape(anchor)}" aria-labelledby="{escape(anchor)}-title">'
        f'<h2 id="{escape(anchor)}-title">{escape(title)}</h2>{body}</section>'
    )


def paragraph(text: str, kind: str = "") -> str:
    """Return a paragraph; `kind` is its CSS class."""
    return f"<p{_class(kind)}>{escape(text)}</p>"


def facts(pairs: Iterable[tuple[str, str]], kind: str = "facts") -> str:
    """Return name and value pairs as a description list."""
    rows = "".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in pairs
    )
    return f"<dl{_class(kind)}>{rows}</dl>"


def table(caption: str, head: Sequence[str], rows: Iterable[Sequence[str]], text: int = 1) -> str:
    """Return a table with row names in column 1; the first `text` columns are left-aligned."""

    def cell(number: int, value: str) -> str:
        kind = "" if number < text else ' class="number"'
        inner = value if isinstance(value, Drawing) else escape(value)
        if isinstance(value, PageLink):
            inner = f'<a href="{escape(value.address)}">{inner}</a>'
        if number == 0:
            return f'<th scope="row">{inner}</th>'
        return f"<td{kind}>{inner}</td>"

    titles = "".join(
        f'<th scope="col"{"" if k < text else _class("number")}>{escape(name)}</th>'
        for k, name in enumerate(head)
    )
    body = "".join(
        f"<tr>{''.join(cell(k, value) for k, value in enumerate(row))}</tr>" for row in rows
    )
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{escape(caption)}"><table>'
        f"<caption>{escape(caption)}</caption><thead><tr>{titles}</tr></thead>"
        f"<tbody>{body}</tbody></table></div>"
    )


def figure(drawing: str, caption: str, legend: Sequence[tuple[str, str]] = ()) -> str:
    """Return a drawing with caption and legend; a legend entry is a CSS class and a text."""
    keys = "".join(
        f'<span class="key"><svg class="swatch" viewBox="0 0 22 12" aria-hidden="true">'
        f"{_SWATCHES[kind]}</svg>{escape(text)}</span>"
        for kind, text in legend
    )
    below = f'<span class="legend">{keys}</span>' if keys else ""
    return f"<figure>{drawing}<figcaption>{escape(caption)}{below}</figcaption></figure>"


_SWATCHES = {
    "imu": '<path class="line imu" d="M1 6h20"/>',
    "band": '<rect class="band imu" x="1" y="1" width="20" height="10"/>',
    "optical": '<path class="line optical" d="M1 6h20"/>',
    "cycle": '<path class="line cycle" d="M1 6h20"/>',
    "data": '<rect class="bar" x="1" y="2" width="20" height="8"/>',
    "gap": '<rect class="bar gap" x="1" y="2" width="20" height="8"/>',
    "walking": '<rect class="bar walking" x="1" y="2" width="20" height="8"/>',
    "limit": '<path class="line limit" d="M1 6h20"/>',
}


def _class(kind: str) -> str:
    return f' class="{escape(kind)}"' if kind else ""
