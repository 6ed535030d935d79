"""Methods, costs and options of a marker refinement, without an import of the refinement."""

from __future__ import annotations

from typing import Literal

RefinementMethod = Literal["joint", "block", "search"]
RefinementCost = Literal["l1", "l2"]

METHODS_OF_OPTION: dict[str, tuple[RefinementMethod, ...]] = {
    "prior": ("joint", "block"),
    "evenness": ("joint", "block"),
    "holdout": ("joint", "block"),
    "first_step": ("search",),
    "threshold": ("search",),
}
"""Methods that use an option. Options that are not listed are used by all methods."""
