"""Numbers of files for pydantic, and its errors as one line: the key, the expected and the actual value."""

import re
from collections.abc import Iterable
from typing import Annotated, TypeVar

from pydantic import BaseModel, BeforeValidator, Field, ValidationError

from dsr.utils.guards import decode_text

# Numbers of a file: a finite one; a whole one that 64 bits hold, which may be written as 640.0. True and text are none.
Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Whole = Annotated[
    int,
    Field(strict=True, ge=-(2**63), lt=2**63),
    BeforeValidator(lambda value: int(value) if isinstance(value, float) and value.is_integer() else value),
]
Content = TypeVar("Content", bound=BaseModel)


def parse_model(model: type[Content], content: str | bytes, place: object, expected: str = "") -> Content:
    """Parse JSON into a model; a message begins with the place that it is from, and ``expected a camera; ``, say."""
    try:
        return model.model_validate_json(decode_text(content) if isinstance(content, bytes) else content)
    except ValidationError as error:
        raise ValueError(f"{place}: {expected}{describe(error, model.model_fields)}") from error


def describe(error: ValidationError, known: Iterable[str] = ()) -> str:
    """Return the first thing that is wrong, such as ``trials.a1.scale: expected a valid integer, got 'x'``."""
    first = error.errors(include_url=False, include_context=False)[0]
    key = ".".join(map(str, first["loc"]))
    message = re.sub(r"^(\w+ should (be|have) |Value error, )", "", first["msg"])
    what = {
        "missing": "it is missing",
        "json_invalid": message.replace("Invalid JSON:", "got damaged JSON:"),
        "extra_forbidden": f"unknown key; expected {', '.join(known)}",
    }.get(first["type"], f"expected {message}, got {first['input']!r:.60}")
    return f"{key}: {what}" if key else what
