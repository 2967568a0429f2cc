"""Inner loops in generic LLVM vectors, which the compiler does not generate by itself.

No code depends on the processor: LLVM lowers the vectors to the available registers, and fused
multiply-adds are rounded once everywhere, so that the bits are the same on all machines.
 Addresses are given as integers (``array.ctypes.data``); the caller keeps the arrays
alive and their sizes right.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, overload

LANES: Final = 4
"""Float64 values in a vector of `project`."""
STRIDE: Final = 16
"""Bins in a step of `residuals`."""

_I64: Final = ir.IntType(64)
_I32: Final = ir.IntType(32)
_DOUBLE: Final = ir.DoubleType()
_HALF: Final = STRIDE // 2


def _integer(value: int) -> Any:
    return ir.Constant(_I64, value)


def _pattern(lanes: Sequence[int]) -> Any:
    return ir.Constant(ir.VectorType(_I32, len(lanes)), list(lanes))


class _Lanes:
    """Operations on vectors of one type within one function."""

    def __init__(self, builder: Any, element: Any, count: int, tag: str) -> None:
        self.b, self.count = builder, count
        self.element, self.type = element, ir.VectorType(element, count)
        self.size = 4 if element == ir.FloatType() else 8
        self._tag = tag
        self.zero = ir.Constant(self.type, [0.0] * count)
        self.undefined = ir.Constant(self.type, ir.Undefined)

    def _call(self, name: str, *arguments: Any) -> Any:
        kind = ir.FunctionType(self.type, [self.type] * len(arguments))
        function = cgutils.get_or_insert_function(self.b.module, kind, f"llvm.{name}.{self._tag}")
        return self.b.call(function, arguments)

    def fma(self, x: Any, y: Any, z: Any) -> Any:
        return self._call("fma", x, y, z)

    def absolute(self, x: Any) -> Any:
        return self._call("fabs", x)

    def larger(self, x: Any, y: Any) -> Any:
        return self.b.select(self.b.fcmp_ordered(">", x, y), x, y)

    def cast(self, double: Any) -> Any:
        return double if self.size == 8 else self.b.fptrunc(double, self.element)

    def splat(self, scalar: Any) -> Any:
        first = self.b.insert_element(self.undefined, scalar, ir.Constant(_I32, 0))
        return self.b.shuffle_vector(first, self.undefined, _pattern([0] * self.count))

    def load(self, address: Any) -> Any:
        pointer = self.b.inttoptr(address, self.type.as_pointer())
        return self.b.load(pointer, align=self.size)

    def store(self, vector: Any, address: Any) -> None:
        pointer = self.b.inttoptr(address, self.type.as_pointer())
        self.b.store(vector, pointer, align=self.size)

    def where(self, other: Any, bit: int) -> Any:
        """Return a vector of ones, with `other` in the lanes whose number has `bit` set."""
        one = ir.Constant(self.type, [1.0] * self.count)
        chosen = [self.count + j if j & bit else j for j in range(self.count)]
        return self.b.shuffle_vector(one, other, _pattern(chosen))

    def fold(self, vector: Any, join: Callable[[Any, Any], Any]) -> Any:
        """Join all lanes in a fixed order; return a double."""
        width = self.count // 2
        while width:
            turned = [(j + width) % self.count for j in range(self.count)]
            other = self.b.shuffle_vector(vector, self.undefined, _pattern(turned))
            vector = join(vector, other)
            width //= 2
        first = self.b.extract_element(vector, ir.Constant(_I32, 0))
        return first if self.size == 8 else self.b.fpext(first, _DOUBLE)


class _Loop:
    """A counted loop that runs at least once."""

    def __init__(self, builder: Any, count: Any) -> None:
        self._b, self._count = builder, count
        self._before = builder.block
        self._body = builder.append_basic_block("vector.body")
        self._after = builder.append_basic_block("vector.after")
        builder.branch(self._body)
        builder.position_at_end(self._body)
        self.index = self.carried(_I64, _integer(0))
        self._next = builder.add(self.index, _integer(1))
        self.more = builder.icmp_signed("<", self._next, count)

    def carried(self, kind: Any, start: Any) -> Any:
        """Return a value that each step passes on to the next."""
        self._b.position_at_start(self._body)
        value = self._b.phi(kind)
        value.add_incoming(start, self._before)
        self._b.position_at_end(self._body)
        return value

    def close(self, pairs: Sequence[tuple[Any, Any]]) -> None:
        """End the loop; `pairs` are carried values and their values in the next step."""
        for value, following in [(self.index, self._next), *pairs]:
            value.add_incoming(following, self._body)
        self._b.cbranch(self.more, self._body, self._after)
        self._b.position_at_end(self._after)


def _prefetch(builder: Any, address: Any) -> None:
    byte = ir.IntType(8).as_pointer()
    kind = ir.FunctionType(ir.VoidType(), [byte, _I32, _I32, _I32])
    function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
    hints = [ir.Constant(_I32, value) for value in (0, 3, 1)]  # to read, keep near, data
    builder.call(function, [builder.inttoptr(address, byte), *hints])


def _projection(rows: int, vectors: int) -> Any:
    """Return the intrinsic that multiplies `rows` rows with a matrix of `vectors` * LANES columns.

    All sums stay in registers: rows * vectors of them, with one vector of the matrix each.
    """

    @intrinsic
    def project(  # type: ignore[no-untyped-def]
        context, values, stride, matrix, terms, out, ahead, ahead_step
    ):
        signature = types.void(*[types.intp] * 7)

        def generate(target: Any, b: Any, _: Any, arguments: Any) -> Any:
            values, stride, matrix, terms, out, ahead, ahead_step = arguments
            v = _Lanes(b, _DOUBLE, LANES, f"v{LANES}f64")
            width = 8 * LANES
            loop = _Loop(b, terms)
            sums = [[loop.carried(v.type, v.zero) for _ in range(vectors)] for _ in range(rows)]
            row = b.add(matrix, b.mul(loop.index, _integer(vectors * width)))
            columns = [v.load(b.add(row, _integer(j * width))) for j in range(vectors)]
            first_row = b.add(values, b.mul(loop.index, _integer(8)))
            pairs = []
            for k in range(rows):
                address = b.add(first_row, b.mul(stride, _integer(k)))
                value = v.splat(b.load(b.inttoptr(address, _DOUBLE.as_pointer()), align=8))
                pairs += [(s, v.fma(value, c, s)) for s, c in zip(sums[k], columns, strict=True)]
            _prefetch(b, b.add(ahead, b.mul(loop.index, ahead_step)))
            loop.close(pairs)
            for position, (_, total) in enumerate(pairs):
                v.store(total, b.add(out, _integer(position * width)))
            return target.get_dummy_value()

        return signature, generate

    return project


project_4_12 = _projection(rows=4, vectors=3)
"""``project_4_12(values, stride, matrix, terms, out, ahead, ahead_step)``: write the (4, 12)
products of 4 rows of float64 `values`, `stride` bytes apart, with the (terms, 12) `matrix`, each
summed over the terms in order; prefetch memory from the address `ahead` meanwhile."""
project_2_24 = _projection(rows=2, vectors=6)
project_1_24 = _projection(rows=1, vectors=6)
project_1_12 = _projection(rows=1, vectors=3)
project_1_8 = _projection(rows=1, vectors=2)
project_1_4 = _projection(rows=1, vectors=1)


def _decays(v: _Lanes, b: Any, e1: Any, e2: Any, e4: Any, e8: Any) -> list[Any]:
    """Return the powers 0 to `STRIDE` - 1 of a decay from bin to bin, as two vectors."""
    first = v.where(v.splat(v.cast(e1)), 1)
    for power, bit in ((e2, 2), (e4, 4)):
        first = b.fmul(first, v.where(v.splat(v.cast(power)), bit))
    return [first, b.fmul(first, v.splat(v.cast(e8)))]


@intrinsic
def _shape_moments(  # type: ignore[no-untyped-def]
    context, x, weights, values, envelope, steps, e1, e2, e4, e8, out
):
    """Write a shape to `out`; return its 3 x 3 products.

    They are those of 1, x and x^2 with the weighted shape, the weighted square of the shape, and
    the shape times the values, which are weighted. The shape is ``e1**i * envelope[i]``; arrays are
    addresses of float64, of `steps` steps of `STRIDE` bins. The others are as in `residuals`.
    """
    signature = types.UniTuple(types.float64, 9)(
        *[types.intp] * 5, *[types.float64] * 4, types.intp
    )

    def generate(target: Any, b: Any, _: Any, given: Any) -> Any:
        x, weights, values, envelope, steps, e1, e2, e4, e8, out = given
        v = _Lanes(b, _DOUBLE, _HALF, f"v{_HALF}f64")
        decays = _decays(v, b, e1, e2, e4, e8)
        e16 = b.fmul(e8, e8)
        loop = _Loop(b, steps)
        scale = loop.carried(_DOUBLE, ir.Constant(_DOUBLE, 1.0))
        carried = [loop.carried(v.type, v.zero) for _ in range(9)]
        factor, totals = v.splat(scale), list(carried)
        for half, decay in enumerate(decays):
            at = b.mul(loop.index, _integer(STRIDE * v.size))
            at = b.add(at, _integer(_HALF * v.size * half))
            distance = v.load(b.add(x, at))
            shape = b.fmul(b.fmul(factor, decay), v.load(b.add(envelope, at)))
            v.store(shape, b.add(out, at))
            weighted = b.fmul(shape, v.load(b.add(weights, at)))
            terms = (weighted, b.fmul(weighted, shape), b.fmul(shape, v.load(b.add(values, at))))
            for j, term in enumerate(terms):
                first = b.fmul(term, distance)
                totals[3 * j] = b.fadd(totals[3 * j], term)
                totals[3 * j + 1] = b.fadd(totals[3 * j + 1], first)
                totals[3 * j + 2] = v.fma(first, distance, totals[3 * j + 2])
        loop.close([(scale, b.fmul(scale, e16)), *zip(carried, totals, strict=True)])
        sums = [v.fold(total, b.fadd) for total in totals]
        return target.make_tuple(b, signature.return_type, sums)

    return signature, generate


shape_moments: Any = _shape_moments


def _residual_pass(*, single: bool) -> Any:
    @intrinsic
    def residual_pass(  # type: ignore[no-untyped-def]
        context, row, tail, steps, envelope, root, e1, e2, e4, e8, amplitude, background, out
    ):
        arguments = [types.intp] * 5 + [types.float64] * 6 + [types.intp]
        signature = types.UniTuple(types.float64, 2)(*arguments)

        def generate(target: Any, b: Any, _: Any, given: Any) -> Any:
            row, tail, steps, envelope, root, e1, e2, e4, e8, amplitude, background, out = given
            element = ir.FloatType() if single else _DOUBLE
            v = _Lanes(b, element, _HALF, f"v{_HALF}f{32 if single else 64}")
            level = v.splat(v.cast(background))
            decays = _decays(v, b, e1, e2, e4, e8)
            e16 = b.fmul(e8, e8)
            loop = _Loop(b, steps)
            scale = loop.carried(_DOUBLE, amplitude)
            energies = [loop.carried(v.type, v.zero) for _ in decays]
            largest = [loop.carried(v.type, v.zero) for _ in decays]
            offset = b.mul(loop.index, _integer(STRIDE * v.size))
            source = b.select(loop.more, b.add(row, offset), tail)
            factor = v.splat(v.cast(scale))
            pairs = [(scale, b.fmul(scale, e16))]
            for half, decay in enumerate(decays):
                step = _integer(_HALF * v.size * half)
                at = b.add(offset, step)
                signal = b.fneg(b.fmul(factor, decay))
                above = b.fsub(v.load(b.add(source, step)), level)
                residual = v.fma(signal, v.load(b.add(envelope, at)), above)
                residual = b.fmul(residual, v.load(b.add(root, at)))
                v.store(residual, b.add(out, at))
                pairs.append((energies[half], v.fma(residual, residual, energies[half])))
                pairs.append((largest[half], v.larger(v.absolute(residual), largest[half])))
            loop.close(pairs)
            (_, energy_0), (_, largest_0), (_, energy_1), (_, largest_1) = pairs[1:]
            energy = v.fold(b.fadd(energy_0, energy_1), b.fadd)
            peak = v.fold(v.larger(largest_0, largest_1), v.larger)
            return target.make_tuple(b, signature.return_type, (energy, peak))

        return signature, generate

    return residual_pass


_residuals_32 = _residual_pass(single=True)
_residuals_64 = _residual_pass(single=False)


def residuals(
    like: Any,
    row: int,
    tail: int,
    steps: int,
    envelope: int,
    root: int,
    e1: float,
    e2: float,
    e4: float,
    e8: float,
    amplitude: float,
    background: float,
    out: int,
) -> tuple[float, float]:
    """Return energy and largest of the weighted residuals of a row (compiled code only).

    Parameters
    ----------
    like : array
        Of the float type of the arrays at the addresses.
    row, tail, envelope, root, out : int
        Addresses. The row is read in `steps` steps of `STRIDE` bins, the last from `tail`; the
        others hold a multiple of `STRIDE`. `root` are square roots of weights, 0 beyond the
        end; `out` gets the weighted residuals.
    e1, e2, e4, e8 : float
        Powers 1, 2, 4, 8 of the decay of the signal from bin to bin.
    amplitude, background : float
        The signal is ``background + amplitude * e1**i * envelope[i]``.
    """
    raise TypeError("is for compiled code only, where numba replaces it by the overload below")


def _single(  # type: ignore[no-untyped-def]
    like, row, tail, steps, envelope, root, e1, e2, e4, e8, amplitude, background, out
):
    return _residuals_32(
        row, tail, steps, envelope, root, e1, e2, e4, e8, amplitude, background, out
    )


def _double(  # type: ignore[no-untyped-def]
    like, row, tail, steps, envelope, root, e1, e2, e4, e8, amplitude, background, out
):
    return _residuals_64(
        row, tail, steps, envelope, root, e1, e2, e4, e8, amplitude, background, out
    )


@overload(residuals, inline="always")
def _residuals(  # type: ignore[no-untyped-def]
    like, row, tail, steps, envelope, root, e1, e2, e4, e8, amplitude, background, out
):
    return _single if like.dtype == types.float32 else _double
