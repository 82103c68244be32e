"""Expressions of variables in a sweep's `set`: texts that begin with =, such as "=0.5 + x / 2".

`ast` parses an expression, and `_value` evaluates a few kinds of nodes and rejects all others. Powers are computed as
floats, so that 9**9**9 overflows at once.
"""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Mapping
from typing import Any

from taichi_msm.errors import Key, did_you_mean, truncate

# Largest number of characters; longer texts could nest deeper than Python's stack.
MAX_LENGTH = 200

Function = Callable[..., float]


def _floor(number: float) -> float:
    # NaN stands for a value that is not known yet.
    return number if math.isnan(number) else math.floor(number)


FUNCTIONS: dict[str, Function] = {
    "min": min,
    "max": max,
    "abs": abs,
    "floor": _floor,
    "sqrt": math.sqrt,
    "exp": math.exp,
    "log": math.log,
    "sin": math.sin,
    "cos": math.cos,
}
CONSTANTS = {"pi": math.pi}
SYNTAX = f"numbers, + - * / ** ( ), {', '.join(FUNCTIONS)}, pi, and names of variables"


def _power(base: float, exponent: float) -> float:
    result = math.pow(base, exponent)
    is_exact = isinstance(base, int) and isinstance(exponent, int) and exponent >= 0 and abs(result) < 2**53
    return int(result) if is_exact else result


_OPERATORS: dict[type[ast.AST], Function] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: _power,
    ast.UAdd: operator.pos,
    ast.USub: operator.neg,
}


class ExpressionError(ValueError):
    """An expression is invalid or has no value."""


def evaluate(text: str, variables: Mapping[str, float]) -> float:
    """Evaluate an expression that begins with =; an int if it is a floor, or has only ints and no division.

    Raise an ExpressionError when it is invalid, or its value is not defined or too large; NaN as the value of variables
    raises only errors that do not depend on values.
    """
    reason = f"{len(text)} characters; take at most {MAX_LENGTH}"
    if len(text) <= MAX_LENGTH:
        try:
            return _value(ast.parse(text[1:].strip(), mode="eval").body, {**CONSTANTS, **variables})
        except ExpressionError as error:
            reason = str(error)
        except (SyntaxError, ValueError):
            reason = f"not an expression; take {SYNTAX}"
    raise ExpressionError(f"{truncate(text)}: {reason}")


def _value(node: ast.expr, names: Mapping[str, float]) -> float:
    """Return the value of a node, recursively."""
    values: list[float]
    function: Function
    match node:
        case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
            values, function = [number], operator.pos
        case ast.Name(id=name):
            if name not in names:
                remedy = did_you_mean(name, names) or "; name it in variables"
                raise ExpressionError(f"{name} is not a variable{remedy}")
            return names[name]
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
            values, function = [_value(left, names), _value(right, names)], _OPERATORS[type(op)]
        case ast.UnaryOp(op=op, operand=operand) if type(op) in _OPERATORS:
            values, function = [_value(operand, names)], _OPERATORS[type(op)]
        case ast.Call(func=ast.Name(id=name), args=[_, *_] as arguments, keywords=[]) if name in FUNCTIONS:
            values, function = [_value(argument, names) for argument in arguments], FUNCTIONS[name]
        case _:
            raise ExpressionError(f"{ast.unparse(node)} is not allowed; take {SYNTAX}")
    fault = "is too large"
    try:
        result = function(*values)
        if not math.isinf(result):
            return result
    except TypeError:
        raise ExpressionError(f"{ast.unparse(node)} has the wrong number of arguments") from None
    except OverflowError:
        pass
    except (ZeroDivisionError, ValueError):
        fault = "is not defined"
    raise ExpressionError(f"{ast.unparse(node)}, of {' and '.join(f'{value:g}' for value in values)}, {fault}")


def replace_expressions(value: Any, change: Callable[[Key, str], Any], path: Key = ()) -> Any:
    """Return a copy of a value of `set`, with expressions replaced by `change` of their key and text."""
    if isinstance(value, str):
        return change(path, value) if value.startswith("=") else value
    if isinstance(value, dict):
        return {name: replace_expressions(item, change, (*path, name)) for name, item in value.items()}
    if isinstance(value, list):
        return [replace_expressions(item, change, (*path, index)) for index, item in enumerate(value)]
    return value
