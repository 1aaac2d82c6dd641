"""CRC-32, fast, and of data put together from parts whose CRC is known, without reading them again.

`crc32(data, value=0)` is zlib's function: zlib-ng's where it is installed (it uses the processor's carry-less
multiplication: a quarter of the time for a picture), else the standard library's. Both give the same numbers.

Appending n zero bytes to data is a linear map of its CRC over GF(2); one 32×32 bit matrix per power of two
gives any n (the method of zlib's crc32_combine, M. Adler). Checked against `zlib.crc32` in a test.
"""

from __future__ import annotations

try:
    from zlib_ng.zlib_ng import crc32
except ImportError:
    from zlib import crc32

__all__ = ["crc32", "joined_crc"]

_POLYNOMIAL = 0xEDB88320
_BITS = 32
Matrix = tuple[int, ...]
"""Column i: what bit i of a CRC turns into."""
Tables = tuple[list[int], list[int], list[int], list[int]]


def _apply(matrix: Matrix, vector: int) -> int:
    total = 0
    for column in matrix:
        if not vector:
            break
        if vector & 1:
            total ^= column
        vector >>= 1
    return total


def _squared(matrix: Matrix) -> Matrix:
    return tuple(_apply(matrix, column) for column in matrix)


def _tables(matrix: Matrix) -> Tables:
    """The matrix times every value of each of a CRC's four bytes."""
    tables = []
    for first in range(0, _BITS, 8):
        table = [0] * 256
        for value in range(1, 256):
            lowest = value & -value
            table[value] = table[value ^ lowest] ^ matrix[first + lowest.bit_length() - 1]
        tables.append(table)
    return tables[0], tables[1], tables[2], tables[3]


def _zero_bytes() -> list[Tables]:
    """Operators for 1, 2, 4 … 2^40 zero bytes."""
    operator: Matrix = (_POLYNOMIAL, *(1 << i for i in range(_BITS - 1)))  # one zero bit
    for _ in range(3):
        operator = _squared(operator)
    operators = [_tables(operator)]
    for _ in range(40):
        operator = _squared(operator)
        operators.append(_tables(operator))
    return operators


_ZERO_BYTES = _zero_bytes()


def joined_crc(first_crc: int, second_crc: int, second_length: int) -> int:
    """CRC-32 of first + second from the two parts' CRCs; a few µs for any length."""
    crc = first_crc
    for power, (a, b, c, d) in enumerate(_ZERO_BYTES):
        if second_length >> power & 1:
            crc = a[crc & 255] ^ b[crc >> 8 & 255] ^ c[crc >> 16 & 255] ^ d[crc >> 24]
    return crc ^ second_crc
