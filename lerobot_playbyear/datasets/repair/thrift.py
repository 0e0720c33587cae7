"""The Thrift compact protocol: what parquet writes its headers and footers in. As much of it as parquet uses."""

import io
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

    def value(self, field: int) -> Any:
        """The value of a field; None where it is absent."""
        return self[field][1] if field in self else None


def read_struct(data: bytes) -> tuple[Struct, int]:
    """Reads the structure that some bytes begin with.

    Returns:
        The structure, and how many bytes it takes.

    Raises:
        ThriftError: There is none.
    """
    stream = io.BytesIO(data)
    try:
        return _read_value(STRUCT, stream, 0), stream.tell()
    except (IndexError, OverflowError) as error:
        raise ThriftError("the structure is cut off") from error


def write_struct(struct: Struct) -> bytes:
    """The bytes of a structure. In parquet the numbers of two neighbouring fields are never more than 15 apart."""
    out = bytearray()
    last = 0
    for field in sorted(struct):
        kind, value = struct[field]
        out.append(field - last << 4 | kind)
        if kind not in (BOOL_TRUE, BOOL_FALSE):  # their type says it all
            out += _write_value(kind, value)
        last = field
    out.append(0)
    return bytes(out)


def _read_struct(stream: io.BytesIO, depth: int) -> Struct:
    struct, last = Struct(), 0
    while head := stream.read(1)[0]:
        kind, delta = head & 15, head >> 4
        last = last + delta if delta else _read_integer(stream)
        is_bool = kind in (BOOL_TRUE, BOOL_FALSE)
        struct[last] = (kind, kind == BOOL_TRUE if is_bool else _read_value(kind, stream, depth + 1))
    return struct


def _read_value(kind: int, stream: io.BytesIO, depth: int) -> Any:
    if depth > _MAX_DEPTH:
        raise ThriftError("the structure is nested too deeply")
    if kind in (I16, I32, I64):
        return _read_integer(stream)
    if kind in (BYTE, BOOL_TRUE, BOOL_FALSE):
        return stream.read(1)[0]
    if kind == BINARY:
        size = _read_varint(stream)
        value = stream.read(size)
        if len(value) < size:
            raise ThriftError("a value is longer than the file")
        return value
    if kind == LIST:
        head = stream.read(1)[0]
        size = head >> 4 if head >> 4 != 15 else _read_varint(stream)
        return Elements(head & 15, [_read_value(head & 15, stream, depth + 1) for _ in range(size)])
    if kind == STRUCT:
        return _read_struct(stream, depth)
    raise ThriftError(f"type {kind} does not occur in parquet")


def _write_value(kind: int, value: Any) -> bytes:
    if kind in (I16, I32, I64):
        return _varint((value << 1) ^ (value >> 63))
    if kind in (BYTE, BOOL_TRUE, BOOL_FALSE):
        return bytes([value])
    if kind == BINARY:
        return _varint(len(value)) + value
    if kind == LIST:
        size = len(value.values)
        head = bytes([size << 4 | value.type]) if size < 15 else bytes([0xF0 | value.type]) + _varint(size)
        return head + b"".join(_write_value(value.type, element) for element in value.values)
    if kind == STRUCT:
        return write_struct(value)
    raise ThriftError(f"type {kind} does not occur in parquet")


def _read_integer(stream: io.BytesIO) -> int:
    number = _read_varint(stream)
    return (number >> 1) ^ -(number & 1)


def _read_varint(stream: io.BytesIO) -> int:
    number = 0
    for shift in range(0, 64, 7):
        byte = stream.read(1)[0]
        number |= (byte & 127) << shift
        if byte < 128:
            return number
    raise ThriftError("a number has more than 64 bits")


def _varint(number: int) -> bytes:
    out = bytearray()
    while number > 127:
        out.append(number & 127 | 128)
        number >>= 7
    out.append(number)
    return bytes(out)
