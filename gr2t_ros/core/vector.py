# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The two innermost loops of the voxel density, written for eight and four floats at a time.

The compiler does not find these vectors by itself: a window of eight columns is too short for its
loop vectoriser, and the 64 taps of a spline are too scattered. Vectors of eight or four floats
exist in LLVM on every machine; where the processor has narrower ones, they are split.
"""
from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
import numpy as np
from numpy.typing import NDArray

LANES = 8
ROW = 12  # coefficients stored for a row of eight voxels: three of the next block, one spare

_FLOAT, _I32, _I64 = ir.FloatType(), ir.IntType(32), ir.IntType(64)


_THREE_FLOATS: Any = types.containers.UniTuple(types.float32, 3)  # type: ignore[no-untyped-call]
_declared: Callable[..., Any] = cgutils.get_or_insert_function


class _Vectors:
    """Builds operations on vectors of a number of floats."""

    def __init__(self, builder: Any, lanes: int) -> None:
        self.builder = builder
        self.lanes = lanes
        self.type = ir.VectorType(_FLOAT, lanes)
        self._operations: dict[str, Any] = {}

    def constant(self, value: float) -> Any:
        return ir.Constant(self.type, [ir.Constant(_FLOAT, float(np.float32(value)))] * self.lanes)

    def constants(self, values: NDArray[np.float64]) -> Any:
        return ir.Constant(self.type, [ir.Constant(_FLOAT, float(np.float32(x))) for x in values])

    def splat(self, scalar: Any) -> Any:
        undefined = ir.Constant(self.type, ir.Undefined)
        return self.spread(
            self.builder.insert_element(undefined, scalar, ir.Constant(_I32, 0)), 0)

    def spread(self, vector: Any, lane: int) -> Any:
        undefined = ir.Constant(self.type, ir.Undefined)
        lanes = ir.Constant(ir.VectorType(_I32, self.lanes), [lane] * self.lanes)
        return self.builder.shuffle_vector(vector, undefined, lanes)

    def load(self, pointer: Any, index: Any) -> Any:
        place = self.builder.gep(pointer, [index])
        vector = self.builder.load(self.builder.bitcast(place, self.type.as_pointer()))
        vector.align = 4
        return vector

    def store(self, vector: Any, pointer: Any, index: Any) -> None:
        place = self.builder.gep(pointer, [index])
        self.builder.store(
            vector, self.builder.bitcast(place, self.type.as_pointer()), align=4)

    def splat_of(self, pointer: Any, index: Any) -> Any:
        return self.splat(self.builder.load(self.builder.gep(pointer, [index])))

    def multiply_add(self, a: Any, b: Any, c: Any) -> Any:
        return self._call('llvm.fmuladd', a, b, c)

    def minimum(self, a: Any, b: Any) -> Any:
        return self._call('llvm.minnum', a, b)

    def maximum(self, a: Any, b: Any) -> Any:
        return self._call('llvm.maxnum', a, b)

    def total(self, vector: Any) -> Any:
        function = _declared(
            self.builder.module, ir.FunctionType(_FLOAT, [_FLOAT, self.type]),
            f'llvm.vector.reduce.fadd.v{self.lanes}f32')
        zero = ir.Constant(_FLOAT, 0.0)
        return self.builder.call(function, [zero, vector], fastmath=['reassoc'])

    def _call(self, name: str, *arguments: Any) -> Any:
        function = _declared(
            self.builder.module, ir.FunctionType(self.type, [self.type] * len(arguments)),
            f'{name}.v{self.lanes}f32')
        return self.builder.call(function, arguments)


def _pointers(
    context: Any, builder: Any, signature: Any, arguments: Any
) -> Callable[[int], Any]:
    """Return a function from an argument's number to the address of that array's data."""
    def pointer(number: int) -> Any:
        array = context.make_array(signature.args[number])
        return array(context, builder, arguments[number]).data
    return pointer


@intrinsic
def _window_strip(  # type: ignore[no-untyped-def]
    typing_context, image, first, stride, rows, row, count, columns, column, at
):
    """
    Sum rows[row + r] columns[column + a] g(image[first + r stride + a] - at), r < count, a < 8.

    g(x) = exp(-16 x^2), to 2.6e-4 of its peak and zero beyond |x| = 0.88: what is stored is a
    residual over its bandwidth and sqrt(32). Arrays are flat float32; count is even.
    """
    signature = types.float32(
        image, types.int64, types.int64, rows, types.int64, types.int64, columns, types.int64,
        types.float32)

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        pointer = _pointers(context, builder, signature, arguments)
        image, rows, columns = pointer(0), pointer(3), pointer(6)
        first, stride, row, count, column = (arguments[i] for i in (1, 2, 4, 5, 7))
        v = _Vectors(builder, LANES)
        at = v.splat(arguments[8])

        def with_row(index: Any, row: Any, total: Any) -> Any:
            x = builder.fsub(v.load(image, index), at)
            y = v.minimum(builder.fmul(x, x), v.constant(25 / 32))
            # exp(-16 y) = (1 - y + y^2/2 - ...)^16, its cubic fitted to the whole range
            p = v.multiply_add(y, v.constant(0.12456328), v.constant(-0.48643234))
            p = v.multiply_add(y, p, v.constant(0.99880067))
            p = v.multiply_add(builder.fneg(y), p, v.constant(1.0))
            for _ in range(4):
                p = builder.fmul(p, p)
            return v.multiply_add(p, v.splat_of(rows, row), total)

        # two rows a pass, so that one's additions wait less for the other's
        before = builder.block
        loop, after = builder.append_basic_block('rows'), builder.append_basic_block('after')
        builder.branch(loop)
        builder.position_at_end(loop)
        done, index = builder.phi(_I64), builder.phi(_I64)
        even, odd = builder.phi(v.type), builder.phi(v.type)
        new_even = with_row(index, builder.add(row, done), even)
        new_odd = with_row(
            builder.add(index, stride),
            builder.add(builder.add(row, done), ir.Constant(_I64, 1)), odd)
        new_done = builder.add(done, ir.Constant(_I64, 2))
        new_index = builder.add(index, builder.add(stride, stride))
        for phi, initial, new in (
                (done, ir.Constant(_I64, 0), new_done), (index, first, new_index),
                (even, v.constant(0), new_even), (odd, v.constant(0), new_odd)):
            phi.add_incoming(initial, before)
            phi.add_incoming(new, builder.block)
        builder.cbranch(builder.icmp_signed('<', new_done, count), loop, after)
        builder.position_at_end(after)
        return v.total(builder.fmul(builder.fadd(new_even, new_odd), v.load(columns, column)))

    return signature, generate


@intrinsic
def _agreement(  # type: ignore[no-untyped-def]
    typing_context, image, first, stride, weights, middle, out
):
    """
    Bound from below what the 24 pixels about each of eight neighbours add up to at its depth.

    out[a] = sum weights[middle + r] weights[middle + c] max(1 - 16 x^2, 0), r and c from -2 to 2
    but not both 0, x = image[first + a + r stride + c] - image[first + a], a < 8: exp(-16 x^2) is
    not less. Arrays are flat float32.
    """
    signature = types.void(image, types.int64, types.int64, weights, types.int64, out)

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        pointer = _pointers(context, builder, signature, arguments)
        first, stride, middle = arguments[1], arguments[2], arguments[4]
        v = _Vectors(builder, LANES)
        centre = v.load(pointer(0), first)
        weights = [
            v.splat_of(pointer(3), builder.add(middle, ir.Constant(_I64, c)))
            for c in range(-2, 3)]
        total = v.constant(0)
        for r in range(-2, 3):
            start = builder.add(first, builder.mul(stride, ir.Constant(_I64, r)))
            row = v.constant(0)
            for c in range(-2, 3):
                if r == 0 and c == 0:
                    continue
                pixels = v.load(pointer(0), builder.add(start, ir.Constant(_I64, c)))
                x = builder.fsub(pixels, centre)
                kernel = v.multiply_add(builder.fmul(x, x), v.constant(-16), v.constant(1))
                row = v.multiply_add(
                    weights[c + 2], v.maximum(kernel, v.constant(0)), row)
            total = v.multiply_add(weights[r + 2], row, total)
        v.store(total, pointer(5), ir.Constant(_I64, 0))
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def _five_taps(  # type: ignore[no-untyped-def]
    typing_context, source, first, step, tap0, tap1, tap2, out, to
):
    """
    Filter eight values: out[to + a] = tap0 s[2] + tap1 (s[1] + s[3]) + tap2 (s[0] + s[4]), a < 8.

    s[k] = source[first + a + k step]. Arrays are flat float32, and do not overlap.
    """
    signature = types.void(
        source, types.int64, types.int64, types.float32, types.float32, types.float32, out,
        types.int64)

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        pointer = _pointers(context, builder, signature, arguments)
        v = _Vectors(builder, LANES)
        first, step = arguments[1], arguments[2]
        tap0, tap1, tap2 = (v.splat(tap) for tap in arguments[3:6])
        s = []
        for _ in range(5):
            s.append(v.load(pointer(0), first))
            first = builder.add(first, step)
        total = builder.fmul(tap2, builder.fadd(s[0], s[4]))
        total = v.multiply_add(tap1, builder.fadd(s[1], s[3]), total)
        v.store(v.multiply_add(tap0, s[2], total), pointer(6), arguments[7])
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def _copy_eight(typing_context, source, first, out, to):  # type: ignore[no-untyped-def]
    """Copy source[first + a] to out[to + a], a < 8. Arrays are flat float32."""
    signature = types.void(source, types.int64, out, types.int64)

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        pointer = _pointers(context, builder, signature, arguments)
        v = _Vectors(builder, LANES)
        v.store(v.load(pointer(0), arguments[1]), pointer(2), arguments[3])
        return context.get_dummy_value()

    return signature, generate


# The spline's four taps as polynomials of the fraction: rows are powers, columns taps. The kernel
# is the cubic B-spline plus 1/42 of its second derivative (O-MOMS of degree 3: Blu, Thevenaz,
# Unser 2001): no four taps have less error. It is continuous; its derivative has small steps at
# the voxels.
SPLINE = (
    np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6
    + np.array([[1, -2, 1, 0], [-1, 3, -3, 1], [0, 0, 0, 0], [0, 0, 0, 0]]) / 42)


@intrinsic
def _spline_jet(  # type: ignore[no-untyped-def]
    typing_context, coefficients, bases, x, y, z, at_x, at_y, at_z, along_x, along_y, along_z
):
    """
    Contract 4 x 4 x 4 spline coefficients to a value and its two derivatives along a ray.

    :param coefficients: flat float32; a block is 8 (z) x 8 (y) x ROW (x)
    :param bases: (4,) int64: where the block of the first tap begins, the next in y, in z, in both
    :param x: the first tap within its block, 0 to 7; likewise y, z
    :param at_x: fraction of the way from the second tap to the third, float32
    :param along_x: the ray's component, voxels per unit, float32
    """
    signature = _THREE_FLOATS(
        coefficients, bases, types.int64, types.int64, types.int64, *[types.float32] * 6)

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        pointer = _pointers(context, builder, signature, arguments)
        coefficients, bases = pointer(0), pointer(1)
        x, y, z = arguments[2:5]
        v = _Vectors(builder, 4)

        def whole(value: int) -> Any:
            return ir.Constant(_I64, value)

        def weights(at: Any, along: Any) -> list[Any]:
            """Return the four taps' weights, their first and their second derivatives."""
            at, along = v.splat(at), v.splat(along)
            orders = []
            powers = SPLINE
            for order in range(3):
                total = v.constants(powers[-1])
                for row in powers[-2::-1]:
                    total = v.multiply_add(total, at, v.constants(row))
                for _ in range(order):
                    total = builder.fmul(total, along)
                orders.append(total)
                powers = powers[1:] * np.arange(1, len(powers))[:, None]
            return orders

        def place(first: Any, tap: int, step: int, bit: int) -> tuple[Any, Any]:
            """Return a tap's offset within its block, and its part of the block's number."""
            at = builder.add(first, whole(tap))
            inside = builder.mul(builder.and_(at, whole(7)), whole(step))
            return inside, builder.shl(builder.lshr(at, whole(3)), whole(bit))

        in_y = [place(y, tap, ROW, 0) for tap in range(4)]
        in_z = [place(z, tap, 8 * ROW, 1) for tap in range(4)]
        of_x, of_y, of_z = (
            weights(arguments[5 + axis], arguments[8 + axis]) for axis in range(3))
        each_z = [[v.spread(of_z[order], tap) for tap in range(4)] for order in range(3)]
        # jets (value, first, second derivative) multiply like polynomials: z, then y, then x
        total = [v.constant(0)] * 3
        for tap_y, (offset_y, block_y) in enumerate(in_y):
            line = [v.constant(0)] * 3
            for tap_z, (offset_z, block_z) in enumerate(in_z):
                base = builder.load(builder.gep(bases, [builder.add(block_z, block_y)]))
                row = v.load(
                    coefficients,
                    builder.add(builder.add(base, x), builder.add(offset_z, offset_y)))
                line = [
                    v.multiply_add(row, each_z[order][tap_z], line[order]) for order in range(3)]
            w0, w1, w2 = (v.spread(of_y[order], tap_y) for order in range(3))
            twice_w1 = builder.fadd(w1, w1)
            total = [
                v.multiply_add(w0, line[0], total[0]),
                v.multiply_add(w1, line[0], v.multiply_add(w0, line[1], total[1])),
                v.multiply_add(w2, line[0], v.multiply_add(
                    twice_w1, line[1], v.multiply_add(w0, line[2], total[2])))]
        w0, w1, w2 = of_x
        twice_w1 = builder.fadd(w1, w1)
        jet = [
            builder.fmul(w0, total[0]),
            v.multiply_add(w1, total[0], builder.fmul(w0, total[1])),
            v.multiply_add(w2, total[0], v.multiply_add(
                twice_w1, total[1], builder.fmul(w0, total[2])))]
        return context.make_tuple(builder, signature.return_type, [v.total(part) for part in jet])

    return signature, generate


# for type checkers: callers do not pass the first argument
window_strip: Callable[..., np.float32] = _window_strip
agreement: Callable[..., None] = _agreement
five_taps: Callable[..., None] = _five_taps
copy_eight: Callable[..., None] = _copy_eight
spline_jet: Callable[..., tuple[np.float32, np.float32, np.float32]] = _spline_jet
