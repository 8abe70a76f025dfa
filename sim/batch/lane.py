"""Memory as the threads of a GPU see it.

*Scratch* of one thread is a column of a tile, as an array of one dimension.  A tile holds the scratch of `WIDTH` neighbouring
threads.  The number of the run is its last axis, so that neighbours touch neighbouring memory.  The distance of two places is
known when the code is compiled.

No place is negative, and none is beyond the end.  The simulator refuses such a place; a GPU takes what is there.

`upto` is `range` with fewer instructions.
"""

import operator
from typing import Any, Final

from numba import config

WIDTH: Final = 32
"""Threads that run in step"""

upto: Any
"""As `range`, with fewer instructions"""

if config.ENABLE_CUDASIM:

    class _Bounded:
        """An array whose places begin with 0: on a GPU nothing counts negative ones from the end."""

        def __init__(self, array: Any) -> None:
            self._array, self._length = array, len(array)

        def __len__(self) -> int:
            return self._length

        def __getitem__(self, place: int) -> Any:
            return self._array[self._checked(place)]

        def __setitem__(self, place: int, value: Any) -> None:
            self._array[self._checked(place)] = value

        def _checked(self, place: int) -> int:
            if not 0 <= place < self._length:
                raise IndexError(f"place {place} of {self._length}")
            return place

    def lane_of(tiles: Any, lane: int) -> Any:
        """Returns the scratch of a thread; `tiles`: (tiles, places, WIDTH)."""
        return _Bounded(tiles[lane // WIDTH, :, lane % WIDTH])

    upto = range

else:
    from llvmlite import ir
    from numba.cuda import cgutils, types
    from numba.cuda.core.imputils import RefType, iternext_impl
    from numba.cuda.cudadecl import register_global
    from numba.cuda.cudaimpl import lower
    from numba.cuda.extending import core_models, intrinsic, register_model
    from numba.cuda.np.arrayobj import load_item, make_array, populate_array, store_item
    from numba.cuda.typing.templates import AbstractTemplate, signature

    class Lane(types.Array):  # type: ignore[misc, unused-ignore]
        """A column of a tile."""

        def __init__(self, dtype: Any) -> None:
            super().__init__(dtype, 1, "A")
            self.name = f"Lane({dtype})"

    register_model(Lane)(core_models.ArrayModel)

    @intrinsic  # type: ignore[untyped-decorator, unused-ignore]
    def lane_of(typing: Any, tiles: Any, lane: Any) -> Any:
        """Returns the scratch of a thread; `tiles`: (tiles, places, WIDTH)."""
        kind = Lane(tiles.dtype)

        def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            all_tiles = make_array(tiles)(context, builder, arguments[0])
            _, places, _ = cgutils.unpack_tuple(builder, all_tiles.shape, 3)
            number = context.cast(builder, arguments[1], lane, types.intp)
            width = ir.Constant(places.type, WIDTH)
            tile, column = builder.udiv(number, width), builder.urem(number, width)
            first = builder.add(builder.mul(builder.mul(tile, places), width), column)
            item = context.get_abi_sizeof(context.get_data_type(tiles.dtype))
            mine = make_array(kind)(context, builder)
            populate_array(
                mine,
                data=_hidden(builder, builder.gep(all_tiles.data, [first])),
                shape=[places],
                strides=[ir.Constant(places.type, WIDTH * item)],
                itemsize=ir.Constant(places.type, item),
                meminfo=None,
            )
            return mine._getvalue()

        return kind(tiles, lane), code

    def _hidden(builder: Any, pointer: Any) -> Any:
        """Returns a pointer to global memory of which the compiler does not know where it comes from: it would add up places
        anew for each access."""
        number = ir.IntType(64)
        move = ir.InlineAsm(ir.FunctionType(number, [number]), "mov.b64 $0, $1;", "=l,l")
        kept = builder.call(move, [builder.ptrtoint(pointer, number)])
        there = builder.inttoptr(kept, ir.PointerType(pointer.type.pointee, addrspace=1))
        return builder.addrspacecast(there, pointer.type)

    def _at(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        """Returns a pointer to one number."""
        kind, place = signature.args[:2]
        mine = make_array(kind)(context, builder, arguments[0])
        number = context.cast(builder, arguments[1], place, types.intp)
        return builder.gep(mine.data, [builder.mul(number, ir.Constant(number.type, WIDTH))], inbounds=True)

    @lower(operator.getitem, Lane, types.Integer)  # type: ignore[untyped-decorator, unused-ignore]
    def _get(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return load_item(context, builder, signature.args[0], _at(context, builder, signature, arguments))

    @lower(operator.setitem, Lane, types.Integer, types.Any)  # type: ignore[untyped-decorator, unused-ignore]
    def _set(context: Any, builder: Any, signature: Any, arguments: Any) -> None:
        kind, _, given = signature.args
        value = context.cast(builder, arguments[2], given, kind.dtype)
        store_item(context, builder, kind, value, _at(context, builder, signature, arguments))

    class Steps(types.SimpleIterableType):  # type: ignore[misc, unused-ignore]
        """What `upto` gives."""

        def __init__(self) -> None:
            super().__init__("Steps", Walk())

    class Walk(types.SimpleIteratorType):  # type: ignore[misc, unused-ignore]
        """... on its way."""

        def __init__(self) -> None:
            super().__init__("Walk", types.int64)

    @register_model(Steps)
    class _StepsModel(core_models.StructModel):  # type: ignore[misc, unused-ignore]
        def __init__(self, manager: Any, kind: Any) -> None:
            super().__init__(manager, kind, [("start", types.int64), ("stop", types.int64)])

    @register_model(Walk)
    class _WalkModel(core_models.StructModel):  # type: ignore[misc, unused-ignore]
        def __init__(self, manager: Any, kind: Any) -> None:
            super().__init__(manager, kind, [("at", types.CPointer(types.int64)), ("stop", types.int64)])

    def _up_to(*bounds: int) -> Any:
        """As `range`: with a step it is that."""
        return range(*bounds)

    upto = _up_to

    @register_global(_up_to)  # type: ignore[untyped-decorator, unused-ignore]
    class _Upto(AbstractTemplate):  # type: ignore[misc, unused-ignore]
        def generic(self, args: Any, kws: Any) -> Any:
            kind = Steps() if len(args) < 3 else types.range_state64_type
            return signature(kind, *[types.int64] * len(args))

    @lower(_up_to, types.int64)  # type: ignore[untyped-decorator, unused-ignore]
    def _upto(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        return _steps(context, builder, context.get_constant(types.int64, 0), arguments[0])

    @lower(_up_to, types.int64, types.int64)  # type: ignore[untyped-decorator, unused-ignore]
    def _from_upto(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        return _steps(context, builder, *arguments)

    @lower(_up_to, types.int64, types.int64, types.int64)  # type: ignore[untyped-decorator, unused-ignore]
    def _with_step(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        return context.get_function(range, sig)(builder, arguments)

    def _steps(context: Any, builder: Any, start: Any, stop: Any) -> Any:
        steps = cgutils.create_struct_proxy(Steps())(context, builder)
        steps.start, steps.stop = start, stop
        return steps._getvalue()

    @lower("getiter", Steps)  # type: ignore[untyped-decorator, unused-ignore]
    def _begin(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        steps = cgutils.create_struct_proxy(Steps())(context, builder, arguments[0])
        walk = cgutils.create_struct_proxy(Walk())(context, builder)
        walk.at, walk.stop = cgutils.alloca_once_value(builder, steps.start), steps.stop
        return walk._getvalue()

    @lower("iternext", Walk)  # type: ignore[untyped-decorator, unused-ignore]
    @iternext_impl(RefType.BORROWED)  # type: ignore[untyped-decorator, unused-ignore]
    def _go_on(context: Any, builder: Any, sig: Any, arguments: Any, result: Any) -> None:
        walk = cgutils.create_struct_proxy(Walk())(context, builder, arguments[0])
        at = builder.load(walk.at)
        there = builder.icmp_signed("<", at, walk.stop)
        result.set_valid(there)
        with builder.if_then(there):
            result.yield_(at)
            builder.store(builder.add(at, at.type(1), flags=["nsw"]), walk.at)
