"""Arguments in the sources: each is read, 0 is not taken for None, and an option that a function has reaches those that
it calls.
"""

from __future__ import annotations

import ast
import functools
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import pytest

_TOP = Path(__file__).parents[2]


@pytest.fixture(scope="module", autouse=True)
def _parsed() -> None:
    trees()


@functools.cache
def trees() -> list[ast.Module]:
    """The sources, guests' too."""
    files = (path for room in ("imagine_bench", "tasks", "agents") for path in (_TOP / room).rglob("*.py"))
    return [ast.parse(path.read_text()) for path in files if "tests" not in path.parts]


def is_number_or_none(annotation: ast.expr | None) -> bool:
    if not isinstance(annotation, ast.BinOp):
        return False
    words = {word.strip() for word in ast.unparse(annotation).split("|")}
    return "None" in words and not words.isdisjoint(("int", "float", "SupportsFloat"))


def name_of(node: ast.expr) -> str:
    """The last name of ``a.b.name``."""
    return node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""


def parameters(function: ast.FunctionDef) -> list[ast.arg]:
    given = function.args
    return [*given.posonlyargs, *given.args, *given.kwonlyargs]


# None and 0 ----------------------------------------------------------------------------------------------------------


@functools.cache
def fields() -> set[str]:
    """Names of fields that are a number or None, wherever there is such a field."""
    found: dict[str, set[bool]] = {}
    for tree in trees():
        for node in ast.walk(tree):
            if isinstance(node, ast.AnnAssign):
                found.setdefault(name_of(node.target), set()).add(is_number_or_none(node.annotation))
    return {name for name, kinds in found.items() if kinds == {True}}


def conditions(node: ast.AST) -> Iterator[ast.expr]:
    """The expressions whose truth a node asks for."""
    if isinstance(node, ast.If | ast.IfExp | ast.While | ast.Assert):
        yield node.test
    elif isinstance(node, ast.BoolOp):
        yield from node.values
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        yield node.operand
    elif isinstance(node, ast.comprehension):
        yield from node.ifs
    elif isinstance(node, ast.Call) and name_of(node.func) == "bool":
        yield from node.args


def taken_for_none(tree: ast.AST) -> Iterator[str]:
    """Where the truth is asked of what is a number or None, so that 0 counts as None."""
    for function in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)):
        names = {each.arg for each in parameters(function) if is_number_or_none(each.annotation)}
        for asked in (each for node in ast.walk(function) for each in conditions(node)):
            if name_of(asked) in (fields() if isinstance(asked, ast.Attribute) else names):
                yield f"{function.name}: {ast.unparse(asked)}"


def test_zero_is_not_taken_for_none() -> None:
    assert [said for tree in trees() for said in taken_for_none(tree)] == []


@pytest.mark.parametrize("line", ["not n", "n or 3", "3 if n else 4", "[m for m in k if n and m]", "bool(n)"])
def test_a_zero_that_is_taken_for_none_would_be_seen(line: str) -> None:
    for annotation, said in (("float | None", ["f: n"]), ("bool | None", []), ("int", [])):
        assert list(taken_for_none(ast.parse(f"def f(k, n: {annotation}):\n    return {line}"))) == said


# Passing on ----------------------------------------------------------------------------------------------------------


class Signature(NamedTuple):
    """Of a function or class: names by place, and those that may be left out."""

    places: list[str]
    optional: set[str]


def signature_of(function: ast.FunctionDef, is_method: bool) -> Signature:
    given = function.args
    places = [each.arg for each in (*given.posonlyargs, *given.args)]
    by_place = places[len(places) - len(given.defaults) :]
    named = {each.arg for each, value in zip(given.kwonlyargs, given.kw_defaults, strict=True) if value is not None}
    return Signature(places[is_method:], {*by_place, *named})


def defined(tree: ast.Module) -> Iterator[tuple[str, Signature]]:
    """Functions, classes and methods of a module."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef):
            yield node.name, signature_of(node, False)
        if isinstance(node, ast.ClassDef):
            methods = {each.name: each for each in node.body if isinstance(each, ast.FunctionDef)}
            fields = [each for each in node.body if isinstance(each, ast.AnnAssign)]
            if "__init__" in methods:
                yield node.name, signature_of(methods["__init__"], True)
            elif any("dataclass" in ast.unparse(each) for each in node.decorator_list):
                names = [(ast.unparse(each.target), each.value is not None) for each in fields]
                yield node.name, Signature([name for name, _ in names], {name for name, is_there in names if is_there})
            for name, method in methods.items():
                is_static = "staticmethod" in map(ast.unparse, method.decorator_list)
                yield f".{name}", signature_of(method, not is_static)


@functools.cache
def signatures() -> Mapping[str, Signature]:
    """Those of which there is one by that name."""
    found: dict[str, list[Signature]] = {}
    for tree in trees():
        for name, signature in defined(tree):
            found.setdefault(name, []).append(signature)
    return {name: ways[0] for name, ways in found.items() if len(ways) == 1}


def left_out(tree: ast.AST) -> Iterator[str]:
    """Optional arguments of callees that have the name of a parameter of the caller, and are not given."""
    for function in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)):
        own = {each.arg for each in parameters(function)}
        for call in (node for node in ast.walk(function) if isinstance(node, ast.Call)):
            name = name_of(call.func)
            called = signatures().get(name) or signatures().get(f".{name}")
            named = {keyword.arg for keyword in call.keywords}
            if called is None or None in named or any(isinstance(each, ast.Starred) for each in call.args):
                continue
            missing = own & called.optional - named - set(called.places[: len(call.args)])
            yield from (f"{function.name} calls {name} without {each}" for each in missing)


MEANT = {
    "source_of calls read_agent without encoder": "a run has its own",
    "source_of calls ModelSource without encoder": "a privileged model sees through none",
    "score calls interval without trials": "they are counted below, over levels",
    "environment calls CloneExecutedEnv without execution": "who executes, and how the rest of the world happens",
    "_batch calls Batch without rows": "their columns, and the numbers of these rows",
    "train_encoder calls Encoder without device": "it is trained on one, and used on the CPU",
    "__init__ calls restart without seed": "of dm_env",
}
"""Arguments that are not passed on, and why."""


def test_an_argument_is_passed_on_to_those_that_take_it() -> None:
    assert {said for tree in trees() for said in left_out(tree)} == MEANT.keys()


def test_an_argument_that_is_not_passed_on_would_be_seen() -> None:
    found = left_out(ast.parse("def f(run, encoder):\n    load_trained(run)\n    load_trained(run, encoder=encoder)"))
    assert list(found) == ["f calls load_trained without encoder"]


# Reading -------------------------------------------------------------------------------------------------------------


def is_declared_alone(function: ast.FunctionDef) -> bool:
    """Whether it has no body but words, or raises at once."""
    words = [each for each in function.body if isinstance(each, ast.Expr) and isinstance(each.value, ast.Constant)]
    return all(each in words or isinstance(each, ast.Raise | ast.Pass) for each in function.body)


@functools.cache
def methods() -> Counter[str]:
    """In how many classes there is a method of a name."""
    classes = (node for tree in trees() for node in ast.walk(tree) if isinstance(node, ast.ClassDef))
    return Counter(each.name for node in classes for each in node.body if isinstance(each, ast.FunctionDef))


def unread(tree: ast.AST) -> Iterator[str]:
    """Arguments of functions that these never read, but for those of a method that several classes have."""
    for function in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)):
        if methods()[function.name] < 2 and not is_declared_alone(function):
            read = {name.id for each in function.body for name in ast.walk(each) if isinstance(name, ast.Name)}
            taken = {each.arg for each in parameters(function)} - {"self", "cls"} - read
            yield from (f"{function.name}: {name}" for name in taken)


NEEDLESS = {
    "write_motion: card": "as all formats of datasets",
    "testing: variant": "as all regression tasks",
    "errors: variant": "likewise",
    "_collect_one: on_news": "as all jobs of a pool",
    "_frame_renderer: thread": "each has its own, by the cache",
    "_never: macrostate": "as all conditions",
    "get_source: fullname": "of Python's loaders",
}
"""Arguments that are not read, and why they are taken."""


def test_every_argument_is_read() -> None:
    assert {said for tree in trees() for said in unread(tree)} == NEEDLESS.keys()


def test_an_argument_that_is_not_read_would_be_seen() -> None:
    assert list(unread(ast.parse("def f(a, b):\n    return a\ndef g(c):\n    raise NotImplementedError"))) == ["f: b"]
