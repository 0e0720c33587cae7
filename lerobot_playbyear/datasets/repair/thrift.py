"""The Thrift compact protocol: what parquet writes its headers and footers in. As much of it as parquet uses."""

from dataclasses import dataclass
from typing import Any

BOOL_TRUE, BOOL_FALSE, BYTE, I16, I32, I64, DOUBLE, BINARY, LIST, SET, MAP, STRUCT = range(1, 13)

_MAX_DEPTH = 32


class ThriftError(ValueError):
    """The bytes are no Thrift structure."""


@dataclass
class Elements:
    """A list of values of one type."""

    type: int
    values: list[Any]


class Struct(dict[int, tuple[int, Any]]):
    """Fields by their number: type and value."""

    def value(self, field: int, default: Any = None) -> Any:
        """The value of a field, or `default` where it is absent."""
        return self[field][1] if field in self else default


def read_struct(data: bytes | memoryview, start: int = 0) -> tuple[Struct, int]:
    """Reads a structure.

    Args:
        data: The bytes.
        start: Where it begins.

    Returns:
        The structure, and where the next byte after it is.

    Raises:
        ThriftError: There is none.
    """
    try:
        return _read_struct(data, start, 0)
    except (IndexError, UnicodeDecodeError) as error:
        raise ThriftError("the structure is cut off") from error


def write_struct(struct: Struct) -> bytes:
    """The bytes of a structure."""
    out = bytearray()
    last = 0
    for field in sorted(struct):
        kind, value = struct[field]
        if kind in (BOOL_TRUE, BOOL_FALSE):
            kind = BOOL_TRUE if value else BOOL_FALSE
        delta = field - last
        if 0 < delta <= 15:
            out.append(delta << 4 | kind)
        else:
            out.append(kind)
            out += _varint(_zigzag(field))
        if kind not in (BOOL_TRUE, BOOL_FALSE):
            out += _write_value(kind, value)
        last = field
    out.append(0)
    return bytes(out)


def _read_struct(data: bytes | memoryview, at: int, depth: int) -> tuple[Struct, int]:
    if depth > _MAX_DEPTH:
        raise ThriftError("the structure is nested too deeply")
    struct, last = Struct(), 0
    while True:
        head = data[at]
        at += 1
        if head == 0:
            return struct, at
        kind, delta = head & 15, head >> 4
        if delta:
            last += delta
        else:
            number, at = _read_varint(data, at)
            last = _unzigzag(number)
        if kind in (BOOL_TRUE, BOOL_FALSE):
            struct[last] = (kind, kind == BOOL_TRUE)
        else:
            value, at = _read_value(kind, data, at, depth)
            struct[last] = (kind, value)


def _read_value(kind: int, data: bytes | memoryview, at: int, depth: int) -> tuple[Any, int]:
    if kind in (I16, I32, I64):
        number, at = _read_varint(data, at)
        return _unzigzag(number), at
    if kind in (BYTE, BOOL_TRUE, BOOL_FALSE):
        return data[at], at + 1
    if kind == DOUBLE:
        return _read_bytes(data, at, 8)
    if kind == BINARY:
        size, at = _read_varint(data, at)
        return _read_bytes(data, at, size)
    if kind in (LIST, SET):
        head = data[at]
        size, at = (head >> 4, at + 1) if head >> 4 != 15 else _read_varint(data, at + 1)
        if size > len(data) - at:
            raise ThriftError("a list is longer than the file")
        elements = Elements(head & 15, [])
        for _ in range(size):
            value, at = _read_value(elements.type, data, at, depth + 1)
            elements.values.append(value)
        return elements, at
    if kind == STRUCT:
        return _read_struct(data, at, depth + 1)
    raise ThriftError(f"type {kind} does not occur in parquet")


def _write_value(kind: int, value: Any) -> bytes:
    if kind in (I16, I32, I64):
        return _varint(_zigzag(value))
    if kind in (BYTE, BOOL_TRUE, BOOL_FALSE):
        return bytes([value])
    if kind == DOUBLE:
        return value
    if kind == BINARY:
        return _varint(len(value)) + value
    if kind in (LIST, SET):
        size = len(value.values)
        head = bytes([size << 4 | value.type]) if size < 15 else bytes([0xF0 | value.type]) + _varint(size)
        return head + b"".join(_write_value(value.type, element) for element in value.values)
    if kind == STRUCT:
        return write_struct(value)
    raise ThriftError(f"type {kind} does not occur in parquet")


def _read_bytes(data: bytes | memoryview, at: int, size: int) -> tuple[bytes, int]:
    if size > len(data) - at:
        raise ThriftError("a value is longer than the file")
    return bytes(data[at : at + size]), at + size


def _read_varint(data: bytes | memoryview, at: int) -> tuple[int, int]:
    number = shift = 0
    while True:
        byte = data[at]
        at += 1
        number |= (byte & 127) << shift
        if byte < 128:
            return number, at
        shift += 7
        if shift > 63:
            raise ThriftError("a number has more than 64 bits")


def _varint(number: int) -> bytes:
    out = bytearray()
    while number > 127:
        out.append(number & 127 | 128)
        number >>= 7
    out.append(number)
    return bytes(out)


def _zigzag(number: int) -> int:
    return number << 1 if number >= 0 else (-number << 1) - 1


def _unzigzag(number: int) -> int:
    return number >> 1 if not number & 1 else -(number + 1 >> 1)
