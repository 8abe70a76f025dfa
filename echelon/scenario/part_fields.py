"""Types for fields of a scenario's tables that hold a part (echelon.plugins), and the ways in which a scenario writes one:

    trajectory = { kind = "circle", radius = 2.0, rate = 0.1 }                       by name, parameters beside it
    trajectory = { use = "my_paths.py:Spiral", parameters = { rate = 0.2 } }         parameters in a table of their own
    robot.model = "rigid_body"                                                       by name alone
    robot.model = { use = "my_plants.py:Slipping", parameters = { slip = 0.1 } }
    law = { use = "my_laws.py:Relay", parameters = { gain = 2.0 }, epsilon = [0.5] }   in a table that has other keys, too
    robot.drive.protocol = "odrive"

Validation needs a `PartContext`: the registry in which parts are looked up, and the folder to which files are relative.
"""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

from pydantic import BaseModel, PlainSerializer, PlainValidator, SerializationInfo, ValidationInfo, WithJsonSchema

from echelon.part_groups import Registry
from echelon.plugins import Part, PartError, Source

KIND: Final = "kind"
_PARAMETERS: Final = "parameters"
_NO_CONTEXT: Final = "a scenario with parts is validated with a PartContext (echelon.sim.parts.loading.load)"
PART: Final = "part"
"""Key in the JSON schema of a field that holds a part; its value is the group of the part (see echelon.scenario.schema)"""
BESIDE: Final = "beside"
"""Key in the same JSON schema.  True: the parameters stand beside the part's name.  False: the name stands alone, or in a table
with `use` and `parameters`.  None: the parameters are another field of the table"""


class PartContext(NamedTuple):
    """The validation context that pydantic needs for a scenario: where parts are found."""

    registry: Registry
    folder: Path


def make_part(group: str, use: Any, parameters: Any, context: PartContext | None) -> Part[Any]:
    """Returns the part that a scenario describes.  Raises PartError with the key that is wrong, `use` or `parameters`; raises
    TypeError without a context."""
    if context is None:
        raise TypeError(_NO_CONTEXT)
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
    """Returns a mistake of `make_part` with the keys of a field whose key for the part is `name` and whose parameters stand
    beside that key, not in a table of their own."""
    if mistake.keys == ("use",):
        return mistake.at(*name, shown=mistake.shown)
    return mistake.at(*mistake.keys[1:], shown=mistake.shown)


def _inline(group: str) -> Callable[[Any, ValidationInfo], Part[Any]]:
    """Returns the validator of a table with `kind` and the parameters beside it, or with `use` and `parameters`."""

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
    """Returns the validator of a part's name, or of a table with `use` and `parameters`."""

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


def written_use(part: Part[Any], info: SerializationInfo) -> str:
    """Returns the name of a part for a scenario that is written out.

    The context of pydantic may map files to other names; a part in such a file is named with the other name."""
    names: Mapping[Source, str] = info.context or {}
    if part.source is not None and part.source in names:
        return f"{names[part.source]}:{part.use.rpartition(':')[2]}"
    return part.use


def _written_inline(part: Part[Any], info: SerializationInfo) -> dict[str, Any]:
    use = written_use(part, info)
    if ":" in use:
        return {"use": use, _PARAMETERS: dict(part.parameters)}
    return {KIND: use, **part.parameters}


def _written_by_name(part: Part[Any] | None, info: SerializationInfo) -> Any:
    if part is None or not (":" in part.use or part.parameters):
        return part and part.use
    return {"use": written_use(part, info), _PARAMETERS: dict(part.parameters)}


def parts_in(value: Any) -> Iterator[Part[Any]]:
    """Yields all parts in a scenario, or in a value of a scenario, in the order of the fields."""
    if isinstance(value, Part):
        yield value
    elif isinstance(value, BaseModel):
        for name in type(value).model_fields:
            yield from parts_in(getattr(value, name))
    elif isinstance(value, (Mapping, list)):
        for item in value.values() if isinstance(value, Mapping) else value:
            yield from parts_in(item)


def _named(group: str) -> Callable[[Any, ValidationInfo], str]:
    """Returns the validator of a part's name in the field `use` of a table that has its parameters in another field."""

    def validate(value: Any, info: ValidationInfo) -> str:
        context: PartContext | None = info.context
        if context is None:
            raise TypeError(_NO_CONTEXT)
        if not isinstance(value, str):
            raise PartError(context.registry.allowed(group), (), value)
        try:
            context.registry.find(group, value, context.folder)
        except PartError as mistake:
            raise mistake.at(shown=value) from None
        return value

    return validate


def _beside_name(group: str) -> Callable[[Any, ValidationInfo], Part[Any] | None]:
    """Returns the validator of the parameters of a part.  The field `use` of the same table, validated before, has its name."""

    def validate(value: Any, info: ValidationInfo) -> Part[Any] | None:
        if isinstance(value, Part):
            return value
        if "use" not in info.data:  # `use` is wrong, and that mistake is reported already
            return None
        try:
            return make_part(group, info.data["use"], value, info.context)
        except PartError as mistake:
            raise _beside(mistake) from None

    return validate


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
WrittenLawName = Annotated[str, WithJsonSchema({PART: "laws", BESIDE: None})]
LawName = Annotated[WrittenLawName, PlainValidator(_named("laws"))]
LawParameters = Annotated[
    Part[Any],
    PlainValidator(_beside_name("laws")),
    PlainSerializer(lambda part: dict(part.parameters)),
    WithJsonSchema({"type": "object"}),
]
