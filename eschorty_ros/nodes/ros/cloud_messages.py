"""Point clouds and images as messages, built from arrays without loops over elements."""

from __future__ import annotations

import struct
from array import array
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image, PointCloud2, PointField

from eschorty_ros.nodes.ros.conversions import stamp_from_ns

_POINT_FIELD_TYPES = {
    "u1": PointField.UINT8,
    "u2": PointField.UINT16,
    "u4": PointField.UINT32,
    "f4": PointField.FLOAT32,
    "f8": PointField.FLOAT64,
}
# In a serialized message, after the four bytes that name its encoding.
_STAMP_AT, _FRAME_AT = 4, 16


def _fill(field: array[int], values: NDArray[Any]) -> None:
    """Copy an array's bytes into a message's field, once: to set it would copy them again."""
    field.frombytes(np.ascontiguousarray(values).data.cast("B"))


def cloud_message(points: NDArray[Any], stamp_ns: int, frame_id: str) -> PointCloud2:
    """Return the ``PointCloud2`` of a structured array, field by field.

    A height map, shape (profiles, columns), is organised and not dense.
    """
    message = PointCloud2()
    message.header.stamp = stamp_from_ns(stamp_ns)
    message.header.frame_id = frame_id
    message.height, message.width = (1, *points.shape)[-2:]
    dtype = points.dtype
    message.fields = _point_fields(dtype)
    message.is_bigendian = False
    message.point_step = dtype.itemsize
    message.row_step = dtype.itemsize * message.width
    message.is_dense = points.ndim == 1
    if points.size:
        _fill(message.data, points)
    return message


def serialized_cloud(parts: Sequence[NDArray[Any]], stamp_ns: int, frame_id: str) -> bytes:
    """Return the ``cloud_message`` of vectors of points, one after the other, serialized.

    To serialize the message's objects costs several times what its points cost.
    """
    begin = bytearray(_serialized_empty(parts[0].dtype, frame_id))
    stamp = stamp_from_ns(stamp_ns)
    struct.pack_into("<iI", begin, _STAMP_AT, stamp.sec, stamp.nanosec)
    # The frame's text ends with a zero and is followed by height and width.
    width_at = _FRAME_AT + (len(frame_id) + 4) // 4 * 4 + 4
    struct.pack_into("<I", begin, width_at, sum(map(len, parts)))
    # At the end are row_step, the number of bytes of the points, the points, and is_dense.
    size = sum(part.nbytes for part in parts)
    struct.pack_into("<II", begin, len(begin) - 9, size, size)
    end = begin.pop()
    return b"".join((begin, *(part.view(np.uint8).data for part in parts), bytes((end,))))


@cache
def _serialized_empty(dtype: np.dtype[Any], frame_id: str) -> bytes:
    return bytes(serialize_message(cloud_message(np.empty(0, dtype), 0, frame_id)))


@cache
def _point_fields(dtype: np.dtype[Any]) -> list[PointField]:
    return [
        PointField(name=name, offset=offset, datatype=_POINT_FIELD_TYPES[kind.str[1:]], count=1)
        for name, (kind, offset, *_) in (dtype.fields or {}).items()
    ]


def points_from_message(message: PointCloud2, *, organized: bool = False) -> NDArray[Any]:
    """Return a cloud as a structured array with the message's fields.

    Of an organised one the points that are there; with ``organized`` all of it, as it is.
    """
    codes = {datatype: "<" + code for code, datatype in _POINT_FIELD_TYPES.items()}
    dtype = np.dtype(
        {
            "names": [field.name for field in message.fields],
            "formats": [codes[field.datatype] for field in message.fields],
            "offsets": [field.offset for field in message.fields],
            "itemsize": message.point_step,
        }
    )
    points = np.frombuffer(message.data, dtype=dtype, count=message.width * message.height)
    if organized and message.height > 1:
        return points.reshape(message.height, message.width)
    return points if message.is_dense else points[np.isfinite(points["x"])]


def image_message(pixels: NDArray[np.uint8], stamp_ns: int, frame_id: str) -> Image:
    """Return the ``mono8`` message of a (rows, columns) uint8 image."""
    message = Image()
    message.header.stamp = stamp_from_ns(stamp_ns)
    message.header.frame_id = frame_id
    message.height, message.width = pixels.shape
    message.encoding = "mono8"
    message.is_bigendian = 0
    message.step = message.width
    _fill(message.data, pixels)
    return message
