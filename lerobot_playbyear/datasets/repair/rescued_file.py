"""A parquet file whose end is lost, read as if it had another."""

import io
import os
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import pyarrow as pa


@dataclass(frozen=True)
class RescuedFile:
    """A parquet file that can be read with another end.

    Args:
        path: The file.
        length: How much of it is taken [bytes].
        end: What follows these.
    """

    path: Path
    length: int
    end: bytes

    def open(self) -> pa.NativeFile:
        """For reading."""
        return pa.PythonFile(_WithEnd(self), mode="r")


class _WithEnd(io.RawIOBase):
    """The bytes of a rescued file."""

    def __init__(self, rescued: RescuedFile) -> None:
        self._file = rescued.path.open("rb")
        self._length, self._end = rescued.length, rescued.end
        self._at = 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._at = offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self.size()}[whence]
        return self._at

    def tell(self) -> int:
        return self._at

    def size(self) -> int:
        return self._length + len(self._end)

    def read(self, size: int | None = -1, /) -> bytes:
        stop = self.size() if size is None or size < 0 else min(self._at + size, self.size())
        self._file.seek(min(self._at, self._length))
        data = self._file.read(max(min(stop, self._length) - self._at, 0))
        data += self._end[max(self._at - self._length, 0) : max(stop - self._length, 0)]
        self._at += len(data)
        return data

    def close(self) -> None:
        self._file.close()
        super().close()


class FileBytes:
    """A file's bytes, read where they are sliced. Not mapped: a disk that fails would end the process.

    Args:
        file: An opened file.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file, self._size = file, os.fstat(file.fileno()).st_size

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, span: slice) -> bytes:
        start, stop, _ = span.indices(self._size)
        self._file.seek(start)
        return self._file.read(stop - start)
