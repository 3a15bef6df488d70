"""TOML files as validated tables: unknown keys are refused with the nearest valid name, every error is one line."""

from __future__ import annotations

import difflib
import json
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, ValidationError


class Table(BaseModel):
    """A table of a file: no other keys than its own, nothing that is not finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


Model = TypeVar("Model", bound=Table)


def read_toml(path: Path, kind: str, example: str, overrides: Iterable[str] = ()) -> dict[str, Any]:
    """The table in a TOML file, with overrides such as "vesicles.points=32". kind, example: for the error messages.

    Raises ValueError with one line for what is wrong.
    """
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ValueError(f"{kind} {path} does not exist: give the path of a TOML file, such as {example}") from None
    except IsADirectoryError:
        raise ValueError(f"{kind} {path} is a folder: give the path of a TOML file") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{kind} {path} is not valid TOML: {error}") from None
    for text in overrides:
        override(table, text)
    return table


def validated(model: type[Model], table: Mapping[str, Any], expected: Mapping[str, str] | None = None) -> Model:
    """The model of a dictionary. expected: what a key takes, in words, by its path. Raises ValueError with one line for what is wrong."""
    try:
        return model.model_validate_json(json.dumps(table, default=str), strict=True)  # as JSON: lists may be tuples, true is no 1
    except ValidationError as error:
        raise ValueError("; ".join(dict.fromkeys(_explain(e, model, expected or {}) for e in error.errors()))) from None


def flat(table: Mapping[str, Any] | list[Any], prefix: str = "") -> dict[str, Any]:
    """The values of nested tables and lists of tables by their paths, as in "walls.obstacles.0.size"."""
    values: dict[str, Any] = {}
    for key, value in table.items() if isinstance(table, Mapping) else enumerate(table):
        if isinstance(value, Mapping) or (isinstance(value, list) and value and isinstance(value[0], Mapping)):
            values.update(flat(value, f"{prefix}{key}."))
        else:
            values[f"{prefix}{key}"] = value
    return values


def override(table: dict[str, Any], text: str) -> None:
    """Sets a key of nested tables, as in "vesicles.points=32". Raises ValueError."""
    key, equals, right = text.partition("=")
    if not equals or not key.strip():
        raise ValueError(f'--set {text}: expected key=value, as in "vesicles.points=32"')
    try:
        value = tomllib.loads(f"value = {right}")["value"]
    except tomllib.TOMLDecodeError:
        value = right
    *parents, last = key.strip().split(".")
    for parent in parents:
        table = table.setdefault(parent, {})
        if not isinstance(table, dict):
            raise ValueError(f"--set {text}: {parent} is not a table")
    table[last] = value


def _explain(error: Any, root: type[Table], expected: Mapping[str, str]) -> str:
    path = ".".join(str(part) for part in error["loc"])
    if error["type"] == "extra_forbidden":
        known = list(_table_at(root, error["loc"][:-1]).model_fields)
        near = difflib.get_close_matches(str(error["loc"][-1]), known, n=1, cutoff=0.5)
        hint = f"did you mean {near[0]}?" if near else "the keys there are " + ", ".join(known)
        return f"unknown key {path}: {hint}"
    if error["type"] == "missing" and isinstance(error["loc"][-1], int):  # of a pair
        return f"{path.rpartition('.')[0]} = {error['input']!r}: expected two numbers"
    if error["type"] == "missing":
        return f"key {path} is missing"
    for key, what in expected.items():
        if path == key or path.startswith(key + "."):  # one line for all the types that a key may have
            return f"{key} = {error['input']!r}: expected {what}"
    if error["type"] == "model_type":
        return f"{path} = {error['input']!r}: expected a table [{path}]"
    return f"{path} = {error['input']!r}: {error['msg'][0].lower()}{error['msg'][1:]}"


def _table_at(root: Any, location: tuple[str | int, ...]) -> Any:
    """The table at a place of the file: through optional tables and lists of tables."""
    model = root
    for part in location:
        if isinstance(part, str):
            model = _table_in(model.model_fields[part].annotation)
    return model


def _table_in(annotation: Any) -> Any:
    if isinstance(annotation, type) and issubclass(annotation, Table):
        return annotation
    return next((found for inner in get_args(annotation) if (found := _table_in(inner)) is not None), None)
