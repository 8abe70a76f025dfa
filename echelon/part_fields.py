"""How a scenario writes a part (echelon.plugins), as types for the fields of its tables.

    trajectory = { kind = "circle", radius = 2.0, rate = 0.1 }                       by name, parameters beside it
    trajectory = { use = "my_paths.py:Spiral", parameters = { rate = 0.2 } }         the same for any part
    robot.model = "rigid_body"                                                       by name alone
    robot.model = { use = "my_plants.py:Slipping", parameters = { slip = 0.1 } }
    robot.drive.protocol = "odrive"

Validation needs a `PartContext`: the registry that parts are looked up in, and the folder that files are relative to.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

from pydantic import PlainSerializer, PlainValidator, ValidationInfo, WithJsonSchema

from echelon.explain import PartError
from echelon.plugins import Part, Registry

KIND: Final = "kind"
_PARAMETERS: Final = "parameters"
PART: Final = "part"
"""Stands in the JSON schema of a field of this kind, with the group of its parts: echelon.schema says what may be written"""
BESIDE: Final = "beside"
"""Stands there too; True: parameters are written beside the part's name"""


class PartContext(NamedTuple):
    """What pydantic is given as context when it validates a scenario."""

    registry: Registry
    folder: Path


def make_part(group: str, use: Any, parameters: Any, context: PartContext | None) -> Part[Any]:
    """Returns the part that a scenario describes.  Raises PartError, whose keys are `use` or `parameters`."""
    if context is None:
        raise TypeError("a scenario with parts is validated with a PartContext (echelon.sim.parts.load)")
    if not isinstance(parameters, Mapping):
        raise PartError("must be a table", (_PARAMETERS,), parameters)
    if not isinstance(use, str):
        raise PartError(context.registry.allowed(group), ("use",), use)
    try:
        return context.registry.make(group, use, parameters, context.folder)
    except PartError as mistake:
        raise (mistake.at(_PARAMETERS) if mistake.model else mistake.at("use", shown=use)) from None


def _table(group: str, value: Mapping[str, Any], context: PartContext | None) -> Part[Any]:
    for key in value:
        if key not in ("use", _PARAMETERS):
            raise PartError(f"unknown key; known here: {_PARAMETERS}, use", (str(key),))
    if "use" not in value:
        raise PartError(f"missing; {context.registry.allowed(group) if context else ''}", ("use",))
    return make_part(group, value["use"], value.get(_PARAMETERS, {}), context)


def _beside(mistake: PartError, *name: str) -> PartError:
    """Returns a mistake where the part is called by `name` and parameters stand beside that, not in a table of their own."""
    if mistake.keys == ("use",):
        return mistake.at(*name, shown=mistake.shown)
    return mistake.at(*mistake.keys[1:], shown=mistake.shown)


def _inline(group: str) -> Callable[[Any, ValidationInfo], Part[Any]]:
    """Returns the validator of a table that says its `kind` beside its parameters, or `use` and `parameters`."""

    def validate(value: Any, info: ValidationInfo) -> Part[Any]:
        if isinstance(value, Part):
            return value
        if not isinstance(value, Mapping):
            raise PartError("must be a table", (), value)
        context: PartContext | None = info.context
        if "use" in value:
            return _table(group, value, context)
        rest = {str(key): item for key, item in value.items() if key != KIND}
        if KIND not in value:
            allowed = context.registry.allowed(group) if context else ""
            raise PartError(f"missing; {allowed}", (KIND,))
        try:
            return make_part(group, value[KIND], rest, context)
        except PartError as mistake:
            raise _beside(mistake, KIND) from None

    return validate


def _by_name(group: str) -> Callable[[Any, ValidationInfo], Part[Any] | None]:
    """Returns the validator of a name, or of a table with `use` and `parameters`."""

    def validate(value: Any, info: ValidationInfo) -> Part[Any] | None:
        if value is None or isinstance(value, Part):
            return value
        if isinstance(value, Mapping):
            return _table(group, value, info.context)
        try:
            return make_part(group, value, {}, info.context)
        except PartError as mistake:
            raise _beside(mistake) from None

    return validate


def _written_inline(part: Part[Any]) -> dict[str, Any]:
    if ":" in part.use:
        return {"use": part.use, _PARAMETERS: dict(part.parameters)}
    return {KIND: part.use, **part.parameters}


def _written_by_name(part: Part[Any] | None) -> Any:
    if part is None or not (":" in part.use or part.parameters):
        return part and part.use
    return {"use": part.use, _PARAMETERS: dict(part.parameters)}


TrajectoryField = Annotated[
    Part[Any],
    PlainValidator(_inline("trajectories")),
    PlainSerializer(_written_inline),
    WithJsonSchema({PART: "trajectories", BESIDE: True}),
]
PlantField = Annotated[
    Part[Any] | None,
    PlainValidator(_by_name("plants")),
    PlainSerializer(_written_by_name),
    WithJsonSchema({PART: "plants", BESIDE: False}),
]
ProtocolField = Annotated[
    Part[Any] | None,
    PlainValidator(_by_name("protocols")),
    PlainSerializer(_written_by_name),
    WithJsonSchema({PART: "protocols", BESIDE: False}),
]
