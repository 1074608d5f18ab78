"""Values in words for people: numbers of things, room on a disk, times, JSON laid out to be read, and what is wrong
with a JSON value for those who have never seen a JSON Schema.
"""

import difflib
import json
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    from jsonschema import ValidationError

_JSON_TYPES = {
    "object": "an object {...}",
    "array": "a list [...]",
    "string": "a text in quotes",
    "number": "a number",
    "integer": "a whole number",
    "boolean": "true or false",
    "null": "null",
}
_BOUNDS = {
    "minimum": "at least",
    "maximum": "at most",
    "exclusiveMinimum": "more than",
    "exclusiveMaximum": "less than",
    "minItems": "at least",
    "maxItems": "at most",
}

LINE_LENGTH = 100  # written JSON values that fit on one such line stay on one line
MAX_CHOICES = 12  # named in a remedy; the rest are counted


def counted(count: int, one: str, many: str) -> str:
    """A number of things: ``counted(1, "identity", "identities")`` is "1 identity"."""
    return f"{count:,} {one if count == 1 else many}"


def disk_space(count: float) -> str:
    """A number of bytes in the unit that suits it: "9.2 kB", "34.5 MB"."""
    for unit, of_unit in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6)):
        if count >= of_unit:
            return f"{count / of_unit:.1f} {unit}"
    return f"{count / 1e3:.1f} kB"


def duration(seconds: float) -> str:
    """A time in the unit that suits it: "40 s", "12 min", "3.5 h"."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


def in_plain_words(error: "ValidationError") -> tuple[str, str, str]:
    """Translate a violation of a JSON Schema into (field, problem, remedy)."""
    field, keyword = json_field(error.absolute_path), str(error.validator)
    value, wanted = cast(Any, error.instance), cast(Any, error.validator_value)
    schema: Any = error.schema if isinstance(error.schema, Mapping) else {}
    description = str(schema.get("description", "")).rstrip(".")
    remedy = f"It is: {description}" if description else "See data_specs for its meaning"
    match keyword:
        case "type":
            kinds = [wanted] if isinstance(wanted, str) else wanted
            needed = " or ".join(_JSON_TYPES[kind] for kind in kinds)
            problem = f"is {shown(value)}, {json_type(value)}, but must be {needed}"
        case "required" | "dependentRequired":
            names = (
                wanted
                if keyword == "required"
                else [n for key in wanted if key in value for n in wanted[key]]
            )
            missing = next(name for name in names if name not in value)
            about = schema.get("properties", {}).get(missing, {}).get("description", "see data_specs")
            field, problem, remedy = join_field(field, missing), "is missing", f"Add it ({about.rstrip('.')})"
        case "additionalProperties":
            extra = next(name for name in value if name not in schema["properties"])
            field, problem = join_field(field, extra), "is not a known key"
            remedy = f"{suggestion(extra, schema['properties'])} or remove it"
        case "enum":
            problem, remedy = f"{shown(value)} is not one of {', '.join(wanted)}", suggestion(value, wanted)
        case "const":
            problem = f"is {shown(value)}, but must be {shown(wanted)}"
        case "minimum" | "exclusiveMinimum" | "maximum" | "exclusiveMaximum":
            problem = f"is {shown(value)}, but must be {_BOUNDS[keyword]} {shown(wanted)}"
        case "minItems" | "maxItems":
            problem = f"has {len(value)} entries, but must have {_BOUNDS[keyword]} {wanted}"
        case "pattern" | "minLength" | "maxLength":
            problem = f"{shown(value)} is not allowed here"
        case "not":  # {"not": {}}: the key has no meaning beside its neighbours
            problem, remedy = "has no meaning here", "Remove it"
        case _:
            problem = error.message[:200]
    return field, problem, remedy


def json_text(value: Any, indent: str = "") -> str:
    """JSON that people can read: short values and lists of numbers on one line, the rest indented."""
    line = json.dumps(value, ensure_ascii=False, allow_nan=False)
    is_list = isinstance(value, list)
    nested = value if is_list else list(value.values()) if isinstance(value, dict) else []
    scalars = is_list and not any(isinstance(item, list | dict) for item in nested)
    if not nested or scalars or (indent and len(indent) + len(line) <= LINE_LENGTH):
        return line
    inner = indent + "  "
    keys = [""] * len(nested) if is_list else [f"{json.dumps(k, ensure_ascii=False)}: " for k in value]
    rows = ",\n".join(f"{inner}{key}{json_text(item, inner)}" for key, item in zip(keys, nested, strict=True))
    return f"[\n{rows}\n{indent}]" if is_list else f"{{\n{rows}\n{indent}}}"


def json_field(parts: Iterable[str | int]) -> str:
    """Spell the path of a JSON value: ``["subjects", 3, "take"]`` becomes ``subjects[3].take``."""
    field = ""
    for part in parts:
        field = f"{field}[{part}]" if isinstance(part, int) else join_field(field, part)
    return field or "file"


def join_field(field: str, key: str) -> str:
    """The path of ``key`` within the object at ``field``."""
    return key if field in ("", "file") else f"{field}.{key}"


def json_type(value: Any) -> str:
    """The JSON type of a Python value, in plain words."""
    kinds = {dict: "object", list: "array", str: "string", bool: "boolean", int: "integer", float: "number"}
    return _JSON_TYPES[kinds.get(type(value), "null")]


def shown(value: Any) -> str:
    """A value as it stands in the file, shortened and on one line."""
    text = f"'{value}'" if isinstance(value, str) else json.dumps(value, default=repr)
    return text if len(text) <= 60 else f"{text[:57]}..."


def suggestion(value: Any, choices: Iterable[str]) -> str:
    """A remedy: the closest of ``choices``, or the first of them; a prior knows more than a thousand people."""
    choices = list(choices)
    close = difflib.get_close_matches(str(value), choices, n=1)
    if close:
        return f"Perhaps '{close[0]}' was meant"
    more = f", ... and {len(choices) - MAX_CHOICES:,} more" if len(choices) > MAX_CHOICES else ""
    return f"Choose one of {', '.join(choices[:MAX_CHOICES])}{more}"
