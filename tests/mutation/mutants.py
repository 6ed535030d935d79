"""Mutants of a module: the source with one operator, constant or keyword replaced.

The replacements are those of cosmic-ray. Each is a mistake that a programmer could make, such as
`<` for `<=`. Annotations are left out, because no test can observe them.
"""

from __future__ import annotations

import ast
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cosmic_ray.plugins
from cosmic_ray.ast import Visitor, get_ast
from cosmic_ray.mutating import mutate_code

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

REPLACEMENTS = (
    "ReplaceBinaryOperator_Add_Sub", "ReplaceBinaryOperator_Sub_Add",
    "ReplaceBinaryOperator_Mul_Div", "ReplaceBinaryOperator_Div_Mul",
    "ReplaceBinaryOperator_FloorDiv_Mul", "ReplaceBinaryOperator_Mod_FloorDiv",
    "ReplaceBinaryOperator_Pow_Mul", "ReplaceBinaryOperator_RShift_LShift",
    "ReplaceBinaryOperator_LShift_RShift", "ReplaceBinaryOperator_BitOr_BitAnd",
    "ReplaceBinaryOperator_BitAnd_BitOr", "ReplaceBinaryOperator_BitXor_BitOr",
    "ReplaceComparisonOperator_Eq_NotEq", "ReplaceComparisonOperator_NotEq_Eq",
    "ReplaceComparisonOperator_Lt_LtE", "ReplaceComparisonOperator_LtE_Lt",
    "ReplaceComparisonOperator_Gt_GtE", "ReplaceComparisonOperator_GtE_Gt",
    "ReplaceComparisonOperator_Is_IsNot", "ReplaceComparisonOperator_IsNot_Is",
    "ReplaceUnaryOperator_Delete_USub", "ReplaceUnaryOperator_Delete_Not", "AddNot",
    "ReplaceTrueWithFalse", "ReplaceFalseWithTrue", "ReplaceAndWithOr", "ReplaceOrWithAnd",
    "ReplaceBreakWithContinue", "ReplaceContinueWithBreak", "NumberReplacer",
    "ZeroIterationForLoop", "ExceptionReplacer",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Mutant:
    """One replacement in one file."""

    path: Path
    replacement: str
    occurrence: int
    line: int

    def source(self) -> str:
        """Return the text of the file with the replacement."""
        operator = cosmic_ray.plugins.get_operator(f"core/{self.replacement}")()
        text = mutate_code(self.path.read_text(encoding="utf-8"), operator, self.occurrence)
        assert text is not None
        return str(text)

    def change(self, source: str) -> tuple[str, str]:
        """Return the first line that differs between the file and `source`, without indentation."""
        before = self.path.read_text(encoding="utf-8").splitlines()
        after = source.splitlines()
        pairs = zip(before, after, strict=False)
        return next(
            ((one.strip(), other.strip()) for one, other in pairs if one != other), ("", "")
        )


class _Positions(Visitor):  # type: ignore[misc]  # cosmic-ray has no types
    """Collects the positions at which operators of cosmic-ray can replace something."""

    def __init__(self) -> None:
        self.found: dict[str, list[tuple[int, int]]] = {name: [] for name in REPLACEMENTS}
        self._operators = {
            name: cosmic_ray.plugins.get_operator(f"core/{name}")() for name in REPLACEMENTS
        }

    def visit(self, node: object) -> object:
        for name, operator in self._operators.items():
            positions = operator.mutation_positions(node)
            self.found[name] += [(begin[0], begin[1]) for begin, _ in positions]
        return node


def mutants_of(path: Path) -> list[Mutant]:
    """Return all mutants of a file, in the order of their lines."""
    text = path.read_text(encoding="utf-8")
    positions = _Positions()
    positions.walk(get_ast(text))
    unseen = list(_unobservable(ast.parse(text)))
    found = [
        Mutant(path, name, occurrence, place[0])
        for name, places in positions.found.items()
        for occurrence, place in enumerate(places)
        if not any(begin <= place < end for begin, end in unseen)
    ]
    return sorted(found, key=lambda mutant: (mutant.line, mutant.replacement, mutant.occurrence))


def _unobservable(tree: ast.Module) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """Yield begin and end of annotations and other code that only type checkers use."""
    for node in ast.walk(tree):
        unseen: Sequence[ast.AST | None] = ()
        if isinstance(node, ast.AnnAssign):
            is_alias = isinstance(node.annotation, ast.Name) and node.annotation.id == "TypeAlias"
            unseen = (node.annotation, node.value if is_alias else None)
        elif isinstance(node, ast.arg):
            unseen = (node.annotation,)
        elif isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            unseen = (node.returns,)
        elif isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            unseen = (node,)
        for part in unseen:
            if isinstance(part, (ast.expr, ast.stmt)):
                end = (part.end_lineno or part.lineno, part.end_col_offset or part.col_offset)
                yield (part.lineno, part.col_offset), end
