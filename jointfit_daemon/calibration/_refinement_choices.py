"""Names of the methods and costs of a marker refinement, without an import of the refinement."""

from __future__ import annotations

from typing import Literal

RefinementMethod = Literal["joint", "block", "search"]
RefinementCost = Literal["l1", "l2"]
