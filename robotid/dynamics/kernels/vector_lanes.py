"""A vector type for compiled code: a number of each of eight states, computed together.

Imported only by compiled code, since importing Numba takes time. Vectors have the operators of
numbers, by which a kernel reads like one of numbers; a comparison returns a mask for ``where``.
Numba alone would compute one lane after the other, since it cannot show that an entry written is
not one that the next lane reads.
"""

import math
import operator
from typing import Any

from llvmlite import ir
from numba import types
from numba.core.cgutils import get_or_insert_function
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import ConcreteTemplate, Signature, infer_global
from numba.extending import intrinsic, models, register_model
from numba.np.arrayobj import make_array

LANES = 8
_CODE = ir.VectorType(ir.DoubleType(), LANES)
_CONTRACT = ("contract",)  # a b + c may be rounded once


class _Vector(types.Type):
    """Numba's type of a vector, a number of each lane."""

    def __init__(self) -> None:
        super().__init__(name="vector")


class _Mask(types.Type):
    """Numba's type of a mask, a truth value of each lane."""

    def __init__(self) -> None:
        super().__init__(name="mask")


def _modelled(kind: Any, code: ir.Type) -> Any:
    class Model(models.PrimitiveModel):
        def __init__(self, manager: Any, own: Any) -> None:
            super().__init__(manager, own, code)

    register_model(kind)(Model)
    return kind()


_vector = _modelled(_Vector, _CODE)
_mask = _modelled(_Mask, ir.VectorType(ir.IntType(1), LANES))


def _wide(builder: Any, value: Any) -> Any:
    """Return a value as a vector: a number is the same in each lane."""
    if isinstance(value.type, ir.VectorType):
        return value
    one = builder.insert_element(ir.Constant(_CODE, ir.Undefined), value, ir.IntType(32)(0))
    lanes = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    return builder.shuffle_vector(one, ir.Constant(_CODE, ir.Undefined), lanes)


def _define(
    function: Any, result: types.Type, arguments: tuple[types.Type, ...], code: Any
) -> None:
    """Define a function or operator of vectors; numbers among them become vectors."""
    cases = [arguments]
    if arguments == (_vector, _vector):
        cases += [(_vector, types.float64), (types.float64, _vector)]

    signatures = [Signature(result, case, None) for case in cases]
    infer_global(function)(type("_Operator", (ConcreteTemplate,), {"cases": signatures}))

    def lower(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        wide = (_wide(builder, x) if _vector in arguments else x for x in values)
        return code(builder, *wide)

    for case in cases:
        lower_builtin(function, *case)(lower)


def _call(name: str) -> Any:
    """Return the code that calls an intrinsic function of LLVM."""

    def code(builder: Any, *arguments: Any) -> Any:
        kind = ir.FunctionType(_CODE, [_CODE] * len(arguments))
        own = get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f64")
        return builder.call(own, arguments)

    return code


for _name, *_owns in (
    ("fadd", operator.add, operator.iadd), ("fsub", operator.sub, operator.isub),
    ("fmul", operator.mul, operator.imul), ("fdiv", operator.truediv, operator.itruediv),
):  # fmt: skip
    for _own in _owns:
        _define(
            _own, _vector, (_vector, _vector),
            lambda builder, x, y, name=_name: getattr(builder, name)(x, y, flags=_CONTRACT),
        )  # fmt: skip
for _own, _sign in (
    (operator.lt, "<"), (operator.le, "<="), (operator.gt, ">"), (operator.ge, ">="),
    (operator.eq, "=="),
):  # fmt: skip
    _define(
        _own, _mask, (_vector, _vector),
        lambda builder, x, y, sign=_sign: builder.fcmp_ordered(sign, x, y),
    )  # fmt: skip
_define(operator.neg, _vector, (_vector,), lambda builder, x: builder.fneg(x))
_define(abs, _vector, (_vector,), _call("fabs"))
_define(math.sqrt, _vector, (_vector,), _call("sqrt"))
_define(operator.and_, _mask, (_mask, _mask), lambda builder, x, y: builder.and_(x, y))
_define(operator.or_, _mask, (_mask, _mask), lambda builder, x, y: builder.or_(x, y))
_define(operator.invert, _mask, (_mask,), lambda builder, x: builder.not_(x))


def _intrinsic(function: Any) -> Any:
    """Return a function of compiled code, defined by its type and its code."""
    return intrinsic(function)


@_intrinsic
def read(typing, numbers, at):
    """Return the vector of adjacent numbers of an array, shape (k,), from index ``at``."""

    def code(context, builder, signature, given):
        place = _place(context, builder, signature.args[0], *given)
        vector = builder.load(place)
        vector.align = 8
        return vector

    return _vector(numbers, types.intp), code


@_intrinsic
def write(typing, numbers, at, value):
    """Write a vector, or one number for all lanes, to adjacent numbers of an array."""

    def code(context, builder, signature, given):
        place = _place(context, builder, signature.args[0], *given[:2])
        builder.store(_wide(builder, given[2]), place).align = 8
        return context.get_dummy_value()

    return types.none(numbers, types.intp, _number_type(value)), code


def _place(context, builder, array, value, at):
    """Return the address of the vector from an index of an array."""
    first = builder.gep(make_array(array)(context, builder, value).data, [at])
    return builder.bitcast(first, _CODE.as_pointer())


def _number_type(value):
    return value if value is _vector else types.float64


@_intrinsic
def wide(typing, number):
    """Return a vector of one number."""

    def code(context, builder, signature, given):
        return _wide(builder, given[0])

    return _vector(types.float64), code


@_intrinsic
def where(typing, mask, x, y):
    """Return x in the lanes of a mask, and y in the others; either may be a number."""

    def code(context, builder, signature, given):
        return builder.select(given[0], _wide(builder, given[1]), _wide(builder, given[2]))

    return _vector(mask, _number_type(x), _number_type(y)), code


@_intrinsic
def is_any(typing, mask):
    """Return whether a mask is true in any lane."""

    def code(context, builder, signature, given):
        bits = builder.bitcast(given[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, bits.type(0))

    return types.boolean(mask), code


@_intrinsic
def lane_of(typing, x, lane):
    """Return the number of one lane."""

    def code(context, builder, signature, given):
        return builder.extract_element(*given)

    return types.float64(x, types.intp), code


@_intrinsic
def with_lane(typing, x, lane, value):
    """Return a vector with another number in one lane."""

    def code(context, builder, signature, given):
        return builder.insert_element(given[0], given[2], given[1])

    return _vector(x, types.intp, types.float64), code


@_intrinsic
def copysign(typing, x, y):
    """Return the size of x with the sign of y, of each lane; x may be a number."""

    def code(context, builder, signature, given):
        return _call("copysign")(builder, _wide(builder, given[0]), given[1])

    return _vector(_number_type(x), y), code
