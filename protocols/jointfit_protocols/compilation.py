"""Options for the compiler mypyc, in modules that it may compile.

mypyc reads the decorators of mypy_extensions in the source and never runs them, so an installation
does not need mypy_extensions. This module itself is not compiled, because mypyc regards the branch
after ``else`` as unreachable.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

__all__ = ["mypyc_attr"]

if TYPE_CHECKING:
    from collections.abc import Callable

    from mypy_extensions import mypyc_attr
else:

    def mypyc_attr(**_options: bool) -> Callable[[type], type]:
        """Return a decorator without effect."""
        return lambda decorated: decorated
