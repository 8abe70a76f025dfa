"""The docstrings below the fields of a class, which Python itself does not keep."""

import ast
import inspect
import textwrap


def field_docstrings(record: type) -> dict[str, str]:
    """Returns the docstring below each field of a class, as one line; fields without a docstring are left out.

    Only the class's own fields are read, not those of its bases.  Raises OSError if the source is not there."""
    body = ast.parse(textwrap.dedent(inspect.getsource(record))).body[0]
    assert isinstance(body, ast.ClassDef)
    found = {}
    for statement, below in zip(body.body, body.body[1:], strict=False):
        match statement, below:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                found[name] = " ".join(text.split())
    return found
