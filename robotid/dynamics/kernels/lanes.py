"""Vectors of eight states, work spaces of them, and vector algebra, compiled by Numba.

Imported only where compiled code is used, since importing Numba takes time. Numba stores the
compiled code in ``__pycache__`` beside this file, else in the user's cache or ``NUMBA_CACHE_DIR``.

Compiled code computes ``LANES`` states together, one in each lane. Vectors have the operators of
numbers; a comparison returns a mask for ``where``. Numba alone would compute one lane after the
other, since it cannot show that an entry written is not one that the next lane reads. An entry
``at`` of a work space is one quantity of all lanes, adjacent in memory, for ``get`` and ``put``.
"""

import math
import operator
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from llvmlite import ir
from numba import cfunc, njit, types
from numba.core.cgutils import get_or_insert_function, unpack_tuple
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import ConcreteTemplate, Signature, infer_global
from numba.extending import intrinsic, models, register_model
from numba.np.arrayobj import make_array

from robotid.base.typing import Array

LANES = 8
_CODE = ir.VectorType(ir.DoubleType(), LANES)
_CONTRACT = ("contract",)  # a b + c may be rounded once
_PAIR = types.UniTuple(types.float64, 2)
_HALF_PI = (1.57079632673412561417, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
_ROUND = 6755399441055744.0  # 1.5 2^52: adding and subtracting it rounds to the nearest integer


class _Vector(types.Type):
    """Numba's type of a vector, a number of each lane."""


class _Mask(types.Type):
    """Numba's type of a mask, a truth value of each lane."""


def _modelled(kind: Any, name: str, code: ir.Type) -> Any:
    class Model(models.PrimitiveModel):
        def __init__(self, manager: Any, own: Any) -> None:
            super().__init__(manager, own, code)

    register_model(kind)(Model)
    return kind(name=name)


_vector = _modelled(_Vector, "vector", _CODE)
_mask = _modelled(_Mask, "mask", ir.VectorType(ir.IntType(1), LANES))


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


_intrinsic: Any = intrinsic  # a function of compiled code, defined by its type and its code


def _coded(code: Any) -> Any:
    """Return the code of an intrinsic from a function of the builder and the values."""
    return lambda context, builder, signature, given: code(builder, *given)


@_intrinsic
def read(typing, numbers, at):
    """Return the vector of adjacent numbers of an array, shape (k,), from index ``at``."""

    def code(context, builder, signature, given):
        vector = builder.load(_place(context, builder, signature.args[0], *given))
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
    return _vector(types.float64), _coded(_wide)


@_intrinsic
def where(typing, mask, x, y):
    """Return x in the lanes of a mask, and y in the others; either may be a number."""
    code = _coded(lambda builder, m, a, b: builder.select(m, _wide(builder, a), _wide(builder, b)))
    return _vector(mask, _number_type(x), _number_type(y)), code


@_intrinsic
def is_any(typing, mask):
    """Return whether a mask is true in any lane."""

    def code(builder, lanes):
        bits = builder.bitcast(lanes, ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, bits.type(0))

    return types.boolean(mask), _coded(code)


@_intrinsic
def lane_of(typing, x, lane):
    """Return the number of one lane."""
    code = _coded(lambda builder, vector, k: builder.extract_element(vector, k))
    return types.float64(x, types.intp), code


@_intrinsic
def with_lane(typing, x, lane, value):
    """Return a vector with another number in one lane."""
    code = _coded(lambda builder, vector, k, number: builder.insert_element(vector, number, k))
    return _vector(x, types.intp, types.float64), code


@_intrinsic
def copysign(typing, x, y):
    """Return the size of x with the sign of y, of each lane; x may be a number."""
    code = _coded(lambda builder, a, b: _call("copysign")(builder, _wide(builder, a), b))
    return _vector(_number_type(x), y), code


@_intrinsic
def applied(typing, address, x):
    """Return the result of the function at an address of ``pointed`` for a tuple of numbers."""

    def code(context, builder, signature, given):
        numbers = unpack_tuple(builder, given[1])
        kind = ir.FunctionType(context.get_value_type(_PAIR), [number.type for number in numbers])
        return builder.call(builder.inttoptr(given[0], kind.as_pointer()), numbers)

    return _PAIR(address, x), code


def work_space(entries: int) -> Array:
    """Return a work space of zeros, shape (entries LANES,), each entry in one line of the cache."""
    numbers = np.zeros((entries + 1) * LANES)
    first = -(numbers.ctypes.data // numbers.itemsize) % LANES
    return numbers[first : first + entries * LANES]


def compiled(function: Any, **options: Any) -> Any:
    """Compile without the interpreter's lock; arrays are not counted, so that none can be made."""
    return _cached(njit, function, nogil=True, no_cfunc_wrapper=True, _nrt=False, **options)


def inner(function: Any) -> Any:
    """Compile for compiled code alone: an entry for Python would take longer than most code."""
    return compiled(function, no_cpython_wrapper=True)


def pointed(function: Callable[..., Any], arguments: int) -> Any:
    """Compile a function of numbers that returns two, for ``applied``, which uses its address."""
    return _cached(partial(cfunc, _PAIR(*[types.float64] * arguments)), function)


def _cached(compile: Any, function: Any, **options: Any) -> Any:
    options |= {"fastmath": {"contract"}, "error_model": "numpy"}
    try:
        return compile(cache=True, **options)(function)
    except RuntimeError:  # no cache folder: the code exists only in this process
        return compile(**options)(function)


@inner
def get(work, at):
    """Return a quantity."""
    return read(work, at * LANES)


@inner
def get3(work, at):
    """Return three neighbouring quantities."""
    return get(work, at), get(work, at + 1), get(work, at + 2)


@inner
def put(work, at, value):
    """Write a quantity."""
    write(work, at * LANES, value)


@inner
def put3(work, at, u):
    """Write three neighbouring quantities."""
    put(work, at, u[0])
    put(work, at + 1, u[1])
    put(work, at + 2, u[2])


@inner
def put_lane(work, at, lane, value):
    """Write a quantity of one lane."""
    work[np.uintp(at * LANES + lane)] = value  # Numba checks the sign of other indices


@inner
def cross(u, v):
    """Return u x v."""
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


@inner
def add(u, v):
    """Return u + v."""
    return u[0] + v[0], u[1] + v[1], u[2] + v[2]


@inner
def scale(s, u):
    """Return s u."""
    return s * u[0], s * u[1], s * u[2]


@inner
def dot(u, v):
    """Return u . v."""
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@inner
def times(J, u):
    """Return J u of a symmetric matrix xx xy yy xz yz zz."""
    return (
        J[0] * u[0] + J[1] * u[1] + J[3] * u[2],
        J[1] * u[0] + J[2] * u[1] + J[4] * u[2],
        J[3] * u[0] + J[4] * u[1] + J[5] * u[2],
    )


@inner
def cos_sin(angle):
    """Return cosine and sine: Cody and Waite's reduction, fdlibm's polynomials, no branch."""
    n = (angle * 0.6366197723675814 + _ROUND) - _ROUND  # quarter turns
    r = ((angle - n * _HALF_PI[0]) - n * _HALF_PI[1]) - n * _HALF_PI[2]
    z = r * r
    sine = -2.50507602534068634195e-08 + z * 1.58969099521155010221e-10
    sine = -1.98412698298579493134e-04 + z * (2.75573137070700676789e-06 + z * sine)
    sine = -1.66666666666666324348e-01 + z * (8.33333333332248946124e-03 + z * sine)
    sine = r + r * z * sine
    cosine = 2.08757232129817482790e-09 + z * -1.13596475577881948265e-11
    cosine = 2.48015872894767294178e-05 + z * (-2.75573143513906633035e-07 + z * cosine)
    cosine = 4.16666666666666019037e-02 + z * (-1.38888888888741095749e-03 + z * cosine)
    cosine = (1.0 - 0.5 * z) + z * z * cosine
    quarter = n - 4.0 * ((n * 0.25 - 0.375 + _ROUND) - _ROUND)  # 0, 1, 2 or 3
    is_odd = (quarter == 1.0) | (quarter == 3.0)
    x, y = where(is_odd, sine, cosine), where(is_odd, cosine, sine)
    return where((quarter == 1.0) | (quarter == 2.0), -x, x), where(quarter > 1.5, -y, y)


@inner
def factor(work, n, H):
    """Write the Cholesky factor of H in place, its diagonal as reciprocals for ``solve``."""
    for j in range(n):
        for i in range(j, n):
            x = get(work, H + i * n + j)
            for k in range(j):
                x -= get(work, H + j * n + k) * get(work, H + i * n + k)
            if i == j:
                put(work, H + j * n + j, 1.0 / math.sqrt(x))
            else:
                put(work, H + i * n + j, x * get(work, H + j * n + j))


@inner
def solve(work, n, H, x):
    """Solve H y = x with the factor of H, in place."""
    for i in range(n):
        y = get(work, x + i)
        for k in range(i):
            y -= get(work, H + i * n + k) * get(work, x + k)
        put(work, x + i, y * get(work, H + i * n + i))
    for i in range(n - 1, -1, -1):
        y = get(work, x + i)
        for k in range(i + 1, n):
            y -= get(work, H + k * n + i) * get(work, x + k)
        put(work, x + i, y * get(work, H + i * n + i))
