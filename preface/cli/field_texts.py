"""The text under each field of a dataclass, which is its help: for flags that are made from fields, and their pages."""

import ast
import inspect


def field_texts(kind: type) -> dict[str, str]:
    """The text under each field of a dataclass and of those that it extends, by the field's name, in one line."""
    texts: dict[str, str] = {}
    for one in reversed(kind.__mro__[:-1]):  # the last is object
        (body,) = ast.parse(inspect.getsource(one)).body
        assert isinstance(body, ast.ClassDef)
        for field, text in zip(body.body, body.body[1:], strict=False):
            if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
                assert isinstance(field.target, ast.Name)
                assert isinstance(text.value, ast.Constant)
                texts[field.target.id] = " ".join(str(text.value.value).split())
    return texts
