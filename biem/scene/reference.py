"""The keys of a scene, read off its schema: types, defaults, bounds, and what the source says of them.

The description of a key is its Field's, or else the comment on or right above its line in the source of its table.
"""

from __future__ import annotations

import ast
import inspect
import io
import json
import textwrap
import tokenize
from dataclasses import dataclass
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt, MultipleOf
from pydantic.fields import FieldInfo

from biem.scene.config import EXPECTED, Scene
from biem.scene.tables import Table

WORDS = {bool: "true or false", int: "integer", float: "number", str: "text"}
FILLED_IN = {"name": "that of the file"}  # by load_scene, of keys that the schema requires
BOUNDS = {Gt: ("> {:g}", "gt"), Ge: (">= {:g}", "ge"), Lt: ("< {:g}", "lt"), Le: ("<= {:g}", "le")}


@dataclass(frozen=True)
class Key:
    """One key of a table. takes: its type in words; default: as TOML, or None; required: there must be one; table: of keys of its own."""

    name: str
    takes: str
    bounds: str
    default: str | None
    required: bool
    about: str
    table: str | None = None


@dataclass(frozen=True)
class Keys:
    """A table of a scene file. path: its name there, "" for the file itself; many: it is a list of tables; about: its docstring."""

    path: str
    many: bool
    about: str
    keys: tuple[Key, ...]


def tables(root: type[Table] = Scene) -> list[Keys]:
    """The file's own keys, then its tables in the order of the schema, each one before those within it."""
    return _tables(root, "", False)


def _tables(model: type[Table], path: str, many: bool) -> list[Keys]:
    comments = key_comments(model)
    keys: list[Key] = []
    inner: list[Keys] = []
    for name, field in model.model_fields.items():
        place = f"{path}.{name}" if path else name
        found, is_list = table_in(field.annotation)
        if found is not None:
            inner += _tables(found, place, is_list)
        keys.append(_key(name, place, field, comments.get(name, ""), found is not None))
    return [Keys(path, many, inspect.cleandoc(model.__doc__ or ""), tuple(keys)), *inner]


def _key(name: str, place: str, field: FieldInfo, comment: str, is_table: bool) -> Key:
    takes = EXPECTED.get(place) or words(field.annotation)
    required = field.is_required() and place not in FILLED_IN
    default = None if field.is_required() or field.get_default() is None else as_toml(field.get_default(call_default_factory=False))
    about = field.description or comment
    about += f"; default {FILLED_IN[place]}" if place in FILLED_IN else ""
    return Key(name, takes, bounds(field), default, required, about, place if is_table else None)


def table_in(annotation: Any) -> tuple[type[Table] | None, bool]:
    """The table that a key holds, through None and lists, and whether it is a list of them; (None, False) for a plain value."""
    if isinstance(annotation, type) and issubclass(annotation, Table):
        return annotation, False
    for inner in get_args(annotation):
        found, many = table_in(inner)
        if found is not None:
            return found, many or get_origin(annotation) is list
    return None, False


def words(annotation: Any) -> str:
    """A type as the reader of a TOML file knows it."""
    if annotation in WORDS:
        return WORDS[annotation]
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return " or ".join(json.dumps(value) for value in inner)
    if origin in (Union, UnionType):
        return " or ".join(dict.fromkeys(words(part) for part in inner if part is not NoneType))
    if origin is tuple and Ellipsis not in inner:
        return f"[{', '.join(words(part) for part in inner)}]"
    if origin in (list, tuple):
        return f"list of {words(inner[0])}"
    return "table"


def bounds(field: FieldInfo) -> str:
    """What the schema asks of a value beyond its type, in words; "" for nothing."""
    found = [text.format(getattr(rule, name)) for rule in field.metadata for kind, (text, name) in BOUNDS.items() if isinstance(rule, kind)]
    found += [f"a multiple of {rule.multiple_of:g}" for rule in field.metadata if isinstance(rule, MultipleOf)]
    return ", ".join(found)


def as_toml(value: Any) -> str:
    """A value as it stands in a TOML file."""
    if isinstance(value, Table):
        value = value.model_dump()
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {as_toml(inner)}" for key, inner in value.items() if inner is not None) + "}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(as_toml(inner) for inner in value)}]"
    if isinstance(value, float):
        return f"{value:g}" if float(f"{value:g}") == value else repr(value)
    return json.dumps(value, ensure_ascii=False) if isinstance(value, bool | str) else str(value)


def key_comments(model: type[Table]) -> dict[str, str]:
    """By key, the comments on the lines of its definition and on lines of their own right above it."""
    source = textwrap.dedent(inspect.getsource(model))
    comments: dict[int, str] = {}
    alone: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            comments[token.start[0]] = token.string.lstrip("# ").strip()
            if token.line.strip().startswith("#"):
                alone.add(token.start[0])
    found: dict[str, str] = {}
    body = ast.parse(source).body[0]
    assert isinstance(body, ast.ClassDef)
    for node in body.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            first = node.lineno
            while first - 1 in alone:
                first -= 1
            lines = range(first, (node.end_lineno or node.lineno) + 1)
            found[node.target.id] = " ".join(comments[line] for line in lines if line in comments)
    return found
