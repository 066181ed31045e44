"""Parameters of OpenSCENARIO in XML: ``$name``, and ``${...}`` with arithmetic, which is computed and never run."""

from __future__ import annotations

import ast
import math
import operator
import re
from collections import ChainMap
from collections.abc import Callable, Mapping
from types import MappingProxyType

from pytest_pafot.extras.recordings.xml_data import Element

OPERATORS: Mapping[type[ast.operator], Callable[[float, float], float]] = MappingProxyType(
    {
        ast.Add: operator.add,
        ast.Sub: operator.sub,
        ast.Mult: operator.mul,
        ast.Div: operator.truediv,
        ast.Mod: operator.mod,
    }
)
FUNCTIONS: Mapping[str, Callable[..., float]] = MappingProxyType({
    "round": round, "floor": math.floor, "ceil": math.ceil, "sqrt": math.sqrt, "abs": abs, "min": min, "max": max,
})  # fmt: skip


LONGEST = 1000
"""The longest value with parameters, before and after they are replaced: ``$a$a`` of ``$b$b`` and so on grows fast."""


def resolved(element: Element, known: ChainMap[str, str]) -> None:
    """Replace the parameters in all values of an element and of those within it."""
    known = known.new_child() if element.find("ParameterDeclarations") else known
    for each in element.all("ParameterDeclarations/ParameterDeclaration"):
        known[each.values.get("name", "").lstrip("$")] = _value(each, "value", known)
    for name in element.values:
        if element.tag not in ("ParameterDeclaration", "ParameterAssignment"):
            element.values[name] = _value(element, name, known)
    for child in element.children:
        resolved(child, known)


def _value(element: Element, name: str, known: Mapping[str, str]) -> str:
    text = element.values.get(name, "")

    def of(match: re.Match[str]) -> str:
        if match[1] not in known:
            expected = f"one of the parameters {', '.join(known)[:100] or '(none is declared)'}"
            raise element.error(expected, match[0], "declare it in ParameterDeclarations", name)
        return known[match[1]]

    if not text.startswith("$"):
        return text
    found = text if len(text) > LONGEST else re.sub(r"\$(\w+)", of, text)
    if len(found) > LONGEST:
        raise element.error(f"at most {LONGEST} characters", f"{found!r:.80}", "write the value", name)
    if not text.startswith("${"):
        return found
    inner = found.removeprefix("${").removesuffix("}")
    try:
        return repr(_computed(ast.parse(inner.strip(), mode="eval").body))
    except (SyntaxError, ValueError, TypeError, ArithmeticError, RecursionError, MemoryError):
        raise element.error("arithmetic with numbers", f"{inner!r:.80}", "write the number", name) from None


def _computed(node: ast.expr) -> float:
    match node:
        case ast.Constant(value=int() | float() as number):
            return float(number)
        case ast.UnaryOp(op=ast.USub(), operand=inner):
            return -_computed(inner)
        case ast.BinOp(left=left, op=op, right=right) if type(op) in OPERATORS:
            return OPERATORS[type(op)](_computed(left), _computed(right))
        case ast.Call(func=ast.Name(id=name), args=arguments) if name in FUNCTIONS:
            return float(FUNCTIONS[name](*map(_computed, arguments)))
    raise ValueError
