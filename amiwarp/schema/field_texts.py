"""Texts below the fields of a dataclass, which say what each is and in which unit."""

import ast
import inspect
import textwrap
from itertools import pairwise


def field_texts(record: type) -> dict[str, str]:
    """Return the first paragraph of the text below each field, on one line; empty if the source is not installed."""
    try:
        source = inspect.getsource(record)
    except OSError:
        return {}
    [definition] = ast.parse(textwrap.dedent(source)).body
    texts: dict[str, str] = {}
    for field, below in pairwise(getattr(definition, "body", ())):
        match field, below:
            case (
                ast.AnnAssign(target=ast.Name(id=name)),
                ast.Expr(value=ast.Constant(value=str(text))),
            ):
                paragraph = inspect.cleandoc(text).partition("\n\n")[0]
                texts[name] = " ".join(paragraph.split())
    return texts
